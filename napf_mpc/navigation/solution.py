"""What navigation tells a planner. The truth is not in here."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napf_mpc.errors import NavigationError
from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.navigation.fix import coasting_variance
from napf_mpc.navigation.forecast import CovarianceForecast
from napf_mpc.navigation.integrity.overbound import Overbound
from napf_mpc.navigation.sigma_map import SigmaMap
from napf_mpc.navigation.tracks import Tracks
from napf_mpc.vehicle.plant import plain

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class NavSolution:
    """One navigation solution of every UAV of every run, as reported.

    A planner receives this type and the map of what stands, and nothing else, so it cannot peek at the truth.
    """

    time_s: float
    """Time since the start of the mission [s]."""
    available: NDArray[np.bool_]
    """(run, uav): whether there is a position fix now; without one the position is carried on."""
    position: Array
    """(run, uav, 3) east, north, up [m]."""
    velocity: Array
    """(run, uav, 3) [m/s]."""
    attitude: Array
    """(run, uav, 3) roll, pitch, yaw [rad]."""
    body_rates: Array
    """(run, uav, 3) rates of roll, pitch, yaw [rad/s]."""
    covariance: Array
    """(run, uav, 6, 6) of position and velocity, as reported [m^2, m^2/s, m^2/s^2]."""
    common_factor: Array
    """(run, uav, 3, rank) factor L of the part that UAVs share: Sigma_ij = L_i L_j^T [m]."""
    airborne: NDArray[np.bool_] | None = None
    """(run, uav): whether the UAV still flies its mission, so a planner has to work for it; None for all."""
    filtered: bool = False
    """Whether it is a filter's estimate, whose error does not depend on it, or a measurement."""
    tracks: Tracks | None = None
    """Moving obstacles as tracked now; None in a world without any."""
    forecast: CovarianceForecast | None = None
    """What the filter knows of its covariance to come; None if the law of the errors is not known."""
    overbound: Overbound | None = None
    """Overbound of the reported law, from measured errors; None if none is known."""
    protection: Array | None = None
    """(run, uav, 2) horizontal and vertical protection level [m], not finite where there is none; None if
    navigation computes none."""
    disputed: NDArray[np.bool_] | None = None
    """(run, uav): whose fixes have contradicted its estimate for long, so that it is not available; None if
    nothing watches."""
    lasting: Array | None = None
    """(run, uav, 3, 3) part of the position's covariance that nothing measured reduces [m^2]; or None."""
    sigma_map: SigmaMap | None = None
    """Certainty of fixes by place; None if there is no map of it."""

    @property
    def position_covariance(self) -> Array:
        """(run, uav, 3, 3) reported covariance of the position [m^2]."""
        return self.covariance[..., :3, :3]

    def relative_covariance(self, i: int, j: int) -> Array:
        """Covariance of the position of UAV i relative to UAV j: Sigma_i + Sigma_j - Sigma_ij - Sigma_ij^T.

        Returns
        -------
        array, shape (run, 3, 3)
            As reported [m^2]. Nearby receivers share part of their error, which drops out.
        """
        cross = np.einsum("rak,rbk->rab", self.common_factor[:, i], self.common_factor[:, j])
        sigma = self.position_covariance
        return np.asarray(sigma[:, i] + sigma[:, j] - cross - cross.transpose(0, 2, 1))

    def position_covariance_ahead(
        self, ahead_s: Array, with_fixes: bool, places: Array | None = None
    ) -> Array:
        """Covariance of the position at times from now: that of now, each axis with the variance of then.

        Correlations between axes are held. Without a forecast all is, but for what the sigma map says of the
        places to come; there, without a fix, the last one's covariance grows as everywhere.

        Parameters
        ----------
        ahead_s : array, shape (N,)
            Times from now, >= 0 and increasing [s].
        with_fixes : bool
            Whether fixes go on as they come now, or none does.
        places : array, shape (run, uav, N, 3), optional
            Where the UAVs will be then, for the sigma map [m].

        Returns
        -------
        array, shape (run, uav, N, 3, 3)
            [m^2].
        """
        if with_fixes and places is not None and self.sigma_map is not None:
            return self._covariance_at(self.sigma_map, ahead_s, places)
        if self.forecast is None:
            return np.repeat(self.position_covariance[:, :, None], len(ahead_s), axis=2)
        change = self.forecast.change(ahead_s, with_fixes)
        out = np.empty((*change.shape, 3))
        if self.lasting is None:
            _stretch(plain(self.covariance), change, out)
            return out
        waning = self.covariance.copy()
        waning[..., :3, :3] -= self.lasting
        _stretch(plain(waning), change, out)
        out += self.lasting[:, :, None]
        return out

    def _covariance_at(self, sigma_map: SigmaMap, ahead_s: Array, places: Array) -> Array:
        """Covariance (run, uav, N, 3, 3) at times from now and the places of then, by the map [m^2]."""
        out = np.empty((*places.shape, 3))
        if self.forecast is None:
            whole = np.einsum("...aa->...a", self.position_covariance)
            (at_places,) = sigma_map.ahead([whole], self.available, self.position, places)
            then, age = _carried_on(whole, at_places, ahead_s)
            now = np.where(whole > 0.0, whole, np.inf)[:, :, None]
            _stretch(plain(self.covariance), (then + coasting_variance(age)) / now, out)
            return out
        forecast = self.forecast
        lasts = np.zeros(places[:, :, 0].shape)
        if self.lasting is not None:
            lasts = np.einsum("...aa->...a", self.lasting)
        own, lasting = sigma_map.ahead([forecast.sigma**2, lasts], forecast.fixes, self.position, places)
        waning = self.covariance.copy()
        if self.lasting is not None:
            waning[..., :3, :3] -= self.lasting
        _stretch(plain(waning), forecast.change(ahead_s, True, np.sqrt(own)), out)
        if self.lasting is not None:
            then, _ = _carried_on(lasts, lasting, ahead_s)
            share = np.empty_like(out)
            held = np.where(lasts > 0.0, lasts, np.inf)[:, :, None]
            _stretch(plain(self.lasting), np.where(np.isinf(held), 1.0, then / held), share)
            out += share
        return out

    def check(self, runs: int, uavs: int) -> None:
        """Raise unless all arrays have the shapes that are documented here, for so many runs and UAVs.

        Raises
        ------
        NavigationError
            If one has not; it names all that have not.
        """
        many = runs, uavs
        vectors, factor = (*many, 3), self.common_factor
        told: list[tuple[str, object, tuple[int, ...]]] = [
            ("available", self.available, many),
            ("position", self.position, vectors),
            ("velocity", self.velocity, vectors),
            ("attitude", self.attitude, vectors),
            ("body_rates", self.body_rates, vectors),
            ("covariance", self.covariance, (*many, 6, 6)),
            ("common_factor", factor, (*vectors, factor.shape[3] if np.ndim(factor) == 4 else -1)),
        ]
        if self.airborne is not None:
            told.append(("airborne", self.airborne, many))
        if self.protection is not None:
            told.append(("protection", self.protection, (*many, 2)))
        if self.disputed is not None:
            told.append(("disputed", self.disputed, many))
        if self.lasting is not None:
            told.append(("lasting", self.lasting, (*vectors, 3)))
        if self.forecast is not None:
            told.append(("forecast.fixes", self.forecast.fixes, many))
        faults = []
        for name, values, want in told:
            if getattr(values, "shape", None) != want:
                faults.append(_misfit(name, values, want))
            elif want is many and isinstance(values, np.ndarray) and values.dtype.kind != "b":
                faults.append(f"{name} has type {values.dtype}, must be bool")
        if faults:
            hint = "; call the planner's reset(obstacles, runs) first" if runs == 0 else ""
            raise NavigationError("; ".join(faults) + hint)

    def trusted(self) -> NDArray[np.bool_]:
        """(run, uav): a fix is there, all numbers are finite, and the covariance of the position is one.

        A variance of zero, a negative one or NaN means "unknown", never "certain", and so does a matrix with
        a negative eigenvalue or one that is not symmetric, or a part that UAVs share which is more than the
        whole: such a solution is not to be planned with.
        """
        trusted = np.empty(self.available.shape, dtype=np.bool_)
        _sound(
            self.available, plain(self.position), plain(self.velocity), plain(self.attitude),
            plain(self.body_rates), plain(self.covariance), plain(self.common_factor), trusted,
        )  # fmt: skip
        return trusted


