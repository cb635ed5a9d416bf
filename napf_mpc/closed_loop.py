"""The closed loop: sensors -> navigation solution -> planner -> command -> inner loop -> plant.

All runs of a block fly in lock-step as arrays (run, uav). Physics is integrated every ``step_s``, the inner
loop runs at ``controller_rate_hz``, position fixes and the planner at rates of their own. The planner is
given navigation solutions and the map; the truth goes to observers only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from napf_mpc.errors import ProblemError
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.jit import compiled
from napf_mpc.navigation.error_models import position_errors
from napf_mpc.navigation.filtered import FilteredNavigation
from napf_mpc.navigation.fix import (
    Fix,
    FixSource,
    PlacedErrors,
    PositionErrors,
    check_shapes,
    fixes_of_flight,
)
from napf_mpc.navigation.gnss import gnss_scene
from napf_mpc.navigation.gnss_fixes import GnssErrors
from napf_mpc.navigation.gnss_sigma import sigma_map
from napf_mpc.navigation.monitor import Monitor
from napf_mpc.navigation.sigma_map import SigmaMap
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.navigation.tracks import MovingTracker
from napf_mpc.planners.planner import Command, Planner, check_command
from napf_mpc.problem import FormationMission, Gnss, Problem
from napf_mpc.streams import Seed
from napf_mpc.vehicle.lqr import check_sampled_loop
from napf_mpc.vehicle.plant import advance, plain
from napf_mpc.vehicle.quadrotor import parameters
from napf_mpc.vehicle.tracking import TrackingLaw, tracking_law
from napf_mpc.world.distance import Solids
from napf_mpc.world.moving import MovingObstacles, moving_obstacles
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.scenes import build_scenes
from napf_mpc.world.starts import Starts

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

POSITION, VELOCITY = slice(0, 6, 2), slice(1, 6, 2)
ATTITUDE, RATES = slice(6, 12, 2), slice(7, 12, 2)
LOST_M = 1e7
"""A UAV farther than this from the origin has left the range in which the numbers mean anything."""


@dataclass(frozen=True)
class Scenario:
    """What chance decides for a block of runs; every planner of a comparison flies the same."""

    seed: Seed
    """Campaign seed."""
    runs: range
    """Indices of the runs in their campaign."""
    obstacles: ObstacleSet
    """One scene for all runs, or one a run."""
    initial_state: Array
    """(run, uav, 12), Eq. 1."""
    errors: PositionErrors | PlacedErrors
    """Navigation errors over the whole mission."""
    moving: MovingObstacles | None = None
    """What moves, in truth; planners see its tracks only."""
    sigma_map: SigmaMap | None = None
    """What a map of buildings and satellites tells planners of fixes to come; None unless they ask."""


def formation_mission(problem: Problem) -> FormationMission:
    """Return the problem's mission if a formation can fly it.

    Raises
    ------
    ProblemError
        If it is a single point's walk to a goal.
    """
    if not isinstance(problem.mission, FormationMission):
        raise ProblemError(
            "mission.kind", ['is "goal": a walk of one point; fly it with `run` or draw it with `figures`']
        )
    return problem.mission


def initial_state(problem: Problem) -> Array:
    """State (uav, 12) at the start: as given, else in the slots at rest; yaw along the path."""
    mission = formation_mission(problem)
    frame = PathFrame.of_mission(mission)
    state = np.zeros((problem.uav_count, 12))
    if mission.initial_positions_m is None:
        state[:, POSITION] = frame.to_world(formation_offsets(problem.formation))
    else:
        state[:, POSITION] = mission.initial_positions_m
    if mission.initial_velocities_mps is not None:
        state[:, VELOCITY] = mission.initial_velocities_mps
    state[:, 10] = frame.heading_rad
    return state


def formation_starts(problem: Problem) -> Starts:
    """Where the UAVs of a formation start, the same in every run."""
    given = formation_mission(problem).initial_positions_m is not None
    keys = "mission.initial_positions_m" if given else "mission.start_m or the formation"
    return Starts(initial_state(problem)[:, POSITION], problem.vehicle.radius_m, keys)


def formation_scenes(
    problem: Problem, seed: Seed, runs: range, data_folder: Path | None = None
) -> ObstacleSet:
    """Obstacles of some runs of a formation's campaign: one scene a run, or one for all.

    Raises
    ------
    NapfError
        If a scene cannot be built, a UAV would start in contact, or data are missing.
    """
    frame = PathFrame.of_mission(formation_mission(problem))
    lanes = formation_offsets(problem.formation)[:, 1]
    return build_scenes(problem.world, frame, lanes, seed, runs, data_folder, formation_starts(problem))


def build_scenario(problem: Problem, seed: Seed, runs: range, data_folder: Path | None = None) -> Scenario:
    """Draw obstacles, initial state and navigation errors of some runs of a campaign.

    Raises
    ------
    NapfError
        If the scene cannot be built, a UAV would start in contact, a data file is missing, or the inner loop
        would be unstable.
    """
    formation_mission(problem)
    check_sampled_loop(problem.vehicle, 1.0 / problem.simulation.controller_rate_hz)
    start = np.broadcast_to(initial_state(problem), (len(runs), problem.uav_count, 12))
    obstacles = formation_scenes(problem, seed, runs, data_folder)
    moving = moving_obstacles(problem.world, seed, runs, problem.simulation.time_limit_s)
    if moving is not None:
        formation_starts(problem).refuse_moving(moving)
    errors = _errors(problem, seed, runs, obstacles, data_folder)
    mapped = problem.planner.covariance == "mapped"
    return Scenario(
        seed,
        runs,
        obstacles,
        start.copy(),
        errors,
        moving,
        sigma_map(problem, errors.scene) if mapped and isinstance(errors, GnssErrors) else None,
    )


def _errors(
    problem: Problem, seed: Seed, runs: range, obstacles: ObstacleSet, data_folder: Path | None
) -> PositionErrors | PlacedErrors:
    """Draw the navigation errors; buildings hide satellites, and nothing else of the scene enters."""
    navigation, limit_s = problem.navigation, problem.simulation.time_limit_s
    if isinstance(navigation, Gnss):
        scene = gnss_scene(navigation, problem.world, obstacles, seed, runs, limit_s, data_folder)
        return GnssErrors(scene, seed, runs, problem.uav_count)
    return position_errors(navigation, seed, runs, problem.uav_count, limit_s, data_folder)


class Observer(Protocol):
    """Sees the truth; used by evaluation and recording, never by planners."""

    def moved(self, time_s: float, before: Array, after: Array, active: Mask) -> None:
        """See one physics step: states (run, uav, 12) at its start and end, and which runs still fly."""
        ...

    def ticked(
        self, time_s: float, state: Array, nav: NavSolution, command: Command, inputs: Array, active: Mask
    ) -> None:
        """See one tick of the inner loop, before the plant moves."""
        ...


@dataclass(frozen=True)
class Flight:
    """How the runs of a block ended, on the truth."""

    reached: Mask
    """(run,) whether every UAV passed the mission's length in time."""
    failed: Mask
    """(run,) whether a number stopped being finite."""
    holding: Mask
    """(run,) whether any UAV was hovering on purpose at the end."""
    finish_time_s: Array
    """(run,) when the last UAV passed the mission's length; NaN if it did not [s]."""
    duration_s: Array
    """(run,) time flown [s]."""
    gated_fixes: NDArray[np.int64] | None = None
    """(run,) position fixes that the navigation filter refused; None without a filter."""
    missed_fixes: NDArray[np.int64] | None = None
    """(run,) epochs at which a position fix was due and none came; None without a filter."""
    reason: NDArray[np.int8] | None = None
    """(run,) why it waited at the end, codes of :class:`~napf_mpc.planners.planner.Reason`, the largest of
    the run's UAVs; None if it never did."""
    waited_s: Array | None = None
    """(run,) time in which some UAV was hovering on purpose [s]; None if none ever was."""
    monitor: Monitor | None = None
    """What watched the navigation filter's innovations; None if nothing did."""


