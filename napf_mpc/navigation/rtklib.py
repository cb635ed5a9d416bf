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
from napf_mpc.navigation.rtklib_layout import (
    Layout,
    decimal_degrees,
    geodetic_and_covariance,
    layout_of,
    reference_position,
)
from napf_mpc.words import shown_text

__all__ = ["MAX_ROWS", "PosTrack", "numbered_lines", "read_rtklib_pos"]

Array = NDArray[np.float64]

MAX_ROWS = 1_000_000
_MAX_BYTES = 400_000_000
_MAX_SIGMA_M = 1e6
_GPS_EPOCH = dt.date(1980, 1, 6).toordinal()
_CLOCK = re.compile(r"(\d{1,2}):(\d{1,2}):(\d{1,2}(?:\.\d*)?)")
_MAX_HEIGHT_M = 1e5
_MAX_PLACE_M = 1e7
_EARTH_RADIUS_M = 6_367_000.0  # poles and equator are 11 km off
_HEADER = re.compile(r"%\s*(GPST|UTC|JST)\b(.*)")
_FRAME = re.compile(r"lat/lon/height\s*=\s*(\w+)/(ellipsoidal|geodetic)")


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
    """(n, 3) WGS-84 latitude [deg], longitude [deg], height [m]."""
    covariance: Array
    """(n, 3, 3) as reported, in east, north, up [m^2]; zero where none was given (a ground truth)."""
    heights: str = "ellipsoidal"
    """What heights count from: ``ellipsoidal``, or ``geodetic`` for the sea level (geoid)."""


def read_rtklib_pos(path: Path | str) -> PosTrack:
    """Read an RTKLIB position file in any of its forms.

    Positions may be latitude, longitude and height (decimal degrees, or degrees, minutes and seconds),
    earth-fixed x, y, z, or east, north, up from a base whose place the header tells (``% ref pos``). The
    cross terms of the file are signed square roots, as cov_ne = sign(sdne) sdne^2. Without columns of
    standard deviations the covariance is zero, which only a truth may have.

    Parameters
    ----------
    path : Path or str
        File with RTKLIB's own header line, columns apart by white space or the separator that the header line
        has; time as date and clock or as GPS week and seconds. Epochs of quality Q = 0 are no fixes and left
        out, and so is a line that says again what the one before it said.

    Raises
    ------
    DataError
        The file is missing, not such a file, has a column missing, another datum than WGS 84, a line that is
        no epoch, a number that is not finite or out of range, or times that do not ascend.
    """
    path = Path(path)
    system: str | None = None
    heights = "ellipsoidal"
    layout: Layout | None = None
    base: Array | None = None
    times: list[float] = []
    rows: list[list[float]] = []
    numbers: list[int] = []
    for number, line in numbered_lines(path, errors="surrogateescape"):
        place = f"{path}, line {number}"
        if line.startswith("%"):
            if found := _FRAME.search(line):
                if found[1] != "WGS84":
                    raise DataError(f"{place}: positions in datum {found[1]}; write them in WGS84")
                heights = found[2]
            elif re.match(r"%\s*(?:ref|slave) pos\s*:", line):
                base = reference_position(place, line)
            elif found := _HEADER.match(line):
                told = layout_of(place, found[2])
                if layout is not None and rows and (found[1], told) != (system, layout):
                    raise DataError(
                        f"{place}: another header than before; read files of two forms one by one"
                    )
                system, layout = found[1], told
            continue
        if layout is None:
            raise DataError(f"{place}: no header line (% GPST latitude(deg) ...) before it")
        fields = layout.fields(line)
        needed = 3 + max(*layout.places, layout.quality or 0)
        if len(fields) < needed:
            raise DataError(f"{place}: {len(fields)} fields, the header promises at least {needed}")
        if layout.quality is not None and fields[2 + layout.quality] == "0":
            continue
        time = _time(place, fields[0], fields[1])
        row = _row(place, layout, fields)
        if times and time <= times[-1]:
            if time == times[-1] and row == rows[-1]:
                continue
            raise DataError(
                f"{place}: time {fields[0]} {fields[1]} is not after the line before; "
                "sort the file by time and keep one line an epoch"
            )
        times.append(time)
        rows.append(row)
        numbers.append(number)
    if system is None or layout is None or not rows:
        raise DataError(f"{path}: no epochs in it")
    if layout.kind == "enu" and base is None:
        raise DataError(
            f'{path}: positions count from a base, and no line "% ref pos : ..." says where it is; '
            "write them as latitude, longitude, height"
        )
    table = np.array(rows)
    _check_ranges(path, layout, table, numbers)
    sigmas = np.zeros((len(table), 6))
    sigmas[:, : layout.sigmas] = table[:, 3:]
    geodetic, covariance = geodetic_and_covariance(layout, table[:, :3], sigmas, base)
    heights = heights if layout.kind in ("deg", "dms") else "ellipsoidal"
    return PosTrack(str(path), system, np.array(times), geodetic, covariance, heights)


