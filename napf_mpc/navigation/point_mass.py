r"""Compiled body of the point-mass filter: what is known of each axis' position, as density on a grid.

Position p, velocity v and accelerometer bias b of an axis are dead reckoned by the navigation filter's own
prediction (:func:`napf_mpc.navigation.kalman.predict`) and by GNSS velocities. The density of the position
stands on nodes about the estimate (a point-mass filter, Bucy and Senne 1971): it widens by what dead
reckoning adds, and is multiplied by the likelihood of each fix, a Student law with :math:`\nu` degrees of
freedom and the reported sigma as its scale, to the power :math:`w`:

.. math:: p(x) \leftarrow p(x) \left(1 + \frac{(z - x)^2}{\nu \sigma^2}\right)^{-w (\nu + 1) / 2},
          \qquad w = \frac{1 - \phi}{1 + \phi} = \tanh\frac{\lambda}{2},

:math:`\phi = e^{-\lambda}` the correlation of the fix's error with that of the last fix. A mean of fixes
whose errors are correlated so is worth w times as many that are not, so their likelihood counts w times.

Mean and variance of the density go back to the dead reckoning. Velocity and bias are estimated without the
positions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.navigation import height_offset, kalman
from napf_mpc.navigation.kalman import BEGUN, NO_FIX, OUTVOTED, REFUSED, STATES, USED, is_measured

__all__ = ["NODES", "correct"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

NODES = 256
"""Nodes of an axis' grid."""
STEP, CENTRE = 0, 1
"""Numbers of a grid."""
EVIDENCE, PLACE = 0, 1
"""Numbers of what is told of a place beyond it."""
FINEST, COARSEST = 3.0, 12.0
"""Steps of the grid in one sigma of the density, at least and at most: it reaches 10 to 43 sigmas."""
FIRST = 3.0
"""Steps of the first grid in the scale of the first fix."""
LOG_FLOOR = -40.0
FLOOR = np.exp(LOG_FLOOR)
"""Least density of a place over the largest. None is ever ruled out for good, on the grid or beyond it, so a
wrong estimate can be left again: six independent fixes that agree ten sigmas off outweigh it."""
FAR = 5.0
"""Sigmas from the estimate beyond which a fix that the grid does not reach speaks for another place."""
WIDEST_PASS = 0.5
"""Variance in squared steps that one pass of the three-point kernel adds at most."""


