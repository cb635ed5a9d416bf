"""Measured navigation errors with the covariance that was reported at the time."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pymap3d
from numpy.typing import NDArray

from napf_mpc.errors import DataError
from napf_mpc.navigation.clocks import CLOCKS, gps_time_s
from napf_mpc.navigation.rtklib import PosTrack, numbered_lines, read_rtklib_pos
from napf_mpc.words import shown_text

__all__ = [
    "Coverage",
    "ErrorLog",
    "PosTrack",
    "coverage",
    "errors_against_truth",
    "halves",
    "read_error_log_csv",
    "read_rtklib_pos",
    "sample_period",
]

Array = NDArray[np.float64]

MATCH_S = 0.005
"""Largest time between a solution and the truth that it is compared with: 5 mm at 1 m/s."""
_MAX_ERROR_M = 1e6
_MAX_USUAL_ERROR_M = 1000.0
_MAX_TIME_S = 1e10
_MIN_STEP_S = 0.005
_MAX_VARIANCE_M2 = 1e12
_PSD_TOLERANCE = 1e-3  # files round to four digits; what is more negative than that is no rounding
_CSV_ERRORS = ("err_e_m", "err_n_m", "err_u_m")
_CSV_COVARIANCES = ("cov_ee_m2", "cov_en_m2", "cov_eu_m2", "cov_nn_m2", "cov_nu_m2", "cov_uu_m2")


@dataclass(frozen=True)
class ErrorLog:
    """Errors of a positioning solution against the truth, east, north, up.

    Raises
    ------
    DataError
        Times do not ascend, fewer than two epochs have a fix, or an epoch with a fix holds a number that is
        not finite, a variance that is not positive, or a matrix that is no covariance.
    """

    source: str
    """File it came from, for messages."""
    time_s: Array
    """(n,) ascending [s]."""
    available: NDArray[np.bool_]
    """(n,): whether the epoch has a fix."""
    error: Array
    """(n, 3) solution minus truth [m]; zero where there is no fix."""
    covariance: Array
    """(n, 3, 3) as reported [m^2], symmetric and positive semi-definite; zero where there is no fix."""

    def __post_init__(self) -> None:
        n = len(self.time_s)
        if not (
            self.time_s.shape == self.available.shape == (n,)
            and self.error.shape == (n, 3)
            and self.covariance.shape == (n, 3, 3)
        ):
            raise DataError(f"{self.source}: arrays of a log must be (n,), (n,), (n, 3) and (n, 3, 3)")
        fixes = int(np.count_nonzero(self.available))
        if fixes < 2:
            raise DataError(f"{self.source}: {fixes} epochs with a fix, at least 2 are needed")
        steps = np.diff(self.time_s)
        if not (np.abs(self.time_s) <= _MAX_TIME_S).all() or not (steps >= _MIN_STEP_S).all():
            raise DataError(
                f"{self.source}: times must ascend by {_MIN_STEP_S:g} s or more, within +-{_MAX_TIME_S:g} s"
            )
        used = self.available
        for values, limit, what in (
            (self.error, _MAX_ERROR_M, "an error"),
            (self.covariance.reshape(n, 9), _MAX_VARIANCE_M2, "a covariance"),
        ):
            beyond = used & ~(np.abs(values) <= limit).all(-1)
            self._refuse(beyond, f"{what} that is not finite or beyond {limit:g}")
        variances = np.einsum("nii->ni", self.covariance)
        self._refuse(
            used & ~(variances > 0.0).all(-1),
            "a variance that is not positive (zero means unknown); leave it out or say its sigma",
        )
        error = np.where(used[:, None], self.error, 0.0)
        covariance = np.where(used[:, None, None], self.covariance, 0.0)
        covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
        eigenvalues, vectors = np.linalg.eigh(covariance)
        indefinite = eigenvalues[:, 0] < -_PSD_TOLERANCE * eigenvalues[:, 2]
        self._refuse(indefinite, "a matrix that is no covariance")
        rounded = eigenvalues[:, 0] < 0.0
        repaired = np.einsum("nik,nk,njk->nij", vectors, np.maximum(eigenvalues, 0.0), vectors)
        covariance[rounded] = repaired[rounded]
        object.__setattr__(self, "error", error)
        object.__setattr__(self, "covariance", covariance)

    def _refuse(self, bad: NDArray[np.bool_], what: str) -> None:
        if bad.any():
            i = int(np.argmax(bad))
            raise DataError(f"{self.source}: the epoch at {self.time_s[i]:g} s (number {i + 1}) has {what}")


def read_error_log_csv(path: Path | str) -> ErrorLog:
    """Read a log of errors and reported covariances.

    Parameters
    ----------
    path : Path or str
        Comma-separated, fields quoted or not, with a header line: ``t_s``, ``available`` (0 or 1),
        ``err_e_m``, ``err_n_m``, ``err_u_m``, ``cov_ee_m2``, ``cov_en_m2``, ``cov_eu_m2``, ``cov_nn_m2``,
        ``cov_nu_m2``, ``cov_uu_m2`` in any order, each once; further columns are left alone. Without a fix
        the numbers may be empty.

    Raises
    ------
    DataError
        The file is missing, not such a file, or holds something unusable (file and line are named).
    """
    path = Path(path)
    lines = numbered_lines(path)
    _, head = next(lines, (0, ""))
    header = _csv_fields(head)
    wanted = ("t_s", "available", *_CSV_ERRORS, *_CSV_COVARIANCES)
    missing = [name for name in wanted if name not in header]
    if missing:
        raise DataError(
            f"{path}, line 1: column {missing[0]} is missing (has {shown_text(head, 120)}); "
            f"needed are {', '.join(wanted)}, with commas between"
        )
    if twice := [name for name in wanted if header.count(name) > 1]:
        count = header.count(twice[0])
        raise DataError(f"{path}, line 1: column {twice[0]} is there {count} times; keep one")
    places = {name: header.index(name) for name in wanted}
    rows = []
    for number, line in lines:
        fields = _csv_fields(line)
        if len(fields) != len(header):
            raise DataError(f"{path}, line {number}: {len(fields)} fields, the header has {len(header)}")
        rows.append(_csv_row(f"{path}, line {number}", [fields[places[name]] for name in wanted]))
        if len(rows) > 1 and rows[-1][0] <= rows[-2][0]:
            raise DataError(f"{path}, line {number}: time {rows[-1][0]:g} s is not after the line before")
    table = np.array(rows).reshape(-1, len(wanted))
    ee, en, eu, nn, nu, uu = table[:, 5:].T
    covariance = np.stack([np.stack(row, -1) for row in ((ee, en, eu), (en, nn, nu), (eu, nu, uu))], -2)
    return ErrorLog(str(path), table[:, 0], table[:, 1] == 1.0, table[:, 2:5], covariance)


def _csv_fields(line: str) -> list[str]:
    """Fields of a line, quoted or not; none of a line that is no CSV."""
    fields = line.split(",")
    if '"' in line:
        try:
            fields = next(csv.reader([line], skipinitialspace=True))
        except csv.Error:  # a quote that does not end, and what follows is too long for a field
            return []
    return [field.strip() for field in fields]


def _csv_row(place: str, fields: list[str]) -> list[float]:
    time, available, *numbers = fields
    if available not in ("0", "1"):
        raise DataError(f"{place}: available is {shown_text(available)}, must be 0 or 1")
    row = [_finite(place, "t_s", time), float(available)]
    names = (*_CSV_ERRORS, *_CSV_COVARIANCES)
    if available == "0":
        return row + [0.0] * len(names)
    row += [_finite(place, name, text) for name, text in zip(names, numbers, strict=True)]
    for name in ("cov_ee_m2", "cov_nn_m2", "cov_uu_m2"):
        if (variance := row[2 + names.index(name)]) <= 0.0:
            raise DataError(f"{place}: {name} = {variance:g}, must be > 0 (zero means unknown, not certain)")
    return row


def _finite(place: str, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise DataError(f"{place}: {name} is {shown_text(text) or 'empty'}, not a number") from None
    if not math.isfinite(value):
        raise DataError(f"{place}: {name} is {shown_text(text)}, not a finite number")
    return value


def errors_against_truth(solution: PosTrack, truth: PosTrack) -> ErrorLog:
    """Errors of a solution in the local east-north-up frame at the truth of the same time.

    The log has one row for each epoch at which the receiver could have had a fix: the epochs of the truth
    that lie on the solution's own time grid. Those without a solution are gaps. Solutions without a truth
    at the same time (within ``MATCH_S``) are left out.

    Parameters
    ----------
    solution, truth : PosTrack
        What the receiver computed, with its covariance, and what was true. GPS time, UTC and JST are brought
        to one another; other clocks must be the same.

    Raises
    ------
    DataError
        Clocks that cannot be compared, heights of different kinds, fewer than two epochs in common, positions
        too far apart to be of one drive, or a solution without a covariance.
    """
    names = f"{solution.source} against {truth.source}"
    solution_s, truth_s = _same_clock(names, solution, truth)
    if solution.heights != truth.heights:
        raise DataError(
            f"{names}: {solution.heights} and {truth.heights} heights, which are tens of metres apart; "
            "write both alike"
        )
    row = _nearest(solution_s, truth_s)
    available = np.abs(solution_s[row] - truth_s) <= MATCH_S
    if (matches := np.count_nonzero(available)) < 2:
        raise DataError(
            f"{names}: {matches} epochs in common, at least 2 are needed (from {solution_s[0]:.3f} to "
            f"{solution_s[-1]:.3f} s and from {truth_s[0]:.3f} to {truth_s[-1]:.3f} s)"
        )
    period_s = sample_period(solution_s)
    steps = (truth_s - truth_s[np.argmax(available)]) / period_s
    kept = available | (np.abs(steps - np.round(steps)) * period_s <= MATCH_S)
    row, time, true = row[kept], truth_s[kept], truth.geodetic[kept]
    error = np.stack(pymap3d.geodetic2enu(*solution.geodetic[row].T, *true.T), -1)
    usual_m = float(np.median(np.linalg.norm(error[available[kept]], axis=-1)))
    if usual_m > _MAX_USUAL_ERROR_M:
        raise DataError(
            f"{names}: positions are {usual_m:.0f} m apart (median), more than {_MAX_USUAL_ERROR_M:g} m: "
            "these are not the same drive at the same time; check the files and their clocks"
        )
    return ErrorLog(names, time - time[0], available[kept], error, solution.covariance[row])


def _same_clock(names: str, solution: PosTrack, truth: PosTrack) -> tuple[Array, Array]:
    """Times of both on one clock; left as they are if that is the same already."""
    systems = solution.time_system, truth.time_system
    if systems[0] == systems[1]:
        return solution.time_s, truth.time_s
    if not set(systems) <= set(CLOCKS):
        raise DataError(f"{names}: times in {systems[0]} and in {systems[1]}, which cannot be compared")
    return gps_time_s(solution.time_s, systems[0]), gps_time_s(truth.time_s, systems[1])


def _nearest(sorted_values: Array, wanted: Array) -> NDArray[np.int64]:
    """Index of the value nearest to each wanted one."""
    return np.searchsorted(0.5 * (sorted_values[1:] + sorted_values[:-1]), wanted)


def sample_period(time_s: Array) -> float:
    """Time between two samples of a log that may have gaps [s]: the usual one of its short steps."""
    steps = np.diff(time_s)
    return float(np.median(steps[steps < 1.5 * np.quantile(steps, 0.1)]))


def halves(log: ErrorLog) -> tuple[ErrorLog, ErrorLog]:
    """First and second half of a log by its epochs, those without a fix included.

    Raises
    ------
    DataError
        One of them has fewer than two epochs with a fix.
    """
    middle = len(log.time_s) // 2
    first, second = (
        ErrorLog(
            f"{name} half of {log.source}",
            log.time_s[part],
            log.available[part],
            log.error[part],
            log.covariance[part],
        )
        for name, part in (("first", slice(None, middle)), ("second", slice(middle, None)))
    )
    return first, second


@dataclass(frozen=True)
class Coverage:
    """How often errors stayed within k reported sigmas."""

    k: float
    """Number of sigmas."""
    n: int
    """Epochs with a fix."""
    share: tuple[float, float, float]
    """Share of them whose error is within k sigma: east, north, up."""


def coverage(log: ErrorLog, k: float) -> Coverage:
    """What the reported sigma was worth: the share of errors within k sigmas, on each axis.

    A normal law with the reported sigma gives erf(k / sqrt(2)), for example 99.73 % at k = 3. The epochs of
    a log are correlated: n is no number of independent trials.
    """
    if not (math.isfinite(k) and k >= 0.0):
        raise ValueError(f"k = {k!r} must be a finite number >= 0")
    sigma = np.sqrt(np.einsum("nii->ni", log.covariance[log.available]))
    inside = np.abs(log.error[log.available]) <= k * sigma
    east, north, up = (float(share) for share in inside.mean(axis=0))
    return Coverage(k, len(inside), (east, north, up))
