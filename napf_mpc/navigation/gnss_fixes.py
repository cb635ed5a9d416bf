"""Position fixes of emulated receivers: ranges at the true place, solved, with that solution's covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napf_mpc.navigation.fix import Fix, coasting_variance
from napf_mpc.navigation.gnss import GnssScene, Observation
from napf_mpc.navigation.gnss_levels import levels_of, with_levels
from napf_mpc.navigation.pseudorange_solution import Check, PseudorangeSolution, SolverSettings, solve
from napf_mpc.problem import Gnss
from napf_mpc.streams import NormalRows, Seed, Stream

__all__ = ["GnssErrors", "GnssFixes", "solve_observation", "solver_settings"]

Array = NDArray[np.float64]


def solver_settings(config: Gnss) -> SolverSettings:
    """How a problem's receivers compute positions."""
    return SolverSettings(
        config.weighting, config.fault_exclusion == "residuals", config.false_alarm, config.max_pdop
    )


def solve_observation(
    observed: Observation, scene: GnssScene, settings: SolverSettings
) -> PseudorangeSolution:
    """Solve for all receivers (run, uav); what is found is the error of the place.

    At distances of hundreds of metres the linear solution is that of full pseudoranges to under a millimetre.
    """
    _, uavs, sats = observed.error.shape
    unit = np.repeat(observed.directions[:, None], uavs, axis=1)
    return solve(
        unit.reshape(-1, sats, 3),
        scene.clock,
        observed.error.reshape(-1, sats),
        observed.sigma.reshape(-1, sats),
        observed.tracked.reshape(-1, sats),
        settings,
    )


class GnssErrors:
    """Errors of emulated receivers in a block of runs: at each epoch they depend on the true places.

    Parameters
    ----------
    scene : GnssScene
        Satellites, buildings and errors.
    seed : int or Numbers
        Campaign seed, or what stands for it, for the white noise.
    runs : range
        Runs of the block.
    uav_count : int
        Number of UAVs.
    """

    def __init__(self, scene: GnssScene, seed: Seed, runs: range, uav_count: int) -> None:
        self.scene = scene
        self._seed, self._runs, self._uavs = seed, runs, uav_count

    @property
    def period_s(self) -> float:
        """Time between two epochs [s]."""
        return 1.0 / self.scene.config.rate_hz

    def begin(self) -> GnssFixes:
        """Return the fixes of one flight, from epoch 0 on; each flight meets the same errors."""
        receivers, sats = len(self._runs) * self._uavs, len(self.scene.names)
        # Some ten megabytes of noise at most, but for formations of thousands.
        ahead = max(1, min(32, 2_000_000 // (receivers * sats)))
        noise = NormalRows(self._seed, self._runs, Stream.GNSS_NOISE, self._uavs, sats, ahead)
        return GnssFixes(self.scene, noise, self.period_s, (len(self._runs), self._uavs))


class GnssFixes:
    """Fixes of a flight, epoch by epoch.

    Without a fix the error stays what it was in the last, and the covariance grows as everywhere. A UAV that
    has none at the start carries one on that it took under an open sky. Where the residuals show a fault that
    cannot be told, the covariance is scaled by their sum over its degrees of freedom.

    Parameters
    ----------
    scene : GnssScene
        What receivers meet.
    noise : NormalRows
        Code noise (run, uav, sat) of each epoch.
    period_s : float
        Time between two epochs [s].
    shape : (int, int)
        Runs and UAVs.
    """

    def __init__(self, scene: GnssScene, noise: NormalRows, period_s: float, shape: tuple[int, int]) -> None:
        self._scene, self._noise, self._period_s = scene, noise, period_s
        self._settings = solver_settings(scene.config)
        self._next = 0
        self._error = np.zeros((*shape, 3))
        self._covariance = np.zeros((*shape, 3, 3))
        self._age = np.zeros(shape)
        self.check = np.zeros(shape, dtype=np.int8)
        """(run, uav) codes of :class:`~napf_mpc.navigation.pseudorange_solution.Check` of the last epoch."""

    def fix(self, epoch: int, position: Array) -> Fix:
        """Return the fix of the next epoch.

        Parameters
        ----------
        epoch : int
            Its number; epochs come one by one from 0 on.
        position : array, shape (run, uav, 3)
            True places, which decide what is in sight and which reflections are met [m].
        """
        if epoch != self._next:
            raise IndexError(f"epoch = {epoch}, but the next one of this flight is {self._next}")
        self._next += 1
        cfg, scene = self._scene.config, self._scene
        noise = self._noise.take()
        time_s = epoch * self._period_s
        observed = scene.observe(time_s, position, noise)
        found = solve_observation(observed, scene, self._settings)
        shape = self._error.shape[:2]
        protection = None
        if cfg.integrity == "araim":
            levels = levels_of(observed, scene)
            found = with_levels(found, levels, observed, scene)
            protection = cfg.reported_sigma_scale * levels.level_m.reshape(*shape, 2)
        self.check = found.check.reshape(shape)
        available = self.check != Check.NONE
        if epoch == 0 and not available.all():
            wide = scene.observe(time_s, position, noise, open_sky=True)
            before = solve_observation(wide, scene, SolverSettings("plain", exclude=False, max_pdop=1e6))
            self._error = before.offset.reshape(*shape, 3)
            self._covariance = before.covariance.reshape(*shape, 3, 3)
        excess = np.where(
            self.check == Check.FAULTY, np.nan_to_num(found.excess.reshape(shape), nan=1.0), 1.0
        )
        fresh = found.covariance.reshape(*shape, 3, 3) * np.maximum(excess, 1.0)[..., None, None]
        self._error = np.where(available[..., None], found.offset.reshape(*shape, 3), self._error)
        self._covariance = np.where(available[..., None, None], fresh, self._covariance)
        self._age = np.where(available, 0.0, self._age + (self._period_s if epoch else 0.0))
        covariance = self._covariance.copy()
        np.einsum("...ii->...i", covariance)[...] += coasting_variance(self._age)[..., None]
        factor = found.gain.reshape(*shape, 3, -1) * observed.shared_sigma[:, None, None]
        return Fix(
            error=cfg.error_scale * self._error,
            covariance=cfg.reported_sigma_scale**2 * covariance,
            common_factor=cfg.reported_sigma_scale * factor,
            available=available,
            protection=protection,
        )