def _misfit(name: str, values: object, want: tuple[int, ...]) -> str:
    """What is wrong with a value's shape, in words; -1 stands for any length."""
    must = str(want).replace("-1", "rank")
    if not isinstance(values, np.ndarray):
        return f"{name} is a {type(values).__name__}, must be an array {must}"
    return f"{name} has shape {values.shape}, must be {must}"


def _carried_on(now: Array, then: Array, ahead_s: Array) -> tuple[Array, Array]:
    """Variances (run, uav, N, 3), those of the last fix where there is none, and the age of that fix [s]."""
    age = np.zeros(then.shape)
    if not np.isinf(then).any():
        return then, age
    then = then.copy()
    before, waited, moment = now, np.zeros(now.shape), 0.0
    for n, ahead in enumerate(ahead_s):
        none = np.isinf(then[:, :, n])
        waited = np.where(none, waited + (ahead - moment), 0.0)
        before = then[:, :, n] = np.where(none, before, then[:, :, n])
        age[:, :, n], moment = waited, ahead
    return then, age


@compiled_bare
def _stretch(covariance: Array, change: Array, out: Array) -> None:
    """Write covariances (run, uav, N, 3, 3) whose axes have changed by factors (run, uav, N, 3)."""
    for run in range(out.shape[0]):
        for uav in range(out.shape[1]):
            for n in range(out.shape[2]):
                for a in range(3):
                    scale = math.sqrt(change[run, uav, n, a])
                    for b in range(3):
                        both = scale * math.sqrt(change[run, uav, n, b])
                        out[run, uav, n, a, b] = covariance[run, uav, a, b] * both


