r"""What the estimation errors of two UAVs, or of two axes of one, have in common.

The filter treats each axis of each UAV apart, but the errors of its fixes are shared in part. With the
transition :math:`A_i` of an estimation error from one epoch of fixes to the next and its answer :math:`w_i`
to the new part of its fix's error, both known from the filter's gains, the covariance of two such errors is

.. math:: M_{ij}' = A_i M_{ij} A_j^T + \rho\, w_i w_j^T,

exactly, rho being the correlation of the two fixes' errors. It is no product :math:`L_i L_j` of two numbers:
the gains follow sigma, so UAVs whose sigmas swing apart answer to the same error at different times.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled, compiled_bare

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAX_UAVS = 16
"""Largest formation whose common part is followed; the effort grows with the square of the number.

In a larger one no part counts as shared. Distances between UAVs are then reported less certain than they are,
never more (but for the small negative correlations that differing gains may cause).
"""
AXIS_PAIRS = ((0, 1), (0, 2), (1, 2))


@compiled
def advance_pairs(
    common: Array, carried: Array, response: Array, share: Array, begun: Mask, active: Mask
) -> None:
    """Carry the covariance between UAVs, axis by axis, from one epoch of fixes to the next, in place.

    Parameters
    ----------
    common : array, shape (run, 3, uav, uav, 4, 4)
        Covariance of the estimation errors that comes from common errors of fixes; only i <= j is used. On
        the diagonal of the UAVs it is the part of a UAV's own covariance that has this cause.
    carried, response : array, shapes (run, uav, 3, 4, 4) and (run, uav, 3, 4)
        From :func:`napf_mpc.navigation.kalman.correct`.
    share : array, shape (3,)
        Share of the variance of each axis' error that is common.
    begun : array of bool, shape (run, uav)
        UAVs whose filter began at this epoch. With one that did not, it shares nothing yet.
    active : array of bool, shape (run,)
        Runs that fly.
    """
    half = np.empty((4, 4))
    for r in range(common.shape[0]):
        if not active[r]:
            continue
        for a in range(3):
            if share[a] == 0.0:
                continue
            for i in range(common.shape[2]):
                for j in range(i, common.shape[2]):
                    m = common[r, a, i, j]
                    if begun[r, i] != begun[r, j]:
                        m[:] = 0.0
                    else:
                        _advance(
                            m, carried[r, i, a], carried[r, j, a], response[r, i, a], response[r, j, a],
                            share[a], half,
                        )  # fmt: skip


@compiled
def factorise(common: Array, since: Array, factor: Array) -> None:
    """Write factors L_i of the common position covariances: Sigma_ij = L_i L_j^T for i != j, exactly.

    Parameters
    ----------
    common : array, shape (run, 3, uav, uav, 4, 4)
        As :func:`advance_pairs` keeps it, at the last epoch of fixes.
    since : array, shape (4, 4)
        Transition of each axis from that epoch to now. Variances may fall meanwhile, and what is common of
        them must fall with them.
    factor : array, shape (run, uav, 3, 3 uav)
        Out; zeros come in. Axis a uses the columns from ``a uav`` on, as Cholesky's triangle.
    """
    uavs = common.shape[2]
    for r in range(common.shape[0]):
        for a in range(3):
            for j in range(uavs):
                whole = _position_now(common[r, a, j, j], since)
                left = whole
                for n in range(j):
                    left -= factor[r, j, a, a * uavs + n] ** 2
                # A UAV that adds nothing of its own to the others (all begin alike) leaves a rounding error.
                if not left > 1e-12 * whole:
                    continue
                pivot = np.sqrt(left)
                factor[r, j, a, a * uavs + j] = pivot
                for i in range(j + 1, uavs):
                    rest = _position_now(common[r, a, j, i], since)
                    for n in range(j):
                        rest -= factor[r, i, a, a * uavs + n] * factor[r, j, a, a * uavs + n]
                    factor[r, i, a, a * uavs + j] = rest / pivot


@compiled
def advance_axes(cross: Array, carried: Array, response: Array, correlation: Array, active: Mask) -> None:
    """Carry the covariance between the axes of each UAV from one epoch of fixes to the next, in place.

    Parameters
    ----------
    cross : array, shape (run, uav, 3, 4, 4)
        Covariance between the axes of :data:`AXIS_PAIRS`.
    carried, response : array, shapes (run, uav, 3, 4, 4) and (run, uav, 3, 4)
        From :func:`napf_mpc.navigation.kalman.correct`.
    correlation : array, shape (run, uav, 3)
        Reported correlation of the fix between the same axes.
    active : array of bool, shape (run,)
        Runs that fly.
    """
    half = np.empty((4, 4))
    for r in range(cross.shape[0]):
        if not active[r]:
            continue
        for i in range(cross.shape[1]):
            for n in range(3):
                a, b = (0, n + 1) if n < 2 else (1, 2)
                _advance(
                    cross[r, i, n], carried[r, i, a], carried[r, i, b], response[r, i, a], response[r, i, b],
                    correlation[r, i, n], half,
                )  # fmt: skip


@compiled
def report_axes(cross: Array, since: Array, covariance: Array) -> None:
    """Write the covariance between axes into that of position and velocity.

    Parameters
    ----------
    cross : array, shape (run, uav, 3, 4, 4)
        As :func:`advance_axes` keeps it, at the last epoch of fixes.
    since : array, shape (4, 4)
        Transition of each axis from that epoch to now.
    covariance : array, shape (run, uav, 6, 6)
        Out: only entries between axes are written.
    """
    for r in range(cross.shape[0]):
        for i in range(cross.shape[1]):
            for n in range(3):
                a, b = (0, n + 1) if n < 2 else (1, 2)
                for p in range(2):
                    for q in range(2):
                        value = 0.0
                        for k in range(4):
                            for m in range(4):
                                value += since[p, k] * cross[r, i, n, k, m] * since[q, m]
                        covariance[r, i, 3 * p + a, 3 * q + b] = value
                        covariance[r, i, 3 * q + b, 3 * p + a] = value


@compiled_bare
def _position_now(m: Array, since: Array) -> float:
    """Entry of two positions in F m F^T."""
    value = 0.0
    for row in range(4):
        for column in range(4):
            value += since[0, row] * m[row, column] * since[0, column]
    return value


@compiled_bare
def _advance(m: Array, f: Array, g: Array, v: Array, w: Array, correlation: float, half: Array) -> None:
    """Replace m by f m g^T + correlation v w^T."""
    for row in range(4):
        f0, f1, f2, f3 = f[row, 0], f[row, 1], f[row, 2], f[row, 3]
        for column in range(4):
            half[row, column] = f0 * m[0, column] + f1 * m[1, column] + f2 * m[2, column] + f3 * m[3, column]
    for column in range(4):
        g0, g1, g2, g3 = g[column, 0], g[column, 1], g[column, 2], g[column, 3]
        scale = correlation * w[column]
        for row in range(4):
            m[row, column] = (
                half[row, 0] * g0 + half[row, 1] * g1 + half[row, 2] * g2 + half[row, 3] * g3
            ) + scale * v[row]
