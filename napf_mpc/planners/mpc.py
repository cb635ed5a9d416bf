"""QP-NAPF: a model-predictive planner whose soft rows carry the NAPF repulsion; one QP a UAV and step."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napf_mpc.constraints.clearance import ObstacleContact, ObstacleInfluence
from napf_mpc.constraints.constraint import (
    Constraint,
    Horizon,
    LinearRows,
    check_outlines,
    checked_constraints,
)
from napf_mpc.constraints.limits import AltitudeBand, InputBox, SpeedLimit, TiltLimit
from napf_mpc.constraints.moving import MovingObstacleContact
from napf_mpc.constraints.neighbours import NeighbourSeparation, ShortMargins
from napf_mpc.constraints.passage import passage_margins
from napf_mpc.constraints.probability import sigma_along
from napf_mpc.errors import NapfError, ProblemError
from napf_mpc.formation import PathFrame
from napf_mpc.jit import compiled
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.navigation.tracks import Tracks
from napf_mpc.planners import passes
from napf_mpc.planners.cohesion import drawn_together, gone_along
from napf_mpc.planners.descent import Descent
from napf_mpc.planners.fallback import Action, Codes, Ladder
from napf_mpc.planners.guess import cut_at_obstacles
from napf_mpc.planners.guidance import Guidance, guidance_covariance
from napf_mpc.planners.guide import Guide
from napf_mpc.planners.guide_settings import GuidanceSettings
from napf_mpc.planners.guided_field import waiting_reasons
from napf_mpc.planners.plan import Plan, horizon_model, stage_grid, standing_plan, straight_plan
from napf_mpc.planners.planner import Command
from napf_mpc.planners.references import SlotReference
from napf_mpc.planners.tally import COLUMNS, COUNTED, Tally
from napf_mpc.planners.told import check_map, check_told
from napf_mpc.problem import FormationMission, Problem, Vehicle
from napf_mpc.problem import Planner as Settings
from napf_mpc.qp import INPUTS, STATES, HorizonQp, Layout
from napf_mpc.safety_distance import Inflation
from napf_mpc.solvers.acceptance import AcceptanceLimits, Refusal, refusals
from napf_mpc.solvers.batch import (
    STATUSES,
    BatchResult,
    BatchSolver,
    WarmStart,
    judged,
    judges_itself,
    make_batch_solver,
)
from napf_mpc.solvers.solver import SolverError
from napf_mpc.vehicle.plant import plain
from napf_mpc.vehicle.quadrotor import hover_input, mixer_inverse, rotor_limit
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

POSITION, VELOCITY = slice(0, 6, 2), slice(1, 6, 2)
NEIGHBOURS = 3
"""Neighbours that each stage of each UAV keeps rows for, at most."""
UPSET_RAD = 1.0
"""Roll or pitch beyond which the model about hover is worth nothing: the inner loop levels the UAV first."""
SLOT_PART, OPENING_MPS = 0.8, 1.0
"""What is asked of neighbours at most: this part of the distance of their slots, and no faster parting."""
STUCK_PART, STUCK_M = 0.3, 2.0
"""A plan that gets less than this part of its reference's way, if that is farther than this, is stuck."""
REPULSION_PART = 0.5
"""NAPF's repulsion pulls with this part of the contact price at most: it never outbids the margin itself."""
LEAVING_MPS, LEAVING_RAW_MPS = 2.0, 0.3
"""``planner.leaving_mps`` behind a filter, and on raw measurements. These wander in and out of margins by
metres: who leaves faster than errors fade flies after them."""
THRUST_WEIGHT, TORQUE_WEIGHT = 60.0, 600.0
"""``planner.thrust_weight`` and ``planner.torque_weight`` of the paper's vehicle, in their units."""
FAST_MPS = GuidanceSettings.usual_mps
"""Formation speed beyond which prices, thrust and, see there, guidance are others."""
CONTACT_PRICE, FAST_CONTACT_PRICE, FAST_RAW_CONTACT_PRICE = 300.0, 3000.0, 1000.0
"""``planner.contact_price`` up to that, and beyond it behind a filter and on raw measurements. The slot of a
UAV that waits at a corner runs away by ten metres in the seconds of a horizon, all of which pull at the few
stages on which the corner is cut. A margin that jumps with raw measurements would upset who pays as much."""
SPEED_PRICE = (1000.0, 1000.0)
"""Prices of a speed slack: above what the margins can gain by it, so that no margin buys a dash."""
_CAUSES = np.array([reason.name.lower() for reason in Refusal], dtype=object)
_WORDS = np.array([status.value for status in STATUSES])
_COLUMN = np.array(
    [COLUMNS.index(f"solves_{status.value}") if status in COUNTED else -1 for status in STATUSES]
)
_ITERATIONS = COLUMNS.index("iterations")
_SHORT = COLUMNS.index("margin_short")


