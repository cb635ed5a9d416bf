r"""Compiled body of the navigation filter: four states on each axis of each UAV.

States of an axis, in this order: position p [m], velocity v [m/s], the position fix's error in units of its
sigma g, accelerometer bias b [m/s^2]. The covariance is symmetric; its ten different numbers are kept, row by
row. Over a tick with the measured velocity change :math:`\Delta v`

.. math:: p' = p + dt\,v + \tfrac12 dt\,(\Delta v - dt\,b), \quad
          v' = v + \Delta v - dt\,b, \quad b' = \phi_b b

and from one epoch of fixes to the next :math:`g' = \phi g + \sqrt{1 - \phi^2}\,w`. A fix measures
:math:`p + \sigma g` and v.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.navigation import height_offset

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STATES = 4
PACKED = 10
"""Numbers of a symmetric 4x4 covariance: pp, pv, pg, pb, vv, vg, vb, gg, gb, bb."""

NO_FIX, USED, BEGUN, REFUSED = 0, 1, 2, -1
"""What :func:`correct` made of a fix."""
OUTVOTED = 3
"""The point-mass filter's verdict on a fix that is used, but so far off that it counts for little."""
PULL = 2.0
"""Distance in the estimate's own sigmas up to which a fix moves it no more than it claims to know."""


def drift(period_s: float, bias_memory: float) -> Array:
    """Transition matrix (4, 4) of an axis over a tick, as :func:`predict` applies it."""
    f = np.eye(STATES)
    f[0, 1], f[0, 3] = period_s, -0.5 * period_s * period_s
    f[1, 3] = -period_s
    f[3, 3] = bias_memory
    return f


@compiled
def predict(
    mean: Array,
    packed: Array,
    velocity_change: Array,
    period_s: float,
    bias_memory: float,
    velocity_noise: float,
    bias_noise: float,
    active: Mask,
) -> None:
    """Carry every axis over a tick, in place.

    Parameters
    ----------
    mean, packed : array, shape (run, uav, 3, 4) and (run, uav, 3, 10)
        States and their covariance; overwritten.
    velocity_change : array, shape (run, uav, 3)
        As the accelerometers measured it over the tick [m/s].
    period_s : float
        Length of the tick [s].
    bias_memory : float
        phi_b, correlation of the bias over a tick.
    velocity_noise, bias_noise : float
        Variances of the noise in a velocity change [m^2/s^2], and of what is new in the bias [m^2/s^4].
    active : array of bool, shape (run,)
        Runs to carry on.
    """
    dt, phi, w = period_s, bias_memory, velocity_noise
    h = 0.5 * dt * dt
    for r in range(mean.shape[0]):
        if not active[r]:
            continue
        for i in range(mean.shape[1]):
            for a in range(3):
                x = mean[r, i, a]
                gain = velocity_change[r, i, a] - dt * x[3]
                x[0] += dt * (x[1] + 0.5 * gain)
                x[1] += gain
                x[3] *= phi
                c = packed[r, i, a]
                pp, pv, pg, pb = c[0], c[1], c[2], c[3]
                vv, vg, vb, gb, bb = c[4], c[5], c[6], c[8], c[9]
                # Rows first: what p + dt v - h b and v - dt b have in common with the old v and b.
                p_v, p_b = pv + dt * vv - h * vb, pb + dt * vb - h * bb
                v_b = vb - dt * bb
                c[0] = pp + dt * pv - h * pb + dt * p_v - h * p_b + 0.25 * dt * dt * w
                c[1] = p_v - dt * p_b + 0.5 * dt * w
                c[2] = pg + dt * vg - h * gb
                c[3] = phi * p_b
                c[4] = vv - dt * vb - dt * v_b + w
                c[5] = vg - dt * gb
                c[6] = phi * v_b
                c[8] = phi * gb
                c[9] = phi * phi * bb + bias_noise


