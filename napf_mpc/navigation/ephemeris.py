"""Orbits from broadcast ephemerides: GPS, Galileo and QZSS, by their interface documents.

The user algorithm is that of IS-GPS-200 (table 20-IV), of the Galileo OS SIS ICD (section 5.1.1) and of
IS-QZSS-PNT; they differ in the gravitational constant only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "EARTH_ROTATION_RADPS",
    "LIGHT_MPS",
    "MAX_AGE_S",
    "SYSTEMS",
    "BroadcastConstellation",
    "Constellation",
    "Ephemerides",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

LIGHT_MPS = 299_792_458.0
"""Speed of light [m/s]."""
EARTH_ROTATION_RADPS = 7.2921151467e-5
"""Rotation rate of the earth in all three documents [rad/s]."""
SYSTEMS = ("GPS", "Galileo", "QZSS")
"""Names of systems; arrays hold their index."""
_GRAVITY = np.array([3.986005e14, 3.986004418e14, 3.986005e14])  # [m^3/s^2] by system
MAX_AGE_S = (7_200.0, 14_400.0, 7_200.0)
"""Farthest from its reference time that a record is used, by system [s]."""
_KEPLER_STEPS = 8  # Newton from M reaches rounding in five for e < 0.1 (QZSS: 0.075)


class Constellation(Protocol):
    """Satellites and where they are."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the satellites, such as ``G01``."""

    @property
    def system(self) -> Index:
        """(sat,) index into :data:`SYSTEMS`."""

    @property
    def accuracy_m(self) -> Array:
        """(sat,) sigma of the signal in space that the satellites broadcast [m]."""

    def positions(self, time_s: Array) -> Array:
        """(time, sat, 3) earth-fixed at GPS times [s since 1980-01-06] [m]."""


