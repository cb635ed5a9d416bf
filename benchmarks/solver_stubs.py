"""What flies when a solver returns garbage: whole missions with stubs in place of a tenth of the answers.

Run ``python benchmarks/solver_stubs.py`` (100,000 steps of UAVs with stubs and as many without, some minutes
on one core). Kinds of garbage, in equal shares: an answer of 2.1e9, of NaN, of zeros, the last answer once
more (each claimed as solved), an exception, and an answer that is right but 10 s late on the planner's clock.
With the kernel solver a stub stands before the planner, and residuals of what it returns are computed as for
any solver; with others, such as osqp, it stands in the place of the library, behind the library's own checks.
Late answers, and exceptions of the kernel solver, concern a whole step: all UAVs of all runs of a block share
the planner's call and clock.

Every command is checked: its numbers are finite, the rotor thrusts of its plan are inside the limits, and so
are those that the inner loop makes of it. Fall-backs are counted by the planner and, apart from it, by
looking whose command is not the solver's answer. The same seeds are flown without stubs, so that a contact
that only happens with them would show.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from napf_mpc.campaign import versions
from napf_mpc.closed_loop import build_scenario, closed_loop
from napf_mpc.evaluate import MissionScore, Score
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.mpc import QpPlanner
from napf_mpc.planners.planner import Command
from napf_mpc.planners.tally import FALL_BACKS, Tally
from napf_mpc.problem_file import load_problem
from napf_mpc.provenance import processor
from napf_mpc.qp import Array, HorizonQp, Layout, QpStatus, Sparsity, Values
from napf_mpc.solvers.acceptance import INPUT_TOLERANCE_N
from napf_mpc.solvers.batch import (
    STATUSES,
    BatchResult,
    BatchSolver,
    PerUavSolver,
    WarmStart,
    make_batch_solver,
)
from napf_mpc.solvers.residuals import kkt_residuals
from napf_mpc.solvers.solver import Answer, Backend, MakeBackend, Warm, backend_maker
from napf_mpc.vehicle.quadrotor import hover_input, mixer_inverse, rotor_limit
from napf_mpc.world.obstacles import ObstacleSet

Mask = NDArray[np.bool_]

OWN = ("huge", "nan", "zeros", "old")
"""Garbage that one UAV gets."""
KINDS = (*OWN, "raises", "late")
LATE_S = 10.0
HUGE = 2.1e9
"""What OSQP returns for a program without a solution."""


class Faults:
    """Draws which answers are spoilt, and counts them; the planner's clock is here too."""

    def __init__(self, share: float, seed: int) -> None:
        self.share = share
        self._rng = np.random.default_rng(seed)
        self.now_s = 0.0
        self.spoilt: Counter[str] = Counter()
        """Kind -> answers to single UAVs."""

    def clock(self) -> float:
        """Time that goes on when an answer is late [s]."""
        return self.now_s

    def whole_step(self, kind: str, answers: int) -> bool:
        """Whether this step's answers to all UAVs are spoilt in a way."""
        if self._rng.random() >= self.share / len(KINDS):
            return False
        self.spoilt[kind] += answers
        if kind == "late":
            self.now_s += LATE_S
        return True

    def one(self, kinds: tuple[str, ...]) -> str:
        """Kind of garbage that one UAV gets, most often none."""
        place = self._rng.random() / self.share * len(KINDS)
        kind = kinds[int(place)] if place < len(kinds) else ""
        if kind:
            self.spoilt[kind] += 1
        return kind


