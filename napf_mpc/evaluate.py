"""Truth lives here: swept clearance, contacts, formation error, and the statistics of many runs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from napf_mpc.closed_loop import POSITION, VELOCITY, Flight, Mask, Scenario, formation_mission
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.jit import compiled
from napf_mpc.navigation.consistency import normalised_errors
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.planner import REASON_WORDS, Command, Reason
from napf_mpc.problem import Problem
from napf_mpc.safety_distance import Inflation
from napf_mpc.vehicle.quadrotor import hover_input
from napf_mpc.world.distance import COS, SIN, Solids, X, Y, solid_bounds
from napf_mpc.world.moving_sweep import MovingClearance
from napf_mpc.world.sweep import SweptClearance, check_steps, separate

Array = NDArray[np.float64]

SETTLED_S = 12.0
"""Formation errors count from here on: before, the formation takes shape from its take-off places."""
APART_S = 5.0
"""Separation counts from here on: the paper's take-off places are 1.4 m apart."""
REFORMED_S = 1.0
"""A formation is re-formed once its shape error has stayed under the bound for this long."""
DELAYED = "out of time after waiting"
"""Reason of a run that was on its way when time was up, and would have arrived but for its waits."""
CONSISTENCY_EVERY_S = 0.2
"""How often the filter's errors are compared with its covariance; they change over seconds."""


class Outcome(StrEnum):
    """How a mission ended. Decided in the order failed, collided, the rest; all counts sum to N."""

    REACHED = "reached"
    COLLIDED = "collided"
    HELD = "held"
    ABORTED = "aborted"
    TIMEOUT = "timeout"
    FAILED = "failed"


METRICS = (
    "path_rms_m",
    "shape_rms_m",
    "shape_floor_m",
    "path_length_ratio",
    "control_effort",
    "reform_time_s",
    "finish_time_s",
    "waited_s",
    "min_clearance_m",
    "min_separation_m",
    "within_k_sigma_east",
    "within_k_sigma_north",
    "within_k_sigma_up",
    "nees",
    "nees_position",
    "gated_fixes",
    "missed_fixes",
    "monitor_alarms",
    "monitor_scale",
)
"""Metrics of a run, in the order of every table."""


@dataclass(frozen=True)
class Score:
    """Verdicts and metrics of each run of a block, on the truth."""

    runs: NDArray[np.int64]
    """(run,) index in the campaign."""
    outcome: tuple[Outcome, ...]
    """(run,)."""
    obstacle_contact: NDArray[np.bool_]
    """(run, uav) whether the UAV touched an obstacle."""
    uav_contact: NDArray[np.bool_]
    """(run,) whether two UAVs came closer than the least separation."""
    joint_success: NDArray[np.bool_]
    """(run,) reached, no contact of either kind, and re-formed."""
    finished: NDArray[np.bool_]
    """(run,) every UAV passed the mission's length in time, contacts or not."""
    reason: tuple[str, ...]
    """(run,) why a run that did not finish waited, or :data:`DELAYED`; empty if it did finish, or was on its
    way and had not waited for long."""
    metrics: dict[str, Array]
    """Name -> (run,); NaN where the metric is not defined, such as a finish time without a finish."""


