"""Reader of smartLoc's text logs: pseudoranges of an urban drive, and its ground truth.

P. Reisdorf, T. Pfeifer, J. Bressler, S. Bauer, P. Weissig, S. Lange, G. Wanielik, P. Protzel, "The problem of
comparable GNSS results: an approach for a uniform dataset with low-cost and reference data" (Vehicular 2016);
the format is that of the library libRSF.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pymap3d
from numpy.typing import NDArray

from napf_mpc.errors import DataError
from napf_mpc.navigation.readers.track import checked_track, open_size
from napf_mpc.navigation.rtklib import PosTrack, numbered_lines
from napf_mpc.words import shown_text

__all__ = ["CN0_MASK_DBHZ", "ELEVATION_MASK_DEG", "plain_solution", "read_smartloc"]

Array = NDArray[np.float64]

ELEVATION_MASK_DEG, CN0_MASK_DBHZ = 15.0, 30.0
"""Pseudoranges below are left out of the solution."""
LIGHT_MPS = 299_792_458.0
EARTH_RATE_RADPS = 7.292_115e-5
_STEPS, _CONVERGED_M = 12, 1e-4
# Fields of a pseudorange3 record, after its name.
_FIELDS = ("t", "range", "variance", "x", "y", "z", "satellite", "system", "elevation", "cn0")


def read_smartloc(path: Path) -> PosTrack:
    """Read a smartLoc log: its ground truth, or the plain solution of its pseudoranges.

    Parameters
    ----------
    path : Path
        Text file with ``point3`` records (the truth), or with ``pseudorange3`` records. The latter are solved
        epoch by epoch by :func:`plain_solution`, above :data:`ELEVATION_MASK_DEG` and :data:`CN0_MASK_DBHZ`;
        an epoch that cannot be solved is left out.

    Returns
    -------
    PosTrack
        Times in seconds since the start of the log; the truth has zero covariance.

    Raises
    ------
    DataError
        The file is missing, empty, no such log, or a record in it is broken (file and line are named).
    """
    open_size(path)
    truth: list[Array] = []
    records: list[Array] = []
    for number, line in numbered_lines(path):
        name, *words = line.split()
        if name == "point3":
            truth.append(_numbers(path, number, words, 4))
        elif name == "pseudorange3":
            records.append(_numbers(path, number, words, len(_FIELDS)))
        elif name != "odom3":
            raise DataError(f"{path}, line {number}: {shown_text(name)} is no record of a smartLoc log")
    if bool(truth) == bool(records):
        raise DataError(f"{path}: needs point3 records or pseudorange3 records, and not both")
    if truth:
        table = np.array(truth)
        return _track(path, table[:, 0], table[:, 1:4], np.zeros((len(table), 3, 3)))
    return _solved(path, np.array(records))


def _numbers(path: Path, number: int, words: list[str], count: int) -> Array:
    if len(words) < count:
        raise DataError(f"{path}, line {number}: {len(words)} numbers, at least {count} are needed")
    try:
        values = np.array([float(word) for word in words[:count]])
    except ValueError:
        raise DataError(f"{path}, line {number}: {shown_text(' '.join(words))} are not numbers") from None
    if not np.isfinite(values).all():
        raise DataError(f"{path}, line {number}: a number is not finite")
    return values


def _solved(path: Path, records: Array) -> PosTrack:
    used = (records[:, 8] >= ELEVATION_MASK_DEG) & (records[:, 9] >= CN0_MASK_DBHZ) & (records[:, 2] > 0.0)
    records = records[used]
    times, starts = np.unique(records[:, 0], return_index=True)
    if len(records) and (np.diff(records[:, 0]) < 0.0).any():
        raise DataError(f"{path}: times of the pseudoranges go back; sort the log by time")
    kept, places, covariances = [], [], []
    place: Array | None = None
    for time_s, epoch in zip(times, np.split(records, starts[1:]), strict=True):
        solution = plain_solution(epoch[:, 1], epoch[:, 3:6], epoch[:, 2], epoch[:, 7], place)
        if solution is None:
            continue
        place, covariance = solution
        kept.append(time_s)
        places.append(place)
        covariances.append(covariance)
    return _track(
        path, np.array(kept), np.array(places).reshape(-1, 3), np.array(covariances).reshape(-1, 3, 3)
    )


def _track(path: Path, time_s: Array, place: Array, covariance: Array) -> PosTrack:
    """Geodetic track of ECEF positions (n, 3) and their ECEF covariances (n, 3, 3)."""
    geodetic = np.stack(pymap3d.ecef2geodetic(*place.T), -1)
    latitude, longitude = np.deg2rad(geodetic[:, 0]), np.deg2rad(geodetic[:, 1])
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    zero = np.zeros(len(place))
    rows = (
        (-sin_lon, cos_lon, zero),
        (-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat),
        (cos_lat * cos_lon, cos_lat * sin_lon, sin_lat),
    )
    turn = np.stack([np.stack(row, -1) for row in rows], -2)
    local = np.einsum("nai,nij,nbj->nab", turn, covariance, turn)
    return checked_track(path, "time of the log", time_s.tolist(), geodetic.tolist(), list(local))


def plain_solution(
    range_m: Array, satellite: Array, variance: Array, system: Array, start: Array | None = None
) -> tuple[Array, Array] | None:
    r"""Weighted least squares of one epoch: position and one clock a satellite system.

    Gauss-Newton on :math:`\rho_i = |R_3(\omega \tau_i) s_i - x| + c_{sys(i)}`, the satellite turned by the
    Earth's rotation during the signal's flight (IS-GPS-200, 20.3.3.4.3.3.2).

    Parameters
    ----------
    range_m, variance, system : array, shape (n,)
        Pseudorange without the satellite's clock and the atmosphere [m], its variance [m^2], and a number
        that tells the systems apart.
    satellite : array, shape (n, 3)
        Satellites' positions when they sent, ECEF [m].
    start : array, shape (3,), optional
        Where to begin; by default the centre of the Earth.

    Returns
    -------
    (array, array) or None
        Position (3,) ECEF [m] and its covariance (3, 3), :math:`(H^T W H)^{-1}`, the variances' own claim.
        None with fewer satellites than unknowns, a geometry that does not tell them, or no convergence.
    """
    systems, clock = np.unique(system, return_inverse=True)
    unknowns = 3 + len(systems)
    if len(range_m) < unknowns:
        return None
    x = np.zeros(unknowns)
    if start is not None:
        x[:3] = start
    design = np.zeros((len(range_m), unknowns))
    design[np.arange(len(range_m)), 3 + clock] = 1.0
    root = 1.0 / np.sqrt(variance)
    for _ in range(_STEPS):
        flight_s = np.linalg.norm(satellite - x[:3], axis=1) / LIGHT_MPS
        angle = EARTH_RATE_RADPS * flight_s
        cos, sin = np.cos(angle), np.sin(angle)
        turned = np.stack(
            [
                cos * satellite[:, 0] + sin * satellite[:, 1],
                cos * satellite[:, 1] - sin * satellite[:, 0],
                satellite[:, 2],
            ],
            axis=-1,
        )
        away = x[:3] - turned
        distance = np.linalg.norm(away, axis=1)
        design[:, :3] = away / distance[:, None]
        miss = range_m - distance - x[3 + clock]
        step, _, rank, _ = np.linalg.lstsq(design * root[:, None], miss * root, rcond=1e-10)
        if rank < unknowns:
            return None
        x += step
        if math.sqrt(float(step[:3] @ step[:3])) < _CONVERGED_M:
            weighted = design * root[:, None]
            return x[:3].copy(), np.asarray(np.linalg.inv(weighted.T @ weighted)[:3, :3])
    return None
