"""Where the sky is open: satellites in sight, dilution of precision, sigma and levels over the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napf_mpc.navigation.gnss import GnssScene
from napf_mpc.navigation.gnss_levels import levels_of
from napf_mpc.navigation.pseudorange_solution import Check, SolverSettings, solve

__all__ = ["GnssMap", "gnss_map"]

Array = NDArray[np.float64]

_BLOCK = 4096
_PLAIN = SolverSettings("plain", exclude=False, max_pdop=100.0)


@dataclass(frozen=True)
class GnssMap:
    """Satellite geometry over a grid at one height and moment; NaN inside buildings."""

    east_m: Array
    """(x,) of the grid [m]."""
    north_m: Array
    """(y,) of the grid [m]."""
    in_sight: Array
    """(y, x) satellites above the masks of elevation and C/N0 with nothing in the way."""
    hdop: Array
    """(y, x) of those; infinite where they give no position."""
    vdop: Array
    """(y, x)."""
    covariance: Array
    """(y, x, 3, 3) that a receiver reports which has those and no reflected signal [m^2]; infinite without a
    position."""
    protection_m: Array
    """(y, x, 2) HPL and VPL that its signals allow if their strengths are as expected and no error raises an
    alarm [m]; infinite where there is no level. Hidden signals that are strong enough count with their
    chance of being reflections."""


def gnss_map(
    scene: GnssScene, run: int, east_m: Array, north_m: Array, height_m: float, time_s: float = 0.0
) -> GnssMap:
    """Map of a run's sky over the ground.

    Parameters
    ----------
    scene : GnssScene
        Satellites and buildings.
    run : int
        Which run of the block.
    east_m, north_m : array, shapes (x,) and (y,)
        Grid [m].
    height_m : float
        Height [m].
    time_s : float
        Time since the start of the mission [s].
    """
    obstacles = scene.obstacles if scene.obstacles.n_scenes == 1 else scene.obstacles.scene(run)
    grid = np.stack([*np.meshgrid(east_m, north_m), np.full((len(north_m), len(east_m)), height_m)], axis=-1)
    places = grid.reshape(-1, 3)
    one = scene.of_run(run, obstacles)
    seen, dop, covariance, level = [], [], [], []
    for first in range(0, len(places), _BLOCK):
        part = places[first : first + _BLOCK][None]
        # The expected strength, so that the map shows the place and not one drawing of the fading.
        expected = one.expect(time_s, part)
        free = expected.in_sight[0] & expected.tracked[0]
        unit = np.broadcast_to(expected.directions, (part.shape[1], *expected.directions.shape[1:]))
        sigma = np.where(free, expected.sigma[0], 1.0)
        found = solve(unit, scene.clock, expected.error[0], sigma, free, _PLAIN)
        none = found.check == Check.NONE
        seen.append(free.sum(-1).astype(np.float64))
        dop.append(found.dop)
        covariance.append(np.where(none[:, None, None], np.inf, found.covariance))
        level.append(levels_of(expected, one).level_m)
    inside = obstacles.signed_distance(places[None])[0] <= 0.0
    shape = grid.shape[:2]
    dops = np.where(inside[:, None], np.nan, np.concatenate(dop))
    return GnssMap(
        east_m,
        north_m,
        np.where(inside, np.nan, np.concatenate(seen)).reshape(shape),
        dops[:, 0].reshape(shape),
        dops[:, 1].reshape(shape),
        np.where(inside[:, None, None], np.nan, np.concatenate(covariance)).reshape(*shape, 3, 3),
        np.where(inside[:, None], np.nan, np.concatenate(level)).reshape(*shape, 2),
    )
