"""Replay of a measured error log: each run and each UAV starts somewhere else in it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napf_mpc.data_folder import find_data_file
from napf_mpc.errors import DataError
from napf_mpc.navigation.fix import Fix, coasting_variance
from napf_mpc.navigation.integrity.overbound import AxisOverbound, Overbound, fit_overbound
from napf_mpc.navigation.processes import gauss_markov, last_fix
from napf_mpc.navigation.readers.formats import format_of, read_track
from napf_mpc.navigation.recorded import (
    ErrorLog,
    errors_against_truth,
    halves,
    read_error_log_csv,
    sample_period,
)
from napf_mpc.problem import Recorded
from napf_mpc.streams import Seed, Stream, normals, uniforms

__all__ = ["RecordedErrors", "flown_part", "load_error_log", "recorded_errors", "replay"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_MAX_SLOTS = 2_000_000
_OFF_GRID = 0.25  # periods that a step may be off a whole number of them


def load_error_log(config: Recorded, data_folder: Path | None) -> ErrorLog:
    """Read the log that a problem names.

    Raises
    ------
    DataError
        The log is missing or unusable, or its truth is the solution itself.
    """
    if Path(config.file).suffix.lower() == ".csv" and config.format == "auto":
        if config.truth_file is not None:
            raise DataError(f"navigation.truth_file: {config.file} holds errors already; leave the truth out")
        return read_error_log_csv(find_data_file(config.file, data_folder))
    kind = format_of(config.file, config.format, "navigation.file")
    if config.truth_file is None:
        raise DataError(
            f"navigation.truth_file: {config.file} holds positions; name the true ones, by the same clock"
        )
    truth_kind = format_of(config.truth_file, config.truth_format, "navigation.truth_file")
    solution = read_track(find_data_file(config.file, data_folder), kind)
    truth = read_track(find_data_file(config.truth_file, data_folder), truth_kind)
    log = errors_against_truth(solution, truth)
    if not log.error.any():
        raise DataError(
            f"navigation.truth_file: {config.truth_file} has the positions of {config.file} to the last "
            "digit, so that no error is left; name the true ones"
        )
    return log


def recorded_errors(
    config: Recorded, seed: Seed, runs: range, uav_count: int, epochs: int, data_folder: Path | None
) -> RecordedErrors:
    """Draw where each run and UAV starts in the log, and the barometers' errors."""
    log, overbound = flown_part(load_error_log(config, data_folder), config)
    common = uniforms(seed, runs, Stream.RECORD_OFFSET, 1, 1, 1)[:, 0, 0, 0]
    own = uniforms(seed, runs, Stream.RECORD_OFFSET, uav_count, 2, 1)[:, :, 1, 0]
    barometer = None
    if config.vertical == "barometer":
        barometer = normals(seed, runs, Stream.BAROMETER, uav_count, 1, epochs)[:, :, 0]
    return replace(replay(config, log, common, own, epochs, barometer), overbound=overbound)


def flown_part(log: ErrorLog, config: Recorded) -> tuple[ErrorLog, Overbound | None]:
    """Part of a log that is replayed, and the overbound that the other half gives for it.

    A barometer's height keeps its own law, so its axis grows by nothing. Where two errors of the log are
    mixed, their shifts may add up: sqrt(c) sigma_1 + sqrt(1 - c) sigma_2 is at most sqrt(2) sigmas of both.

    Raises
    ------
    DataError
        A half is too short.
    """
    if config.part == "all":
        return log, None
    first, second = halves(log)
    flown, other = (first, second) if config.part == "first_half" else (second, first)
    bound = fit_overbound(other)
    east, north, up = bound.axes
    if 0.0 < config.common_mode_share < 1.0:
        east, north, up = (replace(axis, bias=math.sqrt(2.0) * axis.bias) for axis in (east, north, up))
    if config.vertical == "barometer":
        up = AxisOverbound(bias=0.0, sigma=1.0, n=up.n, effective_n=up.effective_n)
    return flown, replace(bound, axes=(east, north, up))