class MissionScore:
    """Observer that judges every run of a block.

    Parameters
    ----------
    problem : Problem
        Formation mission, sizes and bounds.
    scenario : Scenario
        Its obstacles are the solids of the verdict, those that stand and those that move.
    """

    def __init__(self, problem: Problem, scenario: Scenario) -> None:
        mission = formation_mission(problem)
        self._problem = problem
        self._scenario = scenario
        self._frame = PathFrame.of_mission(mission)
        self._axes = self._frame.axes
        self._offsets = formation_offsets(problem.formation)
        self._hover_thrust = float(hover_input(problem.vehicle)[0])
        self._reform_bound_m = mission.reform_bound_m
        runs, uavs = scenario.initial_state.shape[:2]
        self._clearance = SweptClearance(scenario.obstacles, runs, uavs)
        moving = scenario.moving
        self._moving = None if moving is None else MovingClearance(moving, runs, uavs)
        self._separation = np.full((runs, uavs), np.inf)
        self._flown = np.zeros((runs, uavs))
        self._start = self._frame.along_track(scenario.initial_state[..., POSITION])
        self._end = self._start.copy()
        self._sums = np.zeros((runs, 9))
        self._k = Inflation.of_problem(problem).k
        self._below_since = np.full(runs, np.nan)
        self._passed_at = np.full(runs, np.nan)
        self._reform_time = np.full(runs, np.nan)
        self._last_obstacle = self._last_obstacle_along()
        self._filtered = problem.navigation.filter != "none"
        self._consistency_sums = np.zeros((runs, 3))
        self._ticks = 0

    def _last_obstacle_along(self) -> Array:
        """Along-track place (run,) where the last obstacle to be passed in the corridor ends; NaN if none."""
        obstacles, runs = self._scenario.obstacles, len(self._scenario.runs)
        length, reach = formation_mission(self._problem).length_m, self._problem.planner.influence_m
        ends_of_path = np.array([[(0.0, 0.0, 0.0)], [(length, 0.0, 0.0)]])
        slots = ends_of_path + self._offsets * np.array([0.0, 1.0, 1.0])
        heights = self._frame.to_world(slots)[..., 2]
        half_width = np.abs(self._offsets[:, 1]).max()
        low, high = _seen_from_path(obstacles.solids, self._frame)
        # What ends beyond the finish nobody has passed before the mission is over.
        met = (high[:, 0] >= 0.0) & (high[:, 0] <= length)
        met &= (low[:, 1] <= half_width + reach) & (high[:, 1] >= -half_width - reach)
        met &= (low[:, 2] <= heights.max() + reach) & (high[:, 2] >= heights.min() - reach)
        scene = np.repeat(np.arange(obstacles.n_scenes), obstacles.counts())
        ends = np.full(obstacles.n_scenes, np.nan)
        np.fmax.at(ends, scene[met], high[met, 0])
        return np.broadcast_to(ends, runs).copy()

    def moved(self, time_s: float, before: Array, after: Array, active: Mask) -> None:
        """Sweep one physics step against the solids and the other UAVs."""
        p0, p1, active = check_steps(
            before[..., POSITION], after[..., POSITION], active, self._separation.shape
        )
        self._clearance.take_in(p0, p1, active)
        if self._moving is not None:
            self._moving.update(time_s - self._problem.simulation.step_s, time_s, p0, p1, active)
        if time_s > APART_S and p0.shape[1] > 1:
            separate(p0, p1, active, self._separation)
        _travel(p0, p1, active, self._frame.origin, self._frame.along, self._flown, self._end)

    def ticked(
        self, time_s: float, state: Array, nav: NavSolution, command: Command, inputs: Array, active: Mask
    ) -> None:
        """Add one tick to formation errors and effort."""
        _accumulate(
            time_s,
            1.0 / self._problem.simulation.controller_rate_hz,
            state,
            nav.position,
            nav.covariance,
            self._k,
            inputs,
            active,
            self._frame.origin,
            self._axes,
            self._offsets,
            self._hover_thrust,
            self._reform_bound_m,
            self._last_obstacle,
            self._sums,
            self._below_since,
            self._passed_at,
            self._reform_time,
        )
        every = max(1, round(CONSISTENCY_EVERY_S * self._problem.simulation.controller_rate_hz))
        if self._filtered and self._ticks % every == 0:
            self._compare_with_covariance(state, nav, active)
        self._ticks += 1

    def _compare_with_covariance(self, state: Array, nav: NavSolution, active: Mask) -> None:
        error = np.concatenate(
            [nav.position - state[..., POSITION], nav.velocity - state[..., VELOCITY]], axis=-1
        )
        position, whole = np.empty(error.shape[:2]), np.empty(error.shape[:2])
        normalised_errors(error, nav.covariance, position, whole)
        now = np.stack([np.ones_like(active, dtype=float), whole.mean(-1), position.mean(-1)], axis=-1)
        self._consistency_sums += np.where(active[:, None], now, 0.0)

    def score(self, flight: Flight) -> Score:
        """Verdicts and metrics once the block has flown."""
        vehicle = self._problem.vehicle
        clearance = self._clearance.clearance
        if self._moving is not None:
            clearance = np.minimum(clearance, self._moving.clearance)
        obstacle = clearance <= vehicle.radius_m
        separation = self._separation.min(-1)
        uav = separation < vehicle.min_separation_m
        collided = obstacle.any(-1) | uav
        waited = np.zeros(len(collided), dtype=np.int8) if flight.reason is None else flight.reason
        waited_s = np.zeros(len(collided)) if flight.waited_s is None else flight.waited_s
        outcome = tuple(
            Outcome.FAILED
            if failed
            else Outcome.COLLIDED
            if hit
            else Outcome.REACHED
            if reached
            else Outcome.ABORTED
            if reason == Reason.NO_PASSAGE
            else Outcome.HELD
            if held
            else Outcome.TIMEOUT
            for failed, hit, reached, held, reason in zip(
                flight.failed, collided, flight.reached, flight.holding, waited, strict=True
            )
        )
        counted = self._sums[:, _COUNT]
        compared, whole, position = self._consistency_sums.T
        watched = flight.monitor
        unknown = np.full(len(counted), np.nan)
        gated = np.full(len(counted), np.nan) if flight.gated_fixes is None else flight.gated_fixes
        with np.errstate(invalid="ignore", divide="ignore"):
            progress = (self._end - self._start).mean(-1)
            metrics = {
                "path_rms_m": np.sqrt(self._sums[:, _PATH] / counted),
                "shape_rms_m": np.sqrt(self._sums[:, _SHAPE] / counted),
                "shape_floor_m": np.sqrt(self._sums[:, _FLOOR] / counted),
                "path_length_ratio": np.where(progress > 0.0, self._flown.mean(-1) / progress, np.nan),
                "control_effort": self._sums[:, _EFFORT].copy(),
                "reform_time_s": self._reform_time.copy(),
                "finish_time_s": flight.finish_time_s.copy(),
                "waited_s": waited_s.copy(),
                "min_clearance_m": _finite_or_nan(clearance.min(-1) - vehicle.radius_m),
                "min_separation_m": _finite_or_nan(separation),
                "within_k_sigma_east": self._sums[:, _WITHIN] / self._sums[:, _FIXES],
                "within_k_sigma_north": self._sums[:, _WITHIN + 1] / self._sums[:, _FIXES],
                "within_k_sigma_up": self._sums[:, _WITHIN + 2] / self._sums[:, _FIXES],
                "nees": whole / compared,
                "nees_position": position / compared,
                "gated_fixes": gated.astype(np.float64),
                "missed_fixes": unknown.copy()
                if flight.missed_fixes is None
                else flight.missed_fixes.astype(np.float64),
                "monitor_alarms": unknown if watched is None else watched.alarms.sum(-1).astype(np.float64),
                "monitor_scale": unknown.copy() if watched is None else watched.largest.max(-1),
            }
        for values in metrics.values():
            values[flight.failed] = np.nan
        reformed = np.isfinite(self._reform_time) | np.isnan(self._last_obstacle)
        return Score(
            np.arange(self._scenario.runs.start, self._scenario.runs.stop),
            outcome,
            obstacle,
            uav,
            flight.reached & ~collided & ~flight.failed & reformed,
            flight.reached & ~flight.failed,
            tuple(
                "" if done else DELAYED if late and r == Reason.NONE else REASON_WORDS[Reason(r)]
                for done, r, late in zip(
                    flight.reached, waited, self._delayed(waited_s) & ~flight.holding, strict=True
                )
            ),
            metrics,
        )

    def _delayed(self, waited_s: Array) -> Mask:
        """Whether the waits (run,) were longer than what was left of the path takes at reference speed."""
        mission = formation_mission(self._problem)
        left_m = mission.length_m - self._end.min(-1)
        return np.asarray(waited_s * mission.speed_mps >= left_m)