def closed_loop(
    problem: Problem, planner: Planner, scenario: Scenario, observers: Sequence[Observer] = ()
) -> Flight:
    """Fly all runs of a scenario in lock-step until each is finished, failed or out of time.

    Parameters
    ----------
    problem : Problem
        Formation mission, rates and limits.
    planner : Planner
        Is reset to the scenario's map, then asked at its rate.
    scenario : Scenario
        Scenes, initial state and errors.
    observers : sequence of Observer
        See the truth.

    Returns
    -------
    Flight
        Per run.

    Raises
    ------
    ProblemError
        If a planner returns no command that fits, or writes into the map.
    ValueError
        If the errors' period is no whole multiple of the inner loop's, or a fix of theirs is none, or one of
        other runs and UAVs.
    """
    mission = formation_mission(problem)
    clock = _Clock.of_problem(problem, scenario.errors.period_s)
    frame = PathFrame.of_mission(mission)
    law = tracking_law(problem.vehicle)
    constants = parameters(problem.vehicle)
    state = scenario.initial_state.copy()
    runs = len(scenario.runs)

    active = np.ones(runs, dtype=bool)
    failed, lost = np.zeros(runs, dtype=bool), np.zeros(runs, dtype=bool)
    holding = np.zeros(runs, dtype=bool)
    reason = np.zeros(runs, dtype=np.int8)
    waited_s = np.zeros(runs)
    finish_time = np.full(runs, np.nan)
    duration = np.zeros(runs)
    own = not type(planner).__module__.startswith("napf_mpc.")
    as_built = deepcopy(scenario.obstacles.solids) if own else None
    planner.reset(scenario.obstacles, runs)
    if as_built is not None:
        _check_untouched(scenario.obstacles.solids, as_built, planner.name)
    filtered = _filtered(problem, scenario, clock)
    tracker = _tracker(problem, scenario, clock)
    unfiltered = _Unfiltered(fixes_of_flight(scenario.errors), clock) if filtered is None else None
    command: Command | None = None
    for tick in range(clock.ticks):
        time_s = tick * clock.period_s
        if filtered is not None:
            nav = filtered.solution(
                tick,
                time_s,
                state[..., POSITION],
                state[..., VELOCITY],
                state[..., ATTITUDE],
                state[..., RATES],
                active,
            )
        else:
            assert unfiltered is not None
            nav = unfiltered.solution(tick, time_s, state)
        if tracker is not None:
            tracker.tick(tick)
        if command is None or tick % clock.ticks_per_plan == 0:
            airborne = np.repeat(active[:, None], state.shape[1], axis=1)
            tracks = None if tracker is None else tracker.tracks()
            shown = replace(nav, airborne=airborne, tracks=tracks, sigma_map=scenario.sigma_map)
            command = planner.step(_of_its_own(shown) if own else shown, time_s)
            check_command(command, planner.name, (runs, state.shape[1]))
            holding[active] = command.holding[active].any(-1)
            if command.reason is not None:
                reason[active] = command.reason[active].max(-1)
        waited_s[active & holding] += clock.period_s
        inputs = _inner_loop(law, nav, command, active)
        for observer in observers:
            observer.ticked(time_s, state, nav, command, inputs, active)
        for step in range(clock.steps_per_tick):
            before = state.copy()
            advance(state, inputs, constants, clock.step_s, 1, active)
            if _lost(state, active, lost):
                failed |= lost
                active = active & ~lost
                duration[lost] = time_s
                # Out of the arithmetic for good: a lost run stands where it started, masked.
                state[lost] = scenario.initial_state[lost]
                before[lost] = state[lost]
            moment = time_s + (step + 1) * clock.step_s
            for observer in observers:
                observer.moved(moment, before, state, active)
        now = time_s + clock.period_s
        passed = (frame.along_track(state[..., POSITION]) >= mission.length_m).all(-1) & active
        if passed.any():
            finish_time[passed] = now
            duration[passed] = now
            active = active & ~passed
        if not active.any():
            break
    duration[active] = clock.ticks * clock.period_s
    if as_built is not None:
        _check_untouched(scenario.obstacles.solids, as_built, planner.name)
    return Flight(
        np.isfinite(finish_time),
        failed,
        holding,
        finish_time,
        duration,
        None if filtered is None else filtered.gated_fixes,
        None if filtered is None else filtered.missed_fixes,
        reason,
        waited_s,
        None if filtered is None else filtered.monitor,
    )


