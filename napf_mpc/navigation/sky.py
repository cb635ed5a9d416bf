"""The sky over a place: in which direction, and how far, the satellites of a constellation are."""

from __future__ import annotations

import numpy as np
import pymap3d
from numpy.typing import NDArray

from napf_mpc.navigation.ephemeris import EARTH_ROTATION_RADPS, LIGHT_MPS, Constellation

__all__ = ["azimuth_rad", "directions", "east_north_up", "elevation_rad", "ranges"]

Array = NDArray[np.float64]

_FLIGHTS = 3  # the signal's flight moves a satellite by 300 m at most, its change by less than a millimetre


def east_north_up(latitude_deg: float, longitude_deg: float) -> Array:
    """Matrix (3, 3) whose rows are east, north, up at a place, in earth-fixed axes."""
    phi, lam = np.radians(latitude_deg), np.radians(longitude_deg)
    return np.array(
        [
            [-np.sin(lam), np.cos(lam), 0.0],
            [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)],
            [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)],
        ]
    )


def directions(
    constellation: Constellation, latitude_deg: float, longitude_deg: float, time_s: Array
) -> Array:
    """Unit vectors (time, sat, 3) from a place on the ellipsoid to the satellites, east, north, up.

    The signal's time of flight is left out, which turns them by 2e-5 rad at most; so does a kilometre of
    distance from the place.

    Parameters
    ----------
    constellation : Constellation
        Satellites.
    latitude_deg, longitude_deg : float
        WGS-84.
    time_s : array, shape (time,)
        GPS time since 1980-01-06 [s].
    """
    place = np.array(pymap3d.geodetic2ecef(latitude_deg, longitude_deg, 0.0), dtype=np.float64)
    away = constellation.positions(time_s) - place
    local = np.einsum("ak,tsk->tsa", east_north_up(latitude_deg, longitude_deg), away)
    return np.asarray(local / np.sqrt(np.einsum("tsa,tsa->ts", local, local))[..., None])


def elevation_rad(unit: Array) -> Array:
    """Elevation of unit vectors (..., 3) in east, north, up [rad]."""
    return np.asarray(np.arcsin(np.clip(unit[..., 2], -1.0, 1.0)))


def azimuth_rad(unit: Array) -> Array:
    """Azimuth of unit vectors (..., 3), clockwise from north, from 0 to 2 pi [rad]."""
    return np.asarray(np.mod(np.arctan2(unit[..., 0], unit[..., 1]), 2.0 * np.pi))


def ranges(constellation: Constellation, place: Array, time_s: float) -> tuple[Array, Array]:
    """Distances that signals received at a moment have flown, with the earth's turn during the flight.

    Parameters
    ----------
    constellation : Constellation
        Satellites.
    place : array, shape (3,)
        Earth-fixed [m].
    time_s : float
        Moment of reception, GPS time since 1980-01-06 [s].

    Returns
    -------
    range_m : array, shape (sat,)
        [m].
    satellite : array, shape (sat, 3)
        Satellites when they sent, in earth-fixed axes of that moment (as a receiver computes them) [m].
    """
    count = len(constellation.names)
    flight = np.full(count, 0.075)
    at = np.arange(count)
    for _ in range(_FLIGHTS):
        sent = constellation.positions(time_s - flight)[at, at]
        distance = np.linalg.norm(turned(sent, flight) - place, axis=-1)
        flight = distance / LIGHT_MPS
    return distance, sent


def turned(satellite: Array, flight_s: Array) -> Array:
    """Places (..., 3) in the axes of a moment that is a time of flight (...) later (Sagnac's term) [m]."""
    angle = EARTH_ROTATION_RADPS * flight_s
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = satellite[..., 0], satellite[..., 1]
    return np.stack([cos * x + sin * y, cos * y - sin * x, satellite[..., 2]], axis=-1)