class SpoiltSolver:
    """A solver whose answers are spoilt before the planner sees them.

    Parameters
    ----------
    solver : BatchSolver
        Answers in good faith.
    faults : Faults
        When not to.
    kinds : tuple of str
        Kinds for single UAVs.
    raises : bool
        Whether the whole solver raises now and then.
    """

    def __init__(self, solver: BatchSolver, faults: Faults, kinds: tuple[str, ...], raises: bool) -> None:
        self._solver, self._faults, self._kinds, self._raises = solver, faults, kinds, raises
        self._old: BatchResult | None = None
        self.answer: BatchResult | None = None
        """What the planner got last; None if it got an exception."""

    def reset(self) -> None:
        """Forget all workspaces."""
        self._solver.reset()
        self._old = None

    def solve_batch(
        self, horizon: HorizonQp, warm: WarmStart | None = None, active: Mask | None = None
    ) -> BatchResult:
        """Answer, or not."""
        runs, uavs, _ = horizon.shape
        asked = np.ones(runs, dtype=bool) if active is None else active
        answers = int(asked.sum()) * uavs
        self.answer = None
        good = self._solver.solve_batch(horizon, warm, active)
        old, self._old = self._old, good
        if self._raises and self._faults.whole_step("raises", answers):
            raise RuntimeError("the library has had enough")
        if self._faults.whole_step("late", answers):
            self.answer = good
            return good
        self.answer = self._spoil(horizon, good, good if old is None else old, asked)
        return self.answer

    def _spoil(self, horizon: HorizonQp, good: BatchResult, old: BatchResult, asked: Mask) -> BatchResult:
        z, y, status = good.z.copy(), good.y.copy(), good.status.copy()
        touched = np.zeros(status.shape, dtype=bool)
        for run in np.flatnonzero(asked).tolist():
            for uav in range(status.shape[1]):
                kind = self._faults.one(self._kinds)
                if not kind:
                    continue
                at = (run, uav)
                touched[at] = True
                status[at] = STATUSES.index(QpStatus.SOLVED)
                if kind == "old":
                    z[at], y[at] = old.z[at], old.y[at]
                else:
                    z[at], y[at] = {"huge": HUGE, "nan": np.nan, "zeros": 0.0}[kind], 0.0
        if not touched.any():
            return good
        # Residuals on today's numbers are all that tells the old answer from a new one.
        layout = Layout.of(horizon)
        with np.errstate(all="ignore"):
            residuals = kkt_residuals(layout.sparsity, layout.values(horizon), z, y)
        primal, dual, product = (
            np.where(touched, new, was)
            for new, was in zip(residuals, (good.primal, good.dual, good.complementarity), strict=True)
        )
        return replace(
            good, status=status, states=layout.states(z), inputs=layout.inputs(z),
            slacks=layout.block_slacks(z), z=z, y=y, primal=primal, dual=dual, complementarity=product,
        )  # fmt: skip


class SpoiltBackend:
    """A library that returns garbage to one UAV now and then and calls it solved."""

    def __init__(self, backend: Backend, sparsity: Sparsity, faults: Faults) -> None:
        self._backend, self._sparsity, self._faults = backend, sparsity, faults
        self._old: Answer | None = None

    def solve(self, values: Values, warm: Warm | None) -> Answer:
        """Answer, or not."""
        kind = self._faults.one((*OWN, "raises"))
        good = self._backend.solve(values, warm)
        old, self._old = self._old, good
        if not kind:
            return good
        if kind == "raises":
            raise RuntimeError("the library has had enough")
        if kind == "old":
            return good if old is None else replace(old, status=QpStatus.SOLVED)
        value = {"huge": HUGE, "nan": np.nan, "zeros": 0.0}[kind]
        z, y = np.full(self._sparsity.variables, value), np.zeros(self._sparsity.constraints)
        return Answer(QpStatus.SOLVED, z, y)


def spoilt_solver(name: str, faults: Faults) -> SpoiltSolver:
    """Return the stubs around a solver, as near to its library as can be."""
    if name == "kernel":
        return SpoiltSolver(make_batch_solver(name), faults, OWN, raises=True)
    make = backend_maker(name)
    stub: MakeBackend = lambda sparsity: SpoiltBackend(make(sparsity), sparsity, faults)  # noqa: E731
    return SpoiltSolver(PerUavSolver(stub), faults, (), raises=False)