@compiled
def correct(
    mean: Array,
    packed: Array,
    fix_position: Array,
    fix_velocity: Array,
    fix_sigma: Array,
    has_fix: Mask,
    fixless_axis: Mask,
    error_memory: Array,
    error_noise: Array,
    position_noise: float,
    velocity_noise: float,
    bias_variance: float,
    gate: float,
    doubted: Mask,
    follows: Mask,
    barred: Mask,
    speed_alone: bool,
    restart: Mask,
    active: Mask,
    verdict: NDArray[np.int8],
    carried: Array,
    response: Array,
    offset: Array,
    offset_variance: float,
) -> None:
    """Take in one epoch of fixes, in place.

    A fix is used as a whole or not at all, but for ``speed_alone``. It is refused if one of its numbers is
    not finite, if a sigma is not positive (unknown, not certain), or if an innovation leaves ``gate`` of its
    own sigmas.

    Parameters
    ----------
    mean, packed : array, shape (run, uav, 3, 4) and (run, uav, 3, 10)
        States and their covariance; overwritten.
    fix_position, fix_velocity, fix_sigma : array, shape (run, uav, 3)
        Measured position [m] and velocity [m/s], reported sigma of the position [m].
    has_fix : array of bool, shape (run, uav)
        Whether there is a new fix.
    fixless_axis : array of bool, shape (3,)
        Axes whose position is measured without a fix too (a barometer's).
    error_memory, error_noise : array, shape (3,)
        phi and 1 - phi^2 of the error from one epoch to the next.
    position_noise, velocity_noise : float
        Variances of the white noise in position [m^2] and velocity [m^2/s^2].
    bias_variance : float
        Variance of an accelerometer bias of which nothing is known [m^2/s^4].
    gate : float
        Largest innovation in its sigmas; 0 for none.
    doubted : array of bool, shape (run, uav)
        UAVs whose fixes have disagreed for long: what was known of their error counts no more.
    follows : array of bool, shape (run, uav)
        Fixes that say no more than the refused one before: refused as well if they are doubted, or farther
        from the estimate than :data:`PULL` of its own sigmas.
    barred : array of bool, shape (run, uav)
        Fixes that are refused whatever they say.
    speed_alone : bool
        Whether a fix refused for its position leaves its velocity, if that is inside its gate on all axes.
    restart : array of bool, shape (run, uav)
        UAVs that forget all they knew and begin with this fix, if it can be used.
    active : array of bool, shape (run,)
        Runs that fly.
    verdict : array of int8, shape (run, uav)
        Out: :data:`NO_FIX`, :data:`USED`, :data:`BEGUN` or :data:`REFUSED`.
    carried, response : array, shapes (run, uav, 3, 4, 4) and (run, uav, 3, 4)
        ``carried`` comes in as the transition of the estimation error since the last epoch and goes out as
        that to after this fix. ``response`` goes out as that error's answer to what is new in g at this
        epoch, in units of its sigma (at a beginning: to g as a whole). With no runs in them, neither is kept.
    offset : array, shape (run, uav, 6)
        Offsets of barometers, see :mod:`napf_mpc.navigation.height_offset`; overwritten. With no runs in it,
        there is none.
    offset_variance : float
        Variance of an offset of which nothing is known [m^2].
    """
    keep, barometer = carried.shape[0] > 0, offset.shape[0] > 0
    full, k = np.empty((4, 4)), np.empty(4)
    for r in range(mean.shape[0]):
        if not active[r]:
            continue
        for i in range(mean.shape[1]):
            fresh, begins = has_fix[r, i], restart[r, i]
            usable = True
            witness = speed_alone and fresh and not begins
            for a in range(3):
                x, c = mean[r, i, a], packed[r, i, a]
                memory = 0.0 if doubted[r, i] else error_memory[a]
                noise = 1.0 if doubted[r, i] else error_noise[a]
                forget(x, c, memory, noise)
                tied = barometer and a == height_offset.VERTICAL
                if tied:
                    offset[r, i, height_offset.OG] *= memory
                if keep:
                    _forget_carried(carried[r, i, a], response[r, i, a], memory, noise)
                if fresh:
                    place, speed, sigma = fix_position[r, i, a], fix_velocity[r, i, a], fix_sigma[r, i, a]
                    measured = is_measured(place, sigma) and np.isfinite(speed)
                    usable &= measured
                    witness &= measured
                    if not begins:
                        steady = _inside(speed - x[1], c[4] + velocity_noise, gate)
                        usable &= position_inside(x, c, place, sigma, position_noise, gate) and steady
                        usable &= not barred[r, i]
                        if follows[r, i]:
                            near = _inside(place - x[0] - sigma * x[2], c[0], PULL)
                            usable &= near and not doubted[r, i]
                        witness &= steady
            verdict[r, i] = NO_FIX
            if fresh:
                verdict[r, i] = REFUSED if not usable else BEGUN if begins else USED
            for a in range(3):
                x, c = mean[r, i, a], packed[r, i, a]
                place, speed, sigma = fix_position[r, i, a], fix_velocity[r, i, a], fix_sigma[r, i, a]
                tied = barometer and a == height_offset.VERTICAL
                if verdict[r, i] == BEGUN:
                    begin(x, c, place, speed, sigma, position_noise, velocity_noise, bias_variance)
                    if tied:
                        height_offset.begin(offset[r, i], offset_variance)
                    if keep:
                        carried[r, i, a] = 0.0
                        response[r, i, a] = 0.0
                        response[r, i, a, 0], response[r, i, a, 2] = -sigma, 1.0
                    continue
                alone = not fresh and fixless_axis[a] and is_measured(place, sigma)
                alone = alone and position_inside(x, c, place, sigma, position_noise, gate)
                spoken = witness and verdict[r, i] == REFUSED
                if not (alone or spoken or verdict[r, i] == USED):
                    continue
                unpack(c, full)
                if not spoken:
                    spread, miss = take_in(x, full, k, place, 1.0, 0.0, sigma, position_noise)
                    if tied:
                        height_offset.learn(offset[r, i], k, 1.0, 0.0, sigma, spread, miss)
                    if keep:
                        _take_in_carried(carried[r, i, a], response[r, i, a], k, 1.0, 0.0, sigma)
                if not alone:
                    spread, miss = take_in(x, full, k, speed, 0.0, 1.0, 0.0, velocity_noise)
                    if tied:
                        height_offset.learn(offset[r, i], k, 0.0, 1.0, 0.0, spread, miss)
                    if keep:
                        _take_in_carried(carried[r, i, a], response[r, i, a], k, 0.0, 1.0, 0.0)
                pack(full, c)