def default_constraints(problem: Problem) -> list[Constraint]:
    """Rows of the QP as a problem's settings ask for them."""
    settings, leaving = problem.planner, problem.planner.leaving_mps
    if leaving is None:
        leaving = LEAVING_RAW_MPS if problem.navigation.filter == "none" else LEAVING_MPS
    rows, price, margin = settings.obstacle_rows, contact_price(problem), settings.margin
    inflation = Inflation.of_problem(problem)
    contact = ObstacleContact(
        inflation,
        obstacles=rows,
        w1=price,
        extra_m=settings.contact_extra_m,
        extra_sigmas=settings.contact_extra_sigmas,
        opening_mps=leaving,
        margin=margin,
        narrow_w1=firm_price(problem) if settings.contact_price is None else 0.0,
    )
    most = REPULSION_PART * price if price > 0.0 else math.inf
    influence = ObstacleInfluence(
        inflation, obstacles=rows, per_speed=settings.influence_scale, most=most, margin=margin
    )
    neighbours = min(NEIGHBOURS, problem.uav_count - 1)
    apart = NeighbourSeparation(
        max(1, neighbours), inflation=inflation, w1=price, slot_part=SLOT_PART, opening_mps=OPENING_MPS
    )
    others: list[Constraint] = [apart] if neighbours else []
    # Nobody is asked to get out of anything faster than it can fly: that would buy a dash and nothing else.
    pace = problem.mission.speed_mps if isinstance(problem.mission, FormationMission) else math.inf
    most_mps = settings.max_speed_ratio * pace
    if problem.world.moving:
        count = min(rows, len(problem.world.moving))
        extra_m, extra_sigmas = settings.contact_extra_m, settings.contact_extra_sigmas
        moving = MovingObstacleContact(
            obstacles=count, w1=price, extra_m=extra_m, extra_sigmas=extra_sigmas, opening_mps=most_mps
        )
        others.append(moving)
    if settings.altitude_m is not None:
        low, high = settings.altitude_m
        others.append(AltitudeBand(low, high, opening_mps=pace))
    speed = SpeedLimit(w1=SPEED_PRICE[0], w2=SPEED_PRICE[1])
    return [contact, influence, *others, speed, TiltLimit(), InputBox()]


def contact_price(problem: Problem) -> float:
    """Price of a margin as a problem's settings ask for it [1/(m s)]."""
    asked = problem.planner.contact_price
    if asked is not None:
        return asked
    return firm_price(problem) if _is_fast(problem) else CONTACT_PRICE


def firm_price(problem: Problem) -> float:
    """Price of a margin for fast formations, and of the margins of small errors [1/(m s)]."""
    return FAST_RAW_CONTACT_PRICE if problem.navigation.filter == "none" else FAST_CONTACT_PRICE


def _is_fast(problem: Problem) -> bool:
    return isinstance(problem.mission, FormationMission) and problem.mission.speed_mps > FAST_MPS


