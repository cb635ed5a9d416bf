"""Reader of u-blox UBX logs: positions from NAV-PVT, their reported covariance from NAV-COV."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napf_mpc.errors import DataError
from napf_mpc.navigation.readers.track import GPS_EPOCH_UNIX_S, checked_track, log_file, unix_seconds
from napf_mpc.navigation.rtklib import PosTrack
from napf_mpc.words import shown_text

__all__ = ["read_ubx"]

Array = NDArray[np.float64]

WEEK_S = 604_800.0
_FIX_3D = (3, 4)  # 3-D, and 3-D with dead reckoning


def read_ubx(path: Path | str) -> PosTrack:
    """Read NAV-PVT and NAV-COV messages of a u-blox receiver's log.

    NAV-COV gives the covariance in north, east, down. Without one of the same epoch NAV-PVT's accuracies do:
    ``hAcc`` is taken as the root of the two horizontal variances' sum, shared evenly, ``vAcc`` as the sigma
    of the height (u-blox interface description, UBX-NAV-PVT and UBX-NAV-COV).

    Parameters
    ----------
    path : Path or str
        Binary file; NMEA or RTCM between the messages is passed over.

    Returns
    -------
    PosTrack
        Epochs with a valid 3-D fix and a valid date, in GPS time.

    Raises
    ------
    DataError
        The file is missing, empty, broken, cut off, or has no such messages.
    """
    path = log_file(path)
    fixes: list[tuple[int, float, list[float], Array]] = []
    reports: dict[int, Array] = {}
    epoch, last_ms = 0, -1
    for message in _messages(path):
        # Messages of an epoch stand together. Its time of week alone comes again a week later.
        if (now_ms := _time_of_week_ms(message)) != last_ms:
            epoch, last_ms = epoch + 1, now_ms
        if message.identity == "NAV-COV" and message.posCovValid:
            reports[epoch] = _covariance(message)
        elif message.identity == "NAV-PVT":
            sound = message.fixType in _FIX_3D and message.gnssFixOk and message.validDate
            if sound and not getattr(message, "invalidLlh", 0):
                position = [message.lat, message.lon, 1e-3 * message.height]
                east = 0.5 * (1e-3 * message.hAcc) ** 2
                plain = np.diag([east, east, (1e-3 * message.vAcc) ** 2])
                fixes.append((epoch, _gps_time(message, now_ms), position, plain))
    covariances = [reports.get(epoch, plain) for epoch, _, _, plain in fixes]
    return checked_track(
        path, "GPST", [time for _, time, _, _ in fixes], [place for _, _, place, _ in fixes], covariances
    )


def _messages(path: Path) -> list[Any]:
    try:
        import pyubx2
    except ImportError as error:
        raise DataError(
            f"{path}: reading UBX needs the package pyubx2; install napf-mpc[receivers]"
        ) from error
    wanted = ("NAV-PVT", "NAV-COV")
    found: list[Any] = []
    with path.open("rb") as file:
        reader = pyubx2.UBXReader(file, protfilter=pyubx2.UBX_PROTOCOL, quitonerror=pyubx2.ERR_RAISE)
        while True:
            try:
                raw, message = reader.read()
            except Exception as error:  # a parser given anything may raise anything
                raise DataError(
                    f"{path}, near byte {file.tell()}: broken or cut-off message "
                    f"({shown_text(str(error), 120)}); cut the log there"
                ) from error
            if raw is None:
                break
            if getattr(message, "identity", "") in wanted:
                found.append(message)
    if not any(message.identity == "NAV-PVT" for message in found):
        raise DataError(f"{path}: no UBX-NAV-PVT messages in it; is it a u-blox log, and is NAV-PVT on?")
    return found


def _time_of_week_ms(message: Any) -> int:
    return int(message.iTOW)


def _gps_time(message: Any, week_ms: int) -> float:
    """Seconds since 1980-01-06 in GPS time: time of week as given, the week from the UTC date."""
    day_s = unix_seconds(message.year, message.month, message.day) - GPS_EPOCH_UNIX_S
    clock_s: float = message.hour * 3600.0 + message.min * 60.0 + message.second
    week = round((day_s + clock_s - 1e-3 * week_ms) / WEEK_S)
    return week * WEEK_S + 1e-3 * week_ms


def _covariance(message: Any) -> Array:
    """East, north, up covariance [m^2] from north, east, down."""
    nn, ne, nd = message.posCovNN, message.posCovNE, message.posCovND
    ee, ed, dd = message.posCovEE, message.posCovED, message.posCovDD
    return np.array([[ee, ne, -ed], [ne, nn, -nd], [-ed, -nd, dd]], dtype=np.float64)
