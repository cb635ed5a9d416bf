"""Programs of closed-loop missions, as the planner shows them to its solver."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from napf_mpc.benchmark.contenders import Scene
from napf_mpc.closed_loop import build_scenario, closed_loop
from napf_mpc.errors import ProblemError
from napf_mpc.planners.mpc import QpPlanner
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.qp import HorizonQp
from napf_mpc.solvers.batch import BatchResult, Mask, WarmStart, make_batch_solver


@dataclass(frozen=True)
class Step:
    """What the planner shows its solver at one step."""

    horizon: HorizonQp
    """Programs of all (run, uav)."""
    warm: WarmStart | None
    """The flight's own guess: its last answer, re-sampled."""
    active: Mask
    """(run,) runs still flying."""

    @property
    def programs(self) -> int:
        """How many are to be solved."""
        return int(self.active.sum()) * self.horizon.shape[1]

    def cold(self) -> Step:
        """The same without a guess."""
        return replace(self, warm=None)

    def of_one(self, run: int, uav: int) -> Step:
        """The same of one UAV."""
        at = (slice(run, run + 1), slice(uav, uav + 1))
        warm = None if self.warm is None else WarmStart(self.warm.z[at].copy(), self.warm.y[at].copy())
        return Step(self.horizon.of_one(run, uav), warm, np.ones(1, dtype=bool))


class _Recorder:
    """A solver that keeps one step in every so many."""

    def __init__(self, every: int) -> None:
        self._solver, self._every, self._seen = make_batch_solver("kernel"), every, 0
        self.steps: list[Step] = []

    def reset(self) -> None:
        """Forget all workspaces."""
        self._solver.reset()

    def solve_batch(
        self, horizon: HorizonQp, warm: WarmStart | None = None, active: Mask | None = None
    ) -> BatchResult:
        """Answer of the solver."""
        if self._seen % self._every == self._every - 1:
            asked = np.ones(horizon.shape[0], dtype=bool) if active is None else active.copy()
            self.steps.append(Step(horizon, warm, asked))
        self._seen += 1
        return self._solver.solve_batch(horizon, warm, active)


def flown(problem: Problem, *, missions: int, every: int, seed: int) -> list[Step]:
    """One step in every so many of closed-loop missions.

    Parameters
    ----------
    problem : Problem
        Formation problem; its own navigation and planner settings are flown.
    missions : int
        Flown in lock-step.
    every : int
        Steps from one that is kept to the next.
    seed : int
        Campaign seed.
    """
    recorder = _Recorder(every)
    closed_loop(problem, QpPlanner(problem, solver=recorder), build_scenario(problem, seed, range(missions)))
    return [step for step in recorder.steps if step.programs]


def programs_of(
    label: str, scene: Scene, *, missions: int, every: int, seed: int
) -> tuple[Problem, list[Step]]:
    """Fly a scene behind the filter, and give its problem and steps as of :func:`flown`.

    Raises
    ------
    ProblemError
        If the flights are too short to keep two steps: the first pays for what is done once.
    """
    problem = load_problem(scene.problem, {"navigation.filter": "kalman", **scene.overrides})
    steps = flown(problem, missions=missions, every=every, seed=seed)
    if len(steps) < 2:
        fault = f"every = {every}: leaves {len(steps)} steps of a mission, and two are needed; take fewer"
        raise ProblemError(f"benchmark, {label}", [fault])
    return problem, steps