class Checked:
    """Passes commands on, checks each, and counts those that are not the solver's answer."""

    def __init__(self, planner: QpPlanner, solver: SpoiltSolver) -> None:
        self._planner, self._solver = planner, solver
        vehicle = planner.problem.vehicle
        self._inverse, self._most = mixer_inverse(vehicle), rotor_limit(vehicle)
        self._hover = hover_input(vehicle)
        self.steps = 0
        """Commands to UAVs."""
        self.unsound = 0
        """Commands with a number that is not finite or a rotor thrust outside its limits."""
        self.fallen = 0
        """Commands that are not the solver's answer."""

    @property
    def name(self) -> str:
        """Name in tables and files."""
        return self._planner.name

    @property
    def tally(self) -> Tally:
        """What the planner counted."""
        return self._planner.tally

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        """Take a new map."""
        self._planner.reset(obstacles, runs)

    def step(self, nav: NavSolution, time_s: float) -> Command:
        """Ask the planner and look at what it says."""
        command = self._planner.step(nav, time_s)
        plan, answer = command.plan, self._solver.answer
        assert plan is not None
        assert nav.airborne is not None
        sound = self._inside(plan.inputs + self._hover).all(-1)
        for values in (command.position, command.velocity, command.direction, command.feedforward):
            sound &= np.isfinite(values).all(-1)
        sound &= np.isfinite(plan.states).all((2, 3)) & np.isfinite(command.yaw)
        # A late answer may be right and yet not be flown; a standing plan may look like one of zeros.
        # A UAV that guidance holds flies an answer too.
        same = np.zeros_like(sound) if answer is None or command.planned is None else command.planned.copy()
        if answer is not None:
            same &= (plan.inputs == answer.inputs).all((2, 3))
        self.steps += int(nav.airborne.sum())
        self.unsound += int((~sound & nav.airborne).sum())
        self.fallen += int((~same & nav.airborne).sum())
        return command

    def moved(self, time_s: float, before: Array, after: Array, active: Mask) -> None:
        """Nothing to see in the plant."""

    def ticked(
        self, time_s: float, state: Array, nav: NavSolution, command: Command, inputs: Array, active: Mask
    ) -> None:
        """Check what the inner loop makes of the command."""
        self.unsound += int((~self._inside(inputs[:, :, None])[active]).sum())

    def _inside(self, inputs: Array) -> Mask:
        thrusts = np.einsum("ij,ruki->rukj", self._inverse.T, inputs)
        inside = np.isfinite(thrusts) & (thrusts >= -INPUT_TOLERANCE_N)
        return np.asarray((inside & (thrusts <= self._most + INPUT_TOLERANCE_N)).all(-1))


@dataclass
class Flown:
    """Sums over the blocks of one way to fly."""

    score: list[Score]
    tally: Counter[str]
    spoilt: Counter[str]
    steps: int = 0
    unsound: int = 0
    fallen: int = 0

    @classmethod
    def none(cls) -> Flown:
        """Nothing flown yet."""
        return cls([], Counter(), Counter())

    def contacts(self) -> Mask:
        """(run, kind) contacts with obstacles and between UAVs."""
        return np.concatenate(
            [np.stack([s.obstacle_contact.any(-1), s.uav_contact], axis=-1) for s in self.score]
        )

    def finished(self) -> Mask:
        """(run,)."""
        return np.concatenate([s.finished for s in self.score])

    def mean(self, metric: str) -> float:
        """Mean of a metric over all runs."""
        return float(np.nanmean(np.concatenate([s.metrics[metric] for s in self.score])))


def fly(flown: Flown, problem_name: str, solver: str, share: float, seed: int, runs: range) -> None:
    """Fly one block of runs."""
    problem = load_problem(problem_name, {"navigation.filter": "kalman", "planner.kind": "qp"})
    scenario = build_scenario(problem, seed, runs)
    # A share of zero draws nothing, so that nothing but the stubs differs.
    faults = Faults(max(share, 1e-300), seed + runs.start)
    stubs = spoilt_solver(solver, faults)
    pilot = Checked(QpPlanner(problem, solver=stubs, clock=faults.clock), stubs)
    judge = MissionScore(problem, scenario)
    flight = closed_loop(problem, pilot, scenario, (judge, pilot))
    flown.score.append(judge.score(flight))
    for name, count in pilot.tally.counts.items():
        flown.tally[name] += int(count.sum())
    flown.spoilt += faults.spoilt
    flown.steps += pilot.steps
    flown.unsound += pilot.unsound
    flown.fallen += pilot.fallen


