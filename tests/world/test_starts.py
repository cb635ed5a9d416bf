"""Nobody starts in contact: random obstacles keep clear of initial places, fixed ones are refused by name."""

import hashlib
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from napf_mpc.cli import run_command
from napf_mpc.closed_loop import POSITION, build_scenario, formation_scenes, initial_state
from napf_mpc.errors import SceneError
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.mission import check_mission, fly_mission
from napf_mpc.problem import Forest, Lanes, Problem, Scatter, StreetCanyon
from napf_mpc.problem_file import load_problem
from napf_mpc.scenario_file import scenes_of
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.scenes import build_scenes
from napf_mpc.world.shapes import Cylinder, Sphere
from napf_mpc.world.starts import CLEAR_M, Starts

RADIUS_M = 0.3
FILE = {"shape": "line", "count": 4, "spacing_m": 25.0, "bearing_deg": 0.0}
WIDE = {"shape": "square", "side_m": 40.0, "first_lane_m": 12.0}
PAIR = {"shape": "line", "count": 2}  # at 2.5 m to either side; UAV 2 to the left
RUNS = range(300)


def problem_of(world: dict[str, Any], formation: dict[str, Any], **mission: Any) -> Problem:
    given = {
        "formation": formation,
        "mission": {"kind": "formation", "length_m": 30.0} | mission,
        "world": world,
    }
    return Problem.model_validate_json(json.dumps(given))


def least_clearance(problem: Problem, obstacles: ObstacleSet) -> np.ndarray:
    """Clearance of the nearest UAV at the start, (scene,) [m]."""
    places = initial_state(problem)[:, POSITION]
    points = np.broadcast_to(places, (obstacles.n_scenes, *places.shape))
    return obstacles.signed_distance(points).min(axis=1) - problem.vehicle.radius_m


def digest(obstacles: ObstacleSet) -> str:
    solids = obstacles.solids
    return hashlib.sha256(solids.kind.tobytes() + solids.parameters.tobytes()).hexdigest()


# ------------------------------------------------------------------------------------- random obstacles


@pytest.mark.parametrize(
    ("world", "formation"),
    [
        ({"kind": "scatter"}, FILE),
        ({"kind": "scatter", "shape": "cylinder"}, FILE),
        ({"kind": "lanes"}, WIDE),
        ({"kind": "lanes", "shape": "cylinder"}, WIDE),
        ({"kind": "forest"}, FILE),
        ({"kind": "street_canyon", "mast_count": 30}, FILE | {"spacing_m": 15.0}),
        (
            {"kind": "street_canyon"},
            FILE | {"bearing_deg": 45.0, "spacing_m": 16.0},
        ),  # some beside the fronts
    ],
)
@pytest.mark.parametrize("climb_deg", [0.0, 20.0])
def test_a_wide_formation_never_starts_in_contact(
    world: dict[str, Any], formation: dict[str, Any], climb_deg: float
) -> None:
    problem = problem_of(world, formation, heading_deg=30.0, climb_deg=climb_deg, start_m=[30.0, -7.0, 5.0])
    obstacles = build_scenario(problem, 11, RUNS).obstacles
    unaware = build_scenes(
        problem.world,
        PathFrame.of_mission(problem.mission),
        formation_offsets(problem.formation)[:, 1],
        11,
        RUNS,
    )
    assert (least_clearance(problem, unaware) <= 0.0).sum() >= 3
    assert least_clearance(problem, obstacles).min() >= CLEAR_M - 1e-9
    # As many as before, and scenes that were clear by themselves are the same to the bit.
    assert np.array_equal(obstacles.counts(), unaware.counts())
    clear = np.flatnonzero(least_clearance(problem, unaware) > 2.0)
    assert len(clear) >= 3
    for run in clear:
        assert digest(obstacles.scene(run)) == digest(unaware.scene(run))


def test_the_planners_scenes_are_those_of_the_files() -> None:
    problem = problem_of({"kind": "scatter"}, FILE)
    flown = build_scenario(problem, 11, RUNS).obstacles
    assert digest(scenes_of(problem, 11, RUNS)) == digest(flown)
    # And a run's scene does not depend on the runs beside it, drawn again or not.
    assert digest(scenes_of(problem, 11, range(40, 80))) == digest(
        ObstacleSet.stack([flown.scene(run) for run in range(40, 80)])
    )


def test_initial_positions_count_where_they_are_given() -> None:
    places = [[40.0, 0.0, 0.0], [44.0, 3.0, 0.0], [48.0, -3.0, 0.0], [52.0, 0.0, 0.0]]
    problem = problem_of({"kind": "scatter", "shape": "cylinder"}, FILE, initial_positions_m=places)
    obstacles = formation_scenes(problem, 0, RUNS)
    assert np.array_equal(initial_state(problem)[:, POSITION], places)
    assert least_clearance(problem, obstacles).min() >= CLEAR_M - 1e-9


