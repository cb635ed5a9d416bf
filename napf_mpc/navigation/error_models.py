"""Position errors of navigation: correlated with a swinging sigma, constant, or replayed from a log."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napf_mpc.errors import ProblemError
from napf_mpc.navigation.fix import Fix, PositionErrors, coasting_variance, diagonal
from napf_mpc.navigation.processes import (
    gauss_markov,
    has_fix,
    last_fix,
    mixed,
    outage_starts,
    swinging_sigma,
)
from napf_mpc.navigation.replay import RecordedErrors, recorded_errors
from napf_mpc.problem import ConstantBias, GaussMarkov, Gnss, Navigation, Recorded
from napf_mpc.streams import Seed, Stream, normals, uniforms

__all__ = [
    "ConstantErrors",
    "Fix",
    "GaussMarkovErrors",
    "PositionErrors",
    "RecordedErrors",
    "constant_errors",
    "gauss_markov_errors",
    "position_errors",
]

Array = NDArray[np.float64]


def position_errors(
    navigation: Navigation,
    seed: Seed,
    runs: range,
    uav_count: int,
    duration_s: float,
    data_folder: Path | None,
) -> PositionErrors:
    """Draw the position errors of a block of runs.

    Parameters
    ----------
    navigation : Navigation
        Which errors.
    seed : int or Numbers
        Campaign seed, or what stands for it.
    runs : range
        Runs of the block. What a run draws depends on its index and the seed alone.
    uav_count : int
        Number of UAVs.
    duration_s : float
        Time that the errors must cover [s]; a longer one never changes the first epochs.
    data_folder : Path or None
        Folder of recorded logs (see :func:`napf_mpc.data_folder.find_data_file`).

    Raises
    ------
    DataError
        The log is missing or unusable.
    ProblemError
        A setting cannot be flown.
    """
    if not (math.isfinite(duration_s) and duration_s >= 0.0):
        raise ValueError(f"duration_s = {duration_s!r} must be a finite number >= 0")
    epochs = math.ceil(duration_s * navigation.rate_hz - 1e-9) + 1
    match navigation:
        case GaussMarkov():
            return _draw_gauss_markov(navigation, seed, runs, uav_count, epochs)
        case ConstantBias():
            own, common = _draw_units(navigation.common_mode_share, seed, runs, uav_count, 1)
            share = uniforms(seed, runs, Stream.SIGMA_PHASE, uav_count, 3, 1)[..., 0]
            return constant_errors(navigation, own[..., 0], common[..., 0], share, epochs)
        case Recorded():
            return recorded_errors(navigation, seed, runs, uav_count, epochs, data_folder)
        case Gnss():
            raise ProblemError(
                "navigation.kind", ['is "gnss": its errors depend on the place; see navigation.gnss_fixes']
            )


# --------------------------------------------------------------------------------------- Gauss-Markov


@dataclass(frozen=True)
class GaussMarkovErrors:
    r"""Errors e = sigma(t) g(t): g of unit variance and correlated in time, sigma swinging.

    Sigma multiplies after the recursion, so that P(\|e\| < k sigma(t)) is exact at each time.
    """

    config: GaussMarkov
    """Settings."""
    unit: Array
    """(epoch, run, uav, 3) unit process g, frozen in outages."""
    phase: Array
    """(run, uav, 3) phase of sigma's swing [rad]."""
    source: NDArray[np.int32] | None
    """(epoch, run, uav) epoch of the last fix; None without outages."""

    @property
    def period_s(self) -> float:
        """Time between two epochs [s]."""
        return 1.0 / self.config.rate_hz

    def fix(self, epoch: int) -> Fix:
        """Return the fix of an epoch."""
        _require_epoch(epoch, len(self.unit))
        cfg = self.config
        unit = self.unit[epoch]
        shape = unit.shape[:2]
        if self.source is None:
            age = None
            time: Array | float = epoch * self.period_s
            available = np.ones(shape, dtype=np.bool_)
        else:
            source = self.source[epoch]
            age = ((epoch - source) * self.period_s)[..., None]
            time = (source * self.period_s)[..., None]
            available = source == epoch
        sigma = swinging_sigma(time, cfg.sigma_min_m, cfg.sigma_max_m, cfg.sigma_period_s, self.phase)
        variance = sigma**2 if age is None else sigma**2 + coasting_variance(age)
        shared = math.sqrt(cfg.common_mode_share) * sigma
        if age is not None:
            shared = shared * _memory(age, cfg.correlation_time_s)
        return Fix(
            error=cfg.error_scale * (sigma * unit),
            covariance=cfg.reported_sigma_scale**2 * diagonal(variance),
            common_factor=cfg.reported_sigma_scale * diagonal(shared),
            available=available,
        )


