"""Reader of PX4 ULog files: the autopilot's GNSS positions with their reported accuracy."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napf_mpc.errors import DataError
from napf_mpc.navigation.readers.track import GPS_EPOCH_UNIX_S, checked_track, log_file
from napf_mpc.navigation.rtklib import PosTrack
from napf_mpc.words import shown_text

__all__ = ["read_ulog"]

Array = NDArray[np.float64]

TOPICS = ("vehicle_gps_position", "sensor_gps")
"""Topics that hold GNSS positions, the first that is there is read."""
_FIX_3D = 3
# What a quantity is called in older and newer logs, and the factor to degrees or metres.
_NAMES: dict[str, tuple[tuple[str, float], ...]] = {
    "latitude": (("latitude_deg", 1.0), ("lat", 1e-7)),
    "longitude": (("longitude_deg", 1.0), ("lon", 1e-7)),
    "height": (("altitude_ellipsoid_m", 1.0), ("alt_ellipsoid", 1e-3)),
    "eph": (("eph", 1.0),),
    "epv": (("epv", 1.0),),
    "fix_type": (("fix_type", 1.0),),
    "time": (("time_utc_usec", 1e-6),),
}


def read_ulog(path: Path | str) -> PosTrack:
    """Read the GNSS topic of a PX4 log.

    PX4 logs no covariance but accuracies: ``eph`` is taken as the root of the two horizontal variances' sum,
    shared evenly, ``epv`` as the sigma of the height (PX4 message ``SensorGps``).

    Parameters
    ----------
    path : Path or str
        ULog file.

    Returns
    -------
    PosTrack
        Samples with a 3-D fix and a known time, in UTC. A log holds no truth.

    Raises
    ------
    DataError
        The file is missing, empty, no ULog, broken, or without such a topic.
    """
    path = log_file(path)
    topic, data = _topic(path)
    columns = {name: _column(path, topic, data, name) for name in _NAMES}
    used = (columns["fix_type"] >= _FIX_3D) & (columns["time"] > 0.0)
    place = np.stack([columns[name][used] for name in ("latitude", "longitude", "height")], axis=-1)
    variance = np.zeros((int(used.sum()), 3, 3))
    variance[:, 0, 0] = variance[:, 1, 1] = 0.5 * columns["eph"][used] ** 2
    variance[:, 2, 2] = columns["epv"][used] ** 2
    time_s = columns["time"][used] - GPS_EPOCH_UNIX_S
    return checked_track(path, "UTC", time_s.tolist(), place.tolist(), list(variance))


def _topic(path: Path) -> tuple[str, Mapping[str, Any]]:
    try:
        import pyulog
    except ImportError as error:
        raise DataError(
            f"{path}: reading ULog needs the package pyulog; install napf-mpc[receivers]"
        ) from error
    with path.open("rb") as file:
        if file.read(7) != b"ULog\x01\x12\x35":
            raise DataError(f"{path}: not a ULog file (its first bytes are others)")
    try:
        # It prints what it does not like; what it cannot read must come out as one line.
        with contextlib.redirect_stdout(io.StringIO()):
            log = pyulog.ULog(str(path), list(TOPICS))
    except Exception as error:  # a parser given anything may raise anything
        words = shown_text(f"{type(error).__name__}: {error}", 120)
        raise DataError(f"{path}: broken ULog file ({words})") from error
    if log.file_corruption:
        raise DataError(f"{path}: broken ULog file (parts of it cannot be read)")
    for topic in TOPICS:
        for data in log.data_list:
            if data.name == topic:
                return topic, data.data
    raise DataError(f"{path}: no GNSS positions in it (topic {' or '.join(TOPICS)})")


def _column(path: Path, topic: str, data: Mapping[str, Any], name: str) -> Array:
    for field, factor in _NAMES[name]:
        if field in data:
            return np.asarray(data[field], dtype=np.float64) * factor
    fields = " or ".join(field for field, _ in _NAMES[name])
    raise DataError(f"{path}: topic {topic} has no field {fields}")