def test_redrawn_obstacles_keep_their_size_and_stratum() -> None:
    world, frame = Lanes(kind="lanes"), PathFrame.from_angles((0.0, 0.0, 0.0), 0.0, 0.0)
    lanes = np.array([-3.0, 3.0])
    starts = Starts(np.array([[25.0, -3.0, 0.0], [65.0, 3.0, 0.5]]), RADIUS_M)
    aware = build_scenes(world, frame, lanes, 2, RUNS, starts=starts).solids.parameters.reshape(300, 8, 8)
    unaware = build_scenes(world, frame, lanes, 2, RUNS).solids.parameters.reshape(300, 8, 8)
    moved = (aware[..., 0] != unaware[..., 0]).any(axis=0)
    assert moved.tolist() == [True, False, False, False, True, False, False, False]
    edges = 20.0 + 10.0 * np.arange(9)
    assert np.all((aware[..., 0] >= edges[:-1]) & (aware[..., 0] <= edges[1:]))
    assert np.array_equal(aware[..., 2:], unaware[..., 2:])  # radius and height


@pytest.mark.parametrize(
    "world",
    [
        Forest(kind="forest", ground_m=3.0),
        StreetCanyon(
            kind="street_canyon", ground_m=3.0, building_height_m=(9.0, 20.0), mast_height_m=(8, 20)
        ),
        Scatter(kind="scatter"),
    ],
    ids=lambda world: world.kind,
)
def test_above_what_stands_there_nothing_is_drawn_again(
    world: Forest | StreetCanyon | Scatter,
) -> None:
    frame = PathFrame.from_angles((0.0, 0.0, 0.0), 0.4, 0.0)
    ahead = np.column_stack([np.linspace(20.0, 110.0, 40), np.zeros(40), np.full(40, 25.0)])
    starts = Starts(frame.to_world(ahead), RADIUS_M)
    alone = build_scenes(world, frame, np.zeros(1), 5, range(20))
    assert digest(build_scenes(world, frame, np.zeros(1), 5, range(20), starts=starts)) == digest(alone)


@pytest.mark.parametrize(
    ("world", "named"),
    [
        (
            {"kind": "scatter", "count": 1, "along_range_m": [0, 0], "lateral_range_m": [2, 3]},
            r"world\.count = 1.*only 0 found a place, clear of the UAVs' initial places.*widen",
        ),
        (
            {
                "kind": "lanes",
                "count": 1,
                "along_range_m": [0, 0],
                "lane_jitter_m": 0.1,
                "height_jitter_m": 0,
            },
            r"world\.along_range_m = \[0\.0, 0\.0\] m: in run 0 an obstacle stands on a UAV's initial place, "
            r"nearer than 0\.8 m, .* 10000 tries; shift the range, .*mission\.start_m",
        ),
        (
            {"kind": "street_canyon", "street_width_m": 4, "setback_m": 1, "along_range_m": [-20, 80]},
            r"world\.street_width_m = 4 m: in run 0 a building stands on a UAV's .*widen the street",
        ),
    ],
)
def test_no_place_clear_of_the_starts_is_said(world: dict[str, Any], named: str) -> None:
    began = time.perf_counter()
    with pytest.raises(SceneError, match=named):
        build_scenario(problem_of(world, PAIR), 0, range(1))
    assert time.perf_counter() - began < 10.0


@pytest.mark.parametrize(
    ("name", "seed", "expected"),
    [
        ("table1_8c", 0, "4e35a0cd255d6bfa"),
        ("table1_40", 7, "3ae9b7544b1e4568"),
    ],
)
def test_shipped_scenes_are_what_they_were(name: str, seed: int, expected: str) -> None:
    assert digest(scenes_of(load_problem(name), seed, range(200)))[:16] == expected


# -------------------------------------------------------------------------------------- fixed obstacles

SPHERE = {"shape": "sphere", "centre_m": [0.0, 2.5, 0.0], "radius_m": 2.0}
FAR = {"shape": "box", "centre_m": [20.0, 0.0, 0.0], "size_m": [1.0, 1.0, 1.0]}


