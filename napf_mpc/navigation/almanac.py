"""Nominal constellation of GPS and Galileo, so that an emulated receiver needs no file.

Slots, not satellites: circular orbits whose ground tracks repeat as they are meant to, GPS after one sidereal
day (two orbits), Galileo after ten (17 orbits). Orbits' slow turning is left out on both, since the systems
are kept to their ground tracks.

Sources: GPS Standard Positioning Service Performance Standard (2001), table A2-1: 24 slots at 1993-07-01;
European GNSS Service Centre, Galileo reference constellation: Walker 24/3/1, 56 degrees, slots at 2016-11-21.
"""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napf_mpc.navigation.ephemeris import EARTH_ROTATION_RADPS, SYSTEMS
from napf_mpc.navigation.rinex import gps_seconds

__all__ = ["NominalConstellation", "nominal_constellation"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Plane -> right ascension of the node, and argument of latitude of its slots [deg].
_GPS = {
    "A": (272.847, (268.126, 161.786, 11.676, 41.806)),
    "B": (332.847, (80.956, 173.336, 309.976, 204.376)),
    "C": (32.847, (111.876, 11.796, 339.666, 241.556)),
    "D": (92.847, (135.226, 265.446, 35.156, 167.356)),
    "E": (152.847, (197.046, 302.596, 66.066, 333.686)),
    "F": (212.847, (238.886, 345.226, 105.206, 135.346)),
}
_GPS_EPOCH = dt.datetime(1993, 7, 1)
_GPS_GREENWICH_DEG = 15.0 * (18.0 + 36.0 / 60.0 + 14.4 / 3600.0)
_GPS_AXIS_M, _GPS_INCLINATION_DEG, _GPS_ORBITS_PER_DAY = 26_559_700.0, 55.0, 2.0

_GALILEO_NODES_DEG = (317.632, 77.632, 197.632)
_GALILEO_FIRST_DEG = (225.153, 240.153, 255.153)
_GALILEO_EPOCH = dt.datetime(2016, 11, 21)
_GALILEO_AXIS_M, _GALILEO_INCLINATION_DEG, _GALILEO_ORBITS_PER_DAY = 29_599_800.0, 56.0, 1.7

_J2000 = dt.datetime(2000, 1, 1, 12)


@dataclass(frozen=True)
class NominalConstellation:
    """Slots on circular orbits, all arrays (sat,)."""

    names: tuple[str, ...]
    """System's letter, plane and slot, such as ``G-A1``."""
    system: Index
    """Index into :data:`~napf_mpc.navigation.ephemeris.SYSTEMS`."""
    accuracy_m: Array
    """What a satellite in good order broadcasts: URA 2 m, SISA 3.12 m."""
    epoch_s: Array
    """GPS time since 1980-01-06 of the two angles [s]."""
    node: Array
    """Earth-fixed longitude of the ascending node [rad]."""
    latitude_argument: Array
    """Argument of latitude [rad]."""
    rate: Array
    """Of the argument of latitude [rad/s]."""
    inclination: Array
    """[rad]."""
    axis_m: Array
    """Radius of the orbit [m]."""

    def positions(self, time_s: Array) -> Array:
        """(time, sat, 3) earth-fixed [m]."""
        elapsed = np.asarray(time_s, dtype=np.float64)[:, None] - self.epoch_s
        u = self.latitude_argument + self.rate * elapsed
        node = self.node - EARTH_ROTATION_RADPS * elapsed
        x, y = np.cos(u), np.sin(u) * np.cos(self.inclination)
        unit = (
            x * np.cos(node) - y * np.sin(node),
            x * np.sin(node) + y * np.cos(node),
            np.sin(u) * np.sin(self.inclination),
        )
        return np.asarray(self.axis_m[:, None] * np.stack(unit, axis=-1))


def nominal_constellation() -> NominalConstellation:
    """Return GPS with 24 slots and Galileo with 24."""
    names, rows = [], []
    for plane, (node, slots) in _GPS.items():
        for n, argument in enumerate(slots):
            names.append(f"G-{plane}{n + 1}")
            rows.append((0, 2.0, gps_seconds(_GPS_EPOCH), node - _GPS_GREENWICH_DEG, argument))
    greenwich = _greenwich_deg(_GALILEO_EPOCH)
    for plane, node, first in zip("ABC", _GALILEO_NODES_DEG, _GALILEO_FIRST_DEG, strict=True):
        for n in range(8):
            names.append(f"E-{plane}{n + 1}")
            rows.append((1, 3.12, gps_seconds(_GALILEO_EPOCH), node - greenwich, first + 45.0 * n))
    system, accuracy, epoch, node_deg, argument_deg = np.array(rows).T
    galileo = system == SYSTEMS.index("Galileo")
    return NominalConstellation(
        names=tuple(names),
        system=system.astype(np.int64),
        accuracy_m=accuracy,
        epoch_s=epoch,
        node=np.radians(node_deg),
        latitude_argument=np.radians(argument_deg),
        rate=EARTH_ROTATION_RADPS * np.where(galileo, _GALILEO_ORBITS_PER_DAY, _GPS_ORBITS_PER_DAY),
        inclination=np.radians(np.where(galileo, _GALILEO_INCLINATION_DEG, _GPS_INCLINATION_DEG)),
        axis_m=np.where(galileo, _GALILEO_AXIS_M, _GPS_AXIS_M),
    )


def _greenwich_deg(moment: dt.datetime) -> float:
    """Greenwich mean sidereal time of a date in universal time, to first order (IAU 1982) [deg]."""
    days = (moment - _J2000).total_seconds() / 86_400.0
    return (280.46062 + 360.98564737 * days) % 360.0
