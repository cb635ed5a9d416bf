"""Limits in metres, m/s, radians and newtons: what is inside, what is outside, and by how much."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.constraints.constraint import Constraint, ConstraintError, Horizon
from napf_mpc.constraints.contract import check_constraint, sample_horizon, sample_problem
from napf_mpc.constraints.limits import (
    AltitudeBand,
    Geofence,
    InputBox,
    RotorLimits,
    SpeedLimit,
    TiltLimit,
    inward_normals,
)
from napf_mpc.problem import Problem, Vehicle
from napf_mpc.safety_distance import Inflation
from napf_mpc.vehicle.quadrotor import hover_input, mixer, mixer_inverse, rotor_limit
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]
FIELD = ((0.0, 0.0), (30.0, 0.0), (30.0, 20.0), (0.0, 20.0))


def horizon(sigma_m: float = 1.0, **mission: Any) -> Horizon:
    """One run, four UAVs and two stages."""
    problem = Problem.model_validate(
        {
            "formation": {"shape": "square"},
            "mission": {"kind": "formation", "length_m": 100.0, "speed_mps": 2.0, **mission},
            "world": {"kind": "empty"},
        }
    )
    drawn = sample_horizon(np.random.default_rng(0), ObstacleSet.empty(), problem=problem, runs=1, stages=2)
    covariance = np.broadcast_to(sigma_m**2 * np.eye(3), drawn.covariance.shape).copy()
    return replace(drawn, covariance=covariance)


def outside(constraint: Constraint, signal: Array | list[float], at: Horizon) -> float:
    """Largest violation of a signal (dim,) that all UAVs have at all stages."""
    rows = constraint.rows(at)
    violation = rows.violation(np.broadcast_to(np.asarray(signal, dtype=float), (*at.shape, len(signal))))
    assert (violation == violation[:1, :1, :1]).all()
    return float(violation.max())


@pytest.mark.parametrize("heading_deg", [0.0, 30.0, -90.0])
@pytest.mark.parametrize("directions", [2, 3, 4])
def test_the_speed_polygon_is_inside_the_circle_and_touches_it_along_the_path(
    heading_deg: float, directions: int
) -> None:
    at, limit = horizon(heading_deg=heading_deg), SpeedLimit(max_mps=3.0, directions=directions)
    assert outside(limit, 2.999999 * at.frame.along, at) == 0.0
    assert outside(limit, 4.0 * at.frame.along, at) == pytest.approx(math.cos(0.5 * math.pi / directions))
    angle = np.linspace(-math.pi, math.pi, 721)
    circle = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    rows = limit.rows(at)
    assert rows.upper is not None
    reach = (rows.upper[0, 0, 0] / np.abs(circle @ rows.jac[0, 0, 0].T).clip(1e-12)).min(-1)
    assert reach.max() <= 3.0 + 1e-9
    assert reach.min() == pytest.approx(3.0 * math.cos(0.5 * math.pi / directions), rel=1e-3)


def test_the_speed_limit_follows_the_mission_and_holds_the_climb() -> None:
    at = horizon(speed_mps=4.0)
    along = at.frame.along
    assert outside(SpeedLimit(), 5.999 * along, at) == 0.0
    assert outside(SpeedLimit(), 6.1 * along, at) > 0.0
    climbing = SpeedLimit(max_climb_mps=1.0)
    assert outside(climbing, [0.0, 0.0, 1.75], at) == pytest.approx(0.75)
    assert outside(climbing, [0.0, 0.0, -1.75], at) == pytest.approx(0.75)


def test_tilt_is_roll_and_pitch_and_not_yaw() -> None:
    at, limit = horizon(), TiltLimit(0.4)
    assert outside(limit, [0.4, -0.4, 3.0], at) == 0.0
    assert outside(limit, [0.5, 0.0, 0.0], at) == pytest.approx(0.1)
    assert outside(limit, [0.0, -0.65, 0.0], at) == pytest.approx(0.25)


def test_the_altitude_band_is_in_metres_with_k_sigma_if_asked() -> None:
    at = horizon(sigma_m=1.0)
    band = AltitudeBand(40.0, 60.0)
    assert outside(band, [7.0, -3.0, 50.0], at) == 0.0
    assert outside(band, [0.0, 0.0, 38.5], at) == pytest.approx(1.5)
    assert outside(band, [0.0, 0.0, 60.25], at) == pytest.approx(0.25)
    careful = AltitudeBand(40.0, 60.0, Inflation(3.0))
    assert outside(careful, [0.0, 0.0, 43.0], at) == pytest.approx(0.0, abs=1e-12)
    assert outside(careful, [0.0, 0.0, 58.0], at) == pytest.approx(1.0)


def test_a_band_narrower_than_its_margins_shrinks_to_its_middle() -> None:
    at = horizon(sigma_m=5.0)
    rows = AltitudeBand(40.0, 60.0, Inflation(3.0)).rows(at)
    rows.check(at.shape)
    assert rows.lower == pytest.approx(50.0)
    assert rows.upper == pytest.approx(50.0)


def test_a_band_may_be_open_on_one_side() -> None:
    at = horizon()
    floor = AltitudeBand(min_m=2.0, inflation=Inflation(1.0))
    assert floor.rows(at).upper is None
    assert outside(floor, [0.0, 0.0, 1.0], at) == pytest.approx(2.0)
    assert outside(floor, [0.0, 0.0, 1e4], at) == 0.0
    assert AltitudeBand(max_m=2.0).rows(at).lower is None


def test_who_is_outside_is_asked_in_at_a_speed() -> None:
    """9 m under the band, 4 m over it, 6 m beside the fence; stages end after 1 and 3 s."""

    def missing(constraint: Constraint, place: tuple[float, float, float]) -> Array:
        at = replace(horizon(), step_s=np.array([1.0, 2.0]))
        position = np.broadcast_to(np.array(place), (*at.shape, 3)).copy()
        return constraint.rows(replace(at, position=position)).violation(position)[0, 0].max(-1)

    band, fence = AltitudeBand(40.0, 60.0), Geofence(FIELD)
    for constraint, place, whole in ((band, (0.0, 0.0, 31.0), 9.0), (band, (0.0, 0.0, 64.0), 4.0),
                                     (fence, (36.0, 10.0, 5.0), 6.0)):  # fmt: skip
        np.testing.assert_allclose(missing(constraint, place), whole)
        slowly = replace(constraint, opening_mps=1.5)  # type: ignore[type-var]
        np.testing.assert_allclose(missing(slowly, place), np.minimum(whole, (1.5, 4.5)))


@pytest.mark.parametrize("turned", [1, -1])
def test_the_geofence_is_in_metres_either_way_round(turned: int) -> None:
    at, fence = horizon(sigma_m=0.5), Geofence(FIELD[::turned])
    assert outside(fence, [15.0, 10.0, 99.0], at) == 0.0
    assert outside(fence, [-2.0, 10.0, 0.0], at) == pytest.approx(2.0)
    assert outside(fence, [31.0, 23.0, 0.0], at) == pytest.approx(3.0)
    careful = Geofence(FIELD[::turned], Inflation(2.0))
    # 0.3 m of UAV and two sigma of 0.5 m.
    assert outside(careful, [28.7, 10.0, 0.0], at) == pytest.approx(0.0, abs=1e-12)
    assert outside(careful, [29.7, 10.0, 0.0], at) == pytest.approx(1.0)


def test_the_normals_of_a_slanted_edge_have_length_one() -> None:
    normals, level = inward_normals([(0.0, 0.0), (4.0, 0.0), (0.0, 3.0)])
    assert normals == pytest.approx(np.array([(0.0, 1.0), (-0.6, -0.8), (1.0, 0.0)]))
    assert level == pytest.approx([0.0, -2.4, 0.0])


@pytest.mark.parametrize(
    "corners",
    [
        FIELD[:2],
        (*FIELD[:3], (15.0, 15.0), FIELD[3]),  # a dent
        (FIELD[0], FIELD[2], FIELD[1], FIELD[3]),  # crossed
        (*FIELD, FIELD[0]),  # closed twice
        ((0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (0.0, 1.0)),  # a corner on a line
        ((0.0, 0.0), (np.nan, 0.0), (0.0, 1.0)),
        tuple((math.cos(1.6 * math.pi * i / 2), math.sin(1.6 * math.pi * i / 2)) for i in range(5)),  # a star
    ],
)
def test_a_fence_that_is_not_convex_is_refused(corners: tuple[tuple[float, float], ...]) -> None:
    with pytest.raises(ConstraintError, match="corners_m"):
        Geofence(corners)


def test_rotor_rows_are_newtons_of_each_rotor() -> None:
    at = horizon()
    vehicle = at.problem.vehicle
    rows = RotorLimits().rows(at)
    assert not rows.soft
    most = rotor_limit(vehicle)

    def about_hover(*thrusts: float) -> Array:
        return mixer(vehicle) @ np.array(thrusts) - hover_input(vehicle)

    assert outside(RotorLimits(), about_hover(1.0, 2.0, 3.0, 4.0), at) == 0.0
    assert outside(RotorLimits(), about_hover(0.0, most, 0.0, most), at) == pytest.approx(0.0, abs=1e-12)
    assert outside(RotorLimits(), about_hover(1.0, 2.0, -0.5, 2.0), at) == pytest.approx(0.5)
    assert outside(RotorLimits(), about_hover(1.0, most + 0.25, 1.0, 2.0), at) == pytest.approx(0.25)
    kept = RotorLimits(reserve=0.1)
    assert outside(kept, about_hover(0.0, 2.0, 2.0, 2.0), at) == pytest.approx(0.1 * most)
    assert outside(kept, about_hover(most, 2.0, 2.0, 2.0), at) == pytest.approx(0.1 * most)


def test_a_reserve_that_hover_itself_needs_is_refused() -> None:
    given = sample_problem()
    weak = given.model_copy(update={"vehicle": given.vehicle.model_copy(update={"thrust_to_weight": 1.1})})
    at = replace(horizon(), problem=weak)
    RotorLimits(reserve=0.05).rows(at)
    with pytest.raises(ConstraintError, match="hover needs"):
        RotorLimits(reserve=0.15).rows(at)


@pytest.mark.parametrize(
    "constraint",
    [
        SpeedLimit(),
        SpeedLimit(1.0, 0.5, directions=2),
        TiltLimit(),
        AltitudeBand(-5.0, 8.0),
        AltitudeBand(-1.0, 1.0, Inflation(3.0)),
        AltitudeBand(min_m=2.0, inflation=Inflation(3.0, reading="largest")),
        Geofence(FIELD),
        Geofence(FIELD[::-1], Inflation(3.0)),
        AltitudeBand(-5.0, 8.0, opening_mps=2.0),
        Geofence(FIELD, opening_mps=2.0),
        RotorLimits(),
    ],
    ids=lambda constraint: constraint.name,
)
def test_contract(constraint: Constraint) -> None:
    check_constraint(constraint)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: SpeedLimit(max_mps=0.0), "max_mps"),
        (lambda: SpeedLimit(max_climb_mps=np.nan), "max_climb_mps"),
        (lambda: SpeedLimit(directions=1), "directions"),
        (lambda: TiltLimit(-1.0), "max_rad"),
        (lambda: AltitudeBand(5.0, 5.0), "min_m"),
        (lambda: AltitudeBand(np.nan, 5.0), "min_m"),
        (lambda: AltitudeBand(), "min_m"),
        (lambda: AltitudeBand(0.0, 5.0, opening_mps=0.0), "opening_mps"),
        (lambda: Geofence(FIELD, opening_mps=np.nan), "opening_mps"),
        (lambda: RotorLimits(0.5), "reserve"),
    ],
)
def test_settings_that_mean_nothing_are_refused(make: Any, name: str) -> None:
    with pytest.raises(ConstraintError, match=name):
        make()


@pytest.mark.parametrize("thrust_to_weight", [1.05, 1.5, 2.2, 5.0])
def test_every_input_of_the_box_is_one_that_the_rotors_give(thrust_to_weight: float) -> None:
    vehicle = Vehicle(thrust_to_weight=thrust_to_weight)
    lower, upper = InputBox().bounds(vehicle)
    assert (lower < 0.0).all()
    assert (upper > 0.0).all()
    corners = np.array(np.meshgrid(*zip(lower, upper, strict=True))).reshape(4, -1).T
    thrusts = (corners + hover_input(vehicle)) @ mixer_inverse(vehicle).T
    assert thrusts.min() > -1e-12
    assert thrusts.max() < rotor_limit(vehicle) + 1e-12
    if thrust_to_weight == 5.0:  # nothing to shrink for
        assert upper[0] == pytest.approx(0.7 * vehicle.mass_kg * 9.80665, rel=2e-3)
        assert upper[1:] == pytest.approx(np.array(vehicle.inertia_kgm2) * [25.0, 25.0, 5.0])


def test_the_box_holds_in_rows_as_it_is() -> None:
    drawn = horizon()
    rows = InputBox().rows(drawn)
    lower, upper = InputBox().bounds(drawn.problem.vehicle)
    assert not rows.soft
    assert rows.violation(np.broadcast_to(upper, (*drawn.shape, 4))).max() == pytest.approx(0.0, abs=1e-12)
    beyond = rows.violation(np.broadcast_to(upper + np.array([1.0, 0.0, 0.1, 0.0]), (*drawn.shape, 4)))
    assert beyond[0, 0, 0] == pytest.approx([1.0, 0.0, 0.1, 0.0])
    assert rows.violation(np.broadcast_to(lower - 0.5, (*drawn.shape, 4))) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"least_thrust": 1.0}, "least_thrust"),
        ({"most_thrust": 0.9}, "most_thrust"),
        ({"turn_radps2": 0.0}, "turn"),
    ],
)
def test_a_box_without_hover_is_refused(settings: dict[str, float], name: str) -> None:
    with pytest.raises(ConstraintError, match=name):
        InputBox(**settings)


@pytest.mark.parametrize("limit", [SpeedLimit(), TiltLimit(), InputBox()], ids=lambda limit: limit.name)
def test_rows_are_made_again_only_when_what_they_follow_from_changes(limit: Constraint) -> None:
    now = horizon()
    assert limit.rows(now) is limit.rows(now)
    faster, more = (
        horizon(speed_mps=3.0),
        sample_horizon(np.random.default_rng(1), ObstacleSet.empty(), runs=3),
    )
    heavier = replace(now, problem=now.problem.model_copy(update={"vehicle": Vehicle(mass_kg=2.0)}))
    for other in (faster, more, heavier, now):
        kept, fresh = limit.rows(other), type(limit)().rows(other)
        for name in ("jac", "lower", "upper", "w1", "w2"):
            if getattr(fresh, name) is not None:
                np.testing.assert_array_equal(getattr(kept, name), getattr(fresh, name))
