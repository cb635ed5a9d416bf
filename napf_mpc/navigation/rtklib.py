"""Reader of RTKLIB position files (``.pos``): geodetic positions with their reported covariance."""

from __future__ import annotations

import datetime as dt
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napf_mpc.data_file import readable_file
from napf_mpc.errors import DataError
from napf_mpc.words import shown_text

__all__ = ["MAX_ROWS", "PosTrack", "numbered_lines", "read_rtklib_pos"]

Array = NDArray[np.float64]

MAX_ROWS = 1_000_000
_MAX_BYTES = 400_000_000
_MAX_SIGMA_M = 1e6
_GPS_EPOCH = dt.date(1980, 1, 6).toordinal()
_CLOCK = re.compile(r"(\d{1,2}):(\d{1,2}):(\d{1,2}(?:\.\d*)?)")
_TIME_SYSTEMS = ("GPST", "UTC", "JST")
_POSITION = ("latitude(deg)", "longitude(deg)", "height(m)")
_SIGMAS = ("sdn(m)", "sde(m)", "sdu(m)", "sdne(m)", "sdeu(m)", "sdun(m)")


@dataclass(frozen=True)
class PosTrack:
    """Positions of one receiver over time."""

    source: str
    """File it came from, for messages."""
    time_system: str
    """``GPST``, ``UTC`` or ``JST``, as the file's header says."""
    time_s: Array
    """(n,) time since 1980-01-06 00:00 in that system [s], ascending."""
    geodetic: Array
    """(n, 3) WGS-84 latitude [deg], longitude [deg], ellipsoidal height [m]."""
    covariance: Array
    """(n, 3, 3) as reported, in east, north, up [m^2]; zero where none was given (a ground truth)."""


def read_rtklib_pos(path: Path | str) -> PosTrack:
    """Read an RTKLIB position file in latitude, longitude and height (degrees).

    The cross terms of the file are signed square roots in the order sdne, sdeu, sdun:
    cov_ne = sign(sdne) sdne^2.

    Parameters
    ----------
    path : Path or str
        File with RTKLIB's own header line and white-space columns; time as date and clock or as GPS week
        and seconds.

    Raises
    ------
    DataError
        The file is missing, not such a file, has a column missing, a line that is no epoch, a number that
        is not finite or out of range, or times that do not ascend.
    """
    path = Path(path)
    header: list[str] | None = None
    times: list[float] = []
    rows: list[list[float]] = []
    for number, line in numbered_lines(path):
        if line.startswith("%"):
            words = line[1:].split()
            if words and words[0] in _TIME_SYSTEMS:
                header = words
                columns = _columns(path, header)
            continue
        if header is None:
            raise DataError(f"{path}, line {number}: no header line (% GPST latitude(deg) ...) before it")
        place = f"{path}, line {number}"
        fields = line.split()
        if len(fields) < 2 + max(columns) + 1:
            raise DataError(f"{place}: {len(fields)} fields, the header promises at least {3 + max(columns)}")
        time = _time(place, fields[0], fields[1])
        if times and time <= times[-1]:
            raise DataError(f"{place}: time {fields[0]} {fields[1]} is not after the line before")
        times.append(time)
        rows.append([_number(place, header[1 + c], fields[2 + c]) for c in columns])
    if header is None or not rows:
        raise DataError(f"{path}: no epochs in it")
    table = np.array(rows)
    _check_ranges(path, table)
    return PosTrack(str(path), header[0], np.array(times), table[:, :3], _covariance(table[:, 3:]))


def numbered_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text file that are not blank, stripped and numbered from 1.

    Raises
    ------
    DataError
        The file is missing, packed, too big, or not text.
    """
    readable_file(path, _MAX_BYTES)
    try:
        with path.open(encoding="utf-8-sig") as file:
            count = 0
            for number, line in enumerate(file, start=1):
                if "\0" in line:
                    raise DataError(f"{path}, line {number}: not a text file (zero byte)")
                if text := line.strip():
                    count += 1
                    if count > MAX_ROWS:
                        raise DataError(f"{path}: more than {MAX_ROWS} lines; cut the log")
                    yield number, text
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not a text file ({error.reason})") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error


def _columns(path: Path, header: list[str]) -> list[int]:
    """Places of the columns we need, counted after the time."""
    missing = [name for name in (*_POSITION, *_SIGMAS) if name not in header]
    if missing:
        raise DataError(
            f"{path}: column {missing[0]} is missing (has {shown_text(' '.join(header[1:]), 120)}); "
            "write it with positions in latitude, longitude, height and degrees, and with standard deviations"
        )
    return [header.index(name) - 1 for name in (*_POSITION, *_SIGMAS)]


def _time(place: str, first: str, second: str) -> float:
    """Seconds since the GPS epoch, from date and clock or from GPS week and seconds of the week."""
    clock = _CLOCK.fullmatch(second)
    try:
        if clock is None:
            week, seconds = int(first), float(second)
            if not (0 <= week < 10_000 and 0.0 <= seconds <= 604_800.0):
                raise ValueError
            return week * 604_800.0 + seconds
        year, month, day = (int(part) for part in first.split("/"))
        days = dt.date(year, month, day).toordinal() - _GPS_EPOCH
        hours, minutes, seconds = int(clock[1]), int(clock[2]), float(clock[3])
        if hours > 23 or minutes > 59 or seconds >= 61.0:
            raise ValueError
        return days * 86_400.0 + hours * 3600.0 + minutes * 60.0 + seconds
    except (ValueError, OverflowError):
        text = shown_text(f"{first} {second}")
        raise DataError(f"{place}: {text} is no time (yyyy/mm/dd hh:mm:ss, or GPS week, seconds)") from None


def _number(place: str, column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise DataError(f"{place}: {column} is {shown_text(text)}, not a number") from None
    if not math.isfinite(value):
        raise DataError(f"{place}: {column} is {shown_text(text)}, not a finite number")
    return value


def _check_ranges(path: Path, table: Array) -> None:
    names = (*_POSITION, *_SIGMAS)
    low = [-90.0, -360.0, -1e5, 0.0, 0.0, 0.0, -_MAX_SIGMA_M, -_MAX_SIGMA_M, -_MAX_SIGMA_M]
    high = [90.0, 360.0, 1e5, *(_MAX_SIGMA_M,) * 6]
    for column, name in enumerate(names):
        bad = (table[:, column] < low[column]) | (table[:, column] > high[column])
        if bad.any():
            epoch = int(np.argmax(bad))
            raise DataError(
                f"{path}, epoch {epoch + 1}: {name} = {table[epoch, column]:g}, "
                f"must be from {low[column]:g} to {high[column]:g}"
            )


def _covariance(sigmas: Array) -> Array:
    """Covariance in east, north, up from sdn, sde, sdu, sdne, sdeu, sdun."""
    squares = np.copysign(sigmas**2, sigmas)
    nn, ee, uu, ne, eu, un = squares.T
    return np.stack([np.stack(row, -1) for row in ((ee, ne, eu), (ne, nn, un), (eu, un, uu))], -2)