@dataclass(frozen=True)
class Ephemerides:
    """Records of broadcast ephemerides, all arrays (record,), names as in the interface documents."""

    name: NDArray[np.str_]
    """Satellite."""
    system: Index
    """Index into :data:`SYSTEMS`."""
    toc_s: Array
    """Reference time of the clock, GPS time since 1980-01-06 [s]."""
    toe_s: Array
    """Reference time of the orbit, GPS time since 1980-01-06 [s]."""
    af0: Array
    """Clock offset [s]."""
    af1: Array
    """Clock drift [s/s]."""
    af2: Array
    """Clock drift rate [s/s^2]."""
    sqrt_a: Array
    """Root of the semi-major axis [m^0.5]."""
    e: Array
    """Eccentricity."""
    m0: Array
    """Mean anomaly [rad]."""
    delta_n: Array
    """Correction of the mean motion [rad/s]."""
    omega0: Array
    """Longitude of the ascending node at the start of the week [rad]."""
    omega_dot: Array
    """Rate of right ascension [rad/s]."""
    omega: Array
    """Argument of perigee [rad]."""
    i0: Array
    """Inclination [rad]."""
    idot: Array
    """Rate of inclination [rad/s]."""
    cuc: Array
    """Cosine term, argument of latitude [rad]."""
    cus: Array
    """Sine term, argument of latitude [rad]."""
    crc: Array
    """Cosine term, radius [m]."""
    crs: Array
    """Sine term, radius [m]."""
    cic: Array
    """Cosine term, inclination [rad]."""
    cis: Array
    """Sine term, inclination [rad]."""
    accuracy_m: Array
    """URA of GPS and QZSS, SISA of Galileo [m]."""
    healthy: NDArray[np.bool_]
    """Whether the satellite says that it may be used."""

    def __len__(self) -> int:
        """Number of records."""
        return len(self.name)

    def take(self, rows: Sequence[int] | Index | NDArray[np.bool_]) -> Ephemerides:
        """Return some of the records."""
        return Ephemerides(*(getattr(self, field.name)[rows] for field in fields(self)))

    def positions(self, time_s: Array) -> Array:
        """Positions of the antennas' phase centres, earth-fixed at each time.

        Parameters
        ----------
        time_s : array, shape (time,)
            GPS time since 1980-01-06 [s].

        Returns
        -------
        array, shape (time, record, 3)
            Earth-centred, earth-fixed [m].
        """
        tk = np.asarray(time_s, dtype=np.float64)[:, None] - self.toe_s
        e, sin_e, cos_e = self.e, *self._anomaly(tk)
        phi = np.arctan2(np.sqrt(1.0 - e**2) * sin_e, cos_e - e) + self.omega
        sin2, cos2 = np.sin(2.0 * phi), np.cos(2.0 * phi)
        u = phi + self.cus * sin2 + self.cuc * cos2
        r = self.sqrt_a**2 * (1.0 - e * cos_e) + self.crs * sin2 + self.crc * cos2
        i = self.i0 + self.idot * tk + self.cis * sin2 + self.cic * cos2
        seconds_of_week = np.mod(self.toe_s, 604_800.0)
        node = (
            self.omega0
            + (self.omega_dot - EARTH_ROTATION_RADPS) * tk
            - EARTH_ROTATION_RADPS * seconds_of_week
        )
        x, y = r * np.cos(u), r * np.sin(u)
        return np.stack(
            [
                x * np.cos(node) - y * np.cos(i) * np.sin(node),
                x * np.sin(node) + y * np.cos(i) * np.cos(node),
                y * np.sin(i),
            ],
            axis=-1,
        )

    def clock_s(self, time_s: Array) -> Array:
        """Offset of the satellites' clocks with the relativistic part, without group delays.

        Parameters
        ----------
        time_s : array, shape (time,)
            GPS time since 1980-01-06 [s].

        Returns
        -------
        array, shape (time, record)
            [s].
        """
        time = np.asarray(time_s, dtype=np.float64)[:, None]
        dt = time - self.toc_s
        sin_e, _ = self._anomaly(time - self.toe_s)
        relativity = -2.0 * np.sqrt(_GRAVITY[self.system]) * self.sqrt_a * self.e * sin_e / LIGHT_MPS**2
        return np.asarray(self.af0 + self.af1 * dt + self.af2 * dt**2 + relativity)

    def _anomaly(self, tk: Array) -> tuple[Array, Array]:
        """Sine and cosine of the eccentric anomaly, by Newton's steps on Kepler's equation."""
        mean = self.m0 + (np.sqrt(_GRAVITY[self.system]) / self.sqrt_a**3 + self.delta_n) * tk
        anomaly = mean
        for _ in range(_KEPLER_STEPS):
            anomaly = anomaly - (anomaly - self.e * np.sin(anomaly) - mean) / (1.0 - self.e * np.cos(anomaly))
        return np.sin(anomaly), np.cos(anomaly)

    def at(self, time_s: float) -> BroadcastConstellation:
        """Satellites with a record that is valid at a time: of each the record nearest to it, if healthy."""
        age = np.abs(self.toe_s - time_s)
        usable = age <= np.array(MAX_AGE_S)[self.system]
        rows = []
        for name in np.unique(self.name):
            mine = np.flatnonzero(usable & (self.name == name))
            if len(mine) and self.healthy[row := mine[np.argmin(age[mine])]]:
                rows.append(int(row))
        return BroadcastConstellation(self.take(np.array(rows, dtype=np.int64)))


@dataclass(frozen=True)
class BroadcastConstellation:
    """Satellites with one record each, good for the hours around its reference time."""

    records: Ephemerides
    """One a satellite, ordered by name."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the satellites."""
        return tuple(str(name) for name in self.records.name)

    @property
    def system(self) -> Index:
        """(sat,) index into :data:`SYSTEMS`."""
        return self.records.system

    @property
    def accuracy_m(self) -> Array:
        """(sat,) URA or SISA [m]."""
        return self.records.accuracy_m

    def positions(self, time_s: Array) -> Array:
        """(time, sat, 3) earth-fixed [m]."""
        return self.records.positions(time_s)