def replay(
    config: Recorded, log: ErrorLog, common: Array, own: Array, epochs: int, barometer: Array | None
) -> RecordedErrors:
    """Map uniform and standard-normal arrays to replayed errors.

    Parameters
    ----------
    config : Recorded
        Settings; its file names are not read here.
    log : ErrorLog
        What was measured.
    common, own : array, shape (run,), (run, uav)
        Uniform on [0, 1): start in the log of the part that all share, and of each UAV's own part.
    epochs : int
        Number of epochs.
    barometer : array, shape (run, uav, epoch), or None
        Standard normal, if ``vertical`` is ``"barometer"``.
    """
    table = _table(log, config.gaps == "outage", config.vertical == "recorded")
    n = len(table.available)
    period_s = 1.0 / config.rate_hz
    common_start = (common * n).astype(np.int64)[:, None]
    own_start = (own * n).astype(np.int64)
    vertical = None
    if config.vertical == "barometer":
        if barometer is None:
            raise ValueError("barometer: standard-normal numbers are needed for vertical = barometer")
        unit = gauss_markov(barometer, period_s, config.barometer_correlation_time_s)
        vertical = config.barometer_sigma_m * np.ascontiguousarray(np.moveaxis(unit, -1, 0))
    available = None
    if not table.available.all():
        slots = np.arange(_slot((epochs - 1) * period_s, table.period_s) + 1)[:, None, None]
        available = np.ones((len(slots), *own_start.shape), dtype=np.bool_)
        if config.common_mode_share > 0.0:
            available &= table.available[(common_start + slots) % n]
        if config.common_mode_share < 1.0:
            available &= table.available[(own_start + slots) % n]
    source = None if available is None else last_fix(available)
    return RecordedErrors(config, table, epochs, common_start, own_start, vertical, available, source)


@dataclass(frozen=True)
class RecordedErrors:
    """Replayed errors: e_i = sqrt(c) e_log(common place) + sqrt(1 - c) e_log(own place).

    The reported covariance is mixed alike, Sigma_i = c Sigma_common + (1 - c) Sigma_own, and two UAVs share
    Sigma_ij = c Sigma_common, c the common-mode share. For 0 < c < 1 this is no longer the measured law. The
    mixing thins the log's tails, a sum of two errors being nearer to a normal law than each: on the Nagoya
    log, over all pairs of its epochs, the kurtosis of east error over reported sigma falls from 8.8 to 5.2 at
    c = 0.5, while the share beyond 3 sigma stays (3.6 % and 3.9 %). A mean error in the log grows by the
    factor sqrt(c) + sqrt(1 - c). For the measured law itself use c = 0 or c = 1.

    A sample of the log is held until the next. Without a fix in either part a UAV has none: for 0 < c < 1
    outages are more frequent than in the log. A UAV that starts in an outage carries the last fix before it
    in the log, with its age. Nothing counts as shared while a UAV has no fix. A barometer needs no fix: its
    height error goes on through outages.
    """

    config: Recorded
    """Settings."""
    table: _Table
    """The log as it is replayed."""
    epochs: int
    """Number of epochs."""
    common_start: Index
    """(run, 1) sample of the log at t = 0, for the common part."""
    own_start: Index
    """(run, uav) sample of the log at t = 0, for each UAV's own part."""
    vertical: Array | None
    """(epoch, run, uav) error of the barometer's height [m]."""
    available: NDArray[np.bool_] | None
    """(sample, run, uav) whether there is a fix; None if always."""
    source: NDArray[np.int32] | None
    """(sample, run, uav) sample of the last fix; None without outages."""
    overbound: Overbound | None = None
    """Fitted to the half of the log that is not replayed; None if all of it is."""

    @property
    def period_s(self) -> float:
        """Time between two epochs [s]."""
        return 1.0 / self.config.rate_hz

    def fix(self, epoch: int) -> Fix:
        """Return the fix of an epoch."""
        if not 0 <= epoch < self.epochs:
            raise IndexError(f"epoch = {epoch} must be from 0 to {self.epochs - 1}")
        cfg, table = self.config, self.table
        time = epoch * self.period_s
        slot = _slot(time, table.period_s)
        step: int | NDArray[np.int32] = slot if self.source is None else self.source[slot]
        i = (self.common_start + step) % len(table.available)
        j = (self.own_start + step) % len(table.available)
        share, rest = cfg.common_mode_share, 1.0 - cfg.common_mode_share
        error = math.sqrt(share) * table.error[i] + math.sqrt(rest) * table.error[j]
        covariance = share * table.covariance[i] + rest * table.covariance[j]
        factor = np.broadcast_to(math.sqrt(share) * table.factor[i], covariance.shape).copy()
        available = np.ones(self.own_start.shape, dtype=np.bool_)
        if self.available is not None:
            available = self.available[slot].copy()
            age_at_start = np.maximum((share > 0.0) * table.age_s[i], (rest > 0.0) * table.age_s[j])
            age = age_at_start + (time - step * table.period_s)
            growth = np.where(available, 0.0, coasting_variance(age))
            np.einsum("...ii->...i", covariance)[...] += growth[..., None]
            factor *= available[..., None, None]
        if self.vertical is not None:
            error[..., 2] = self.vertical[epoch]
            covariance[..., 2, 2] = cfg.barometer_sigma_m**2
        return Fix(
            error=cfg.error_scale * error,
            covariance=cfg.reported_sigma_scale**2 * covariance,
            common_factor=cfg.reported_sigma_scale * factor,
            available=available,
            overbound=self.overbound,
        )


