r"""Compiled body of a barometer's offset: a fifth state of the vertical axis.

A barometer measures :math:`z = p + o + w`: the height p, an offset o that nobody knows at the start and that
wanders with the weather and with the sensor, and white noise w. What the offset has in common with the
axis' four states (:mod:`napf_mpc.navigation.kalman`) is kept beside them, so that an axis without a barometer
costs nothing: as the fix's errors are told from the position, so is the offset, and then holds the height
where no fix comes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled, compiled_bare

__all__ = ["NUMBERS", "VERTICAL", "begin", "carry", "follow", "follow_alarm", "learn", "take_in_heights"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MEAN, OP, OV, OG, OB, OO = range(6)
"""Numbers of an offset: its estimate, what it has in common with p, v, g and b, and its variance."""
NUMBERS = 6
VERTICAL = 2


@compiled_bare
def begin(offset: Array, variance: float) -> None:
    """Know nothing of an offset but the variance of its law [m^2]; infinite: nothing at all."""
    offset[:] = 0.0
    offset[OO] = variance


@compiled_bare
def _tell(offset: Array, x: Array, c: Array, height: float, noise: float) -> None:
    """Take an offset of which nothing is known from one height: what the position is off, it is off too."""
    offset[MEAN] = height - x[0]
    for n in range(4):
        offset[OP + n] = -c[n]
    offset[OO] = c[0] + noise


@compiled_bare
def learn(offset: Array, k: Array, h_p: float, h_v: float, h_g: float, spread: float, miss: float) -> None:
    """Take in a measurement of ``h_p p + h_v v + h_g g`` that moved the four states with gains ``k``."""
    seen = h_p * offset[OP] + h_v * offset[OV] + h_g * offset[OG]
    offset[MEAN] += seen / spread * miss
    offset[OO] -= seen / spread * seen
    for n in range(4):
        offset[OP + n] -= k[n] * seen


@compiled_bare
def follow(offset: Array, pp: float, pv: float, pg: float, pb: float, c: Array, moved: float) -> None:
    """Take in that what is known of the position changed, and nothing else.

    The other states did not follow; the offset does, as far as its error is the position's: by
    :math:`P_{op} / P_{pp}` of what that changed, whether less is known now or more.

    Parameters
    ----------
    offset : array, shape (6,)
        Overwritten.
    pp, pv, pg, pb : float
        Variance of the position before, and what it had in common with the other states.
    c : array, shape (10,)
        Covariance of the states now.
    moved : float
        How far the estimate of the position moved [m].
    """
    if pp <= 0.0:
        return
    rate = offset[OP] / pp
    offset[MEAN] += rate * moved
    offset[OO] += rate * rate * (c[0] - pp)
    offset[OP] = rate * c[0]
    offset[OV] += rate * (c[1] - pv)
    offset[OG] += rate * (c[2] - pg)
    offset[OB] += rate * (c[3] - pb)


@compiled
def follow_alarm(packed: Array, offset: Array, root: Array) -> None:
    """Let offsets follow positions that turn out less certain, before these are told so, in place.

    Parameters
    ----------
    packed, offset : array, shape (run, uav, 3, 10) and (run, uav, 6)
        Covariances before; offsets are overwritten.
    root : array, shape (run, uav)
        Factor on the sigma of the height, and on what it has in common with the other states; at least 1.
    """
    after = np.empty(4)
    for r in range(offset.shape[0]):
        for i in range(offset.shape[1]):
            if root[r, i] == 1.0:
                continue
            c = packed[r, i, VERTICAL]
            for n in range(4):
                after[n] = root[r, i] * c[n]
            after[0] *= root[r, i]
            follow(offset[r, i], c[0], c[1], c[2], c[3], after, 0.0)


@compiled
def carry(offset: Array, period_s: float, bias_memory: float, drift: float, active: Mask) -> None:
    """Carry what offsets have in common with the states over a tick, in place.

    Parameters
    ----------
    offset : array, shape (run, uav, 6)
        Overwritten.
    period_s, bias_memory : float
        As in :func:`napf_mpc.navigation.kalman.predict`.
    drift : float
        Variance by which an offset wanders in a tick [m^2].
    active : array of bool, shape (run,)
        Runs to carry on.
    """
    for r in range(offset.shape[0]):
        if not active[r]:
            continue
        for i in range(offset.shape[1]):
            o = offset[r, i]
            o[OP] += period_s * o[OV] - 0.5 * period_s * period_s * o[OB]
            o[OV] -= period_s * o[OB]
            o[OB] *= bias_memory
            o[OO] += drift


@compiled
def take_in_heights(
    mean: Array,
    packed: Array,
    offset: Array,
    height: Array,
    noise: float,
    gate: float,
    begun: Mask,
    active: Mask,
) -> None:
    """Update the vertical axes with one height each, in place.

    A height that leaps, farther than ``gate`` of its sigmas from what is expected, is one with a new offset,
    of which it alone tells. One that is not finite is none.

    Parameters
    ----------
    mean, packed : array, shape (run, uav, 3, 4) and (run, uav, 3, 10)
        As in :mod:`napf_mpc.navigation.kalman`; the vertical axes are overwritten.
    offset : array, shape (run, uav, 6)
        Overwritten.
    height : array, shape (run, uav)
        Measured [m].
    noise : float
        Variance of the white noise [m^2].
    gate : float
        Largest innovation in its sigmas; 0 for none.
    begun : array of bool, shape (run, uav)
        UAVs whose filter has begun; the others have no height to compare with.
    active : array of bool, shape (run,)
        Runs that fly.
    """
    seen = np.empty(4)
    for r in range(offset.shape[0]):
        if not active[r]:
            continue
        for i in range(offset.shape[1]):
            if not (begun[r, i] and np.isfinite(height[r, i])):
                continue
            x, c, o = mean[r, i, VERTICAL], packed[r, i, VERTICAL], offset[r, i]
            miss = height[r, i] - x[0] - o[MEAN]
            spread = c[0] + 2.0 * o[OP] + o[OO] + noise
            if o[OO] == np.inf or (gate > 0.0 and miss * miss > gate * gate * spread):
                _tell(o, x, c, height[r, i], noise)
                continue
            for n in range(4):
                seen[n] = c[n] + o[OP + n]
            own = o[OP] + o[OO]
            for n in range(4):
                x[n] += seen[n] / spread * miss
                o[OP + n] -= seen[n] / spread * own
            o[MEAN] += own / spread * miss
            o[OO] -= own / spread * own
            n = 0
            for row in range(4):
                for column in range(row, 4):
                    c[n] -= seen[row] / spread * seen[column]
                    n += 1