@compiled
def correct(
    mean: Array,
    packed: Array,
    density: Array,
    grids: Array,
    astray: Array,
    lag: Array,
    fix_position: Array,
    fix_velocity: Array,
    fix_sigma: Array,
    has_fix: Mask,
    fixless_axis: Mask,
    error_memory: Array,
    error_noise: Array,
    change: Array,
    degrees: float,
    position_noise: float,
    velocity_noise: float,
    bias_variance: float,
    gate: float,
    restart: Mask,
    active: Mask,
    verdict: NDArray[np.int8],
    offset: Array,
    offset_variance: float,
) -> None:
    """Take in one epoch of fixes, in place.

    A fix is refused as a whole if one of its numbers is not finite, if a sigma is not positive, or if its
    velocity, or a barometer's height, leaves ``gate`` of its own sigmas; its position is never too far away.

    Parameters
    ----------
    mean, packed : array, shape (run, uav, 3, 4) and (run, uav, 3, 10)
        States and covariance as in :mod:`napf_mpc.navigation.kalman`, the state g unused; overwritten.
    density : array, shape (run, uav, 3, NODES)
        Of the position on the nodes, with sum 1; overwritten.
    grids : array, shape (run, uav, 3, 2)
        Distance of two nodes, and of the middle node from the estimate [m]; overwritten.
    astray : array, shape (run, uav, 3, 2)
        Evidence that the UAV is at a place far beyond the grid, and where from the estimate [m]; overwritten.
    lag : array, shape (run, uav, 3)
        Time since the last measured position, in correlation times; overwritten.
    fix_position, fix_velocity, fix_sigma : array, shape (run, uav, 3)
        Measured position [m] and velocity [m/s], reported sigma of the position [m].
    has_fix : array of bool, shape (run, uav)
        Whether there is a new fix.
    fixless_axis : array of bool, shape (3,)
        Axes whose position is measured without a fix too (a barometer's). Their errors are slow and have no
        tails, and only a filter that has the error as a state takes from them how fast a UAV climbs: such an
        axis is the Kalman filter's.
    error_memory, error_noise : array, shape (3,)
        phi and 1 - phi^2 of the fix's error from one epoch to the next, of the Kalman filter's axes.
    change : array, shape (run, uav, 3)
        How far the fix's error changes in this epoch, in correlation times.
    degrees : float
        nu, degrees of freedom of the Student law.
    position_noise : float
        Variance of the white noise in position, of the Kalman filter's axes [m^2].
    velocity_noise, bias_variance : float
        Variances of the GNSS velocity [m^2/s^2], and of a bias of which nothing is known [m^2/s^4].
    gate : float
        Largest innovation of the velocity in its sigmas, and of a position that counts in full; 0 for none.
    restart : array of bool, shape (run, uav)
        UAVs that forget all they knew and begin with this fix, if it can be used.
    active : array of bool, shape (run,)
        Runs that fly.
    verdict : array of int8, shape (run, uav)
        Out: as in :func:`napf_mpc.navigation.kalman.correct`, or ``OUTVOTED`` of that module.
    offset : array, shape (run, uav, 6)
        Offsets of barometers, see :mod:`napf_mpc.navigation.height_offset`; overwritten. With no runs in it,
        there is none.
    offset_variance : float
        Variance of an offset of which nothing is known [m^2].
    """
    barometer = offset.shape[0] > 0
    spare, full, gain = np.empty(NODES), np.empty((STATES, STATES)), np.empty(STATES)
    for r in range(mean.shape[0]):
        if not active[r]:
            continue
        for i in range(mean.shape[1]):
            usable, height_fits = has_fix[r, i], False
            for a in range(3):
                lag[r, i, a] += change[r, i, a]
                usable = usable and is_measured(fix_position[r, i, a], fix_sigma[r, i, a])
                usable = usable and np.isfinite(fix_velocity[r, i, a])
                if usable and not restart[r, i]:
                    miss = fix_velocity[r, i, a] - mean[r, i, a, 1]
                    spread = packed[r, i, a, 4] + velocity_noise
                    usable = gate == 0.0 or miss * miss <= gate * gate * spread
                if fixless_axis[a]:
                    x, c = mean[r, i, a], packed[r, i, a]
                    kalman.forget(x, c, error_memory[a], error_noise[a])
                    height_fits = restart[r, i] or kalman.position_inside(
                        x, c, fix_position[r, i, a], fix_sigma[r, i, a], position_noise, gate
                    )
                    usable = usable and height_fits
            verdict[r, i] = NO_FIX
            if has_fix[r, i]:
                verdict[r, i] = REFUSED if not usable else BEGUN if restart[r, i] else USED
            used, outvoted = verdict[r, i] == USED, False
            for a in range(3):
                x, c, p, grid = mean[r, i, a], packed[r, i, a], density[r, i, a], grids[r, i, a]
                place, speed, sigma = fix_position[r, i, a], fix_velocity[r, i, a], fix_sigma[r, i, a]
                if fixless_axis[a]:
                    alone = not has_fix[r, i] and height_fits and is_measured(place, sigma)
                    if verdict[r, i] == BEGUN:
                        kalman.begin(x, c, place, speed, sigma, position_noise, velocity_noise, bias_variance)
                    elif alone or used:
                        kalman.unpack(c, full)
                        kalman.take_in(x, full, gain, place, 1.0, 0.0, sigma, position_noise)
                        if not alone:
                            kalman.take_in(x, full, gain, speed, 0.0, 1.0, 0.0, velocity_noise)
                        kalman.pack(full, c)
                    continue
                tied = barometer and a == height_offset.VERTICAL
                if verdict[r, i] == BEGUN:
                    x[1], x[3] = speed, 0.0
                    c[4], c[6], c[9] = velocity_noise, 0.0, bias_variance
                    _lay(x, c, p, grid, place, sigma, degrees)
                    if tied:
                        height_offset.begin(offset[r, i], offset_variance)
                    astray[r, i, a, EVIDENCE], lag[r, i, a] = 0.0, 0.0
                    continue
                # Widened only now: of what an outage adds, the first velocity after it takes much away again.
                if used:
                    if tied:
                        miss, expected = speed - x[1], c[4] + velocity_noise
                        gain[0], gain[1] = c[1] / expected, c[4] / expected
                        gain[2], gain[3] = 0.0, c[6] / expected
                        height_offset.learn(offset[r, i], gain, 0.0, 1.0, 0.0, expected, miss)
                    _take_in_velocity(x, c, speed, velocity_noise)
                    off, spread = place - x[0], c[0] + sigma * sigma
                    outvoted = outvoted or (gate > 0.0 and off * off > gate * gate * spread)
                    prior = _widen(p, spare, grid, c[0])
                    weight = np.tanh(0.5 * lag[r, i, a])
                    lag[r, i, a] = 0.0
                    if _is_elsewhere(astray[r, i, a], grid, off, sigma, degrees, weight):
                        _lay(x, c, p, grid, place, sigma, degrees)
                        if tied:
                            height_offset.begin(offset[r, i], np.inf)
                        outvoted = False
                        continue
                    _sharpen(p, spare, grid, off, sigma, degrees, weight)
                    _weigh(p, off - grid[CENTRE], grid[STEP], sigma, degrees, weight)
                    # Heights may know more than the density, so what the offset follows is the covariance.
                    pp, pv, pb = c[0], c[1], c[3]
                    moved = _settle(x, c, p, grid, prior)
                    if tied:
                        height_offset.follow(offset[r, i], pp, pv, 0.0, pb, c, moved)
                    astray[r, i, a, PLACE] -= moved
                    _fit_grid(p, spare, grid, c[0])
            if outvoted:
                verdict[r, i] = OUTVOTED