@compiled
def _sound(
    available: Mask, position: Array, velocity: Array, attitude: Array, rates: Array, covariance: Array,
    factor: Array, sound: Mask,
) -> None:  # fmt: skip
    """Write whether a solution is there, all its numbers are finite, and its position's covariance is one."""
    for run in range(sound.shape[0]):
        for uav in range(sound.shape[1]):
            fine = available[run, uav] and _semidefinite(covariance[run, uav])
            for a in range(3):
                fine = fine and np.isfinite(position[run, uav, a]) and np.isfinite(velocity[run, uav, a])
                fine = fine and np.isfinite(attitude[run, uav, a]) and np.isfinite(rates[run, uav, a])
                fine = fine and covariance[run, uav, a, a] > 0.0
                shared = 0.0
                for c in range(factor.shape[3]):
                    shared += factor[run, uav, a, c] * factor[run, uav, a, c]
                # NaN fails every comparison.
                fine = fine and shared <= covariance[run, uav, a, a] * (1.0 + 1e-6)
            for a in range(6):
                for b in range(6):
                    fine = fine and np.isfinite(covariance[run, uav, a, b])
            for a in range(3):
                for b in range(a):
                    c = covariance[run, uav]
                    fine = fine and abs(c[a, b] - c[b, a]) <= 1e-6 * np.sqrt(c[a, a] * c[b, b])
            sound[run, uav] = fine


@compiled
def _semidefinite(c: Array) -> bool:
    """Whether the leading 3x3 of a matrix has no negative eigenvalue beyond rounding, by its minors."""
    xy, xz, yz = 0.5 * (c[0, 1] + c[1, 0]), 0.5 * (c[0, 2] + c[2, 0]), 0.5 * (c[1, 2] + c[2, 1])
    x, y, z = c[0, 0], c[1, 1], c[2, 2]
    # Each minor is measured against the product of its variances, whatever their unit's size.
    slack = 1e-9
    sound = xy * xy <= x * y * (1.0 + slack)
    sound = sound and xz * xz <= x * z * (1.0 + slack) and yz * yz <= y * z * (1.0 + slack)
    determinant = x * (y * z - yz * yz) - xy * (xy * z - yz * xz) + xz * (xy * yz - y * xz)
    return bool(sound and determinant >= -slack * x * y * z)
