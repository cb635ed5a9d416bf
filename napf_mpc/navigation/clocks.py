"""Clocks of logs brought to GPS time: Japan's is nine hours ahead of UTC, UTC lags by leap seconds."""

from __future__ import annotations

import datetime as dt

import numpy as np
from numpy.typing import NDArray

__all__ = ["CLOCKS", "gps_time_s"]

Array = NDArray[np.float64]

CLOCKS = ("GPST", "UTC", "JST")
"""Time systems that can be brought to one another."""
_JST_AHEAD_S = 9 * 3600.0
_GPS_EPOCH = dt.date(1980, 1, 6)
# Days at whose beginning (UTC) GPS time gained a second on UTC. Source: IERS Bulletin C; none after 2017 had
# been announced when this was written.
_LEAPS = (
    "1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01",
    "1991-01-01", "1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01",
    "1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01",
)  # fmt: skip
_LEAPS_S = np.array([(dt.date.fromisoformat(day) - _GPS_EPOCH).days * 86_400.0 for day in _LEAPS])


def gps_time_s(time_s: Array, system: str) -> Array:
    """GPS time of moments on one of the :data:`CLOCKS`, counted from 1980-01-06 00:00 of their own clock [s].

    A UTC count has no leap seconds in it, so within one it cannot tell the second from the one after.
    """
    if system == "GPST":
        return time_s
    utc_s = time_s - (_JST_AHEAD_S if system == "JST" else 0.0)
    return np.asarray(utc_s + np.searchsorted(_LEAPS_S, utc_s, side="right"))
