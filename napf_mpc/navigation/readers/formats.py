"""Which reader a file needs: by its suffix, or as it is told."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from napf_mpc.errors import DataError
from napf_mpc.navigation.readers.nmea import read_nmea
from napf_mpc.navigation.readers.smartloc import read_smartloc
from napf_mpc.navigation.readers.ubx import read_ubx
from napf_mpc.navigation.readers.ulog import read_ulog
from napf_mpc.navigation.rtklib import PosTrack, read_rtklib_pos

__all__ = ["READERS", "SUFFIXES", "format_of", "read_track"]

READERS: dict[str, Callable[[Path | str], PosTrack]] = {
    "pos": read_rtklib_pos,
    "nmea": read_nmea,
    "ubx": read_ubx,
    "ulog": read_ulog,
    "smartloc": read_smartloc,
}
SUFFIXES = {".pos": "pos", ".nmea": "nmea", ".nma": "nmea", ".ubx": "ubx", ".ulg": "ulog", ".ulog": "ulog"}


def format_of(name: str, told: str, key: str) -> str:
    """Format of a file of positions.

    Parameters
    ----------
    name : str
        The file's name.
    told : str
        ``auto``, or the format.
    key : str
        Problem key that names the file, for messages.

    Raises
    ------
    DataError
        If nothing tells.
    """
    if told != "auto":
        return told
    suffix = Path(name).suffix.lower()
    if suffix not in SUFFIXES:
        errors = "a .csv file of errors, " if key == "navigation.file" else ""
        raise DataError(
            f"{key} = {name}: must be {errors}an RTKLIB .pos, NMEA .nmea, u-blox .ubx or PX4 .ulg file; "
            f"or say which with {key.replace('file', 'format')}"
        )
    return SUFFIXES[suffix]


def read_track(path: Path | str, kind: str) -> PosTrack:
    """Positions of a log of the given format, with their reported covariance."""
    return READERS[kind](path)
