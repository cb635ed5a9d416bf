"""Rules between the keys of a problem."""

from typing import Any

import pytest
from pydantic import ValidationError

from napf_mpc.problem import (
    City,
    CylinderObstacle,
    GaussMarkov,
    Lanes,
    Planner,
    PrismObstacle,
    Problem,
    Square,
    Vehicle,
)
from napf_mpc.problem_file import load_problem


def problem(**sections: Any) -> Problem:
    given: dict[str, Any] = {
        "formation": {"shape": "square"},
        "mission": {"kind": "formation", "length_m": 100.0},
        "world": {"kind": "empty"},
    }
    return Problem.model_validate(given | sections)


def test_defaults_are_the_papers() -> None:
    vehicle = Vehicle()
    assert vehicle.mass_kg == 1.0
    assert vehicle.inertia_kgm2 == (8.1e-3, 8.1e-3, 14.2e-3)
    assert (vehicle.lift_coefficient, vehicle.drag_coefficient) == (54.2e-6, 4.2e-6)
    assert vehicle.lqr_q_diagonal == (0.1,) * 12
    assert vehicle.lqr_r_diagonal == (0.1, 10.0, 100.0, 10.0)
    assert (Square(shape="square").side_m, Square(shape="square").first_lane_m) == (10.0, 3.0)
    assert Square(shape="square").sync_gain == -0.5
    assert (GaussMarkov().sigma_min_m, GaussMarkov().sigma_max_m) == (1.0, 5.0)
    assert (Planner().influence_m, Planner().repulsive_gain, Planner().max_turn_deg) == (3.0, 15.0, 60.0)


@pytest.mark.parametrize(
    ("formation", "count"),
    [
        ({"shape": "square"}, 4),
        ({"shape": "line", "count": 1}, 1),
        ({"shape": "v", "count": 7}, 7),
        ({"shape": "circle", "count": 12}, 12),
        ({"shape": "list", "offsets_m": ((0.0, 0.0, 0.0), (5.0, 0.0, 0.0))}, 2),
    ],
)
def test_uav_count_follows_the_formation(formation: dict[str, Any], count: int) -> None:
    assert problem(formation=formation).uav_count == count
    rows = ((0.0, 0.0, 0.0),) * count
    mission = {"kind": "formation", "length_m": 100.0, "initial_positions_m": rows}
    assert problem(formation=formation, mission=mission).uav_count == count
    mission["initial_positions_m"] = (*rows, (0.0, 0.0, 0.0))
    with pytest.raises(ValidationError, match=f"has {count + 1} rows, the formation has {count} UAVs"):
        problem(formation=formation, mission=mission)


@pytest.mark.parametrize(
    ("controller", "planner", "navigation", "step", "right"),
    [
        (50.0, 10.0, 10.0, 0.02, True),
        (100.0, 20.0, 10.0, 0.01, True),
        (50.0, 50.0, 1.0, 0.02, True),
        (50.0, 3.0, 10.0, 0.02, False),  # 16.67 inner steps a plan
        (50.0, 10.0, 100.0, 0.02, False),  # fixes faster than the inner loop
        (60.0, 10.0, 10.0, 0.02, False),  # the inner loop faster than physics
        (50.0, 10.0, 10.0, 0.015, False),
        (50.0, 10.0, 10.0, 0.005, True),
    ],
)
def test_each_rate_divides_the_faster_one(
    controller: float, planner: float, navigation: float, step: float, right: bool
) -> None:
    sections: dict[str, Any] = {
        "simulation": {"controller_rate_hz": controller, "step_s": step},
        "planner": {"rate_hz": planner},
        "navigation": {"kind": "gauss_markov", "rate_hz": navigation},
    }
    if right:
        assert problem(**sections).simulation.step_s == step
    else:
        with pytest.raises(ValidationError, match="must divide"):
            problem(**sections)