def _seen_from_path(solids: Solids, frame: PathFrame) -> tuple[Array, Array]:
    """Box of each solid in the frame of a path: lower and upper end along, to the left, and height [m].

    Seen from above: where the path climbs, the ends are those of its points over the solid.
    """
    east, north = frame.left[1], -frame.left[0]
    rows, slope = solids.parameters.copy(), math.hypot(frame.along[0], frame.along[1])
    x, y = solids.parameters[:, X] - frame.origin[0], solids.parameters[:, Y] - frame.origin[1]
    rows[:, X], rows[:, Y] = x * east + y * north, y * east - x * north
    c, s = solids.parameters[:, COS], solids.parameters[:, SIN]
    rows[:, COS], rows[:, SIN] = c * east + s * north, s * east - c * north
    x, y = solids.vertices[:, 0] - frame.origin[0], solids.vertices[:, 1] - frame.origin[1]
    vertices = np.column_stack([x * east + y * north, y * east - x * north])
    low, high = solid_bounds(solids._replace(parameters=rows, vertices=vertices))
    return low / (slope, 1.0, 1.0), high / (slope, 1.0, 1.0)


def _finite_or_nan(values: Array) -> Array:
    return np.where(np.isfinite(values), values, np.nan)


_COUNT, _PATH, _SHAPE, _FLOOR, _EFFORT, _FIXES, _WITHIN = 0, 1, 2, 3, 4, 5, 6


