"""One flight out of a table of trajectories, and what figures derive from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napf_mpc.errors import DataError
from napf_mpc.navigation.fix import diagonal
from napf_mpc.problem import Problem
from napf_mpc.safety_distance import Inflation
from napf_mpc.world.moving import MovingObstacles, round_distance
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Track:
    """Recorded flight of all UAVs in one run with one planner; arrays are (time, uav, axis)."""

    planner: str
    """Who planned."""
    run: int
    """Index of the run."""
    time_s: Array
    """(time,) [s]."""
    position: Array
    """Truth [m]."""
    velocity: Array
    """Truth [m/s]."""
    estimate: Array
    """Position as navigation reported it [m]."""
    sigma: Array
    """Standard deviation of each axis as reported [m]."""
    attitude: Array
    """Roll, pitch, yaw [rad]."""
    rates: Array
    """Their rates [rad/s]."""

    @property
    def uavs(self) -> int:
        """Number of UAVs."""
        return int(self.position.shape[1])


def track(trajectories: Mapping[str, NDArray[Any]], planner: str, run: int) -> Track:
    """Flight of one planner in one run.

    Parameters
    ----------
    trajectories : mapping of str to array
        Columns as :class:`napf_mpc.record.TrajectoryRecorder` keeps them.
    planner : str
        Name in the ``planner`` column.
    run : int
        Index in the ``run`` column.

    Raises
    ------
    DataError
        If the table does not hold this flight, or a time lacks a UAV.
    """
    if not trajectories or len(trajectories["run"]) == 0:
        raise DataError("trajectories: the table is empty; record the flight (record_every >= 1)")
    rows = np.flatnonzero((trajectories["planner"] == planner) & (trajectories["run"] == run))
    if len(rows) == 0:
        known = sorted({str(name) for name in trajectories["planner"]})
        raise DataError(
            f'trajectories: no row of planner "{planner}" in run {run}; planners: {", ".join(known)}'
        )
    uav = np.asarray(trajectories["uav"][rows], dtype=np.int64)
    rows = rows[np.lexsort((uav, trajectories["t_s"][rows]))]
    uavs = int(uav.max()) + 1
    if len(rows) % uavs or (trajectories["uav"][rows] != np.tile(np.arange(uavs), len(rows) // uavs)).any():
        raise DataError(f'trajectories: planner "{planner}", run {run}: some time lacks a UAV')

    def vectors(pattern: str, axes: tuple[str, ...]) -> Array:
        columns = [np.asarray(trajectories[pattern.format(axis)][rows], dtype=float) for axis in axes]
        return np.stack(columns, axis=-1).reshape(-1, uavs, 3)

    xyz, angles = ("x", "y", "z"), ("roll", "pitch", "yaw")
    return Track(
        planner=planner,
        run=run,
        time_s=np.asarray(trajectories["t_s"][rows], dtype=float).reshape(-1, uavs)[:, 0],
        position=vectors("{}_m", xyz),
        velocity=vectors("v{}_mps", xyz),
        estimate=vectors("est_{}_m", xyz),
        sigma=vectors("sigma_{}_m", xyz),
        attitude=vectors("{}_rad", angles),
        rates=vectors("{}_rate_radps", angles),
    )


def first_run(trajectories: Mapping[str, NDArray[Any]]) -> int:
    """Lowest run in a table."""
    if not trajectories or len(trajectories["run"]) == 0:
        raise DataError("trajectories: the table is empty; record the flight (record_every >= 1)")
    return int(np.min(trajectories["run"]))


def inflation_of(problem: Problem, planner: str) -> Inflation:
    """How a planner inflates obstacles; the original APF does not."""
    return Inflation(0.0) if planner == "apf" else Inflation.of_problem(problem)


@dataclass(frozen=True)
class Acting:
    """Obstacles while they act on a UAV, as the planner saw it; one entry an obstacle, UAV and time."""

    sample: NDArray[np.int64]
    """(n,) index into the track's times."""
    uav: NDArray[np.int64]
    """(n,) which UAV."""
    obstacle: NDArray[np.int64]
    """(n,) index of the obstacle in its scene."""
    rho_m: Array
    """(n,) distance from the UAV's hull to the inflated obstacle; below zero inside it [m]."""
    margin_m: Array
    """(n,) k sigma by which the obstacle was inflated [m]."""


