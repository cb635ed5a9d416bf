r"""How certain of its position the navigation filter will be: its covariance carried ahead by its own model.

A Kalman filter's covariance does not depend on what is measured, so the filter can say beforehand how certain
it will be: :func:`variance_ahead` carries the ten numbers of each axis (:mod:`napf_mpc.navigation.kalman`)
from tick to tick as the filter would, either as if no fix came any more, or with the fixes that are to be
expected: at the epochs at which they come now, with the sigma that they report now, if they are in use now;
or with the sigmas that a map has at the places to come (:mod:`.sigma_map`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.navigation import kalman
from napf_mpc.vehicle.plant import plain

__all__ = ["CovarianceForecast", "ForecastModel", "variance_ahead"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LANES = 16
"""Axes of UAVs carried side by side: each is a chain of sums that wait for each other."""


@dataclass(frozen=True, eq=False)
class ForecastModel:
    """What a forecast takes as known, from the filter's model."""

    period_s: float
    """Length of a tick [s]."""
    ticks_per_epoch: int
    """Ticks from one epoch of fixes to the next."""
    drift: Array
    """(ticks_per_epoch + 1, 10) an axis over 0, 1, ... ticks: see :func:`drifts`."""
    error_memory: Array
    """(3,) correlation of the fix's error from one epoch to the next, on each axis."""
    error_noise: Array
    """(3,) or (run, uav, 3) variance of what is new in the unit error."""
    fixless_axis: Mask
    """(3,) axes that are measured without a fix too (a barometer's)."""
    position_noise: float
    """Variance of the white noise in a fix [m^2]."""
    velocity_noise: float
    """Variance of the noise in a GNSS velocity [m^2/s^2]."""


def drifts(
    period_s: float, bias_memory: float, velocity_noise: float, bias_noise: float, ticks: int
) -> Array:
    """Transition and noise of an axis over 0 to ``ticks`` ticks, all :func:`kalman.predict` at once.

    Returns
    -------
    array, shape (ticks + 1, 10)
        Of the transition: how v and b enter p, how b enters v, and what is left of b. Of the noise: pp, pv,
        pb, vv, vb, bb.
    """
    one = kalman.drift(period_s, bias_memory)
    drive = np.array([0.5 * period_s, 1.0, 0.0, 0.0])
    noise = velocity_noise * np.outer(drive, drive)
    noise[3, 3] = bias_noise
    out = np.empty((ticks + 1, 10))
    f, q = np.eye(kalman.STATES), np.zeros((kalman.STATES, kalman.STATES))
    for n in range(ticks + 1):
        out[n] = f[0, 1], f[0, 3], f[1, 3], f[3, 3], q[0, 0], q[0, 1], q[0, 3], q[1, 1], q[1, 3], q[3, 3]
        f, q = one @ f, one @ q @ one.T + noise
    return out


@dataclass(frozen=True, eq=False)
class CovarianceForecast:
    """All that the filter knows now about how certain it will be. It holds no estimate and no measurement."""

    model: ForecastModel
    """Constants."""
    packed: Array
    """(run, uav, 3, 10) covariance of the states of each axis now."""
    sigma: Array
    """(run, uav, 3) sigma of the position that the last epoch of fixes reported [m]."""
    fixes: Mask
    """(run, uav) whether fixes are in use: then they are expected to go on."""
    age: int
    """Ticks since the last epoch of fixes."""
    epochs_to_new: int = 1
    """Epochs until the receiver has a new fix; until then it repeats the last."""
    epochs_per_new: int = 1
    """Epochs from one new fix to the next."""

    def variance(self, ahead_s: Array, with_fixes: bool, fix_sigma: Array | None = None) -> Array:
        """Variance of the position (run, uav, N, 3) on each axis at times from now [m^2].

        Parameters
        ----------
        ahead_s : array, shape (N,)
            Times from now, >= 0 and increasing, taken to the nearest tick [s].
        with_fixes : bool
            Whether fixes and a barometer go on measuring as they do now, or nothing does.
        fix_sigma : array, shape (run, uav, N, 3), optional
            Sigmas of the fixes up to each of the times, instead of those of now, infinite for none [m].
        """
        model, noise = self.model, self.model.error_noise
        out = np.empty((*self.fixes.shape, len(ahead_s), 3))
        variance_ahead(
            self.packed,
            self.sigma[:, :, None] if fix_sigma is None else fix_sigma,
            self.fixes if fix_sigma is None else np.ones_like(self.fixes),
            model.fixless_axis,
            with_fixes,
            plain(ahead_s),
            model.period_s,
            model.drift,
            model.ticks_per_epoch - self.age,
            self.epochs_to_new,
            self.epochs_per_new,
            model.error_memory,
            noise if noise.ndim == 3 else noise[None, None],
            model.position_noise,
            model.velocity_noise,
            out,
        )
        return out

    def change(self, ahead_s: Array, with_fixes: bool, fix_sigma: Array | None = None) -> Array:
        """Factor (run, uav, N, 3) from the variance now to that of then; 1, held, where there is none.

        Parameters are those of :meth:`variance`.
        """
        factor = self.variance(ahead_s, with_fixes, fix_sigma)
        _compare(self.packed, factor)
        return factor