@compiled
def _travel(
    p0: Array, p1: Array, active: Mask, origin: Array, along: Array, flown: Array, end: Array
) -> None:
    """Add the way from p0 to p1 (run, uav, 3) to ``flown``, and write the along-track places of its ends."""
    for r in range(p0.shape[0]):
        if not active[r]:
            continue
        for i in range(p0.shape[1]):
            x, y, z = p1[r, i, 0] - p0[r, i, 0], p1[r, i, 1] - p0[r, i, 1], p1[r, i, 2] - p0[r, i, 2]
            flown[r, i] += math.sqrt(x * x + y * y + z * z)
            u, v, w = p1[r, i, 0] - origin[0], p1[r, i, 1] - origin[1], p1[r, i, 2] - origin[2]
            end[r, i] = u * along[0] + v * along[1] + w * along[2]


@compiled
def _accumulate(
    time_s: float,
    period_s: float,
    state: Array,
    estimate: Array,
    covariance: Array,
    k: float,
    inputs: Array,
    active: NDArray[np.bool_],
    origin: Array,
    axes: Array,
    offsets: Array,
    weight: float,
    reform_bound_m: float,
    last_obstacle: Array,
    sums: Array,
    below_since: Array,
    passed_at: Array,
    reform_time: Array,
) -> None:
    """Add one tick of every active run to its sums (see the metrics of :class:`MissionScore`)."""
    runs, uavs = state.shape[0], state.shape[1]
    slot_error = np.empty((uavs, 3))
    nav_error = np.empty((uavs, 3))
    common = np.empty(3)
    common_nav = np.empty(3)
    for r in range(runs):
        if not active[r]:
            continue
        centre = 0.0
        rear = np.inf
        for i in range(uavs):
            for a in range(3):
                projected = 0.0
                missed = 0.0
                for b in range(3):
                    place = state[r, i, 2 * b]
                    projected += (place - origin[b]) * axes[a, b]
                    missed += (estimate[r, i, b] - place) * axes[a, b]
                slot_error[i, a] = projected
                nav_error[i, a] = missed
            sums[r, _FIXES] += 1.0
            for b in range(3):
                error = estimate[r, i, b] - state[r, i, 2 * b]
                if error * error <= k * k * covariance[r, i, b, b]:
                    sums[r, _WITHIN + b] += 1.0
            centre += slot_error[i, 0]
            rear = min(rear, slot_error[i, 0])
            thrust = inputs[r, i, 0] - weight
            effort = thrust * thrust
            for j in range(1, 4):
                effort += inputs[r, i, j] * inputs[r, i, j]
            sums[r, _EFFORT] += effort * period_s
        centre /= uavs
        for i in range(uavs):
            slot_error[i, 0] -= centre + offsets[i, 0]
            slot_error[i, 1] -= offsets[i, 1]
            slot_error[i, 2] -= offsets[i, 2]
        path = 0.0
        shape = 0.0
        floor = 0.0
        for a in range(3):
            common[a] = 0.0
            common_nav[a] = 0.0
            for i in range(uavs):
                common[a] += slot_error[i, a]
                common_nav[a] += nav_error[i, a]
            common[a] /= uavs
            common_nav[a] /= uavs
        worst = 0.0
        for i in range(uavs):
            own = 0.0
            for a in range(3):
                path += slot_error[i, a] ** 2
                own += (slot_error[i, a] - common[a]) ** 2
                floor += (nav_error[i, a] - common_nav[a]) ** 2
            shape += own
            worst = max(worst, own)
        if time_s >= SETTLED_S:
            sums[r, _COUNT] += 1.0
            sums[r, _PATH] += path / uavs
            sums[r, _SHAPE] += shape / uavs
            sums[r, _FLOOR] += floor / uavs
        if worst < reform_bound_m * reform_bound_m:
            if np.isnan(below_since[r]):
                below_since[r] = time_s
        else:
            below_since[r] = np.nan
        if np.isnan(passed_at[r]) and rear >= last_obstacle[r]:
            passed_at[r] = time_s
        if np.isnan(reform_time[r]) and not np.isnan(passed_at[r]) and not np.isnan(below_since[r]):
            since = max(below_since[r], passed_at[r])
            if time_s - since >= REFORMED_S - 1e-9:
                reform_time[r] = since - passed_at[r]