def numbered_lines(path: Path, errors: str = "strict") -> Iterator[tuple[int, str]]:
    """Yield the lines of a text file that are not blank, stripped and numbered from 1.

    With ``errors="surrogateescape"`` bytes that are not UTF-8 come through: RTKLIB writes the names of its
    input files into comments in whatever code Windows has.

    Raises
    ------
    DataError
        The file is missing, packed, too big, or not text.
    """
    readable_file(path, _MAX_BYTES)
    try:
        with path.open(encoding="utf-8-sig", errors=errors) as file:
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


def _row(place: str, layout: Layout, fields: list[str]) -> list[float]:
    """Position and standard deviations of a line, angles in decimal degrees."""
    values = [
        _number(place, name, fields[2 + at]) for name, at in zip(layout.names, layout.places, strict=True)
    ]
    if layout.kind == "dms":
        for axis in (0, 1):
            texts = fields[2 + layout.places[axis] :][:3]
            degrees, minutes, seconds = (_number(place, layout.names[axis], text) for text in texts)
            if not (0.0 <= minutes < 60.0 and 0.0 <= seconds <= 60.0):
                shown = shown_text(" ".join(texts))
                raise DataError(f"{place}: {layout.names[axis]} is {shown}, not degrees, minutes, seconds")
            values[axis] = decimal_degrees(degrees, minutes, seconds, texts[0].startswith("-"))
    return values


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
        raise DataError(f"{place}: {column} is {shown_text(text) or 'empty'}, not a number") from None
    if not math.isfinite(value):
        raise DataError(f"{place}: {column} is {shown_text(text)}, not a finite number")
    return value


def _check_ranges(path: Path, layout: Layout, table: Array, numbers: list[int]) -> None:
    far = [90.0, 360.0, _MAX_HEIGHT_M] if layout.kind in ("deg", "dms") else [_MAX_PLACE_M] * 3
    low = [*(-limit for limit in far), 0.0, 0.0, 0.0, *(-_MAX_SIGMA_M,) * 3]
    high = [*far, *(_MAX_SIGMA_M,) * 6]
    for column, name in enumerate(layout.names):
        bad = (table[:, column] < low[column]) | (table[:, column] > high[column])
        if bad.any():
            epoch = int(np.argmax(bad))
            raise DataError(
                f"{path}, line {numbers[epoch]}: {name} = {table[epoch, column]:g}, "
                f"must be from {low[column]:g} to {high[column]:g}"
            )
    if layout.kind == "ecef":
        radius = np.linalg.norm(table[:, :3], axis=1)
        bad = np.abs(radius - _EARTH_RADIUS_M) > _MAX_HEIGHT_M
        if bad.any():
            epoch = int(np.argmax(bad))
            raise DataError(
                f"{path}, line {numbers[epoch]}: x, y, z are {radius[epoch]:g} m from the earth's centre, "
                f"must be within {_MAX_HEIGHT_M:g} m of {_EARTH_RADIUS_M:g}"
            )