def gauss_markov_errors(
    config: GaussMarkov,
    own: Array,
    common: Array,
    phase_share: Array,
    available: NDArray[np.bool_] | None = None,
) -> GaussMarkovErrors:
    """Map standard-normal and uniform arrays to correlated errors.

    Parameters
    ----------
    config : GaussMarkov
        Settings.
    own : array, shape (run, uav, 3, epoch)
        Standard normal.
    common : array, shape (run, 1, 3, epoch)
        Standard normal, the part that all UAVs share.
    phase_share : array, shape (run, uav, 3)
        Uniform on [0, 1): phase of sigma's swing over a full turn.
    available : bool array, shape (epoch, run, uav), optional
        Whether there is a fix; by default always.
    """
    period_s, tau_s = 1.0 / config.rate_hz, config.correlation_time_s
    unit = mixed(
        gauss_markov(own, period_s, tau_s), gauss_markov(common, period_s, tau_s), config.common_mode_share
    )
    unit = np.ascontiguousarray(np.moveaxis(unit, -1, 0))
    source = None
    if available is not None:
        source = last_fix(available)
        unit = np.take_along_axis(unit, source[..., None], axis=0)
    return GaussMarkovErrors(config, unit, 2.0 * math.pi * phase_share, source)


def _draw_gauss_markov(
    config: GaussMarkov, seed: Seed, runs: range, uav_count: int, epochs: int
) -> GaussMarkovErrors:
    own, common = _draw_units(config.common_mode_share, seed, runs, uav_count, epochs)
    phase_share = uniforms(seed, runs, Stream.SIGMA_PHASE, uav_count, 3, 1)[..., 0]
    available = None
    if config.outage_interval_s > 0.0 and config.outage_duration_s > 0.0:
        available = _draw_availability(config, seed, runs, uav_count, epochs)
    return gauss_markov_errors(config, own, common, phase_share, available)


def _draw_availability(
    config: GaussMarkov, seed: Seed, runs: range, uav_count: int, epochs: int
) -> NDArray[np.bool_]:
    interval_s, length_s = config.outage_interval_s, config.outage_duration_s
    period_s = 1.0 / config.rate_hz
    if interval_s < period_s:
        raise ProblemError(
            "navigation",
            [
                f"outage_interval_s = {interval_s:g} must be 0 (no outages) or at least the time between two "
                f"fixes, 1 / rate_hz = {period_s:g} s"
            ],
        )
    time = np.arange(epochs, dtype=np.float64) * period_s
    count = 8
    while True:
        # A longer draw from the same streams starts with the same numbers.
        u = uniforms(seed, runs, Stream.OUTAGE, uav_count, 1, count)[:, :, 0]
        starts = outage_starts(u, interval_s, length_s)
        if np.all(starts[..., -1] > time[-1]):
            return has_fix(starts, length_s, time)
        count *= 2


def _memory(age_s: Array, correlation_time_s: float) -> Array:
    """Correlation that a frozen error still has with errors of now."""
    if correlation_time_s == 0.0:
        return np.where(age_s > 0.0, 0.0, 1.0)
    return np.exp(-age_s / correlation_time_s)


# ------------------------------------------------------------------------------------------- constant


@dataclass(frozen=True)
class ConstantErrors:
    """Errors that stay as they are for the whole mission."""

    period_s: float
    """Time between two epochs [s]."""
    epochs: int
    """Number of epochs."""
    constant: Fix
    """The fix of every epoch."""

    def fix(self, epoch: int) -> Fix:
        """Return the fix of an epoch, always the same."""
        _require_epoch(epoch, self.epochs)
        return self.constant


def constant_errors(
    config: ConstantBias, own: Array, common: Array, sigma_share: Array, epochs: int
) -> ConstantErrors:
    """Map standard-normal and uniform arrays to constant errors.

    Parameters
    ----------
    config : ConstantBias
        Settings.
    own, common : array, shape (run, uav, 3), (run, 1, 3)
        Standard normal: each UAV's own part, and the part that all share.
    sigma_share : array, shape (run, uav, 3)
        Uniform on [0, 1): where sigma lies between its bounds.
    epochs : int
        Number of epochs.
    """
    sigma = config.sigma_min_m + (config.sigma_max_m - config.sigma_min_m) * sigma_share
    unit = mixed(own, common, config.common_mode_share)
    reported = config.reported_sigma_scale * sigma
    fix = Fix(
        error=config.error_scale * (sigma * unit),
        covariance=diagonal(reported**2),
        common_factor=diagonal(math.sqrt(config.common_mode_share) * reported),
        available=np.ones(sigma.shape[:2], dtype=np.bool_),
    )
    return ConstantErrors(1.0 / config.rate_hz, epochs, fix)


# ---------------------------------------------------------------------------------------------- shared


def _draw_units(share: float, seed: Seed, runs: range, uav_count: int, count: int) -> tuple[Array, Array]:
    """Own (run, uav, 3, count) and common (run, 1, 3, count) standard-normal numbers."""
    own = normals(seed, runs, Stream.OWN_ERROR, uav_count, 3, count)
    if share == 0.0:  # it would be multiplied by zero
        return own, np.zeros((len(runs), 1, 3, count))
    return own, normals(seed, runs, Stream.COMMON_ERROR, 1, 3, count)


def _require_epoch(epoch: int, epochs: int) -> None:
    if not 0 <= epoch < epochs:
        raise IndexError(f"epoch = {epoch} must be from 0 to {epochs - 1}: the errors were drawn that far")