def report(label: str, flown: Flown) -> None:
    """Print what one way to fly came to."""
    contacts, tally = flown.contacts(), flown.tally
    fallen = sum(tally[f"fall_back_{name}"] for name in FALL_BACKS)
    rungs = ", ".join(f"{tally[f'fall_back_{name}']} {name}" for name in FALL_BACKS)
    print(
        f"| {label} | {len(contacts)} | {flown.steps} | {sum(flown.spoilt.values())} | {flown.unsound} "
        f"| {tally['answers_refused']} | {fallen} ({rungs}) | {flown.fallen} | {contacts[:, 0].sum()} "
        f"| {contacts[:, 1].sum()} | {flown.finished().sum()} | {flown.mean('path_rms_m'):.2f} "
        f"| {flown.mean('shape_rms_m'):.2f} |"
    )


def main() -> int:
    """Fly with stubs and without, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=100_000, help="least steps of UAVs with stubs")
    parser.add_argument("--share", type=float, default=0.1, help="of answers that are spoilt")
    parser.add_argument("--problem", default="study_8s")
    parser.add_argument("--solver", default="kernel")
    parser.add_argument("--seed", type=int, default=7001)
    parser.add_argument("--block", type=int, default=11, help="runs in lock-step")
    arguments = parser.parse_args()
    if not 0.0 < arguments.share < 1.0 or arguments.steps < 1 or arguments.block < 1:
        parser.error("share must be inside 0 to 1, steps and block 1 or more")
    began = time.process_time()
    stubs, plain = Flown.none(), Flown.none()
    first = 0
    while stubs.steps < arguments.steps:
        runs = range(first, first + arguments.block)
        for flown, share in ((stubs, arguments.share), (plain, 0.0)):
            fly(flown, arguments.problem, arguments.solver, share, arguments.seed, runs)
        first = runs.stop
    print(f"{processor()}; " + ", ".join(f"{name} {number}" for name, number in versions().items()))
    print(
        f"{arguments.problem}, navigation filter, planner qp, solver {arguments.solver}, "
        f"seed {arguments.seed}, runs 0 to {first - 1}, blocks of {arguments.block}"
    )
    print(
        "| | runs | steps of UAVs | answers spoilt | unsound commands | answers refused | fall-backs counted "
        "| seen from outside | obstacle contact | UAV-UAV contact | finished | path RMS [m] | shape RMS [m] |"
    )
    print("|---|" + "---:|" * 12)
    report(f"stubs in {100 * arguments.share:g} %", stubs)
    report("none", plain)
    kinds = ", ".join(f"{stubs.spoilt[kind]} {kind}" for kind in KINDS)
    counted = sum(stubs.tally[f"fall_back_{name}"] for name in FALL_BACKS)
    with_stubs, without = stubs.contacts(), plain.contacts()
    caused = int((with_stubs & ~without).any(-1).sum())
    more = stubs.tally["answers_refused"] - sum(stubs.spoilt.values())
    print(
        f"\nSpoilt: {kinds}. Refused less spoilt: {more:+d} (a last answer may pass the test once more, and "
        "one in good faith may fail it)."
    )
    print(f"Fall-backs counted and seen agree: {counted == stubs.fallen}.")
    print(
        f"Runs with a contact that the same seed has not without stubs: {caused}; "
        f"the other way round: {int((without & ~with_stubs).any(-1).sum())}."
    )
    print(f"{time.process_time() - began:.0f} s of processor time.")
    return int(stubs.unsound > 0 or counted != stubs.fallen or caused > 0)


if __name__ == "__main__":
    raise SystemExit(main())