@compiled
def rescale(mean: Array, packed: Array, change: Array) -> None:
    r"""Take it that the sigmas of fixes were too small so far, in place.

    The error's state g counts in units of the sigma, so it shrinks by the sigma's growth and
    :math:`\sigma g` stays what it was. Where the sigma grows, so does the position's uncertainty, which came
    from fixes that were believed too much: P becomes D P D with D = diag(sqrt(change), 1, 1, 1).

    Parameters
    ----------
    mean, packed : array, shape (run, uav, 3, 4) and (run, uav, 3, 10)
        States and their covariance; overwritten.
    change : array, shape (run, uav, 3)
        Factor on the variance of the fixes; 1 changes nothing.
    """
    for r in range(mean.shape[0]):
        for i in range(mean.shape[1]):
            for a in range(3):
                if change[r, i, a] == 1.0:
                    continue
                root = np.sqrt(change[r, i, a])
                mean[r, i, a, 2] /= root
                c = packed[r, i, a]
                if root > 1.0:
                    c[0] *= root * root
                    c[1] *= root
                    c[2] *= root
                    c[3] *= root


@compiled_bare
def forget(x: Array, c: Array, memory: float, noise: float) -> None:
    """Carry the error g from one epoch of fixes to the next."""
    x[2] *= memory
    c[2] *= memory
    c[5] *= memory
    c[7] = memory * memory * c[7] + noise
    c[8] *= memory


@compiled_bare
def _forget_carried(carried: Array, response: Array, memory: float, noise: float) -> None:
    for column in range(4):
        carried[2, column] *= memory
        response[column] = 0.0
    response[2] = np.sqrt(noise)


@compiled_bare
def is_measured(position: float, sigma: float) -> bool:
    """Whether a measured position and its sigma are numbers that say something."""
    return bool(np.isfinite(position) and 0.0 < sigma < np.inf)


@compiled_bare
def position_inside(x: Array, c: Array, position: float, sigma: float, noise: float, gate: float) -> bool:
    """Whether a measured position of an axis is inside the gate of what is expected."""
    spread = c[0] + 2.0 * sigma * c[2] + sigma * sigma * c[7] + noise
    return bool(_inside(position - x[0] - sigma * x[2], spread, gate))


@compiled_bare
def _inside(miss: float, spread: float, gate: float) -> bool:
    """Whether an innovation is inside the gate; one that is not a number never is."""
    return bool(miss * miss <= gate * gate * spread or (gate == 0.0 and np.isfinite(miss)))