@compiled_bare
def _compare(packed: Array, factor: Array) -> None:
    """Divide variances to come (run, uav, N, 3) by those of now, in packed covariances (run, uav, 3, 10)."""
    for r in range(factor.shape[0]):
        for i in range(factor.shape[1]):
            for k in range(factor.shape[2]):
                for a in range(3):
                    now = packed[r, i, a, 0]
                    ratio = factor[r, i, k, a] / (now if now > 0.0 else np.inf)
                    # What is not above zero is rounding, and would say "certain"; nothing is known then.
                    factor[r, i, k, a] = ratio if 0.0 < ratio < np.inf else 1.0


@compiled
def variance_ahead(
    packed: Array,
    sigma: Array,
    fixes: Mask,
    fixless_axis: Mask,
    with_fixes: bool,
    ahead_s: Array,
    period_s: float,
    drift: Array,
    ticks_to_epoch: int,
    epochs_to_new: int,
    epochs_per_new: int,
    error_memory: Array,
    error_noise: Array,
    position_noise: float,
    velocity_noise: float,
    out: Array,
) -> None:
    """Write the variance of the position of each axis at some times from now.

    Parameters
    ----------
    packed, sigma : array, shapes (run, uav, 3, 10) and (run, uav, N or 1, 3)
        Covariances now, and sigma of a fix up to each time, or up to all of them [m].
    fixes : array of bool, shape (run, uav)
        Whether there are fixes.
    fixless_axis : array of bool, shape (3,)
        Axes whose position is measured at every epoch, with a fix or without.
    with_fixes : bool
        Whether either goes on.
    ahead_s : array, shape (N,)
        From now, increasing, taken to the nearest tick [s].
    period_s : float
        Length of a tick [s].
    drift : array, shape (ticks an epoch + 1, 10)
        From :func:`drifts`.
    ticks_to_epoch, epochs_to_new, epochs_per_new : int
        When measurements come.
    error_memory, error_noise : array, shapes (3,) and (run or 1, uav or 1, 3)
        Of the fix's error from one epoch to the next.
    position_noise, velocity_noise : float
        Variances of the white noise in position [m^2] and velocity [m^2/s^2].
    out : array, shape (run, uav, N, 3)
        Out [m^2].
    """
    c, sigma_at = np.empty((kalman.PACKED, LANES)), np.empty(LANES)
    memory, noise = np.empty(LANES), np.empty(LANES)
    place = np.empty((3, LANES), dtype=np.uint32)
    by_place, by_speed = np.empty(LANES, dtype=np.bool_), np.empty(LANES, dtype=np.bool_)
    uavs, period = packed.shape[1], drift.shape[0] - 1
    axes = packed.shape[0] * uavs * 3
    last_run, last_uav = error_noise.shape[0] - 1, error_noise.shape[1] - 1
    for first in range(0, axes, LANES):
        last = min(first + LANES, axes)
        for lane in range(LANES):
            # Lanes that are left over do what the last axis does.
            at = min(first + lane, last - 1)
            r, i, a = at // (3 * uavs), at // 3 % uavs, at % 3
            place[0, lane], place[1, lane], place[2, lane] = r, i, a
            for e in range(kalman.PACKED):
                c[e, lane] = packed[r, i, a, e]
            memory[lane], noise[lane] = error_memory[a], error_noise[min(r, last_run), min(i, last_uav), a]
        now, to_epoch, to_new = 0, ticks_to_epoch, epochs_to_new
        for k in range(ahead_s.shape[0]):
            then = int(np.rint(ahead_s[k] / period_s))
            while now < then:
                n = min(then - now, to_epoch)
                _drift(c, drift, n)
                now += n
                to_epoch -= n
                if to_epoch > 0:
                    continue
                to_epoch = period
                to_new -= 1
                _forget(c, memory, noise)
                if with_fixes:
                    measured = 0
                    for lane in range(LANES):
                        r, i, a = place[0, lane], place[1, lane], place[2, lane]
                        size = sigma[r, i, min(k, sigma.shape[2] - 1), a]
                        usable, fix = 0.0 < size < np.inf, fixes[r, i] and to_new == 0
                        sigma_at[lane] = size
                        by_place[lane] = usable and (fix or fixless_axis[a])
                        by_speed[lane] = usable and fix
                        measured += by_place[lane]
                    if measured > 0:
                        _measured_place(c, sigma_at, position_noise, by_place)
                        _measured_speed(c, velocity_noise, by_speed)
                if to_new == 0:
                    to_new = epochs_per_new
            for lane in range(last - first):
                out[place[0, lane], place[1, lane], k, place[2, lane]] = c[0, lane]


