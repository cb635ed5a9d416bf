"""From epochs as some file held them to a checked track of positions."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napf_mpc.data_file import readable_file
from napf_mpc.errors import DataError
from napf_mpc.navigation.rtklib import PosTrack

__all__ = ["GPS_EPOCH_UNIX_S", "MAX_BYTES", "checked_track", "log_file", "unix_seconds"]

Array = NDArray[np.float64]

GPS_EPOCH_UNIX_S = 315_964_800.0
"""1980-01-06 00:00 UTC in seconds since 1970."""
MAX_BYTES = 400_000_000
_MAX_VARIANCE_M2 = 1e12
_EPOCH = dt.datetime(1970, 1, 1)


def unix_seconds(year: int, month: int, day: int) -> float:
    """Seconds from 1970 to the midnight that begins a day, no leap seconds counted."""
    return (dt.datetime(year, month, day) - _EPOCH).total_seconds()


def log_file(path: Path | str) -> Path:
    """Path of a log that can be read and is not empty.

    Raises
    ------
    DataError
        Naming the file and why.
    """
    path = readable_file(path, MAX_BYTES)
    if path.stat().st_size == 0:
        raise DataError(f"{path}: empty file")
    return path


def checked_track(
    path: Path,
    time_system: str,
    time_s: Sequence[float],
    geodetic: Sequence[Sequence[float]],
    covariance: Sequence[Array],
    heights: str = "ellipsoidal",
) -> PosTrack:
    """Track of epochs with a fix, in the order of the file.

    An epoch that repeats the time of the one before is left out: loggers write the same fix twice.

    Parameters
    ----------
    path : Path
        File that they come from.
    time_system : str
        Clock of the times.
    time_s : sequence of float
        [s].
    geodetic : sequence of 3 floats
        WGS-84 latitude and longitude [deg], height [m].
    covariance : sequence of array, shape (3, 3)
        As reported, east, north, up [m^2]; zero where none was given.
    heights : str
        What heights count from: ``ellipsoidal`` or ``geodetic``.

    Raises
    ------
    DataError
        No epochs, times that go back, or a number that is not finite or out of range.
    """
    if not time_s:
        raise DataError(f"{path}: no epochs with a 3-D fix in it")
    times, places = np.array(time_s), np.array(geodetic, dtype=np.float64).reshape(-1, 3)
    matrices = np.array(covariance, dtype=np.float64).reshape(-1, 3, 3)
    steps = np.diff(times)
    if not (np.isfinite(times).all() and (steps >= 0.0).all()):
        at = 1 + int(np.argmax(~(steps >= 0.0))) if len(steps) else 0
        back = times[at - 1] - times[at]
        raise DataError(
            f"{path}, epoch {at + 1}: time goes back by {back:g} s; cut the log there, or sort it by time"
        )
    limits = (("latitude", 90.0, "deg"), ("longitude", 360.0, "deg"), ("height", 1e5, "m"))
    for column, (name, limit, unit) in enumerate(limits):
        bad = np.asarray(~(np.abs(places[:, column]) <= limit))
        if bad.any():
            at = int(np.argmax(bad))
            raise DataError(
                f"{path}, epoch {at + 1}: {name} = {places[at, column]:g} {unit}, must be from {-limit:g} "
                f"to {limit:g}"
            )
    bad = np.asarray(~(np.abs(matrices) <= _MAX_VARIANCE_M2).all(axis=(1, 2)))
    if bad.any():
        raise DataError(
            f"{path}, epoch {int(np.argmax(bad)) + 1}: a reported variance is not finite or beyond "
            f"{_MAX_VARIANCE_M2:g} m^2"
        )
    kept = np.concatenate([[True], steps > 0.0])
    return PosTrack(str(path), time_system, times[kept], places[kept], matrices[kept], heights)
