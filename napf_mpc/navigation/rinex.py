"""Reader of RINEX navigation files (2 to 4): broadcast ephemerides of GPS, Galileo and QZSS."""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np

from napf_mpc.data_file import readable_file
from napf_mpc.errors import DataError
from napf_mpc.navigation.ephemeris import SYSTEMS, Ephemerides
from napf_mpc.words import shown_text

__all__ = ["gps_seconds", "read_rinex_navigation"]

MAX_RECORDS = 200_000
MAX_BYTES = 100_000_000
_LETTERS = {"G": "GPS", "E": "Galileo", "J": "QZSS"}
_LINES = 8
_WEEK_S = 604_800.0
_MESSAGES = ("LNAV", "INAV", "FNAV")
_GPS_EPOCH = dt.datetime(1980, 1, 6)
_INAV = 0b101  # bits of Galileo's "data sources": I/NAV of E1-B, I/NAV of E5b-I

# Place of each number in a record: 3 in the first line, 4 in each of the others.
_PLACES = {
    "af0": 0, "af1": 1, "af2": 2, "crs": 4, "delta_n": 5, "m0": 6, "cuc": 7, "e": 8, "cus": 9, "sqrt_a": 10,
    "toe": 11, "cic": 12, "omega0": 13, "cis": 14, "i0": 15, "crc": 16, "omega": 17, "omega_dot": 18,
    "idot": 19, "source": 20, "week": 21, "accuracy_m": 23, "health": 24,
}  # fmt: skip
_LIMITS = {"e": (0.0, 0.5), "sqrt_a": (2000.0, 8000.0), "toe": (0.0, 604_800.0), "week": (0.0, 10_000.0)}


def gps_seconds(moment: dt.datetime) -> float:
    """Seconds of GPS time since 1980-01-06 00:00, of a date that is in GPS time."""
    return (moment - _GPS_EPOCH).total_seconds()


def read_rinex_navigation(path: Path | str) -> Ephemerides:
    """Read the GPS, Galileo (I/NAV) and QZSS records of a navigation file; others are passed over.

    A file that was read before and has not changed since is not read again.

    Parameters
    ----------
    path : Path or str
        RINEX navigation file of version 2 (GPS), 3 or 4, mixed or of one system. Of version 4 the messages
        LNAV and INAV are read, which have the form of version 3.

    Returns
    -------
    Ephemerides
        In the order of the file, without repeated records.

    Raises
    ------
    DataError
        The file is missing, not such a file, holds no record of these systems, or a record that is cut short
        or has a number that is missing or out of range (file and line are named).
    """
    path = readable_file(path, MAX_BYTES)
    stat = path.stat()
    return _read_cached(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=4)
def _read_cached(path: Path, _changed_ns: int, _size: int) -> Ephemerides:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not a text file ({error.reason})") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    lines = enumerate(text.splitlines(), start=1)
    version = _version(path, next(lines, (0, ""))[1])
    if not any(line[60:].strip() == "END OF HEADER" for _, line in lines):
        raise DataError(f'{path}: has no line "END OF HEADER"; not a RINEX navigation file')
    records: dict[tuple[str, float], tuple[str, dict[str, float], float]] = {}
    for start, block in _blocks(path, version, lines):
        if block[0][0] not in _LETTERS:
            continue
        name, values, toc = _record(f"{path}, line {start}", block)
        if block[0][0] != "E" or int(values["source"]) & _INAV:
            records.setdefault((name, values["week"] * _WEEK_S + values["toe"]), (name, values, toc))
        if len(records) > MAX_RECORDS:
            raise DataError(f"{path}: more than {MAX_RECORDS} records")
    if not records:
        raise DataError(f"{path}: holds no ephemeris of {', '.join(SYSTEMS[:-1])} or {SYSTEMS[-1]}")
    return _table(list(records.values()))


def _version(path: Path, line: str) -> int:
    if line[60:].strip() != "RINEX VERSION / TYPE" or line[20:21] != "N":
        raise DataError(
            f"{path}, line 1: {shown_text(line)} is not the head of a RINEX navigation file of GPS or of "
            "several systems"
        )
    words = line[:20].strip()
    if words[:1] not in ("2", "3", "4") or words[1:2] not in ("", "."):
        raise DataError(
            f"{path}, line 1: RINEX version {shown_text(words)}, must be 2, 3 or 4; convert the file"
        )
    return int(words[0])