def test_a_listed_obstacle_on_a_start_is_refused_by_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    problem = problem_of({"kind": "list", "obstacles": [FAR, SPHERE]}, PAIR)
    words = (
        r"UAV 2 starts at \[0\.0, 2\.5, 0\.0\] m in contact with world\.obstacles\[1\]: with its radius of "
        r"0\.3 m it overlaps by 2\.3 m; move the obstacle, or the UAV \(mission\.start_m or the formation\)"
    )
    with pytest.raises(SceneError, match=words):
        check_mission(problem)
    with pytest.raises(SceneError, match=words):
        fly_mission(problem, "given", "napf")
    path = tmp_path / "on_start.toml"
    path.write_text(
        '[formation]\nshape = "line"\ncount = 2\n[mission]\nlength_m = 30.0\n[world]\nkind = "list"\n'
        'obstacles = [ { shape = "sphere", centre_m = [0.0, 2.5, 0.0], radius_m = 2.0 } ]\n'
    )
    assert run_command(["validate", str(path)]) == 2
    assert "world.obstacles[0]" in capsys.readouterr().err


def test_an_exact_touch_is_refused_and_a_start_within_a_margin_is_not() -> None:
    starts = Starts(np.array([[0.0, 0.0, 0.0], [0.0, 4.0, 0.0]]), 0.25)
    for ahead, refused in ((1.25, True), (1.26, False)):
        scene = ObstacleSet.from_shapes([Sphere((ahead, 4.0, 0.0), 1.0), Cylinder((9.0, 0.0), 1.0)])
        if refused:
            with pytest.raises(SceneError, match=r"UAV 2 .* contact with thing 0: .* overlaps by 0 m"):
                starts.refuse_contact(scene, lambda i: f"thing {i}")
        else:
            starts.refuse_contact(scene, lambda i: f"thing {i}")


def test_the_deepest_of_several_contacts_is_named_and_the_keys_that_move_it() -> None:
    walls = [SPHERE | {"centre_m": [0.0, y, 0.0], "radius_m": r} for y, r in ((1.0, 0.9), (5.0, 1.0))]
    places = [[0.0, 0.0, 0.0], [0.0, 5.5, 0.0]]
    problem = problem_of({"kind": "list", "obstacles": walls}, PAIR, initial_positions_m=places)
    with pytest.raises(
        SceneError,
        match=r"UAV 2 .*obstacles\[1\].* by 0\.8 m \(and 1 more .*\(mission\.initial_positions_m\)",
    ):
        check_mission(problem)


def test_a_building_on_a_start_is_refused(tmp_path: Path) -> None:
    ring = [[139.69, 35.69], [139.691, 35.69], [139.691, 35.691], [139.69, 35.691], [139.69, 35.69]]
    house = {
        "type": "Feature",
        "properties": {"height_m": 12.0},
        "geometry": {"type": "Polygon", "coordinates": [ring]},
    }
    (tmp_path / "town.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [house]}))
    world = {"kind": "city", "file": "town.geojson"}
    with pytest.raises(
        SceneError, match=r'UAV 1 .*a building of world\.file = "town\.geojson": .* by 2\.3 m'
    ):
        check_mission(problem_of(world, PAIR, start_m=[0.0, 0.0, 10.0]), tmp_path)
    assert check_mission(problem_of(world, PAIR, start_m=[0.0, 0.0, 12.5]), tmp_path) == ""


@pytest.mark.parametrize(
    ("moving", "overlap"),
    [
        ({"shape": "sphere", "start_m": [0.0, -2.5, 1.0], "velocity_mps": [0.0, 0.0, 2.0]}, "0.3"),
        ({"shape": "cylinder", "start_m": [0.6, -2.5], "velocity_mps": [0.0, 3.0]}, "0.7"),
    ],
)
def test_what_moves_and_starts_on_a_uav_is_refused(moving: dict[str, Any], overlap: str) -> None:
    far = {"shape": "sphere", "start_m": [9.0, 9.0, 9.0], "velocity_mps": [0.0, 0.0, 0.0], "radius_m": 1.0}
    world = {"kind": "empty", "moving": [far, moving | {"radius_m": 1.0}]}
    with pytest.raises(SceneError, match=rf"UAV 1 .*world\.moving\[1\]: .* by {overlap} m"):
        check_mission(problem_of(world, PAIR))
    check_mission(problem_of({"kind": "empty", "moving": [far]}, PAIR))


def test_a_walk_from_inside_an_obstacle_is_refused() -> None:
    ball = {"shape": "sphere", "centre_m": [0.0, 0.3, 0.0], "radius_m": 1.0}
    with pytest.raises(
        SceneError, match=r"UAV 1 .*world\.obstacles\[0\]: .* by 0\.7 m.*\(mission\.start_m\)"
    ):
        check_mission(load_problem("single_uav", {"world": {"kind": "list", "obstacles": [ball]}}))


def test_starts_of_nobody_refuse_nothing() -> None:
    nobody = Starts()
    scene = ObstacleSet.from_shapes([Sphere((0.0, 0.0, 0.0), 1.0)])
    nobody.refuse_contact(scene, str)
    assert nobody.too_near(scene).tolist() == [False]
    assert math.isfinite(nobody.reach_m)