@dataclass(frozen=True)
class _Table:
    """A log on an even time grid, with the last fix held through gaps."""

    period_s: float
    available: NDArray[np.bool_]
    """(n,)"""
    error: Array
    """(n, 3) of the last fix."""
    covariance: Array
    """(n, 3, 3) of the last fix."""
    factor: Array
    """(n, 3, 3) F with F F^T = covariance."""
    age_s: Array
    """(n,) time since the last fix; the log is a ring."""


def _table(log: ErrorLog, with_gaps: bool, with_height: bool) -> _Table:
    fixes = np.flatnonzero(log.available)
    if with_gaps:
        period_s, slots = _even_grid(log)
        n = int(slots[-1]) + 1
        if n > _MAX_SLOTS:
            raise DataError(f"{log.source}: {n} steps of {period_s:g} s with its gaps, at most {_MAX_SLOTS}")
        fix_of_slot = np.full(n, -1)
        fix_of_slot[slots[fixes].astype(np.int64)] = fixes
    else:
        period_s = sample_period(log.time_s)
        fix_of_slot = fixes
    n = len(fix_of_slot)
    here = fix_of_slot >= 0
    twice = np.arange(2 * n)  # a log that starts in a gap carries on from its end
    last = np.maximum.accumulate(np.where(np.tile(here, 2), twice, -1))[n:]
    row = fix_of_slot[last % n]
    error, covariance = log.error[row].copy(), log.covariance[row].copy()
    if not with_height:
        error[:, 2] = 0.0
        covariance[:, 2, :] = 0.0
        covariance[:, :, 2] = 0.0
    values, vectors = np.linalg.eigh(covariance)
    factor = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return _Table(period_s, here, error, covariance, factor, (twice[n:] - last).astype(np.float64) * period_s)


def _even_grid(log: ErrorLog) -> tuple[float, Array]:
    """Period of an even grid, and the step (n,) of it at which each epoch lies, no two at one.

    Where two would fall on one, multiples of the usual step, or of a part of it, are counted step by step:
    clocks jitter, and the usual step is two seconds where fixes seldom come a second apart. Times that do not
    fit have no grid on which a gap could be told.

    Raises
    ------
    DataError
        The times fit no grid.
    """
    steps, usual_s = np.diff(log.time_s), sample_period(log.time_s)
    slots = np.round((log.time_s - log.time_s[0]) / usual_s)
    if (np.diff(slots) > 0.0).all():
        return usual_s, slots
    for period_s in (usual_s / parts for parts in range(1, 6)):
        counts = np.round(steps / period_s)
        if (counts > 0.0).all() and (np.abs(steps / period_s - counts) < _OFF_GRID).all():
            return period_s, np.concatenate([[0.0], np.cumsum(counts)])
    raise DataError(
        f"{log.source}: its epochs lie {steps.min():g} to {steps.max():g} s apart, on no even grid, so that "
        'gaps cannot be told; set navigation.gaps = "close"'
    )


def _slot(time_s: float, period_s: float) -> int:
    """Sample of the log at a time: each is held until the next."""
    return math.floor(time_s / period_s + 1e-6)  # 0.7 / 0.1 is 6.999...