def _check_untouched(solids: Solids, as_built: Solids, planner: str) -> None:
    """Refuse a planner that wrote into the map: the verdict and the other planners have the same one.

    Raises
    ------
    ProblemError
        After the map is what it was.
    """
    changed = False
    for now, before in zip(solids, as_built, strict=True):
        if not np.array_equal(now, before, equal_nan=True):
            changed = True
            now[...] = before
    if changed:
        raise ProblemError(
            f'planner "{planner}"',
            ["wrote into the obstacles that it was given, which are those of the verdict: work on a copy"],
        )


def _of_its_own(nav: NavSolution) -> NavSolution:
    """Solution for a planner that may write into it, as ``nav.position -= centre`` does.

    The inner loop flies by the original, the verdict reads it, and a fix is shown until the next one comes.
    """
    told: dict[str, Any] = {each.name: getattr(nav, each.name) for each in fields(nav)}
    own: dict[str, Any] = {name: each.copy() for name, each in told.items() if isinstance(each, np.ndarray)}
    return replace(nav, **own)


@dataclass(frozen=True)
class _Clock:
    """Whole-number ratios between the loops (the problem's validation makes them whole)."""

    step_s: float
    period_s: float
    steps_per_tick: int
    ticks_per_plan: int
    ticks_per_fix: int
    ticks: int

    @classmethod
    def of_problem(cls, problem: Problem, fix_period_s: float) -> _Clock:
        simulation = problem.simulation
        period = 1.0 / simulation.controller_rate_hz
        ticks_per_fix = fix_period_s / period
        if not (ticks_per_fix > 0.5 and abs(ticks_per_fix - round(ticks_per_fix)) < 1e-6):
            raise ValueError(
                f"errors have period_s = {fix_period_s:g}, must be one or more whole periods of the inner "
                f"loop, {period:g} s (simulation.controller_rate_hz = {simulation.controller_rate_hz:g})"
            )
        return cls(
            step_s=simulation.step_s,
            period_s=period,
            steps_per_tick=round(period / simulation.step_s),
            ticks_per_plan=round(simulation.controller_rate_hz / problem.planner.rate_hz),
            ticks_per_fix=round(ticks_per_fix),
            ticks=max(1, math.ceil(simulation.time_limit_s / period - 1e-9)),
        )


