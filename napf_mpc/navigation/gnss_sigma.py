"""The sigma map of emulated receivers: the fix that is to be expected over a volume, before anyone flies.

Who knows the buildings and where satellites stand can say beforehand where few will be in sight. The map
holds the covariance of the fix that :meth:`.gnss.GnssScene.expect` leads to, each place at the moment at
which the formation is due there. Nothing that is drawn enters: no error, no fading, no reflection's delay.
What the receiver will make of its residuals is not known either; errors that are zero fit any weights.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.navigation.gnss import GnssScene
from napf_mpc.navigation.gnss_fixes import solve_observation
from napf_mpc.navigation.pseudorange_solution import Check, SolverSettings
from napf_mpc.navigation.sigma_map import SigmaMap, largest_around
from napf_mpc.problem import FormationMission, Problem

__all__ = ["expected_variance", "sigma_map"]

Array = NDArray[np.float64]

CELL_M, SLICE_M = 2.5, 10.0
"""Distance of nodes on the level, wider if else there were more than :data:`MOST_NODES`; of slices [m]."""
MOST_NODES, MOST_SLICES = 20_000, 20
"""Nodes of a run's map at most (half a second of a core in a city, and a megabyte), and of its slices."""
ASIDE_M, BELOW_M, ABOVE_M = 30.0, 10.0, 20.0
"""How far the map reaches beyond the slots: to the sides, down and up [m]."""
BEHIND_M, BEYOND_M = 10.0, 50.0
"""How far it reaches along the path before the start and beyond the end [m]."""


def sigma_map(problem: Problem, scene: GnssScene) -> SigmaMap:
    """Map of a block of runs, each of its own sky.

    Parameters
    ----------
    problem : Problem
        Formation mission: where UAVs will be, and when.
    scene : GnssScene
        Satellites, laws and buildings. Its drawn errors are not used.
    """
    mission = problem.mission
    assert isinstance(mission, FormationMission)
    frame = PathFrame.of_mission(mission)
    slots = formation_offsets(problem.formation)
    low = slots.min(axis=0) - np.array([BEHIND_M, ASIDE_M, BELOW_M])
    high = slots.max(axis=0) + np.array([mission.length_m + BEYOND_M, ASIDE_M, ABOVE_M])
    cell, counts = _grid(high - low)
    along, left, up = (low[a] + cell[a] * np.arange(counts[a]) for a in range(3))
    nodes = np.empty((len(scene.start_s), *counts, 6))
    for run in range(len(nodes)):
        obstacles = scene.obstacles if scene.obstacles.n_scenes == 1 else scene.obstacles.scene(run)
        one = scene.of_run(run, obstacles)
        for n, place in enumerate(along):
            across = np.stack(np.meshgrid([place], left, up, indexing="ij"), axis=-1)
            due_s = min(max(place, 0.0) / mission.speed_mps, problem.simulation.time_limit_s)
            found = expected_variance(one, frame.to_world(across.reshape(-1, 3)), due_s)
            nodes[run, n] = found.reshape(*counts[1:], 6)
    return SigmaMap(frame, low, cell, largest_around(nodes))


def _grid(size: Array) -> tuple[Array, tuple[int, int, int]]:
    """Distances of nodes (3,) and their numbers along, left and up, for a volume (3,) [m]."""
    cell = np.array([CELL_M, CELL_M, max(SLICE_M, float(size[2]) / MOST_SLICES)])
    while True:
        along, left, up = (int(count) for count in np.ceil(size / cell - 1e-9) + 1)
        if along * left * up <= MOST_NODES:
            return cell, (along, left, up)
        cell[:2] *= 1.05


def expected_variance(scene: GnssScene, places: Array, time_s: float) -> Array:
    """Variances (place, 6) of the fix expected at places (place, 3) by one run's receiver [m^2].

    On east, north and up: of its own part, and of what UAVs have in common. Infinite where no fix is
    expected, NaN in a building.
    """
    observed = scene.expect(time_s, places[None])
    settings = SolverSettings("plain", exclude=False, max_pdop=scene.config.max_pdop)
    found = solve_observation(observed, scene, settings)
    whole = np.einsum("...aa->...a", found.covariance)
    lasting = ((found.gain * observed.shared_sigma[0]) ** 2).sum(-1)
    out = scene.config.reported_sigma_scale**2 * np.concatenate([whole - lasting, lasting], axis=-1)
    out[found.check == Check.NONE] = np.inf
    out[scene.obstacles.signed_distance(places[None])[0] <= 0.0] = np.nan
    return np.asarray(out)