def test_one_measure_of_confidence() -> None:
    with pytest.raises(ValidationError, match="exactly one of k and confidence"):
        Planner(k=3.0, confidence=0.99)
    with pytest.raises(ValidationError, match="needs confidence"):
        Planner(sigma="chi2", k=3.0)
    with pytest.raises(ValidationError, match="1e-12"):
        Planner(confidence=1.0 - 1e-14)  # k would be infinite
    assert Planner(sigma="chi2", confidence=0.99).confidence == 0.99


def test_a_height_band_is_only_kept_if_asked_for() -> None:
    assert Planner().altitude_m is None
    assert Planner(altitude_m=(-2.0, 3.0)).altitude_m == (-2.0, 3.0)
    # Among the towers: no roof of the map is below 60 m, so none is to be passed under.
    assert load_problem("nishi_shinjuku").planner.altitude_m == (70.0, 120.0)


CYLINDER = {"shape": "cylinder", "centre_m": (0.0, 0.0), "radius_m": 1.0}
PRISM = {"shape": "prism", "footprint_m": ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)), "top_m": 1.0}


@pytest.mark.parametrize(
    ("model", "values", "words"),
    [
        (Square, {"shape": "square", "side_m": 4.0}, "first_lane_m = 3"),
        (GaussMarkov, {"sigma_min_m": 6.0}, "sigma_min_m = 6"),
        (Lanes, {"kind": "lanes", "radius_m": (2.0, 1.0)}, "low <= high"),
        (CylinderObstacle, CYLINDER | {"base_m": 2.0, "top_m": 2.0}, "top_m = 2"),
        (PrismObstacle, PRISM | {"footprint_m": ((0.0, 0.0), (1.0, 1.0), (2.0, 2.0))}, "enclose an area"),
        (
            PrismObstacle,
            PRISM | {"footprint_m": ((20, -5), (30, 5), (30, -5), (20, 5))},
            "they enclose cancels",
        ),
        (
            PrismObstacle,
            PRISM | {"footprint_m": ((20, -5), (30, 9), (30, -5), (20, 5))},
            "crosses or touches",
        ),
        (PrismObstacle, PRISM | {"base_m": 1.0}, "top_m = 1"),
        (City, {"kind": "city", "file": "x.geojson", "origin_latitude_deg": 35.0}, "go together"),
        (Planner, {"min_distance_m": 5.0}, "min_distance_m = 5"),
        (Planner, {"altitude_m": (5.0, 5.0)}, r"low < high, got \[5, 5\]"),
        (Planner, {"altitude_m": (120.0, 70.0)}, r"low < high, got \[120, 70\]"),
    ],
)
def test_relations_inside_a_section(model: type, values: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        model(**values)


def test_goal_mission_is_one_point_and_the_traditional_field() -> None:
    goal = {"kind": "goal", "start_m": (0.0, 0.0), "goal_m": (10.0, 10.0)}
    one = {"shape": "line", "count": 1}
    assert problem(mission=goal, formation=one, planner={"kind": "apf"}).uav_count == 1
    with pytest.raises(ValidationError, match="needs exactly 1"):
        problem(mission=goal, planner={"kind": "apf"})
    with pytest.raises(ValidationError, match='flown by "apf" only'):
        problem(mission=goal, formation=one)
    with pytest.raises(ValidationError, match="arrival_m"):
        problem(mission=goal | {"step_m": 1.0}, formation=one, planner={"kind": "apf"})


def test_digest_covers_what_decides_a_result_and_no_words() -> None:
    reference = load_problem("table1_8")
    assert load_problem("table1_8", ['title="another"', "source=mine"]).digest() == reference.digest()
    changed = {
        load_problem("table1_8", [setting]).digest()
        for setting in ("planner.k=1.8", "world.count=9", "vehicle.radius_m=0.1", "navigation.rate_hz=5")
    }
    assert len(changed | {reference.digest()}) == 5
    assert load_problem("table1_8").digest() == reference.digest()


def test_a_problem_is_immutable() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        problem().planner.k = 5.0