def _filtered(problem: Problem, scenario: Scenario, clock: _Clock) -> FilteredNavigation | None:
    if problem.navigation.filter == "none":
        return None
    return FilteredNavigation(
        problem.navigation,
        scenario.errors,
        scenario.seed,
        scenario.runs,
        clock.period_s,
        clock.ticks_per_fix,
        scenario.initial_state[..., VELOCITY],
    )


def _tracker(problem: Problem, scenario: Scenario, clock: _Clock) -> MovingTracker | None:
    if scenario.moving is None:
        return None
    return MovingTracker(problem.world, scenario.moving, scenario.seed, scenario.runs, clock.period_s)


class _Unfiltered:
    """Navigation without a filter: the last fix, held."""

    def __init__(self, fixes: FixSource, clock: _Clock) -> None:
        self._fixes, self._ticks_per_fix = fixes, clock.ticks_per_fix
        self._held: tuple[Fix, Array] | None = None

    def solution(self, tick: int, time_s: float, state: Array) -> NavSolution:
        """Issue the solution of a tick, from the true states (run, uav, 12); ticks come from 0 on."""
        if self._held is None or tick % self._ticks_per_fix == 0:
            epoch = tick // self._ticks_per_fix
            fix = self._fixes.fix(epoch, state[..., POSITION])
            check_shapes(fix, epoch, *state.shape[:2])
            self._held = fix, _with_velocity(fix.covariance)
        return _solution(time_s, state, *self._held)


def _with_velocity(covariance: Array) -> Array:
    """Covariance of position and velocity (run, uav, 6, 6); an unfiltered velocity has no error."""
    out = np.zeros((*covariance.shape[:-2], 6, 6))
    out[..., :3, :3] = covariance
    return out


def _solution(time_s: float, state: Array, fix: Fix, covariance: Array) -> NavSolution:
    """Unfiltered solution: current place plus the held error; the error-free channels are copies."""
    return NavSolution(
        time_s=time_s,
        available=fix.available,
        position=state[..., POSITION] + fix.error,
        velocity=state[..., VELOCITY].copy(),
        attitude=state[..., ATTITUDE].copy(),
        body_rates=state[..., RATES].copy(),
        covariance=covariance,
        common_factor=fix.common_factor,
        overbound=fix.overbound,
        protection=fix.protection,
    )