def weights(settings: Settings, vehicle: Vehicle) -> tuple[Array, Array]:
    """Diagonals (12,) of Q and (4,) of R per second, in the order of Eq. 1 and 2.

    One weight for both horizontal axes, so that the Hessian depends neither on the heading nor on yaw. What
    inputs cost goes by accelerations unless it is given: a newton is less to who is heavier.
    """
    usual = Vehicle()
    inputs = np.empty(INPUTS)
    inputs[0], inputs[1:] = THRUST_WEIGHT, TORQUE_WEIGHT
    inputs[0] *= (usual.mass_kg / vehicle.mass_kg) ** 2
    inputs[1:] *= (np.array(usual.inertia_kgm2) / np.array(vehicle.inertia_kgm2)) ** 2
    if settings.thrust_weight is not None:
        inputs[0] = settings.thrust_weight
    if settings.torque_weight is not None:
        inputs[1:] = settings.torque_weight
    state = np.empty(STATES)
    state[POSITION], state[VELOCITY] = settings.position_weight, settings.velocity_weight
    state[6:12:2], state[7:12:2] = settings.attitude_weight, 0.2 * settings.attitude_weight
    return state, inputs


class QpPlanner:
    """Each UAV tracks its synchronised slot by a QP over a horizon; constraints are soft rows.

    Every step the last plans, re-sampled, are the guess at which rows are linear; the constraints give their
    rows; the solver answers; and an answer flies only if it passes the acceptance test. Otherwise the ladder
    of :mod:`napf_mpc.planners.fallback` decides, and its use is counted. Neighbours see each other's plans of
    the step before, so their order does not matter.

    Parameters
    ----------
    problem : Problem
        Formation, mission and planner settings.
    constraints : sequence of Constraint, optional
        Rows of the QP instead of :func:`default_constraints`.
    solver : str or BatchSolver, optional
        A solver, or the name of one, instead of the problem's.
    name : str
        Name in tables and files.
    guided : bool, optional
        Whether the references follow formation guidance, instead of what the problem says.
    clock : callable, optional
        Seconds that go on while the solver works. With one, answers that take longer than the planner's
        period are refused as late; without, as in all simulations, time stands still meanwhile.
    """

    def __init__(
        self,
        problem: Problem,
        constraints: Sequence[Constraint] | None = None,
        solver: str | BatchSolver | None = None,
        name: str = "qp",
        guided: bool | None = None,
        clock: Callable[[], float] | None = None,
    ) -> None:
        if not isinstance(problem.mission, FormationMission):
            raise ProblemError("mission.kind", ['must be "formation" for this planner, not "goal"'])
        settings = problem.planner
        self.problem = problem
        self.constraints = checked_constraints(
            default_constraints(problem) if constraints is None else constraints
        )
        self._name = name
        self._clock = clock
        self._frame = PathFrame.of_mission(problem.mission)
        self._slots = SlotReference.of_problem(problem, problem.mission)
        follows = settings.guidance == "blended" if guided is None else guided
        self._inflation = Inflation.of_problem(problem)
        margins = passage_margins(self._inflation) if settings.margin == "passage" else None
        self._guidance = Guidance(problem, self._inflation, margins=margins) if follows else None
        self._short = ShortMargins(problem, self._inflation) if problem.uav_count > 1 else None
        self._lanes = self._frame.to_world(self._slots.offsets * np.array([0.0, 1.0, 1.0]))
        self._descent = Descent(problem)
        self._tilt_thrust = _is_fast(problem) if settings.tilt_thrust is None else settings.tilt_thrust
        self._period_s = 1.0 / settings.rate_hz
        step = stage_grid(self._period_s, settings.horizon, settings.look_ahead_s)
        self._grid = np.append(0.0, step)  # now, and the ends of the stages
        self._yaw = self._frame.heading_rad
        self._model = horizon_model(problem.vehicle, self._yaw, step, *weights(settings, problem.vehicle))
        self._solver_name = settings.solver if solver is None else solver if isinstance(solver, str) else None
        solver = _solver_of(problem) if solver is None else solver
        self._solver = make_batch_solver(solver) if isinstance(solver, str) else solver
        self._layout: Layout | None = None
        hover = mixer_inverse(problem.vehicle) @ hover_input(problem.vehicle)
        self._limits = AcceptanceLimits.of(
            self._model, mixer_inverse(problem.vehicle), -hover, rotor_limit(problem.vehicle) - hover
        )
        self.reset(ObstacleSet.empty(), 0)

    def __getstate__(self) -> dict[str, Any]:
        """What a copy takes along; a solver that has a name is made anew, without its workspace.

        Arrays of a workspace share memory. Those of a copy do not: it would solve something else.
        """
        state = vars(self).copy()
        if self._solver_name is not None:
            del state["_solver"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Become what was taken along."""
        vars(self).update(state)
        if self._solver_name is not None:
            self._solver = make_batch_solver(self._solver_name)
        # What is counted stands in one array, and in the tally by name.
        counted: Tally = state["tally"]
        self.tally = replace(counted, counts=Tally.over(self._counts).counts)

    @property
    def name(self) -> str:
        """Name in tables and files."""
        return self._name

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        """Take a new map; forget plans, workspaces and fall-backs."""
        check_map(obstacles, runs)
        uavs = len(self._lanes)
        self._last_s = -math.inf
        self._obstacles = obstacles
        self._solver.reset()
        self._plan: Plan | None = None
        self._answer: BatchResult | None = None
        self._tracks: Tracks | None = None
        self._last_horizon: Horizon | None = None
        self._made_s: Array = np.full((runs, uavs), -np.inf)
        self._anchor: Array = np.repeat(self._lanes[None], runs, axis=0)
        self._yaws: Array = np.full((runs, uavs), self._yaw)
        if self._guidance is not None:
            self._guidance.reset(obstacles, runs)
        self.ladder = Ladder(runs, uavs)
        self._descent.reset(obstacles, runs, uavs)
        self._counts = np.zeros((len(COLUMNS), runs), dtype=np.int64)
        self.tally = replace(Tally.over(self._counts), events=self.ladder.events)
        self._outlines: list[Hashable] = []

    def build(self, nav: NavSolution, time_s: float) -> HorizonQp:
        """Programs of this step without a guide; the origin is where each UAV is reported to be."""
        check_told(nav, self.problem, len(self._anchor), time_s, self._last_s)
        nav = self._inflation.informed(nav)
        trusted = nav.trusted()
        state = self._state(nav, trusted)
        carried = self._carried(state, time_s)
        covariance = self._covariance(nav, trusted, self._planned(state, carried))
        reference, way = self._references(state, carried, nav, covariance, trusted, None)
        guess, _ = self._guess(state, way, carried, time_s)
        horizon = self._horizon(_place(state), guess, covariance, nav, trusted, time_s)
        return self._programs(state, _place(state), reference, horizon)

    def step(self, nav: NavSolution, time_s: float) -> Command:
        """Solve this step's programs and command what was accepted, or what the ladder says.

        Raises
        ------
        NavigationError
            If the solution does not fit the problem and the runs of :meth:`reset`, see :mod:`.told`.
        """
        check_told(nav, self.problem, len(self._anchor), time_s, self._last_s)
        self._last_s = time_s
        nav = self._inflation.informed(nav)
        airborne = np.ones(nav.available.shape, dtype=bool) if nav.airborne is None else nav.airborne
        trusted = nav.trusted() & airborne
        self._tracks = nav.tracks
        placed = trusted
        if self._inflation.safety == "protection_level":
            # A place held by a fix without a level would move with its error: hold by velocity.
            placed = trusted | np.isfinite(nav.position).all(-1)
        passes.keep_place(plain(nav.position), placed, self._anchor)
        self._descent.note(nav, trusted)
        state = self._state(nav, trusted)
        place = _place(state)
        carried = self._carried(state, time_s)
        covariance = self._covariance(nav, trusted, self._planned(state, carried))
        guide = None
        if self._guidance is not None:
            expected = self.problem.planner.covariance in ("expected", "mapped")
            room = guidance_covariance(nav, trusted, covariance[:, :, -1] if expected else None)
            # Raw measurements jump by more than a taut way could gain.
            guide = self._guidance.step(
                place, room, trusted, time_s, taut=nav.filtered, flying=_runs_with(airborne),
                sigma_map=nav.sigma_map, measured=not nav.filtered,
            )  # fmt: skip
        reference, way = self._references(state, carried, nav, covariance, trusted, guide)
        began = 0.0 if self._clock is None else self._clock()
        guess = self._guess(state, way, carried, time_s)
        answer = self._solve(state, place, reference, guess, covariance, nav, trusted, time_s)
        late = self._clock is not None and not self._clock() - began <= self._period_s
        refused = refusals(answer, self._limits)
        accepted, upset = np.empty((2, *trusted.shape), dtype=np.bool_)
        everybody = passes.accept(refused, state, trusted, late, UPSET_RAD, upset, accepted)
        causes = None if everybody else _causes(answer, refused, upset, late, trusted, airborne)
        flown, action = self._choose(time_s, state, place, answer, accepted, trusted, upset, causes)
        self._plan, self._answer = flown, answer
        slack = self._contact_slack(answer, flown, accepted)
        passes.count(
            answer.status, _COLUMN, answer.iterations, action, accepted, trusted, airborne, slack,
            _ITERATIONS, self._counts, self.tally.largest_slack_m,
        )  # fmt: skip
        if self._short is not None:
            short = self._counts[_SHORT]
            self._short.count(nav.covariance, nav.common_factor, trusted, short)
        return self._command(action, trusted, flown, guide, slack, answer)

    def _command(
        self,
        action: Codes,
        trusted: Mask,
        flown: Plan,
        guide: Guide | None,
        slack: Array,
        answer: BatchResult,
    ) -> Command:
        """Fly the plans; where the ladder says so, hold the last known place, or go down there."""
        position, velocity, direction = vectors = np.empty((3, *self._anchor.shape))
        planned, holding = np.empty((2, *trusted.shape), dtype=np.bool_)
        reason = np.empty(trusted.shape, dtype=np.int8)
        waiting = np.zeros_like(reason) if guide is None else waiting_reasons(guide)
        passes.command(
            action, trusted, flown.initial, self._anchor, waiting, vectors, planned, holding, reason
        )
        return Command(
            position=position,
            velocity=velocity,
            direction=direction,
            yaw=self._yaws.copy(),
            holding=holding,
            feedforward=np.zeros((*trusted.shape, 4)),
            plan=flown,
            planned=planned,
            tilt_thrust=self._tilt_thrust,
            reason=reason,
            slack_m=slack,
            solver_status=_WORDS.take(answer.status),
        )

    def _to_be_corrected(self, nav: NavSolution, trusted: Mask, covariance: Array) -> Array:
        """Sigmas (run, uav, 3) along, left and up of what will prove to have been error [m].

        Of a measurement all of its error; of an estimate what the filter will have corrected at the end of
        the horizon, by its own covariance (run, uav, N, 3, 3). The rest of an estimate's error does not
        depend on the estimate.
        """
        sigma = np.empty((*trusted.shape, 3))
        _along_axes(
            plain(nav.covariance), plain(covariance), nav.filtered, trusted, plain(self._frame.axes), sigma
        )
        return sigma

    def _state(self, nav: NavSolution, trusted: Mask) -> Array:
        """State (run, uav, 12) as reported; a UAV that is not trusted stands at its last known place."""
        state = np.empty((*trusted.shape, STATES))
        passes.report(
            plain(nav.position), plain(nav.velocity), plain(nav.attitude), plain(nav.body_rates), trusted,
            self._anchor, self._yaw, state,
        )  # fmt: skip
        return state

    def _carried(self, state: Array, time_s: float) -> tuple[Array, Array] | None:
        """States and inputs of the last plans on this step's grid, moved to where navigation is now."""
        if self._plan is None:
            return None
        states, inputs = self._plan.resampled(time_s, self._grid)
        moved, held = np.empty((*state.shape[:2], self._model.stages, STATES)), inputs[:, :, 1:]
        passes.follow(states, state, moved)
        return moved, plain(held)

    def _references(
        self,
        state: Array,
        carried: tuple[Array, Array] | None,
        nav: NavSolution,
        covariance: Array,
        trusted: Mask,
        guide: Guide | None,
    ) -> tuple[Array, Array]:
        """States (run, uav, N, 12) to track, and of the way that guidance has found."""
        times = self._model.times_s
        here = self._slots.here(state[..., POSITION], self._to_be_corrected(nav, trusted, covariance))
        settings = self.problem.planner
        loose = room = None
        if guide is None:
            free = reference = way = self._slots.over_from(here, times)
        else:
            if guide.taut is None:
                way = self._slots.over_from(here, times, guide)
                return way, way
            way, reference, free, loose, room = self._slots.ways_from(here, times, guide)
        if carried is None or len(self._lanes) < 2:
            return reference, way
        alike = reference, free, carried[0], trusted
        if loose is None or room is None:
            return drawn_together(*alike, settings.cohesion, self._frame), way
        if settings.room_m > 0.0:
            return gone_along(*alike, settings.cohesion, self._frame, loose, room, settings.room_m), way
        reference = drawn_together(*alike, settings.cohesion * loose, self._frame)
        return reference, way

    def _guess(
        self, state: Array, way: Array, carried: tuple[Array, Array] | None, time_s: float
    ) -> tuple[Array, Array]:
        """States and inputs at which rows are linear: last plans, or the guide's way for what is stuck."""
        step_s = self._model.step_s
        if carried is None:
            velocity = way[:, :, 0, VELOCITY]
            plan = straight_plan(self.problem.vehicle, self._yaw, time_s, step_s, state, velocity)
            carried = plan.resampled(time_s, step_s)
        states, inputs = carried
        if self._guidance is not None:
            # Rows made at a plan that stands before an obstacle hold it there: the guide's way leads past.
            frame, led = self._frame, np.empty_like(states)
            passes.take_way(
                states, way, state, plain(frame.origin), plain(frame.along), STUCK_M, STUCK_PART, led
            )
            states = led
        return states, inputs

    def _horizon(
        self, place: Array, guess: Array, covariance: Array, nav: NavSolution, trusted: Mask, time_s: float
    ) -> Horizon:
        position, velocity = np.empty((2, *guess.shape[:3], 3))
        passes.places(plain(guess), position, velocity)
        return Horizon(
            time_s=time_s,
            step_s=self._model.step_s,
            position=cut_at_obstacles(place, position, self._obstacles),
            velocity=velocity,
            covariance=covariance,
            common_factor=_shared_ahead(nav, trusted, covariance),
            obstacles=self._obstacles,
            frame=self._frame,
            problem=self.problem,
            tracks=nav.tracks,
        )

    def _covariance(self, nav: NavSolution, trusted: Mask, places: Array | None = None) -> Array:
        """Covariance of the position (run, uav, N, 3, 3) at the end of each stage, as the problem asks."""
        asked = self.problem.planner.covariance
        if asked == "held":
            covariance = np.repeat(nav.position_covariance[:, :, None], self._model.stages, axis=2)
        else:
            fixes = asked != "propagated"
            covariance = nav.position_covariance_ahead(self._model.times_s, fixes, places)
        if passes.everybody(trusted):
            return covariance
        return np.where(trusted[..., None, None, None], covariance, np.eye(3))

    def _planned(self, state: Array, carried: tuple[Array, Array] | None) -> Array | None:
        """Places (run, uav, N, 3) of the last plans, at first straight ahead; None without a sigma map."""
        if self.problem.planner.covariance != "mapped":
            return None
        if carried is not None:
            return _place(carried[0])
        assert isinstance(self.problem.mission, FormationMission)
        way = self.problem.mission.speed_mps * self._model.times_s[:, None] * self._frame.along
        return np.asarray(state[:, :, None, POSITION] + way)

    def _programs(self, state: Array, origin: Array, reference: Array, horizon: Horizon) -> HorizonQp:
        """Programs with each UAV's place as the origin: large coordinates would cost digits."""
        blocks: list[LinearRows] = [constraint.rows(horizon) for constraint in self.constraints]
        try:
            outlines: list[Hashable] = [horizon.shape, *[block.outline() for block in blocks]]
        except AttributeError:  # of what are no rows, or no arrays
            outlines = []
        if not outlines or outlines != self._outlines:
            check_outlines(self.constraints, blocks, horizon.shape)
            self._outlines = outlines
            self._answer = None  # it answers other rows, and is no guess
        blocks = [block.shifted(origin) if block.signal == "position" else block for block in blocks]
        initial = _moved(state[:, :, None], origin, -1.0)[:, :, 0]
        return HorizonQp(self._model, initial, _moved(reference, origin, -1.0), tuple(blocks))

    def _solve(
        self,
        state: Array,
        origin: Array,
        reference: Array,
        guess: tuple[Array, Array],
        covariance: Array,
        nav: NavSolution,
        trusted: Mask,
        time_s: float,
    ) -> BatchResult:
        """Answers in the world's coordinates, after as many passes as the problem asks for."""
        (states, inputs), answer = guess, self._answer
        asked = _runs_with(trusted)
        for turn in range(self.problem.planner.passes):
            if turn and answer is not None:
                better = np.asarray(np.isfinite(answer.states).all(axis=(2, 3), keepdims=True))
                states = np.where(better, _moved(answer.states, origin), states)
                inputs = np.where(better, answer.inputs, inputs)
            self._last_horizon = self._horizon(origin, states, covariance, nav, trusted, time_s)
            programs = self._programs(state, origin, reference, self._last_horizon)
            warm = None
            if self._answer is not None:
                warm = self._answer.warm_start(_moved(states, origin, -1.0), inputs)
            self._answer = answer = self._answer_to(programs, warm, asked)
            if turn + 1 < self.problem.planner.passes:
                # The last pass is counted with what becomes of it.
                passes.count_solves(
                    answer.status, _COLUMN, answer.iterations, trusted, _ITERATIONS, self._counts
                )
        assert answer is not None
        return answer

    def _answer_to(self, programs: HorizonQp, warm: WarmStart | None, asked: Mask) -> BatchResult:
        """Answer of the solver; one that fails altogether has failed in all programs."""
        try:
            answer = self._solver.solve_batch(programs, warm, asked)
            if judges_itself(self._solver):
                return answer
            if self._layout is None or not self._layout.same_rows(programs):
                self._layout = Layout.of(programs)
            return judged(self._layout, programs, answer)
        except NapfError:
            raise  # rows that do not fit, a model that is not sound: to be mended, not flown around
        except Exception as error:
            self._solver.reset()
            return BatchResult.failed(programs, f"{type(error).__name__}: {error}")

    def _choose(
        self,
        time_s: float,
        state: Array,
        origin: Array,
        answer: BatchResult,
        accepted: Mask,
        trusted: Mask,
        upset: Mask,
        causes: NDArray[np.object_] | None,
    ) -> tuple[Plan, Codes]:
        """Plans that fly from now on, and by which rung of the ladder; no causes if all were accepted."""
        old, step_s = self._plan, self._model.step_s
        new = Plan(
            self.problem.vehicle, self._yaw, time_s, step_s, state, _moved(answer.states, origin),
            plain(answer.inputs),
        )  # fmt: skip
        if causes is None:
            self._made_s[:] = time_s
            self._descent.release()
            return new, self.ladder.all_accepted()
        still = standing_plan(self.problem.vehicle, self._yaw, time_s, step_s, self._anchor)
        # Without navigation nothing tells whether the tail is followed; upset, it cannot be.
        clear, tail = trusted & ~upset & ~accepted, still
        if clear.any():
            tail = still if old is None else old.resumed(time_s, step_s)
            clear &= self._clearance(tail) >= 0.0
        age_s = time_s - self._made_s
        action = self.ladder.decide(
            time_s, accepted, age_s, clear, causes,
            lambda hover: self._descent.lower(time_s, hover, self._anchor),
        )  # fmt: skip
        self._made_s = np.where(accepted, time_s, self._made_s)
        return new.where(accepted, tail.where(action == Action.TAIL, still)), action

    def _clearance(self, plan: Plan) -> Array:
        """Least distance (run, uav) of a plan's nodes to the obstacles, less the radius [m]."""
        runs, uavs, stages = plan.states.shape[:3]
        points = np.ascontiguousarray(plan.states[..., POSITION].reshape(runs, uavs * stages, 3))
        distance = self._obstacles.signed_distance(points).reshape(runs, uavs, stages)
        least = distance.min(-1)
        if self._tracks is not None:
            moving = self._tracks.least_distance(plan.states[..., POSITION], np.cumsum(plan.step_s))
            least = np.minimum(least, moving)
        return np.asarray(least - self.problem.vehicle.radius_m)

    def _contact_slack(self, answer: BatchResult, flown: Plan, accepted: Mask) -> Array:
        """Most that each new plan (run, uav) is inside an obstacle's margin, NaN without one [m]."""
        most: Array | None = None
        for constraint, slack in zip(self.constraints, answer.slacks, strict=True):
            if isinstance(constraint, ObstacleContact) and self._last_horizon is not None:
                # Not the slack: a row may ask for less than the margin, see its opening speed.
                found = constraint.shortfall(self._last_horizon, _place(flown.states))
            elif isinstance(constraint, MovingObstacleContact):
                found = slack.max(axis=(2, 3), initial=0.0)
            else:
                continue
            most = found if most is None else np.fmax(most, found)
        if most is None:
            return np.full(accepted.shape, np.nan)
        return most if passes.everybody(accepted) else np.where(accepted, most, np.nan)


def _solver_of(problem: Problem) -> BatchSolver:
    try:
        return make_batch_solver(problem.planner.solver)
    except SolverError as error:
        raise ProblemError("planner.solver", [str(error)]) from error


def _causes(
    answer: BatchResult, refused: Codes, upset: Mask, late: bool, trusted: Mask, airborne: Mask
) -> NDArray[np.object_]:
    """Words (run, uav) for why a plan was refused; an empty one for a UAV that does not fly."""
    words = _CAUSES[refused]
    for place, message in answer.messages.items():
        words[place] = f"{words[place]}: {message}"
    causes = np.where(upset, "upset", np.where(late, "late", words))
    return np.where(trusted, causes, np.where(airborne, "navigation", ""))


def _shared_ahead(nav: NavSolution, trusted: Mask, covariance: Array) -> Array:
    """Factor (run, uav, 3, rank) of what UAVs share of a covariance (run, uav, N, 3, 3) at all stages [m].

    What they share shrinks with the rest of an axis, at most as far as at the stage where that is smallest: a
    relative position must not pass for more certain than it is. What grows is each UAV's own. Who is not
    trusted shares nothing.
    """
    shared = np.empty(nav.common_factor.shape)
    passes.share(plain(nav.common_factor), plain(nav.covariance), plain(covariance), trusted, shared)
    return shared


def _place(state: Array) -> Array:
    """Positions (..., 3) of states (..., 12) [m]."""
    return np.ascontiguousarray(state[..., POSITION])


def _runs_with(mask: Mask) -> Mask:
    """Whether a mask (run, uav) is set for any UAV of each run (run,)."""
    some = np.empty(len(mask), dtype=np.bool_)
    passes.anybody(mask, some)
    return some


def _moved(states: Array, by: Array, sign: float = 1.0) -> Array:
    """States (run, uav, N, 12) with positions moved there or back, by (run, uav, 3) at all stages."""
    out = np.empty(states.shape)
    passes.move(states, by, sign, out)
    return out


@compiled
def _along_axes(now: Array, ahead: Array, filtered: bool, trusted: Mask, axes: Array, sigma: Array) -> None:
    """Write sigmas (run, uav, 3) along some axes, of what an estimate's error loses or of a measurement's.

    Covariances come as (run, uav, 6, 6) of now and (run, uav, N, 3, 3) of a plan's stages.
    """
    passing, last = np.empty((3, 3)), ahead.shape[2] - 1
    for run in range(sigma.shape[0]):
        for uav in range(sigma.shape[1]):
            for a in range(3):
                for b in range(3):
                    kept = ahead[run, uav, last, a, b] if filtered else 0.0
                    passing[a, b] = now[run, uav, a, b] - kept if trusted[run, uav] else 0.0
            for n in range(3):
                sigma[run, uav, n] = sigma_along(passing, axes[n, 0], axes[n, 1], axes[n, 2])