def acting(problem: Problem, flown: Track, obstacles: ObstacleSet) -> Acting:
    """Find every obstacle within the range of influence of a UAV, as the planner saw it.

    The planner sees the estimate and the reported sigma. Trajectories hold the sigma of each axis and no
    covariance between axes, so the margin along an oblique direction leaves that covariance out.

    Parameters
    ----------
    problem : Problem
        Its planner section holds k and the reading of sigma.
    flown : Track
        The flight.
    obstacles : ObstacleSet
        One scene.

    Returns
    -------
    Acting
        By time, then UAV, then distance to the obstacle.
    """
    inflation = inflation_of(problem, flown.planner)
    usable = (np.isfinite(flown.estimate) & np.isfinite(flown.sigma)).all(-1).ravel()
    picks = np.flatnonzero(usable)
    points = flown.estimate.reshape(-1, 3)[picks]
    covariance = diagonal(flown.sigma.reshape(-1, 3)[picks] ** 2)
    reach = problem.planner.influence_m + problem.vehicle.radius_m + inflation.largest_margin(covariance)
    near = obstacles.near(points[None], reach[None])
    margin = inflation.margin(covariance, near.gradient[0])
    rho = near.distance[0] - problem.vehicle.radius_m - margin
    row, slot = np.nonzero(rho < problem.planner.influence_m)
    sample, uav = np.divmod(picks[row], flown.uavs)
    return Acting(sample, uav, near.index[0][row, slot], rho[row, slot], margin[row, slot])


def encounters(seen: Acting, uav: int, most: int) -> list[int]:
    """Entries at which a UAV believed itself closest to each obstacle, the obstacles that came closest first.

    Parameters
    ----------
    seen : Acting
        As :func:`acting` returns it.
    uav : int
        Which UAV.
    most : int
        Keep this many obstacles.

    Returns
    -------
    list of int
        Indices into ``seen``, one an obstacle.
    """
    mine = np.flatnonzero(seen.uav == uav)
    mine = mine[np.argsort(seen.rho_m[mine], kind="stable")]
    _, first = np.unique(seen.obstacle[mine], return_index=True)
    return [int(entry) for entry in mine[np.sort(first)][:most]]


@dataclass(frozen=True)
class Contact:
    """Deepest point of one contact of a UAV with an obstacle, on the truth."""

    uav: int
    """Which UAV."""
    time_s: float
    """When [s]."""
    position: Array
    """(3,) where [m]."""
    clearance_m: float
    """Clearance there, below zero [m]."""


def clearances(
    flown: Track, obstacles: ObstacleSet, radius_m: float, moving: MovingObstacles | None = None
) -> Array:
    """Clearance (time, uav) of each UAV's hull from the nearest obstacle (truth); +inf without any [m]."""
    return _distances(flown.time_s, flown.position, obstacles, moving) - radius_m


def _distances(
    time_s: Array, position: Array, obstacles: ObstacleSet, moving: MovingObstacles | None
) -> Array:
    """Signed distance (time, uav) of points (time, uav, 3) to the nearest obstacle; +inf without any [m]."""
    distance: Array = obstacles.signed_distance(position.reshape(1, -1, 3)).reshape(position.shape[:2])
    if moving is None:
        return distance
    return np.asarray(np.minimum(distance, moving_distances(time_s, position, moving).min(-1)))


def moving_distances(time_s: Array, position: Array, moving: MovingObstacles) -> Array:
    """Signed distances (time, uav, n) of points (time, uav, 3) to the moving obstacles of a run then [m]."""
    centres = np.stack([moving.position(time)[0] for time in time_s.tolist()])
    return round_distance(position[:, :, None], centres[:, None], moving.radius, moving.upright)[0]


def separations(flown: Track) -> Array:
    """Distance (time, uav) of each UAV's centre from its nearest neighbour's; +inf for a lone one [m]."""
    out = np.full(flown.position.shape[:2], np.inf)
    for i in range(flown.uavs):
        gaps = np.sqrt(((flown.position - flown.position[:, i : i + 1]) ** 2).sum(-1))
        gaps[:, i] = np.inf
        out[:, i] = gaps.min(-1)
    return out


SUBSTEPS = 8
"""Points looked at between two recorded samples, so that a graze between them is seen as well."""


def contacts(
    flown: Track, obstacles: ObstacleSet, radius_m: float, moving: MovingObstacles | None = None
) -> list[Contact]:
    """Contacts of a flight, each at its deepest point, by UAV and time."""
    if len(obstacles) == 0 and moving is None:
        return []
    fine = np.linspace(0.0, len(flown.time_s) - 1.0, (len(flown.time_s) - 1) * SUBSTEPS + 1)
    low = np.minimum(fine.astype(int), max(0, len(flown.time_s) - 2))
    share = fine - low
    high = np.minimum(low + 1, len(flown.time_s) - 1)
    time = flown.time_s[low] + share * (flown.time_s[high] - flown.time_s[low])
    position = flown.position[low] + share[:, None, None] * (flown.position[high] - flown.position[low])
    clearance = _distances(time, position, obstacles, moving) - radius_m
    found = []
    for uav in range(flown.uavs):
        inside = clearance[:, uav] < 0.0
        edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
        for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            deepest = start + int(np.argmin(clearance[start:stop, uav]))
            found.append(
                Contact(uav, float(time[deepest]), position[deepest, uav], float(clearance[deepest, uav]))
            )
    return found