def _inner_loop(law: TrackingLaw, nav: NavSolution, command: Command, active: Mask) -> Array:
    position, velocity, direction = command.position, command.velocity, command.direction
    attitude, rates, feedforward = nav.attitude, nav.body_rates, command.feedforward
    if command.plan is not None and command.planned is not None:
        vectors = (position, velocity, direction, attitude, rates)
        shown = np.empty((len(vectors), *nav.position.shape))
        for n, values in enumerate(vectors):
            shown[n] = values
        position, velocity, direction, attitude, rates = shown
        feedforward = np.array(feedforward, dtype=np.float64, order="C")
        planned, held = command.plan.at(nav.time_s)
        _show_plan(command.planned, plain(planned), plain(held), plain(command.yaw), shown, feedforward)
        if command.tilt_thrust:
            hold_up(
                command.planned, plain(nav.attitude), law.hover_thrust, 4.0 * law.rotor_limit, feedforward
            )
    return law.inputs(
        nav.position, nav.velocity, attitude, rates, position, velocity, direction, command.yaw, feedforward,
        active,
    )  # fmt: skip


@compiled
def _show_plan(
    follows: Mask, planned: Array, held: Array, yaw: Array, shown: Array, feedforward: Array
) -> None:
    """Give the law what makes it fly ``u = u_plan(t) - K (x_nav - x_plan(t))``, where a plan is followed.

    The law counts attitude and rates from level flight at the reference yaw, so it is shown their difference
    to the plan's.

    Parameters
    ----------
    follows : array of bool, shape (run, uav)
        Who follows a plan.
    planned, held : array, shapes (run, uav, 12) and (run, uav, 4)
        State and input about hover of the plans now.
    yaw : array, shape (run, uav)
        Reference [rad].
    shown, feedforward : array, shapes (5, run, uav, 3) and (run, uav, 4)
        Position, velocity and direction to fly, attitude and rates as reported; overwritten.
    """
    for run in range(follows.shape[0]):
        for uav in range(follows.shape[1]):
            if not follows[run, uav]:
                continue
            x = planned[run, uav]
            for a in range(3):
                shown[0, run, uav, a] = x[2 * a]
                shown[1, run, uav, a] = x[2 * a + 1]
                shown[2, run, uav, a] = 0.0
                shown[3, run, uav, a] -= x[6 + 2 * a] - yaw[run, uav] * (1.0 if a == 2 else 0.0)
                shown[4, run, uav, a] -= x[7 + 2 * a]
            for i in range(4):
                feedforward[run, uav, i] = held[run, uav, i]


MOST_THRUST = 0.8
"""Part of the rotors' thrust that tilt may take: without the rest for torques nobody turns level again."""
UPRIGHT = 0.5
"""Least cosine of tilt that is made up for: beyond, UAVs are upset, and pushed aside by more thrust."""


@compiled
def hold_up(
    follows: Mask, attitude: Array, hover_thrust: float, largest_thrust: float, feedforward: Array
) -> None:
    """Raise the thrust of plans to what holds up a tilted vehicle: over the cosine of its tilt.

    The model about hover knows no loss of lift: with roll and pitch at their limits a quarter of it is gone,
    and a UAV sinks by a metre in a second's turn.

    Parameters
    ----------
    follows : array of bool, shape (run, uav)
        Who follows a plan.
    attitude : array, shape (run, uav, 3)
        Roll, pitch and yaw as reported [rad].
    hover_thrust, largest_thrust : float
        Of the vehicle [N].
    feedforward : array, shape (run, uav, 4)
        Inputs about hover; thrust is written over, and never lowered.
    """
    for run in range(follows.shape[0]):
        for uav in range(follows.shape[1]):
            if follows[run, uav]:
                upright = np.cos(attitude[run, uav, 0]) * np.cos(attitude[run, uav, 1])
                wanted = (hover_thrust + feedforward[run, uav, 0]) / max(upright, UPRIGHT)
                wanted = min(wanted, MOST_THRUST * largest_thrust) - hover_thrust
                feedforward[run, uav, 0] = max(feedforward[run, uav, 0], wanted)


@compiled
def _lost(state: Array, active: Mask, lost: Mask) -> bool:
    """Write which active runs hold a number that is not finite, or a UAV too far out; whether any does."""
    some = False
    for run in range(state.shape[0]):
        lost[run] = False
        if not active[run]:
            continue
        for uav in range(state.shape[1]):
            for i in range(state.shape[2]):
                size = abs(state[run, uav, i])
                # What is not a number fails every comparison.
                if not size < np.inf or (i % 2 == 0 and i < 6 and not size < LOST_M):
                    lost[run] = some = True
    return some