@compiled_bare
def _lay(x: Array, c: Array, p: Array, grid: Array, place: float, sigma: float, degrees: float) -> None:
    """Take the position from one fix alone: of its error nothing is known but the law."""
    x[0], x[2] = place, 0.0
    c[1], c[2], c[3], c[5], c[7], c[8] = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    grid[STEP], grid[CENTRE] = sigma / FIRST, 0.0
    p[:] = 1.0
    _weigh(p, 0.0, grid[STEP], sigma, degrees, 1.0)
    _settle(x, c, p, grid, 0.0)


@compiled_bare
def _is_elsewhere(
    astray: Array, grid: Array, off: float, sigma: float, degrees: float, weight: float
) -> bool:
    """Whether fixes have told of one place beyond the grid for long enough; this one is ``off`` the estimate.

    The evidence is the logarithm of the likelihoods' ratio, there to here, from the first fix that told of
    it; never below none, and half of what it takes at most from one fix: it takes two that agree.
    """
    power, most = 0.5 * weight * (degrees + 1.0), -0.5 * LOG_FLOOR
    here = np.log1p(min((off / sigma) ** 2, 1e12) / degrees)
    if astray[EVIDENCE] > 0.0:
        there = np.log1p(min(((off - astray[PLACE]) / sigma) ** 2, 1e12) / degrees)
        astray[EVIDENCE] = max(astray[EVIDENCE] + min(power * (here - there), most), 0.0)
    elif abs(off - grid[CENTRE]) > NODES // 2 * grid[STEP] and abs(off) > FAR * sigma:
        astray[EVIDENCE], astray[PLACE] = min(power * here, most), off
    if astray[EVIDENCE] <= -LOG_FLOOR:
        return False
    astray[EVIDENCE] = 0.0
    return True


@compiled_bare
def _take_in_velocity(x: Array, c: Array, speed: float, noise: float) -> None:
    """Update position, velocity and bias with a measured velocity; of pp, pv, pb, vv, vb, bb."""
    pv, vv, vb = c[1], c[4], c[6]
    scale = 1.0 / (vv + noise)
    miss = scale * (speed - x[1])
    x[0] += pv * miss
    x[1] += vv * miss
    x[3] += vb * miss
    c[0] -= scale * pv * pv
    c[1] = scale * noise * pv
    c[3] -= scale * pv * vb
    c[4] = scale * noise * vv
    c[6] = scale * noise * vb
    c[9] -= scale * vb * vb


