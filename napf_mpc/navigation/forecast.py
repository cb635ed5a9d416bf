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
    # Axis beside axis: each is a chain of sums that wait for each other, and three chains wait side by side.
    c, usable = np.empty((3, kalman.PACKED)), np.empty(3, dtype=np.bool_)
    period = drift.shape[0] - 1
    last_run, last_uav = error_noise.shape[0] - 1, error_noise.shape[1] - 1
    for r in range(packed.shape[0]):
        for i in range(packed.shape[1]):
            for a in range(3):
                for e in range(kalman.PACKED):
                    c[a, e] = packed[r, i, a, e]
            now, to_epoch, to_new = 0, ticks_to_epoch, epochs_to_new
            for k in range(ahead_s.shape[0]):
                then, at = int(np.rint(ahead_s[k] / period_s)), min(k, sigma.shape[2] - 1)
                for a in range(3):
                    usable[a] = 0.0 < sigma[r, i, at, a] < np.inf
                while now < then:
                    n = min(then - now, to_epoch)
                    for a in range(3):
                        _drift(c, a, drift, n)
                    now += n
                    to_epoch -= n
                    if to_epoch > 0:
                        continue
                    to_epoch = period
                    to_new -= 1
                    fix = with_fixes and fixes[r, i] and to_new == 0
                    for a in range(3):
                        _forget(c, a, error_memory[a], error_noise[min(r, last_run), min(i, last_uav), a])
                        if usable[a] and (fix or (with_fixes and fixless_axis[a])):
                            _measured_place(c, a, sigma[r, i, at, a], position_noise)
                        if usable[a] and fix:
                            _measured_speed(c, a, velocity_noise)
                    if to_new == 0:
                        to_new = epochs_per_new
                for a in range(3):
                    out[r, i, k, a] = c[a, 0]


@compiled_bare
def _drift(c: Array, a: int, drift: Array, n: int) -> None:
    """Carry an axis over a number of ticks."""
    pv_, pb_, vb_, left = drift[n, 0], drift[n, 1], drift[n, 2], drift[n, 3]
    pp, pv, pg, pb = c[a, 0], c[a, 1], c[a, 2], c[a, 3]
    vv, vg, vb, gb, bb = c[a, 4], c[a, 5], c[a, 6], c[a, 8], c[a, 9]
    # Rows first: what the new p and v have in common with the old v and b.
    p_v, p_b = pv + pv_ * vv + pb_ * vb, pb + pv_ * vb + pb_ * bb
    v_b = vb + vb_ * bb
    c[a, 0] = pp + pv_ * pv + pb_ * pb + pv_ * p_v + pb_ * p_b + drift[n, 4]
    c[a, 1] = p_v + vb_ * p_b + drift[n, 5]
    c[a, 2] = pg + pv_ * vg + pb_ * gb
    c[a, 3] = left * p_b + drift[n, 6]
    c[a, 4] = vv + vb_ * vb + vb_ * v_b + drift[n, 7]
    c[a, 5] = vg + vb_ * gb
    c[a, 6] = left * v_b + drift[n, 8]
    c[a, 8] = left * gb
    c[a, 9] = left * left * bb + drift[n, 9]


@compiled_bare
def _forget(c: Array, a: int, memory: float, noise: float) -> None:
    """Carry the error g from one epoch of fixes to the next."""
    c[a, 2] *= memory
    c[a, 5] *= memory
    c[a, 7] = memory * memory * c[a, 7] + noise
    c[a, 8] *= memory


@compiled_bare
def _measured_place(c: Array, a: int, sigma: float, noise: float) -> None:
    """Covariance after a fix, which measures ``p + sigma g``."""
    p, v = c[a, 0] + sigma * c[a, 2], c[a, 1] + sigma * c[a, 5]
    g, b = c[a, 2] + sigma * c[a, 7], c[a, 3] + sigma * c[a, 8]
    _lessen(c, a, p, v, g, b, p + sigma * g + noise)


@compiled_bare
def _measured_speed(c: Array, a: int, noise: float) -> None:
    """Covariance after a measurement of ``v``."""
    _lessen(c, a, c[a, 1], c[a, 4], c[a, 5], c[a, 6], c[a, 4] + noise)


@compiled_bare
def _lessen(c: Array, a: int, p: float, v: float, g: float, b: float, variance: float) -> None:
    """Take off what a measurement of some variance tells by its covariances with p, v, g and b.

    Shorter than the filter's own update, which must stay sound for hours; over a horizon the plain difference
    does.
    """
    scale = 1.0 / variance
    c[a, 0] -= scale * p * p
    c[a, 1] -= scale * p * v
    c[a, 2] -= scale * p * g
    c[a, 3] -= scale * p * b
    c[a, 4] -= scale * v * v
    c[a, 5] -= scale * v * g
    c[a, 6] -= scale * v * b
    c[a, 7] -= scale * g * g
    c[a, 8] -= scale * g * b
    c[a, 9] -= scale * b * b
