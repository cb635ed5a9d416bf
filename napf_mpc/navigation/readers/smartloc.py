"""Reader of smartLoc's text logs: pseudoranges of an urban drive, and its ground truth.

P. Reisdorf, T. Pfeifer, J. Bressler, S. Bauer, P. Weissig, S. Lange, G. Wanielik, P. Protzel, "The problem of
comparable GNSS results: an approach for a uniform dataset with low-cost and reference data" (Vehicular 2016);
the format is that of the library libRSF.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pymap3d
from numpy.typing import NDArray

from napf_mpc.errors import DataError
from napf_mpc.navigation.pseudorange_solution import Check, SolverSettings
from napf_mpc.navigation.pseudoranges import fix_from_pseudoranges
from napf_mpc.navigation.readers.track import checked_track, log_file
from napf_mpc.navigation.rtklib import PosTrack, numbered_lines
from napf_mpc.words import shown_text

__all__ = ["CN0_MASK_DBHZ", "ELEVATION_MASK_DEG", "read_smartloc"]

Array = NDArray[np.float64]

ELEVATION_MASK_DEG, CN0_MASK_DBHZ = 15.0, 30.0
"""Pseudoranges below are left out of the solution."""
_PLAIN = SolverSettings("plain", exclude=False, max_pdop=1e6)
# Fields of a pseudorange3 record, after its name.
_FIELDS = ("t", "range", "variance", "x", "y", "z", "satellite", "system", "elevation", "cn0")
_RANGE_M = (1e6, 1e9)
_ORBIT_M = (6.4e6, 1e9)
_MAX_VARIANCE_M2 = 1e12


def read_smartloc(path: Path | str) -> PosTrack:
    """Read a smartLoc log: its ground truth, or the plain solution of its pseudoranges.

    Parameters
    ----------
    path : Path or str
        Text file with ``point3`` records (the truth), or with ``pseudorange3`` records. The latter are solved
        epoch by epoch by weighted least squares with a clock a system, above :data:`ELEVATION_MASK_DEG` and
        :data:`CN0_MASK_DBHZ`; an epoch that cannot be solved is left out.

    Returns
    -------
    PosTrack
        Times in seconds since the start of the log; the truth has zero covariance.

    Raises
    ------
    DataError
        The file is missing, empty, no such log, or a record in it is broken (file and line are named).
    """
    path = log_file(path)
    truth: list[Array] = []
    records: list[Array] = []
    for number, line in numbered_lines(path):
        name, *words = line.split()
        if name == "point3":
            truth.append(_numbers(path, number, words, 4))
        elif name == "pseudorange3":
            records.append(_pseudorange(path, number, words))
        elif name != "odom3":
            raise DataError(f"{path}, line {number}: {shown_text(name)} is no record of a smartLoc log")
    if bool(truth) == bool(records):
        raise DataError(f"{path}: needs point3 records or pseudorange3 records, and not both")
    if truth:
        table = np.array(truth)
        return _track(path, table[:, 0], table[:, 1:4], np.zeros((len(table), 3, 3)))
    return _solved(path, np.array(records))


def _numbers(path: Path, number: int, words: list[str], count: int) -> Array:
    if len(words) < count:
        raise DataError(f"{path}, line {number}: {len(words)} numbers, at least {count} are needed")
    try:
        values = np.array([float(word) for word in words[:count]])
    except ValueError:
        raise DataError(f"{path}, line {number}: {shown_text(' '.join(words))} are not numbers") from None
    if not np.isfinite(values).all():
        raise DataError(f"{path}, line {number}: a number is not finite")
    return values


def _pseudorange(path: Path, number: int, words: list[str]) -> Array:
    """Numbers of a pseudorange record that can be those of a satellite."""
    values = _numbers(path, number, words, len(_FIELDS))
    for what, value, (low, high) in (
        ("the range is", values[1], _RANGE_M),
        ("the variance is", values[2], (0.0, _MAX_VARIANCE_M2)),
        ("the satellite's distance from the earth's centre is", math.hypot(*values[3:6]), _ORBIT_M),
    ):
        if not low <= value <= high:
            raise DataError(f"{path}, line {number}: {what} {value:g}, must be from {low:g} to {high:g}")
    return values


def _solved(path: Path, records: Array) -> PosTrack:
    each, count = np.unique(records[:, [0, 6, 7, 1]], axis=0, return_counts=True)
    if (count > 1).any():
        time_s, satellite, system, _ = each[np.argmax(count > 1)]
        raise DataError(
            f"{path}: the range to satellite {satellite:g} of system {system:g} at {time_s:g} s is there "
            "twice and would count double; keep one line of it"
        )
    used = (records[:, 8] >= ELEVATION_MASK_DEG) & (records[:, 9] >= CN0_MASK_DBHZ) & (records[:, 2] > 0.0)
    records = records[used]
    if not len(records):
        raise DataError(
            f"{path}: none of its {len(used)} pseudoranges has an elevation of {ELEVATION_MASK_DEG:g} deg, "
            f"{CN0_MASK_DBHZ:g} dB Hz and a variance above zero"
        )
    times, starts = np.unique(records[:, 0], return_index=True)
    if (np.diff(records[:, 0]) < 0.0).any():
        raise DataError(f"{path}: times of the pseudoranges go back; sort the log by time")
    kept, places, covariances = [], [], []
    place: Array | None = None
    for time_s, epoch in zip(times, np.split(records, starts[1:]), strict=True):
        _, clock = np.unique(epoch[:, 7], return_inverse=True)
        found = fix_from_pseudoranges(
            epoch[:, 1], epoch[:, 3:6], clock, np.sqrt(epoch[:, 2]), _PLAIN, start=place
        )
        if found.check == Check.NONE:
            continue
        place = found.place
        kept.append(time_s)
        places.append(place)
        covariances.append(found.solution.covariance[0])
    return _track(
        path, np.array(kept), np.array(places).reshape(-1, 3), np.array(covariances).reshape(-1, 3, 3)
    )


def _track(path: Path, time_s: Array, place: Array, covariance: Array) -> PosTrack:
    """Geodetic track of ECEF positions (n, 3) and their covariances (n, 3, 3), east, north, up."""
    geodetic = np.stack(pymap3d.ecef2geodetic(*place.T), -1)
    return checked_track(path, "time of the log", time_s.tolist(), geodetic.tolist(), list(covariance))
