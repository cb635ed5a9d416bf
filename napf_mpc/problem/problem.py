"""A whole problem file."""

from __future__ import annotations

import hashlib

from pydantic import Field, model_validator

from napf_mpc.problem.formation import Formation, Listed, Square
from napf_mpc.problem.mission import GoalMission, Mission
from napf_mpc.problem.navigation import GaussMarkov, Gnss, Navigation, Recorded
from napf_mpc.problem.planner import Planner
from napf_mpc.problem.section import MAX_FIXES, Section
from napf_mpc.problem.simulation import Reference, Simulation
from napf_mpc.problem.vehicle import Vehicle
from napf_mpc.problem.world import World


class Problem(Section):
    """A whole problem file."""

    title: str = Field("", max_length=200)
    """One line for lists."""
    description: str = Field("", max_length=10_000)
    """What the problem is for."""
    source: str = Field("", max_length=2000)
    """Where its numbers come from."""
    vehicle: Vehicle = Vehicle()
    """The UAV."""
    formation: Formation
    """Who flies."""
    mission: Mission
    """Where to."""
    world: World
    """Among what."""
    navigation: Navigation = GaussMarkov()
    """With which navigation."""
    planner: Planner = Planner()
    """How it avoids."""
    simulation: Simulation = Simulation()
    """How it is simulated."""
    reference: Reference | None = None
    """Published figures to print beside the results."""

    @property
    def uav_count(self) -> int:
        """Number of UAVs."""
        match self.formation:
            case Square():
                return 4
            case Listed():
                return len(self.formation.offsets_m)
            case _:
                return self.formation.count

    def digest(self) -> str:
        """SHA-256 of everything that decides a result; words and the reference do not count."""
        words = {"title", "description", "source", "reference"}
        return hashlib.sha256(self.model_dump_json(exclude=words).encode()).hexdigest()

    @model_validator(mode="after")
    def _consistent(self) -> Problem:
        faults = [
            *self._initial_faults(), *self._rate_faults(), *self._size_faults(), *self._safety_faults()
        ]  # fmt: skip
        if isinstance(self.mission, GoalMission) and self.uav_count != 1:
            faults.append(f"formation has {self.uav_count} UAVs, a mission of kind goal needs exactly 1")
        if isinstance(self.mission, GoalMission) and self.planner.kind != "apf":
            faults.append(
                f'planner.kind = "{self.planner.kind}", a mission of kind goal is flown by "apf" only'
            )
        if isinstance(self.mission, GoalMission) and self.world.moving:
            faults.append("world.moving: a mission of kind goal is a walk without time; leave it out")
        if faults:
            raise ValueError("; ".join(faults))
        return self

    def _initial_faults(self) -> list[str]:
        if isinstance(self.mission, GoalMission):
            return []
        faults = []
        for key in ("initial_positions_m", "initial_velocities_mps"):
            rows = getattr(self.mission, key)
            if rows is not None and len(rows) != self.uav_count:
                faults.append(f"mission.{key} has {len(rows)} rows, the formation has {self.uav_count} UAVs")
        return faults

    def _safety_faults(self) -> list[str]:
        """What is to drive the safety distance must be told by navigation."""
        navigation = self.navigation
        if navigation.monitor != "none" and navigation.filter == "none":
            return [
                f'navigation.monitor = "{navigation.monitor}" watches a filter\'s innovations, and '
                'navigation.filter = "none" has none: set filter = "kalman" or "point_mass", or leave the '
                "monitor out"
            ]
        if self.planner.covariance == "mapped" and not isinstance(navigation, Gnss):
            return [
                'planner.covariance = "mapped" follows the satellites in sight of navigation.kind = "gnss": '
                f'navigation.kind = "{navigation.kind}" has none: use covariance = "expected"'
            ]
        if self.planner.open_sky_weight > 0.0:
            weight = f"planner.open_sky_weight = {self.planner.open_sky_weight:g}"
            if self.planner.covariance != "mapped":
                return [
                    f'{weight} reads a sigma map, planner.covariance = "{self.planner.covariance}" has none: '
                    'set covariance = "mapped" (with navigation.kind = "gnss"), or open_sky_weight = 0'
                ]
            if self.planner.guidance == "none" and self.planner.kind != "napf_guided":
                return [
                    f'{weight} is a price that guidance pays, and planner.guidance = "none" has none: set '
                    'guidance = "blended", or open_sky_weight = 0'
                ]
        if self.planner.cohesion_room_m:
            room = f"planner.cohesion_room_m = {self.planner.cohesion_room_m:g}"
            if self.planner.guidance == "none":
                return [
                    f'{room} is looked for by guidance, and planner.guidance = "none" has none: set '
                    'guidance = "blended", or leave cohesion_room_m out'
                ]
            if navigation.filter == "none":
                return [
                    f'{room} is for ways behind a filter, and navigation.filter = "none" has none: set '
                    'filter = "kalman" or "point_mass", or leave cohesion_room_m out'
                ]
        if self.planner.safety == "overbound":
            if not isinstance(navigation, Recorded):
                return [
                    f'planner.safety = "overbound": navigation.kind = "{navigation.kind}" has no log to fit '
                    'one to; use kind = "recorded", or safety = "k_sigma"'
                ]
            if navigation.part == "all":
                return [
                    'planner.safety = "overbound" is fitted to the half of the log that is not flown: set '
                    'navigation.part = "first_half" or "second_half"'
                ]
        if self.planner.safety == "protection_level" and navigation.filter != "none":
            return [
                'planner.safety = "protection_level" bounds the error of fixes, not of a filter\'s estimate: '
                'set navigation.filter = "none", or safety = "k_sigma"'
            ]
        silent = isinstance(navigation, Gnss) and navigation.integrity == "none"
        if self.planner.safety == "protection_level" and silent:
            return [
                'planner.safety = "protection_level": receivers compute levels with '
                'navigation.integrity = "araim" only; set it, or safety = "k_sigma"'
            ]
        return []

    def _size_faults(self) -> list[str]:
        """Each of these may be large, but not all of them at once."""
        limit_s, rate_hz = self.simulation.time_limit_s, self.navigation.rate_hz
        fixes = self.uav_count * limit_s * rate_hz
        if isinstance(self.mission, GoalMission) or fixes <= MAX_FIXES:
            return []
        return [
            f"{self.uav_count} UAVs, simulation.time_limit_s = {limit_s:g}, navigation.rate_hz = {rate_hz:g}"
            f" make {fixes:.3g} position fixes a run, must be <= {MAX_FIXES:.3g}: lower one of the three"
        ]

    def _rate_faults(self) -> list[str]:
        """Each slower rate must divide the faster one, so that every loop is a whole number of steps."""
        faults = []
        controller_hz = self.simulation.controller_rate_hz
        physics, controller = "1 / simulation.step_s", "simulation.controller_rate_hz"
        rates = [
            (controller, 1.0 / self.simulation.step_s, controller_hz, physics),
            ("planner.rate_hz", controller_hz, self.planner.rate_hz, controller),
            ("navigation.rate_hz", controller_hz, self.navigation.rate_hz, controller),
        ]
        if self.world.moving:
            rates.append(("world.moving_rate_hz", controller_hz, self.world.moving_rate_hz, controller))
        for name, fast_hz, slow_hz, fast in rates:
            ratio = fast_hz / slow_hz
            if ratio < 1.0 - 1e-9 or abs(ratio - round(ratio)) > 1e-6 * ratio:
                near_hz = fast_hz / max(1, round(ratio))
                faults.append(
                    f"{name} = {slow_hz:g} must divide {fast_hz:g} Hz a whole number of times, "
                    f"which is {fast} (take {near_hz:g}, or change both)"
                )
        return faults
