"""Guidance of a formation: how the virtual structure's own path bends around what its members cannot pass.

Every UAV has a lane; guidance tells it by how much to leave the lane over the next tens of metres, and how
fast to go. It sees what a planner sees, estimates and the map, and keeps the radius and k sigma from every
obstacle, with a little to spare. What cannot be passed with that margin is not squeezed through: the
formation slows, holds in front of it, and if the hold lasts too long, gives up with the reason "no safe
passage".
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from napf_mpc.constraints.passage import PassageMargins, half_space_margins
from napf_mpc.errors import ProblemError
from napf_mpc.formation import PathFrame, formation_offsets, synchronisation_error
from napf_mpc.jit import compiled_bare
from napf_mpc.navigation.sigma_map import SigmaMap
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.navigation.tracks import Tracks
from napf_mpc.planners.descent import ground_m
from napf_mpc.planners.guide import Guide, Passage
from napf_mpc.planners.guide_clearance import SolidBoxes, frame_of, solid_boxes
from napf_mpc.planners.guide_search import plan_all, resample_all, resample_taut
from napf_mpc.planners.guide_settings import FINE, GuidanceSettings, HeightRoom, search_of
from napf_mpc.planners.guide_sky import NO_SKY, SkyField, sky_field
from napf_mpc.planners.guide_traffic import TrafficPace, slowed
from napf_mpc.planners.passes import everybody
from napf_mpc.planners.room import room_outwards
from napf_mpc.planners.sigma_memory import SigmaMemory
from napf_mpc.planners.taut import Clearance, pulled_taut
from napf_mpc.problem import FormationMission, Problem
from napf_mpc.safety_distance import Inflation, rms_sigma
from napf_mpc.vehicle.plant import plain
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def guidance_covariance(nav: NavSolution, trusted: NDArray[np.bool_], ahead: Array | None) -> Array:
    """Covariance (run, uav, 3, 3) for which guidance leaves room [m^2].

    What lies beyond the planner's horizon is passed when navigation is as certain as it will be at its end,
    if fixes go on. In an outage, or if nothing is expected, it is taken to be as certain as now.

    Parameters
    ----------
    nav : NavSolution
        As reported.
    trusted : array of bool, shape (run, uav)
        Where it may be used; elsewhere the answer is a unit matrix.
    ahead : array, shape (run, uav, 3, 3), or None
        Covariance expected at the end of the horizon [m^2].
    """
    room = nav.position_covariance
    if ahead is not None:
        fixes = nav.available if nav.forecast is None else nav.forecast.fixes
        room = ahead if everybody(fixes) else np.where(fixes[..., None, None], ahead, room)
    return room if everybody(trusted) else np.where(trusted[..., None, None], room, np.eye(3))


class Guidance:
    """Plans the guide of all runs and remembers what has been decided.

    Parameters
    ----------
    problem : Problem
        Formation mission, sizes and speeds.
    inflation : Inflation
        Its k and its reading of sigma; guidance always takes k sigma as distance.
    settings : GuidanceSettings, optional
        Weights and limits.
    margins : PassageMargins, optional
        Sigmas to keep from spheres, by default k.
    """

    def __init__(
        self,
        problem: Problem,
        inflation: Inflation,
        settings: GuidanceSettings | None = None,
        margins: PassageMargins | None = None,
    ) -> None:
        if not isinstance(problem.mission, FormationMission):
            raise ProblemError("mission.kind", ['must be "formation" for guidance, not "goal"'])
        self.settings = (settings or GuidanceSettings()).at_speed(problem.mission.speed_mps)
        self._inflation = inflation
        self._path = PathFrame.of_mission(problem.mission)
        self._frame = frame_of(self._path)
        self._slots = formation_offsets(problem.formation)
        self._lanes = np.ascontiguousarray(self._slots[:, 1:])
        self._slots_along = np.ascontiguousarray(self._slots[:, 0])
        self._room_m = problem.planner.room_m
        self._min_separation = problem.vehicle.min_separation_m
        self._traffic = TrafficPace(
            self._path, problem.mission.speed_mps, problem.vehicle.radius_m, inflation
        )
        if margins is None:
            margins = half_space_margins(inflation.k)
        self._open_sky_weight = problem.planner.open_sky_weight
        finish = np.array([problem.mission.length_m, 0.0, 0.0])
        ends = self._path.to_world(np.concatenate([self._slots, self._slots + finish]))
        room = _height_room(problem, ends[:, 2])
        radius = problem.vehicle.radius_m
        self._search = search_of(self.settings, margins, radius, self._open_sky_weight, room)
        self._clearance = Clearance(
            inflation.k,
            problem.vehicle.radius_m,
            problem.planner.contact_extra_m,
            problem.planner.contact_extra_sigmas,
        )
        self._blind = search_of(self.settings, margins, radius, room=room)
        stations = (self._search.lattice.stations - 1) * FINE + 1
        self._step_m = self._search.lattice.step_m / FINE
        self._bends = max(2, round(self.settings.bend_m / self._step_m) + 1)
        self.ahead_m: Array = self._step_m * np.arange(stations, dtype=np.float64)
        gap = self._slots[:, None] - self._slots[None]
        self._slot_distance = np.sqrt(gap[..., 0] ** 2 + gap[..., 1] ** 2 + gap[..., 2] ** 2)
        self.reset(ObstacleSet.empty(), 0)

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        """Take a new map and forget all plans."""
        if runs:
            obstacles.check_runs(runs)
        uavs, stations = len(self._lanes), len(self.ahead_m)
        self._obstacles = obstacles
        self._boxes: SolidBoxes = solid_boxes(obstacles, self._path)
        self._profiles = np.zeros((runs, uavs, stations, 2))
        self._taut: tuple[Array, Array, Array] | None = None
        self._missing = np.zeros((runs, uavs, stations))
        self._kept = np.zeros((runs, uavs, stations))
        self._paid = np.zeros((runs, uavs + 1, 2))
        self._sigma_map: SigmaMap | None = None
        self._sky: SkyField = NO_SKY
        self._busy = np.zeros(runs, dtype=bool)
        self._far = np.zeros(runs, dtype=bool)
        self._planned_at = np.zeros((runs, uavs))
        self._position = np.repeat(self._path.to_world(self._slots)[None], runs, axis=0)
        self._covariance = np.tile(np.eye(3), (runs, uavs, 1, 1))
        self._memory = SigmaMemory(runs, uavs, self.settings.memory_s)
        self._next_s = -np.inf
        self._last_s = np.nan
        self._holding = np.zeros(runs, dtype=bool)
        self._held_s = np.zeros(runs)
        self._stuck = np.zeros(runs, dtype=bool)
        self._squeezing = np.zeros(runs, dtype=bool)
        self._given_up = np.zeros(runs, dtype=bool)
        self._pace = np.ones(runs)
        self._traffic_pace = np.ones(runs)

    def step(
        self,
        position: Array,
        covariance: Array,
        trusted: NDArray[np.bool_],
        time_s: float,
        tracks: Tracks | None = None,
        taut: bool = False,
        flying: NDArray[np.bool_] | None = None,
        sigma_map: SigmaMap | None = None,
        measured: bool = False,
    ) -> Guide:
        """Guide from what navigation reports; plans anew when its period has passed.

        Parameters
        ----------
        position : array, shape (run, uav, 3)
            Estimates [m].
        covariance : array, shape (run, uav, 3, 3)
            Of the position, to leave room for; see :func:`guidance_covariance` [m^2].
        trusted : array of bool, shape (run, uav)
            Where the estimate may be used; elsewhere the last trusted one is.
        time_s : float
            Time since the start [s].
        tracks : Tracks, optional
            Moving obstacles to slow down for.
        taut : bool
            Whether new plans come with their taut ways, see :mod:`.taut`.
        flying : array of bool, shape (run,), optional
            Runs that still fly; the others keep the plans they have.
        sigma_map : SigmaMap, optional
            Where fixes will be good; read only with ``planner.open_sky_weight``.
        measured : bool
            Whether the covariance is that of raw measurements, which says nothing of later ones: then room is
            left for what it was in the last seconds, too, see :mod:`.sigma_memory`.

        Returns
        -------
        Guide
            Offsets from where each UAV is now.
        """
        place, (along, sigma) = np.empty(position.shape), np.empty((2, *trusted.shape))
        _note(
            plain(position), plain(covariance), trusted, self._path.origin, self._path.axes, self._position,
            self._covariance, place, along, sigma,
        )  # fmt: skip
        due = time_s >= self._next_s - 1e-9
        if due:
            self._look_up(sigma_map)
            elapsed = 0.0 if np.isnan(self._last_s) else time_s - self._last_s
            asked = ~self._given_up if flying is None else flying & ~self._given_up
            self._plan(place, elapsed, taut, measured, asked)
            self._last_s = time_s
            self._next_s = time_s + self.settings.period_s
        guide = self._guide(along, sigma)
        if tracks is None or not tracks.count:
            return guide
        if due:
            self._traffic_pace = self._traffic.pace(
                self._position, self._covariance, guide, tracks, self._traffic_pace
            )
        return slowed(guide, self._traffic_pace)

    def _from(self, along: Array) -> Array:
        """Profiles (run, uav, station, 2) as seen from along-track places (run, uav)."""
        out = np.empty(self._profiles.shape)
        resample_all(self._profiles, along - self._planned_at, self._step_m, out)
        return out

    def _look_up(self, sigma_map: SigmaMap | None) -> None:
        """Take a new map of the sky, if there is one and anybody asks."""
        if self._open_sky_weight <= 0.0 or sigma_map is self._sigma_map:
            return
        self._sigma_map, self._sky = sigma_map, NO_SKY
        self._kept[:] = 0.0
        if sigma_map is not None:
            # Places are looked up along, left and up of this path.
            assert np.array_equal(sigma_map.frame.axes, self._path.axes)
            assert np.array_equal(sigma_map.frame.origin, self._path.origin)
            self._sky = sky_field(sigma_map)

    def _plan(
        self, place: Array, elapsed_s: float, taut: bool, measured: bool, asked: NDArray[np.bool_]
    ) -> None:
        # Stations stand still in the world: a gap must not open and close with where the samples fall.
        step = self.settings.step_m
        along = np.floor(place[..., 0] / step) * step
        last = self._from(along)
        offset = np.ascontiguousarray(place[..., 1:]) - self._lanes
        margin = np.ascontiguousarray(self._inflation.margin_covariance(self._covariance))
        if measured:
            margin = self._memory.raised(margin, elapsed_s)
        plan_all(
            self._obstacles.solids,
            self._boxes,
            self._obstacles.scene_start,
            self._frame,
            self._sky,
            asked,
            along,
            offset,
            self._lanes,
            margin,
            self._separation(margin),
            last,
            self._stuck,
            self._blind if self._sky is NO_SKY else self._search,
            self._profiles,
            self._missing,
            self._kept,
            self._paid,
            self._busy,
            self._far,
        )
        self._planned_at = along
        self._taut = None
        if taut:
            there = (
                self._profiles, along, self._step_m, self._lanes, self._frame, self._obstacles, margin,
                self._clearance,
            )  # fmt: skip
            farthest = np.where(self._far, self.settings.taut_m, np.inf)
            pulled, loose = pulled_taut(*there, self.settings.taut_slope, self._kept, farthest)
            room = np.zeros(loose.shape)
            if self._room_m > 0.0:
                room = room_outwards(*there, self._room_m)
            self._taut = pulled, loose, room
        self._hold(place[..., 0] - along, offset, elapsed_s, measured)

    def _separation(self, covariance: Array) -> Array:
        """Distances (run, uav, uav) to keep between UAVs: k sigma of both, as far as slots allow."""
        variance = rms_sigma(covariance) ** 2
        wanted = self._min_separation + self._inflation.k * np.sqrt(variance[:, :, None] + variance[:, None])
        return np.minimum(wanted, self.settings.apart_share * self._slot_distance)

    def _hold(self, past: Array, offset: Array, elapsed_s: float, measured: bool) -> None:
        """Decide per run how fast to go on, from what is blocked ahead and how near it is."""
        settings = self.settings
        distance, squeezed, aside, slope, sigma = np.empty((5, len(offset)))
        _largest_sigma(self._covariance, sigma)
        k = max(self._inflation.k, settings.measured_k) if measured else self._inflation.k
        margin = k * sigma
        scale = np.maximum(1.0, margin / settings.usual_margin_m) ** settings.tolerance_power
        few, many = settings.tolerance_m * scale, max(settings.tolerance_m, settings.squeeze_m) * scale
        _measure(
            self._missing, self._profiles, past, offset, self.ahead_m, settings.spare_m, few, many,
            self._bends, self._step_m, distance, squeezed, aside, slope,
        )  # fmt: skip
        self._squeezing &= distance <= settings.stop_m + settings.slow_m
        self._squeezing |= self._held_s >= settings.squeeze_after_s
        distance = np.where(self._squeezing, squeezed, distance)
        release = np.where(self._holding, settings.release_m, 0.0)
        self._holding = (distance <= settings.stop_m + release) | (self._stuck & (aside > settings.aside_m))
        self._pace = np.clip((distance - settings.stop_m) / settings.slow_m, 0.2, 1.0)
        # The steepest piece just ahead has to be flown.
        flown = np.clip(settings.flown_slope / np.maximum(slope, 1e-9), 0.3, 1.0)
        self._pace = np.minimum(self._pace, flown)
        self._held_s = np.where(
            self._holding, self._held_s + elapsed_s, np.maximum(0.0, self._held_s - elapsed_s)
        )
        self._stuck = self._holding & (self._stuck | (self._held_s >= settings.aside_after_s))
        self._given_up |= self._held_s >= settings.hold_limit_s

    def _guide(self, along: Array, sigma: Array) -> Guide:
        settings, offset = self.settings, self._from(along)
        error = synchronisation_error(along, self._slots_along)
        pace, breach = np.empty((2, *along.shape))
        reason = np.empty(along.shape, dtype=np.int8)
        _ask(
            offset, error, sigma, self._missing, settings.left_behind_m, settings.spare_m, self._pace,
            self._squeezing, self._holding, self._given_up, pace, reason, breach,
        )  # fmt: skip
        if self._taut is None:
            return Guide(self.ahead_m, offset, pace, reason, breach)
        taut, (loose, room) = np.empty(offset.shape), np.empty((2, *offset.shape[:3]))
        resample_taut(*self._taut, along - self._planned_at, self._step_m, taut, loose, room)
        return Guide(self.ahead_m, offset, pace, reason, breach, taut, loose, room)


def _height_room(problem: Problem, heights: Array) -> HeightRoom:
    """Room above and below lanes that reach such heights (n,) [m].

    Where neither the world nor an altitude band says what is below, and all lanes are above zero, the ground
    is taken to be where people mean it to be, at zero. With lanes at zero or below nothing is known of it.
    """
    lowest, highest = float(heights.min()), float(heights.max())
    ground, band = ground_m(problem), problem.planner.altitude_m
    if band is None:
        guessed = 0.0 if ground == -math.inf and lowest > 0.0 else ground
        return HeightRoom(ground_m=lowest - guessed)
    return HeightRoom(band[1] - highest, lowest - band[0], lowest - ground)


# Codes as plain numbers, for the compiled loop.
_NONE, _DETOUR, _WAIT, _SQUEEZE, _HOLD, _NO_PASSAGE = map(int, Passage)


@compiled_bare
def _note(
    position: Array, covariance: Array, trusted: Mask, origin: Array, axes: Array, known_position: Array,
    known_covariance: Array, place: Array, along: Array, sigma: Array,
) -> None:  # fmt: skip
    """Write what is trusted over what was known, and where that is on the path.

    Parameters
    ----------
    position, covariance : array, shapes (run, uav, 3) and (run, uav, 3, 3)
        As reported [m], [m^2].
    trusted : array of bool, shape (run, uav)
        Where it may be used.
    origin, axes : array, shapes (3,) and (3, 3)
        Of the path; rows along, left, up.
    known_position, known_covariance : array, shapes (run, uav, 3) and (run, uav, 3, 3)
        Written over.
    place, along, sigma : array, shapes (run, uav, 3), (run, uav) and (run, uav)
        Out: on the path, the first of it, and the standard deviation along the path [m].
    """
    for run in range(along.shape[0]):
        for uav in range(along.shape[1]):
            p, c, variance = known_position[run, uav], known_covariance[run, uav], 0.0
            if trusted[run, uav]:
                for a in range(3):
                    p[a] = position[run, uav, a]
                    for b in range(3):
                        c[a, b] = covariance[run, uav, a, b]
            x, y, z = p[0] - origin[0], p[1] - origin[1], p[2] - origin[2]
            for a in range(3):
                place[run, uav, a] = x * axes[a, 0] + y * axes[a, 1] + z * axes[a, 2]
                for b in range(3):
                    variance += c[a, b] * axes[0, a] * axes[0, b]
            along[run, uav], sigma[run, uav] = place[run, uav, 0], math.sqrt(max(variance, 0.0))


@compiled_bare
def _largest_sigma(covariance: Array, sigma: Array) -> None:
    """Write the largest :func:`~napf_mpc.safety_distance.rms_sigma` of each run (run,) [m]."""
    for run in range(sigma.shape[0]):
        sigma[run] = 0.0
        for uav in range(covariance.shape[1]):
            c = covariance[run, uav]
            rms = math.sqrt(max(c[0, 0] + c[1, 1] + c[2, 2], 0.0) / 3.0)
            sigma[run] = max(sigma[run], rms)


@compiled_bare
def _measure(
    missing: Array, profiles: Array, past: Array, offset: Array, ahead_m: Array, spare_m: float,
    few_m: Array, many_m: Array, bends: int, step_m: float, distance: Array, squeezed: Array, aside: Array,
    slope: Array,
) -> None:  # fmt: skip
    """Write what there is to decide from, of the ways ahead of each run.

    Parameters
    ----------
    missing, profiles : array, shapes (run, uav, station) and (run, uav, station, 2)
        Of the last plan [m].
    past, offset : array, shape (run, uav) and (run, uav, 2)
        How far UAVs are past the first station, and their offsets now [m].
    ahead_m : array, shape (station,)
        [m].
    spare_m : float
        What may be missing [m].
    few_m, many_m : array, shape (run,)
        What is tolerated of a breach, and in a squeeze [m].
    bends : int
        Stations just ahead.
    step_m : float
        From station to station [m].
    distance, squeezed : array, shape (run,)
        Out: to the first breach that is not tolerated, endless for none [m].
    aside : array, shape (run,)
        Out: most that a UAV is off its profile, left or up [m].
    slope : array, shape (run,)
        Out: of the steepest piece just ahead.
    """
    for run in range(distance.shape[0]):
        distance[run] = squeezed[run] = np.inf
        aside[run] = slope[run] = 0.0
        for uav in range(missing.shape[1]):
            way = profiles[run, uav]
            # Where a UAV is already inside the margin, a way that gets no worse leads out.
            here = max(missing[run, uav, 0] - spare_m, missing[run, uav, 1] - spare_m, 0.0)
            for s in range(missing.shape[2]):
                worse = max(missing[run, uav, s] - spare_m, 0.0) - here
                if worse > few_m[run]:
                    distance[run] = min(distance[run], ahead_m[s])
                if worse > many_m[run]:
                    squeezed[run] = min(squeezed[run], ahead_m[s])
            # The first station is up to a step behind: on a steep way that is metres aside.
            # At places that no UAV can be at, rounding of its station is larger than all of the way.
            stations = min(max(past[run, uav] / step_m, 0.0), way.shape[0] - 1.0)
            lower = min(int(stations), way.shape[0] - 2)
            part = stations - lower
            for a in range(2):
                there = (1.0 - part) * way[lower, a] + part * way[lower + 1, a]
                aside[run] = max(aside[run], abs(there - offset[run, uav, a]))
            for s in range(min(bends, way.shape[0]) - 1):
                left, up = (way[s + 1, 0] - way[s, 0]) / step_m, (way[s + 1, 1] - way[s, 1]) / step_m
                slope[run] = max(slope[run], math.sqrt(left * left + up * up))


@compiled_bare
def _ask(
    offset: Array, error: Array, sigma: Array, missing: Array, left_behind_m: float, spare_m: float,
    run_pace: Array, squeezing: Mask, holding: Mask, given_up: Mask, pace: Array, reason: NDArray[np.int8],
    breach: Array,
) -> None:  # fmt: skip
    """Write pace, reason and breach (run, uav) of a :class:`~.guide.Guide`.

    Parameters
    ----------
    offset, missing : array, shapes (run, uav, station, 2) and (run, uav, station)
        Profiles from where the UAVs are, and the shortfalls of the last plan [m].
    error, sigma : array, shape (run, uav)
        Synchronisation errors, and standard deviations along the path [m].
    left_behind_m, spare_m : float
        Settings.
    run_pace : array, shape (run,)
        As the ways ahead allow.
    squeezing, holding, given_up : array of bool, shape (run,)
        What has been decided.
    """
    for run in range(pace.shape[0]):
        worst = -np.inf
        for uav in range(pace.shape[1]):
            worst = max(worst, -error[run, uav] - left_behind_m - 2.0 * sigma[run, uav])
        late = min(max(1.0 - 0.25 * worst, 0.2), 1.0)
        for uav in range(pace.shape[1]):
            wait = late if worst > 0.0 and error[run, uav] > 0.0 else 1.0
            stopped = holding[run] or given_up[run]
            pace[run, uav] = 0.0 if stopped else min(wait, run_pace[run])
            code, short = _NONE, 0.0
            for s in range(offset.shape[2]):
                left, up = offset[run, uav, s, 0], offset[run, uav, s, 1]
                if math.sqrt(left * left + up * up) > 0.5:
                    code = _DETOUR
                short = max(short, missing[run, uav, s])
            if wait < 1.0:
                code = _WAIT
            if squeezing[run]:
                code = _SQUEEZE
            if holding[run]:
                code = _HOLD
            if given_up[run]:
                code = _NO_PASSAGE
            reason[run, uav] = code
            breach[run, uav] = max(short - spare_m, 0.0)
