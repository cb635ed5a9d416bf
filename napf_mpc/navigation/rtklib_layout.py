"""How an RTKLIB position file is laid out: what its header says of clock, columns, separator and heights."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
import pymap3d
from numpy.typing import NDArray

from napf_mpc.errors import DataError
from napf_mpc.navigation.sky import east_north_up
from napf_mpc.words import shown_text

__all__ = ["Layout", "decimal_degrees", "geodetic_and_covariance", "layout_of", "reference_position"]

Array = NDArray[np.float64]

# Kind of positions -> its columns, and the columns of its standard deviations: three axes, then 12, 23, 31.
_POSITIONS = {
    "deg": ("latitude(deg)", "longitude(deg)", "height(m)"),
    "dms": ("latitude(d'\")", "longitude(d'\")", "height(m)"),
    "ecef": ("x-ecef(m)", "y-ecef(m)", "z-ecef(m)"),
    "enu": ("e-baseline(m)", "n-baseline(m)", "u-baseline(m)"),
}
_GEODETIC_SIGMAS = ("sdn(m)", "sde(m)", "sdu(m)", "sdne(m)", "sdeu(m)", "sdun(m)")
_SIGMAS = {
    "deg": _GEODETIC_SIGMAS,
    "dms": _GEODETIC_SIGMAS,
    "ecef": ("sdx(m)", "sdy(m)", "sdz(m)", "sdxy(m)", "sdyz(m)", "sdzx(m)"),
    "enu": ("sde(m)", "sdn(m)", "sdu(m)", "sden(m)", "sdnu(m)", "sdue(m)"),
}
# The header of degrees, minutes, seconds calls the last column sdue; what stands there is the same.
_OTHER_NAMES = {"sdue(m)": "sdun(m)"}
_FIRST_COLUMNS = "|".join(re.escape(columns[0]) for columns in _POSITIONS.values())
_SEPARATOR = re.compile(rf"\s*(\S?)\s*(?:{_FIRST_COLUMNS})")
_HALF_A_DIGIT_M = 0.5e-4
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d*)?")


@dataclass(frozen=True)
class Layout:
    """Where the numbers of a line stand."""

    kind: str
    """``deg``, ``dms``, ``ecef`` or ``enu``."""
    separator: str | None
    """What stands between two fields; None for white space."""
    names: tuple[str, ...]
    """Columns that are read: position, then standard deviations if there are any."""
    places: tuple[int, ...]
    """Where those begin, counted in fields after the two of the time."""
    quality: int | None
    """Place of the column Q, or None."""
    sigmas: int
    """Number of standard deviations: 0, 3 (no cross terms) or 6."""

    def fields(self, line: str) -> list[str]:
        """Fields of a line, the time as two."""
        if self.separator is None:
            return line.split()
        fields = [field.strip() for field in line.split(self.separator)]
        return fields[0].split() + fields[1:] if ":" in fields[0] else fields


def layout_of(place: str, text: str) -> Layout:
    """Layout that a header line tells.

    Parameters
    ----------
    place : str
        File and line, for messages.
    text : str
        What follows ``% GPST`` (or UTC, JST).

    Raises
    ------
    DataError
        No known position columns, or some of them missing.
    """
    found = _SEPARATOR.match(text)
    separator = found[1] if found and found[1] else None
    header = [name.strip() for name in (text.split() if separator is None else text.split(separator))]
    header = [name for name in header if name]
    kind = next((kind for kind, names in _POSITIONS.items() if names[0] in header), "deg")
    if kind == "dms":
        header = [_OTHER_NAMES.get(name, name) for name in header]
    sigmas: tuple[str, ...] = _SIGMAS[kind]
    if not set(sigmas) & set(header):
        sigmas = ()
    elif not set(sigmas[3:]) & set(header):
        sigmas = sigmas[:3]
    names = (*_POSITIONS[kind], *sigmas)
    missing = [name for name in names if name not in header]
    if missing:
        raise DataError(
            f"{place}: column {missing[0]} is missing (has {shown_text(' '.join(header), 120)}); "
            "write positions as latitude, longitude, height, as x, y, z-ecef or as e, n, u-baseline, "
            "with standard deviations"
        )
    # Degrees, minutes and seconds are three fields of one column, twice.
    wider = {name: 0 if at == 0 else 2 if at == 1 else 4 for at, name in enumerate(header)}
    at = {
        name: header.index(name) + (wider[name] if kind == "dms" else 0) for name in {*names, "Q"} & {*header}
    }
    return Layout(kind, separator, names, tuple(at[name] for name in names), at.get("Q"), len(sigmas))


def decimal_degrees(degrees: float, minutes: float, seconds: float, negative: bool) -> float:
    """Degrees of an angle; its sign stands before the degrees, also before a zero."""
    size = abs(degrees) + minutes / 60.0 + seconds / 3600.0
    return -size if negative else size


def reference_position(place: str, line: str) -> Array:
    """Latitude, longitude [deg] and height [m] of the base, from a header line ``% ref pos : ...``.

    Raises
    ------
    DataError
        Neither three numbers nor seven (degrees, minutes, seconds).
    """
    texts = _NUMBER.findall(line.partition(":")[2])
    numbers = np.array([float(text) for text in texts])
    if len(numbers) == 3:
        if (np.abs(numbers[:2]) > 360.0).any():  # earth-fixed, as with x, y, z
            return np.array(pymap3d.ecef2geodetic(*numbers), dtype=np.float64)
        return numbers
    if len(numbers) == 7:
        angles = []
        for at in (0, 3):
            degrees, minutes, seconds = numbers[at : at + 3].tolist()
            angles.append(decimal_degrees(degrees, minutes, seconds, texts[at].startswith("-")))
        return np.array([*angles, numbers[6]])
    raise DataError(f"{place}: {shown_text(line)} is no reference position (latitude, longitude, height)")


def _without_rounding(covariance: Array, sigmas: Array) -> Array:
    """Nearest covariances where four decimals made of one what is none, as they do with millimetres.

    A sigma that is off by half a digit d puts its square off by 2 sigma d, three of them an eigenvalue by 6.
    What is off by more is left as it is, for whoever uses it to refuse.
    """
    values, vectors = np.linalg.eigh(covariance)
    rounding = 6.0 * _HALF_A_DIGIT_M * np.abs(sigmas).max(axis=1)
    rounded = (values[:, 0] < 0.0) & (values[:, 0] >= -rounding)
    kept = np.einsum("nik,nk,njk->nij", vectors, np.maximum(values, 0.0), vectors)
    return np.where(rounded[:, None, None], kept, covariance)


def geodetic_and_covariance(
    layout: Layout, position: Array, sigmas: Array, base: Array | None
) -> tuple[Array, Array]:
    """Geodetic places (n, 3) and covariances (n, 3, 3) in east, north, up, whatever the file's own axes are.

    Parameters
    ----------
    layout : Layout
        Of the file.
    position : array, shape (n, 3)
        Degrees and metres, earth-fixed metres, or metres from the base.
    sigmas : array, shape (n, 6)
        Standard deviations of the file's three axes, then signed square roots of their cross terms 12, 23,
        31.
    base : array, shape (3,), or None
        Latitude, longitude [deg] and height [m] of what ``enu`` counts from.
    """
    a, b, c, ab, bc, ca = np.copysign(sigmas**2, sigmas).T
    covariance = np.stack([np.stack(row, -1) for row in ((a, ab, ca), (ab, b, bc), (ca, bc, c))], -2)
    covariance = _without_rounding(covariance, sigmas)
    if layout.kind in ("deg", "dms"):
        swap = [1, 0, 2]  # the file has north first
        # Of north, east, up the cross terms are ne, eu, un: 12, 23, 31.
        return position, covariance[:, swap][:, :, swap]
    if layout.kind == "enu":
        assert base is not None
        local = east_north_up(float(base[0]), float(base[1]))
        position = np.array(pymap3d.geodetic2ecef(*base)) + position @ local
        covariance = local.T @ covariance @ local
    geodetic = np.stack(pymap3d.ecef2geodetic(*position.T), -1)
    axes = np.array([east_north_up(lat, lon) for lat, lon in geodetic[:, :2]])
    return geodetic, axes @ covariance @ axes.transpose(0, 2, 1)