@compiled_bare
def _drift(c: Array, drift: Array, n: int) -> None:
    """Carry all lanes over a number of ticks."""
    pv_, pb_, vb_, left = drift[n, 0], drift[n, 1], drift[n, 2], drift[n, 3]
    q_pp, q_pv, q_pb, q_vv, q_vb, q_bb = (
        drift[n, 4], drift[n, 5], drift[n, 6], drift[n, 7], drift[n, 8], drift[n, 9]
    )  # fmt: skip
    for lane in range(LANES):
        pp, pv, pg, pb = c[0, lane], c[1, lane], c[2, lane], c[3, lane]
        vv, vg, vb, gb, bb = c[4, lane], c[5, lane], c[6, lane], c[8, lane], c[9, lane]
        # Rows first: what the new p and v have in common with the old v and b.
        p_v, p_b = pv + pv_ * vv + pb_ * vb, pb + pv_ * vb + pb_ * bb
        v_b = vb + vb_ * bb
        c[0, lane] = pp + pv_ * pv + pb_ * pb + pv_ * p_v + pb_ * p_b + q_pp
        c[1, lane] = p_v + vb_ * p_b + q_pv
        c[2, lane] = pg + pv_ * vg + pb_ * gb
        c[3, lane] = left * p_b + q_pb
        c[4, lane] = vv + vb_ * vb + vb_ * v_b + q_vv
        c[5, lane] = vg + vb_ * gb
        c[6, lane] = left * v_b + q_vb
        c[8, lane] = left * gb
        c[9, lane] = left * left * bb + q_bb


@compiled_bare
def _forget(c: Array, memory: Array, noise: Array) -> None:
    """Carry the error g of all lanes from one epoch of fixes to the next."""
    for lane in range(LANES):
        c[2, lane] *= memory[lane]
        c[5, lane] *= memory[lane]
        c[7, lane] = memory[lane] * memory[lane] * c[7, lane] + noise[lane]
        c[8, lane] *= memory[lane]


@compiled_bare
def _measured_place(c: Array, sigma: Array, noise: float, used: Mask) -> None:
    """Covariance after a fix, which measures ``p + sigma g``, in the lanes that use it."""
    for lane in range(LANES):
        size = sigma[lane]
        p, v = c[0, lane] + size * c[2, lane], c[1, lane] + size * c[5, lane]
        g, b = c[2, lane] + size * c[7, lane], c[3, lane] + size * c[8, lane]
        _lessen(c, lane, used[lane], p, v, g, b, p + size * g + noise)


@compiled_bare
def _measured_speed(c: Array, noise: float, used: Mask) -> None:
    """Covariance after a measurement of ``v``, in the lanes that use it."""
    for lane in range(LANES):
        p, v, g, b = c[1, lane], c[4, lane], c[5, lane], c[6, lane]
        _lessen(c, lane, used[lane], p, v, g, b, v + noise)


@compiled_bare
def _lessen(c: Array, lane: int, used: bool, p: float, v: float, g: float, b: float, variance: float) -> None:
    """Take off what a measurement of some variance tells by its covariances with p, v, g and b.

    Shorter than the filter's own update, which must stay sound for hours; over a horizon the plain difference
    does.
    """
    scale = 1.0 / variance
    pp, pv, pg, pb, vv = c[0, lane], c[1, lane], c[2, lane], c[3, lane], c[4, lane]
    vg, vb, gg, gb, bb = c[5, lane], c[6, lane], c[7, lane], c[8, lane], c[9, lane]
    # A choice of what is written, not whether: lanes go side by side.
    c[0, lane] = pp - scale * p * p if used else pp
    c[1, lane] = pv - scale * p * v if used else pv
    c[2, lane] = pg - scale * p * g if used else pg
    c[3, lane] = pb - scale * p * b if used else pb
    c[4, lane] = vv - scale * v * v if used else vv
    c[5, lane] = vg - scale * v * g if used else vg
    c[6, lane] = vb - scale * v * b if used else vb
    c[7, lane] = gg - scale * g * g if used else gg
    c[8, lane] = gb - scale * g * b if used else gb
    c[9, lane] = bb - scale * b * b if used else bb
