"""What every constraint has to keep to, as one check: ours pass it, and users call it on theirs.

from napf_mpc.constraints.contract import check_constraint
check_constraint(MyFence())
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from napf_mpc.constraints.constraint import (
    Constraint,
    ConstraintError,
    Horizon,
    LinearRows,
    checked_constraints,
    checked_rows,
)
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.navigation.tracks import Tracks
from napf_mpc.problem import FormationMission, Problem
from napf_mpc.streams import Stream, generator
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Shape, Sphere

Array = NDArray[np.float64]

LARGEST_BOUND = 1e6
"""A bound beyond this is a "big number" that stands for none, and should be infinite."""


def sample_problem() -> Problem:
    """Four UAVs in a square, 100 m along x."""
    return Problem.model_validate(
        {
            "formation": {"shape": "square"},
            "mission": {"kind": "formation", "length_m": 100.0},
            "world": {"kind": "empty"},
        }
    )


def sample_worlds() -> dict[str, ObstacleSet]:
    """Worlds without, with one, and with many obstacles of every shape, around the origin."""
    corners = np.array([(-8.0, -9.0), (-4.0, -9.0), (-4.0, -6.0), (-6.0, -5.0)])
    shapes: list[Shape] = [
        Sphere((4.0, 1.0, 0.5), 1.5),
        Cylinder((-3.0, 5.0), 1.0),
        Cylinder((7.0, -6.0), 2.0, -5.0, 1.0),
        Box((0.0, -4.0, 0.0), (2.0, 3.0, 4.0), 0.4),
        Prism((corners,), -3.0, 6.0),
        Sphere((-6.0, 0.0, -2.0), 0.5),
    ]
    return {
        "empty": ObstacleSet.empty(),
        "sphere": ObstacleSet.from_shapes(shapes[:1]),
        "all shapes": ObstacleSet.from_shapes(shapes),
    }


def sample_horizon(
    rng: np.random.Generator,
    obstacles: ObstacleSet,
    *,
    problem: Problem | None = None,
    runs: int = 3,
    stages: int = 6,
    spread_m: float = 8.0,
    sigma_m: float = 1.0,
) -> Horizon:
    """Draw plans anywhere near the origin, inside obstacles too, with covariances in all directions.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of the draw.
    obstacles : ObstacleSet
        One scene, or one a run.
    problem : Problem, optional
        By default :func:`sample_problem`; says how many UAVs there are.
    runs, stages : int
        Sizes.
    spread_m : float
        Standard deviation of the positions [m].
    sigma_m : float
        Scale of the navigation error; 0 for none at all [m].
    """
    problem = problem or sample_problem()
    if not isinstance(problem.mission, FormationMission):
        raise ConstraintError('mission.kind must be "formation"')
    shape = (runs, len(formation_offsets(problem.formation)), stages)
    common = sigma_m * rng.normal(size=(*shape[:2], 3, 2)) / 2.0
    root = sigma_m * rng.normal(size=(*shape, 3, 3)) / 2.0
    covariance = np.einsum("...ij,...kj->...ik", root, root)
    covariance += np.einsum("...ij,...kj->...ik", common, common)[:, :, None]
    return Horizon(
        time_s=float(rng.uniform(0.0, 50.0)),
        step_s=rng.uniform(0.05, 0.8, stages),
        position=spread_m * rng.normal(size=(*shape, 3)),
        velocity=3.0 * rng.normal(size=(*shape, 3)),
        covariance=covariance,
        common_factor=common,
        obstacles=obstacles,
        frame=PathFrame.of_mission(problem.mission),
        problem=problem,
        # From a stream of their own, so that what is drawn after does not depend on them.
        tracks=sample_tracks(rng.spawn(1)[0], runs, spread_m=spread_m),
    )


def sample_tracks(rng: np.random.Generator, runs: int, count: int = 6, spread_m: float = 8.0) -> Tracks:
    """Draw tracks of moving balls and cylinders near the origin, with covariances in all directions."""
    root = rng.normal(size=(runs, count, 6, 6)) / 4.0
    return Tracks(
        position=spread_m * rng.normal(size=(runs, count, 3)),
        velocity=3.0 * rng.normal(size=(runs, count, 3)),
        covariance=np.einsum("...ij,...kj->...ik", root, root),
        radius=rng.uniform(0.3, 2.0, count),
        upright=np.arange(count) % 3 == 1,
        acceleration_sigma_mps2=0.3,
    )


def sample_horizons(seed: int = 0, problem: Problem | None = None) -> list[Horizon]:
    """Horizons in every sample world: scattered, certain (no error), and all in one place."""
    horizons = []
    for i, world in enumerate(sample_worlds().values()):
        rng = generator(seed, i, Stream.SCENE)
        horizons.append(sample_horizon(rng, world, problem=problem))
        horizons.append(sample_horizon(rng, world, problem=problem, sigma_m=0.0))
        still = sample_horizon(rng, world, problem=problem)
        # The first sphere's centre and the box's, where distances have no gradient of their own.
        place = np.where(np.arange(6)[:, None] < 3, [4.0, 1.0, 0.5], [0.0, -4.0, 0.0])
        horizons.append(
            replace(
                still,
                position=np.broadcast_to(place, still.position.shape).copy(),
                velocity=0.0 * still.velocity,
            )
        )
    return horizons


def check_constraint(
    constraint: Constraint, horizons: Sequence[Horizon] | None = None, *, couples_uavs: bool = False
) -> None:
    """Hold a constraint against the contract.

    Its rows fit the horizon and are finite, bounds infinite where there is none; the signal, the number of
    rows and the kind of slack are the same for every horizon; the same question gets the same answer, to the
    last bit, whatever else is in the batch, and leaves the horizon as it was. Rows that are called steady are
    those of every UAV, and nobody writes into them.

    Parameters
    ----------
    constraint : Constraint
        What to check.
    horizons : sequence of Horizon, optional
        Cases; by default :func:`sample_horizons`.
    couples_uavs : bool
        Whether rows of one UAV may depend on other UAVs (of the same run).

    Raises
    ------
    ConstraintError
        Naming everything that is wrong and the horizon's place in the sequence.
    """
    checked_constraints([constraint])
    faults = []
    kinds: dict[tuple[object, ...], int] = {}
    steady: list[tuple[int, LinearRows, list[Array]]] = []
    for i, horizon in enumerate(sample_horizons() if horizons is None else horizons):
        horizon.check()
        before = [values.copy() for values in _arrays(horizon)]
        rows = constraint.rows(horizon)
        if any(not np.array_equal(a, b) for a, b in zip(before, _arrays(horizon), strict=True)):
            faults.append(f"horizon {i}: rows() changed the horizon")
        try:
            checked_rows(rows).check(horizon.shape)
        except ConstraintError as error:
            faults.append(f"horizon {i}: {error}")
            continue
        if rows.steady:
            steady.append((i, rows, [values.copy() for values in _values(rows)]))
        kinds.setdefault(_kind(rows), i)
        faults += [f"horizon {i}: {fault}" for fault in _faults(constraint, horizon, rows, couples_uavs)]
    for i, rows, then in steady:
        if any(not np.array_equal(a, b) for a, b in zip(then, _values(rows), strict=True)):
            faults.append(f"horizon {i}: steady rows were written into later")
    if len(kinds) > 1:
        listed = "; ".join(f"{kind} at horizon {i}" for kind, i in kinds.items())
        faults.append(f"(signal, rows, bounds, slack) must never change, got {listed}")
    if faults:
        raise ConstraintError("\n".join(f"{constraint.name}: {fault}" for fault in faults))


def _arrays(horizon: Horizon) -> list[Array]:
    tracks = horizon.tracks
    seen = [] if tracks is None else [tracks.position, tracks.velocity, tracks.covariance, tracks.radius]
    plans = [horizon.step_s, horizon.position, horizon.velocity, horizon.covariance, horizon.common_factor]
    return plans + seen


def _values(rows: LinearRows) -> list[Array]:
    return [values for values in (rows.jac, rows.lower, rows.upper, rows.w1, rows.w2) if values is not None]


def _kind(rows: LinearRows) -> tuple[object, ...]:
    sides = (rows.lower is not None, rows.upper is not None)
    return (
        rows.signal,
        rows.count,
        sides,
        "hard" if not rows.soft else "shared" if rows.shared_slack else "own",
    )


def _faults(constraint: Constraint, horizon: Horizon, rows: LinearRows, couples_uavs: bool) -> Iterator[str]:
    for name, bound in (("lower", rows.lower), ("upper", rows.upper)):
        if bound is not None and (np.isfinite(bound) & (np.abs(bound) > LARGEST_BOUND)).any():
            yield f"{name} holds a number beyond {LARGEST_BOUND:g}; use an infinite bound for none"
    if rows.steady and any((values != values[:1, :1]).any() for values in _values(rows)):
        yield "steady rows differ between runs or UAVs; leave steady out"
    if not _same(rows, constraint.rows(horizon)):
        yield "asked twice, the rows differ: rows() must not remember anything"
    runs, uavs, _ = horizon.shape
    everything = slice(None)
    for run in range(runs):
        if not _same(_part(rows, run, everything), constraint.rows(part_of(horizon, run))):
            yield f"run {run} alone gives other rows than in the batch"
    for uav in range(0 if couples_uavs else uavs):
        part = slice(uav, uav + 1)
        if not _same(_part(rows, 0, part), constraint.rows(part_of(horizon, 0, part))):
            yield f"UAV {uav} alone gives other rows than beside the others"


def part_of(horizon: Horizon, run: int, uavs: slice = slice(None)) -> Horizon:
    """Horizon of one run, and of some of its UAVs, alone."""
    world = horizon.obstacles
    cut = {
        name: getattr(horizon, name)[run : run + 1, uavs].copy()
        for name in ("position", "velocity", "covariance", "common_factor")
    }
    tracks = None if horizon.tracks is None else horizon.tracks.of_run(run)
    scene = world.scene(run) if world.n_scenes > 1 else world
    return replace(horizon, obstacles=scene, tracks=tracks, **cut)


def _part(rows: LinearRows, run: int, uavs: slice) -> LinearRows:
    lower, upper, w1, w2 = (
        None if values is None else values[run : run + 1, uavs]
        for values in (rows.lower, rows.upper, rows.w1, rows.w2)
    )
    return replace(rows, jac=rows.jac[run : run + 1, uavs], lower=lower, upper=upper, w1=w1, w2=w2)


def _same(a: LinearRows, b: LinearRows) -> bool:
    if not isinstance(b, LinearRows):
        return False
    pairs = ((a.jac, b.jac), (a.lower, b.lower), (a.upper, b.upper), (a.w1, b.w1), (a.w2, b.w2))
    return a.signal == b.signal and all(
        x is y if x is None or y is None else np.array_equal(x, y) for x, y in pairs
    )