def _blocks(path: Path, version: int, lines: Iterator[tuple[int, str]]) -> Iterator[tuple[int, list[str]]]:
    """Records of a file, each with the number of its first line, its lines in the form of version 3."""
    start, block = 0, [""]
    other = False  # a message of version 4 that is of another form
    for number, line in lines:
        if version == 4 and line.startswith(">"):
            words = line[1:].split()
            other = len(words) < 3 or words[0] != "EPH" or words[2] not in _MESSAGES
            continue
        if other or not line.strip():
            continue
        if line[:1].isalpha() if version > 2 else line[:3].strip():
            if block[0]:
                yield start, block
            start, block = number, [line if version > 2 else _head_of_2(f"{path}, line {number}", line)]
        elif block[0]:
            block.append(line if version > 2 else " " + line)
        else:
            raise DataError(f"{path}, line {number}: {shown_text(line)} belongs to no record")
    if block[0]:
        yield start, block


def _head_of_2(place: str, line: str) -> str:
    """First line of a record of version 2 as version 3 writes it: satellite, whole year, whole seconds."""
    try:
        satellite, year, month, day, hour, minute = (int(line[at : at + 2]) for at in (0, 3, 6, 9, 12, 15))
        seconds = int(float(line[17:22]))
    except (ValueError, OverflowError):
        raise DataError(f"{place}: {shown_text(line[:22])} is not a satellite, date and time") from None
    year += 2000 if year < 80 else 1900
    return f"G{satellite:02d} {year} {month:02d} {day:02d} {hour:02d} {minute:02d} {seconds:02d}{line[22:]}"


def _record(place: str, lines: list[str]) -> tuple[str, dict[str, float], float]:
    """Name, numbers and reference time of the clock of one record."""
    if len(lines) < _LINES:
        raise DataError(f"{place}: a record of {len(lines)} lines, must have {_LINES}")
    head = lines[0]
    texts = [head[23 + 19 * k : 42 + 19 * k] for k in range(3)]
    texts += [line[4 + 19 * k : 23 + 19 * k] for line in lines[1:_LINES] for k in range(4)]
    values = {}
    for key, at in _PLACES.items():
        if key == "source" and head[0] != "E":
            continue  # a spare or another thing there
        values[key] = _number(place, key, texts[at])
    try:
        epoch = dt.datetime(*(int(field) for field in head[3:23].split()))  # type: ignore[arg-type]
    except (ValueError, TypeError):
        raise DataError(f"{place}: {shown_text(head[3:23])} is not a date and time") from None
    name = head[0] + head[1:3].replace(" ", "0")
    toc_s = gps_seconds(epoch)
    off = round((values["week"] * _WEEK_S + values["toe"] - toc_s) / _WEEK_S)
    # Some writers give the week of the transmission, which may be that before, or the satellite's ten bits.
    if abs(off) > 1 and off % 1024:
        raise DataError(
            f"{place}: week = {values['week']:g} is {abs(off)} weeks off its date, {head[3:23].strip()}"
        )
    values["week"] -= off
    return name, values, toc_s


def _number(place: str, key: str, text: str) -> float:
    try:
        value = float(text.replace("D", "E").replace("d", "E"))
    except ValueError:
        raise DataError(f"{place}: {key} is {shown_text(text.strip()) or 'missing'}, not a number") from None
    low, high = _LIMITS.get(key, (-math.inf, math.inf))
    if not (math.isfinite(value) and low <= value <= high):
        words = f", must be from {low:g} to {high:g}" if key in _LIMITS else ", must be finite"
        raise DataError(f"{place}: {key} = {value:g}{words}")
    return value


def _table(records: list[tuple[str, dict[str, float], float]]) -> Ephemerides:
    def column(key: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        return np.array([values[key] for _, values, _ in records])

    names = np.array([name for name, _, _ in records])
    return Ephemerides(
        name=names,
        system=np.array([SYSTEMS.index(_LETTERS[name[0]]) for name in names], dtype=np.int64),
        toc_s=np.array([toc for _, _, toc in records]),
        toe_s=column("week") * _WEEK_S + column("toe"),
        healthy=column("health") == 0.0,
        **{key: column(key) for key in _PLACES if key not in ("toe", "source", "week", "health")},
    )