@compiled_bare
def _sharpen(
    p: Array, spare: Array, grid: Array, miss: float, sigma: float, degrees: float, weight: float
) -> None:
    """Lay the grid anew about a fix ``miss`` from the estimate, if its law is too narrow for the steps.

    So it is after an outage. The law's width is where it has fallen to 1/e; with a small weight, never.
    """
    drop = 2.0 / (weight * (degrees + 1.0))
    width = sigma * np.sqrt(degrees * np.expm1(min(drop, 100.0)))
    first = (miss - grid[CENTRE]) / grid[STEP] + NODES // 2
    if grid[STEP] <= width / 2.0 or not 0.0 <= first <= NODES - 1.0:
        return
    _copy(p, spare)
    step = width / FIRST
    least = FLOOR * _largest(spare)
    for n in range(NODES):
        at = first + (n - NODES // 2) * step / grid[STEP]
        p[n] = least
        if 0.0 <= at <= NODES - 1.0:
            below = min(int(at), NODES - 2)
            p[n] = spare[below] + (at - below) * (spare[below + 1] - spare[below])
    grid[STEP], grid[CENTRE] = step, miss
    _normalise(p)


@compiled_bare
def _weigh(p: Array, miss: float, step: float, sigma: float, degrees: float, weight: float) -> None:
    """Multiply a density with the likelihood of a fix that is ``miss`` from the middle node."""
    power, largest = 0.5 * weight * (degrees + 1.0), 0.0
    for n in range(NODES):
        z = (miss - (n - NODES // 2) * step) / sigma
        # Not beyond what a power of it can still tell from zero.
        p[n] *= np.exp(-power * np.log1p(min(z * z, 1e12) / degrees))
        largest = max(largest, p[n])
    total = 0.0
    for n in range(NODES):
        p[n] = max(p[n], FLOOR * largest)
        total += p[n]
    for n in range(NODES):
        p[n] /= total


@compiled_bare
def _moments(p: Array) -> tuple[float, float]:
    """Mean of a density from the middle node, and variance, in steps."""
    first, second = 0.0, 0.0
    for n in range(NODES):
        at = n - NODES // 2
        first += at * p[n]
        second += at * at * p[n]
    return first, second - first * first


@compiled_bare
def _widen(p: Array, spare: Array, grid: Array, variance: float) -> float:
    """Widen a density to a variance [m^2], if it is larger than its own; returns the larger of the two."""
    held = _moments(p)[1] * grid[STEP] ** 2
    added = variance - held
    if added <= 0.0:
        return float(held)
    while added > 8.0 * WIDEST_PASS * grid[STEP] ** 2:
        _coarsen(p, spare, grid)
    passes = int(np.ceil(added / (WIDEST_PASS * grid[STEP] ** 2)))
    share = 0.5 * added / (passes * grid[STEP] ** 2)
    for _ in range(passes):
        _copy(p, spare)
        for n in range(NODES):
            below, above = spare[max(n - 1, 0)], spare[min(n + 1, NODES - 1)]
            p[n] = (1.0 - 2.0 * share) * spare[n] + share * (below + above)
    return variance


@compiled_bare
def _settle(x: Array, c: Array, p: Array, grid: Array, prior: float) -> float:
    """Take over the density's mean and variance; returns how far the estimate moved [m].

    Velocity and bias do not follow the position: which of two places it is says nothing about them. They only
    have less in common with what is left of its error.
    """
    first, second = _moments(p)
    moved, variance = grid[CENTRE] + first * grid[STEP], second * grid[STEP] ** 2
    left = min(variance / prior, 1.0) if prior > 0.0 else 0.0
    c[0] = variance
    c[1] *= left
    c[3] *= left
    x[0] += moved
    grid[CENTRE] -= moved
    return float(moved)


@compiled_bare
def _fit_grid(p: Array, spare: Array, grid: Array, variance: float) -> None:
    """Keep the grid about the estimate, and its step in proportion to the density's width."""
    off = int(np.rint(grid[CENTRE] / grid[STEP]))
    if abs(off) > NODES // 8:
        _copy(p, spare)
        least = FLOOR * _largest(spare)
        for n in range(NODES):
            p[n] = spare[n - off] if 0 <= n - off < NODES else least
        grid[CENTRE] -= off * grid[STEP]
        _normalise(p)
    if variance > (COARSEST * grid[STEP]) ** 2:
        _coarsen(p, spare, grid)
    elif variance < (FINEST * grid[STEP]) ** 2:
        _copy(p, spare)
        for n in range(NODES):
            at, odd = NODES // 2 + (n - NODES // 2) // 2, (n - NODES // 2) % 2
            p[n] = 0.5 * (spare[at] + spare[at + odd])
        grid[STEP] *= 0.5
        _normalise(p)


@compiled_bare
def _coarsen(p: Array, spare: Array, grid: Array) -> None:
    """Double the step about the middle node; what stood between two nodes goes to both."""
    _copy(p, spare)
    least = FLOOR * _largest(spare)
    for n in range(NODES):
        at = NODES // 2 + 2 * (n - NODES // 2)
        p[n] = least
        if 0 <= at < NODES:
            below, above = spare[max(at - 1, 0)], spare[min(at + 1, NODES - 1)]
            p[n] = spare[at] + 0.5 * (below + above)
    grid[STEP] *= 2.0
    _normalise(p)


@compiled_bare
def _copy(p: Array, spare: Array) -> None:
    for n in range(NODES):
        spare[n] = p[n]


@compiled_bare
def _largest(p: Array) -> float:
    largest = 0.0
    for n in range(NODES):
        largest = max(largest, p[n])
    return largest


@compiled_bare
def _normalise(p: Array) -> None:
    total = 0.0
    for n in range(NODES):
        total += p[n]
    for n in range(NODES):
        p[n] /= total
