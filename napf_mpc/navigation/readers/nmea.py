"""Reader of NMEA 0183 logs: positions from GGA sentences, their reported covariance from GST.

GGA and GST tell the time of day only. The date comes from ZDA or RMC sentences; without any, times count from
the first midnight and the time system is called ``UTC, no date``.
"""

from __future__ import annotations

import datetime as dt
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napf_mpc.errors import DataError
from napf_mpc.navigation.readers.track import GPS_EPOCH_UNIX_S, checked_track, log_file, unix_seconds
from napf_mpc.navigation.rtklib import PosTrack, numbered_lines
from napf_mpc.words import shown_text

__all__ = ["read_nmea"]

Array = NDArray[np.float64]

DAY_S = 86_400.0
_NO_FIX = (0, 6, 7)
"""Qualities of GGA without satellites behind them: none, dead reckoning, typed in."""
_SENTENCE = re.compile(r"\$[A-Z]{2}(GGA|GST|ZDA|RMC),")


def read_nmea(path: Path | str) -> PosTrack:
    r"""Read GGA and GST sentences of an NMEA 0183 log.

    The horizontal covariance is that of GST's error ellipse, whose semi-major axis :math:`\sigma_1` lies
    ``orient`` degrees clockwise from north, :math:`\sigma_2` across: with unit vectors u and v along them,
    :math:`\sigma_1^2 u u^T + \sigma_2^2 v v^T`. A receiver that leaves the ellipse empty has its latitude and
    longitude sigmas taken. Height is that above sea level plus the geoid's separation;
    of a receiver that leaves that empty it is ``geodetic``.

    Parameters
    ----------
    path : Path or str
        Text file, one sentence a line, with checksums. Other sentences are passed over.

    Returns
    -------
    PosTrack
        Epochs whose GGA says that there is a fix by satellites; without a GST of the same time, of zero
        covariance, as a truth has it. The time system is ``UTC``.

    Raises
    ------
    DataError
        The file is missing, empty, no such log, or a sentence in it is broken (file and line are named).
    """
    path = log_file(path)
    clock = _Clock()
    fixes: list[tuple[_Epoch, list[float]]] = []
    separated: set[bool] = set()
    reports: list[tuple[_Epoch, Array]] = []
    for number, line in numbered_lines(path):
        if not line.startswith(("$", "!")):
            raise DataError(f"{path}, line {number}: {shown_text(line)} is no NMEA sentence ($...*hh)")
        kind = _SENTENCE.match(line)
        if kind is None:
            continue
        place = f"{path}, line {number}"
        message = _parsed(place, line)
        if kind[1] in ("ZDA", "RMC"):
            clock.date(message)
            continue
        if not isinstance(message.time, dt.time):
            continue  # before its first fix a receiver knows no time
        epoch = clock.count(message.time)
        if kind[1] == "GST":
            reports.append((epoch, _covariance(place, message)))
        elif message.quality not in _NO_FIX:
            values = (message.lat, message.lon, message.alt)
            separation = message.sep if message.sep != "" else 0.0
            if "" in values:
                raise DataError(f"{place}: GGA claims a fix but leaves its position empty")
            separated.add(message.sep != "")
            if len(separated) > 1:
                raise DataError(
                    f"{place}: some GGA give the geoid's separation and some leave it empty, so that heights "
                    "do not go together"
                )
            fixes.append((epoch, [float(values[0]), float(values[1]), float(values[2]) + float(separation)]))
    times = [clock.offset_s + epoch.time_s for epoch, _ in fixes]
    unknown = np.zeros((3, 3))
    reported = {epoch.time_s: covariance for epoch, covariance in reports}
    covariances = [reported.get(epoch.time_s, unknown) for epoch, _ in fixes]
    heights = "geodetic" if separated == {False} else "ellipsoidal"
    return checked_track(path, clock.system, times, [position for _, position in fixes], covariances, heights)


def _parsed(place: str, line: str) -> Any:
    try:
        import pynmeagps
    except ImportError as error:
        raise DataError(
            f"{place}: reading NMEA needs the package pynmeagps; install napf-mpc[receivers]"
        ) from error
    if not re.search(r"\*[0-9A-Fa-f]{2}$", line):
        raise DataError(f"{place}: sentence is cut off (no checksum at its end): {shown_text(line)}")
    try:
        return pynmeagps.NMEAReader.parse(line.encode() + b"\r\n", validate=pynmeagps.VALCKSUM)
    except Exception as error:  # a parser given anything may raise anything
        raise DataError(f"{place}: broken sentence ({shown_text(str(error), 120)})") from error


@dataclass
class _Epoch:
    """Moment that sentences share; which day it is may be learnt from a later one of them."""

    second: float
    """Of the day."""
    days: int
    """Since the first midnight."""
    dated: bool = False
    """Whether a date has told the day."""

    @property
    def time_s(self) -> float:
        """Time since the first midnight [s]."""
        return self.days * DAY_S + self.second


class _Clock:
    """Turns times of day into seconds that go on over midnight."""

    def __init__(self) -> None:
        self.now = _Epoch(-1.0, 0)
        self.offset_s = 0.0
        self.system = "UTC, no date"

    def count(self, time: dt.time) -> _Epoch:
        """Epoch of a sentence; a step back of more than half a day is a new day."""
        second = time.hour * 3600.0 + time.minute * 60.0 + time.second + 1e-6 * time.microsecond
        if second != self.now.second:
            self.now = _Epoch(second, self.now.days + (second < self.now.second - DAY_S / 2))
        return self.now

    def date(self, message: Any) -> None:
        """Learn the date of the first midnight, then how many days a gap has taken.

        Many receivers send the date last in an epoch, so it holds for what the epoch began with, too.
        """
        if not isinstance(message.time, dt.time):
            return
        if message.msgID == "ZDA":
            day = message.year, message.month, message.day
        elif isinstance(message.date, dt.date):
            day = message.date.year, message.date.month, message.date.day
        else:
            return
        if not all(isinstance(part, int) for part in day) or day[0] < 1980:
            return
        epoch = self.count(message.time)
        midnight_s = unix_seconds(*day) - GPS_EPOCH_UNIX_S
        if self.system != "UTC":
            self.offset_s = midnight_s - epoch.days * DAY_S
            self.system = "UTC"
        days = round((midnight_s - self.offset_s) / DAY_S)
        if epoch.dated and epoch.days != days:  # the same second of another day
            epoch = self.now = _Epoch(epoch.second, days)
        epoch.days, epoch.dated = days, True


def _covariance(place: str, gst: Any) -> Array:
    """East, north, up covariance [m^2] of a GST sentence; zero where it leaves its sigmas empty."""
    out = np.zeros((3, 3))
    ellipse = (gst.stdMajor, gst.stdMinor, gst.orient)
    axes = (gst.stdLat, gst.stdLong, gst.stdAlt)
    if "" in axes:
        return out
    north, east, up = (float(value) for value in axes)
    if min(north, east, up) < 0.0:
        raise DataError(f"{place}: GST has a negative sigma; it must be >= 0")
    if "" in ellipse:
        out[0, 0], out[1, 1] = east**2, north**2
    else:
        major, minor, bearing = float(ellipse[0]), float(ellipse[1]), math.radians(float(ellipse[2]))
        along = np.array([math.sin(bearing), math.cos(bearing)])
        across = np.array([math.cos(bearing), -math.sin(bearing)])
        out[:2, :2] = major**2 * np.outer(along, along) + minor**2 * np.outer(across, across)
    out[2, 2] = up**2
    return out