@compiled_bare
def begin(
    x: Array,
    c: Array,
    position: float,
    velocity: float,
    sigma: float,
    position_noise: float,
    velocity_noise: float,
    bias_variance: float,
) -> None:
    """Begin an axis: p = fix - sigma g, so the error of the position is that of the fix, turned round."""
    x[0], x[1], x[2], x[3] = position, velocity, 0.0, 0.0
    c[:] = 0.0
    c[0] = sigma * sigma + position_noise
    c[2] = -sigma
    c[4] = velocity_noise
    c[7] = 1.0
    c[9] = bias_variance


@compiled_bare
def unpack(c: Array, full: Array) -> None:
    """Write a packed covariance (10) as a matrix (4, 4)."""
    n = 0
    for row in range(4):
        for column in range(row, 4):
            full[row, column] = c[n]
            full[column, row] = c[n]
            n += 1


@compiled_bare
def pack(full: Array, c: Array) -> None:
    """Write the symmetric part of a matrix (4, 4) as a packed covariance (10)."""
    n = 0
    for row in range(4):
        for column in range(row, 4):
            c[n] = 0.5 * (full[row, column] + full[column, row])
            n += 1


@compiled_bare
def take_in(
    x: Array, full: Array, k: Array, value: float, h_p: float, h_v: float, h_g: float, noise: float
) -> tuple[float, float]:
    """Update with one scalar measurement of ``h_p p + h_v v + h_g g``; leaves the gain in ``k``.

    Returns the variance that was expected of the measurement, and how far it was off.
    """
    for n in range(4):
        k[n] = h_p * full[n, 0] + h_v * full[n, 1] + h_g * full[n, 2]
    spread = h_p * k[0] + h_v * k[1] + h_g * k[2] + noise
    miss = value - h_p * x[0] - h_v * x[1] - h_g * x[2]
    for n in range(4):
        k[n] /= spread
        x[n] += k[n] * miss
    # Joseph's form (I - k h) P (I - k h)^T + k noise k^T, rows then columns: it stays positive semidefinite.
    for column in range(4):
        seen = h_p * full[0, column] + h_v * full[1, column] + h_g * full[2, column]
        for row in range(4):
            full[row, column] -= k[row] * seen
    for row in range(4):
        seen = h_p * full[row, 0] + h_v * full[row, 1] + h_g * full[row, 2]
        for column in range(4):
            full[row, column] += k[column] * (noise * k[row] - seen)
    return spread, miss


@compiled_bare
def _take_in_carried(carried: Array, response: Array, k: Array, h_p: float, h_v: float, h_g: float) -> None:
    for column in range(4):
        seen = h_p * carried[0, column] + h_v * carried[1, column] + h_g * carried[2, column]
        for row in range(4):
            carried[row, column] -= k[row] * seen
    seen = h_p * response[0] + h_v * response[1] + h_g * response[2]
    for row in range(4):
        response[row] -= k[row] * seen


@compiled
def report(
    mean: Array, packed: Array, position: Array, velocity: Array, covariance: Array, widest: Array
) -> None:
    """Write out what a navigation solution holds.

    Parameters
    ----------
    mean, packed : array, shape (run, uav, 3, 4) and (run, uav, 3, 10)
        States and their covariance.
    position, velocity : array, shape (run, uav, 3)
        Out [m, m/s].
    covariance : array, shape (run, uav, 6, 6)
        Out, of position and velocity; zeros come in, and stay between axes.
    widest : array, shape (run, uav)
        Out: largest variance of the position among the axes [m^2].
    """
    for r in range(mean.shape[0]):
        for i in range(mean.shape[1]):
            widest[r, i] = 0.0
            for a in range(3):
                x, c = mean[r, i, a], packed[r, i, a]
                position[r, i, a], velocity[r, i, a] = x[0], x[1]
                covariance[r, i, a, a] = c[0]
                covariance[r, i, a, 3 + a] = c[1]
                covariance[r, i, 3 + a, a] = c[1]
                covariance[r, i, 3 + a, 3 + a] = c[4]
                # Not max(): what is not a number must not look narrow.
                if not c[0] <= widest[r, i]:
                    widest[r, i] = c[0]
