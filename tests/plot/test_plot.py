"""Figures hold the data they claim to hold, can be read, and are the same file twice."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse
from matplotlib.transforms import Bbox
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from napf_mpc.block import Block, fly_block
from napf_mpc.closed_loop import build_scenario
from napf_mpc.errors import DataError, OutputError, ProblemError
from napf_mpc.goal_walk import goal_scenes, walk_to_goal
from napf_mpc.plot import (
    Mission,
    animation,
    compare_figures,
    paper_figures,
    paths_overview,
    pick_missions,
    run_figures,
    scene,
)
from napf_mpc.plot.compare import clearance_figure, ecdf, published, risk_figure
from napf_mpc.plot.field import limit_cases, potential_at, surface_figure, walk_figure
from napf_mpc.plot.flight import MOST_INFLATED, paths_figure, spread, uncertainty_figure
from napf_mpc.plot.overview import overview_figure
from napf_mpc.plot.paper import without_errors
from napf_mpc.plot.space import space_figure
from napf_mpc.plot.states import angle_figure, attitude_figure, axis_figure, distance_figure, motion_figure
from napf_mpc.plot.style import FONT_PT, credit_of, house_style, save, uav_colour
from napf_mpc.plot.tracks import SUBSTEPS, Track, acting, clearances, contacts, encounters, separations, track
from napf_mpc.plot.trade import FINISHED, draw_fronts, fronts_figure, round_up, trade_figure
from napf_mpc.problem import City, Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.provenance import identity
from napf_mpc.summary import summarise
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Sphere

PLANNERS = ("apf", "napf")
SEED = 3


@pytest.fixture(autouse=True)
def in_house_style() -> Iterator[None]:
    """Figures are made in the style that the public functions set."""
    with house_style():
        yield


@pytest.fixture(scope="module")
def problem() -> Problem:
    # An obstacle so near to the start that five seconds are enough to meet it.
    return load_problem("square_8", ["simulation.time_limit_s=5", "world.obstacles[0].centre_m=[11,2,0.3]"])


@pytest.fixture(scope="module")
def block(problem: Problem) -> Block:
    return fly_block(problem, PLANNERS, SEED, range(1), None, 5)


@pytest.fixture(scope="module")
def obstacles(problem: Problem) -> ObstacleSet:
    return build_scenario(problem, SEED, range(1)).obstacles


@pytest.fixture(scope="module")
def napf(block: Block) -> Track:
    return track(block.trajectories, "napf", 0)


@pytest.fixture(scope="module")
def campaign(problem: Problem) -> tuple[dict[str, Any], dict[str, Any]]:
    rows = fly_block(problem, PLANNERS, SEED, range(6)).rows
    return summarise(rows, identity(problem, "square_8", PLANNERS, SEED)), rows


def column(block: Block, planner: str, name: str, uav: int) -> np.ndarray:
    table = block.trajectories
    return table[name][(table["planner"] == planner) & (table["uav"] == uav)]


def has_line(figure: Figure, x: np.ndarray, y: np.ndarray) -> bool:
    """Whether some panel holds exactly this line."""
    lines = [line for axes in figure.axes for line in axes.lines]
    return any(
        np.array_equal(line.get_xdata(), x) and np.array_equal(line.get_ydata(), y)
        for line in lines
        if len(np.atleast_1d(line.get_xdata())) == len(x)
    )


def straight_track(positions: np.ndarray, sigma: float = 1.0) -> Track:
    """Flight through positions (time, uav, 3) whose estimates are the truth."""
    still = np.zeros_like(positions)
    time = 0.1 * np.arange(len(positions))
    return Track("napf", 0, time, positions, still, positions, still + sigma, still, still)


# ------------------------------------------------------------------------------------------- a flight


def test_track_holds_the_columns(block: Block) -> None:
    flown = track(block.trajectories, "apf", 0)
    assert flown.position.shape == (len(flown.time_s), 4, 3)
    for uav in range(4):
        assert_array_equal(flown.position[:, uav, 1], column(block, "apf", "y_m", uav))
        assert_array_equal(flown.velocity[:, uav, 2], column(block, "apf", "vz_mps", uav))
        assert_array_equal(flown.estimate[:, uav, 0], column(block, "apf", "est_x_m", uav))
        assert_array_equal(flown.sigma[:, uav, 2], column(block, "apf", "sigma_z_m", uav))
        assert_array_equal(flown.attitude[:, uav, 1], column(block, "apf", "pitch_rad", uav))
        assert_array_equal(flown.rates[:, uav, 0], column(block, "apf", "roll_rate_radps", uav))


def test_track_does_not_depend_on_the_order_of_rows(block: Block) -> None:
    mixed = np.random.default_rng(1).permutation(len(block.trajectories["run"]))
    shuffled = {name: values[mixed] for name, values in block.trajectories.items()}
    assert_array_equal(track(shuffled, "napf", 0).position, track(block.trajectories, "napf", 0).position)


def test_a_flight_that_is_not_there_is_named(block: Block) -> None:
    with pytest.raises(DataError, match='planner "qp" in run 0; planners: apf, napf'):
        track(block.trajectories, "qp", 0)
    with pytest.raises(DataError, match="in run 7"):
        track(block.trajectories, "apf", 7)
    with pytest.raises(DataError, match="empty"):
        track({}, "apf", 0)
    with pytest.raises(DataError, match="lacks a UAV"):
        track({name: values[:-1] for name, values in block.trajectories.items()}, "napf", 0)


def test_run_figures_write_every_figure_twice_the_same(
    problem: Problem, block: Block, obstacles: ObstacleSet, tmp_path: Path
) -> None:
    first = run_figures(problem, "s8", block.trajectories, obstacles, ["napf"], tmp_path / "a")
    second = run_figures(problem, "s8", block.trajectories, obstacles, ["napf"], tmp_path / "b")
    kinds = ("paths", "uncertainty", "motion", "attitude", "distances", "space")
    assert [path.name for path in first] == [
        f"s8_napf_{kind}.{end}" for kind in kinds for end in ("png", "svg")
    ]
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes(), one.name
        check_picture(one)


def check_picture(path: Path) -> None:
    if path.suffix == ".svg":
        assert ElementTree.parse(path).getroot().tag.endswith("svg")
        assert "<dc:date>" not in path.read_text()
    else:
        with Image.open(path) as picture:
            assert picture.width in (700, 1440)
            extrema = picture.convert("L").getextrema()
        assert extrema[0] < 50, "nothing drawn"


def test_top_and_side_view_show_the_true_paths(
    problem: Problem, block: Block, obstacles: ObstacleSet, napf: Track
) -> None:
    figure = paths_figure(problem, napf, obstacles)
    for uav in range(4):
        x, y, z = (column(block, "napf", name, uav) for name in ("x_m", "y_m", "z_m"))
        assert has_line(figure, x, y)
        assert has_line(figure, x, z)
    (plan,) = [axes for axes in figure.axes if axes.get_ylabel() == "North y (m)"]
    box = plan.get_window_extent()
    assert box.width / np.ptp(plan.get_xlim()) == pytest.approx(
        box.height / np.ptp(plan.get_ylim()), rel=1e-6
    )
    assert {text.get_text() for text in plan.texts} == {f"UAV {i}" for i in (1, 2, 3, 4)}


def test_two_flights_side_by_side_share_their_scales(
    problem: Problem, block: Block, obstacles: ObstacleSet, napf: Track
) -> None:
    apf = track(block.trajectories, "apf", 0)
    one, other = paths_figure(problem, apf, obstacles, [napf]), paths_figure(problem, napf, obstacles, [apf])
    for a, b in zip(one.axes, other.axes, strict=True):
        assert a.get_xlim() == b.get_xlim()
        assert a.get_ylim() == b.get_ylim()


def test_states_show_the_columns_in_degrees_and_metres(problem: Problem, block: Block, napf: Track) -> None:
    time = column(block, "napf", "t_s", 2)
    motion, attitude = motion_figure(problem, napf), attitude_figure(problem, napf)
    assert has_line(motion, time, column(block, "napf", "y_m", 2))
    assert has_line(motion, time, column(block, "napf", "vz_mps", 2))
    assert has_line(attitude, time, np.degrees(column(block, "napf", "roll_rad", 2)))
    assert has_line(attitude, time, np.degrees(column(block, "napf", "pitch_rate_radps", 2)))


def test_distances_are_those_between_centres_and_surfaces(
    problem: Problem, napf: Track, obstacles: ObstacleSet
) -> None:
    radius = problem.vehicle.radius_m
    ball = [shape for shape in obstacles.shapes() if isinstance(shape, Sphere)]
    by_hand = np.min(
        [np.linalg.norm(napf.position - np.array(s.centre_m), axis=-1) - s.radius_m for s in ball], axis=0
    )
    assert_allclose(clearances(napf, obstacles, radius), by_hand - radius, atol=1e-12)
    gap = np.linalg.norm(napf.position[:, 0] - napf.position[:, 1:2].squeeze(1), axis=-1)
    assert (separations(napf)[:, 0] <= gap + 1e-12).all()
    figure = distance_figure(problem, napf, obstacles)
    assert has_line(figure, napf.time_s, clearances(napf, obstacles, radius)[:, 1])
    assert has_line(figure, napf.time_s, separations(napf)[:, 3])
    levels = [
        line.get_ydata()[0] for axes in figure.axes for line in axes.lines if len(line.get_ydata()) == 2
    ]
    assert levels == [0.0, problem.vehicle.min_separation_m]


def test_neighbours_of_an_equilateral_triangle_are_its_side_apart() -> None:
    corners = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [1.0, np.sqrt(3.0), 0.0]])
    assert_allclose(separations(straight_track(np.tile(corners, (3, 1, 1)))), 2.0)
    assert np.isinf(separations(straight_track(np.zeros((3, 1, 3))))).all()


# ------------------------------------------------------------------------------------------ uncertainty


def test_inflated_radius_is_radius_plus_k_sigma_at_the_closest_approach(
    problem: Problem, block: Block, obstacles: ObstacleSet, napf: Track
) -> None:
    figure = uncertainty_figure(problem, napf, obstacles)
    uav, ball = 0, obstacles.shapes()[0]
    assert isinstance(ball, Sphere)
    estimate = np.column_stack([column(block, "napf", f"est_{a}_m", uav) for a in "xyz"])
    sigma = np.column_stack([column(block, "napf", f"sigma_{a}_m", uav) for a in "xyz"])
    offset = estimate - np.array(ball.centre_m)
    distance = np.linalg.norm(offset, axis=1)
    margin = 3.0 * np.sqrt(((offset / distance[:, None] * sigma) ** 2).sum(1))
    closest = int(np.argmin(distance - ball.radius_m - margin))
    panel = next(axes for axes in figure.axes if axes.get_title(loc="left") == "UAV 1")
    circles = [patch for patch in panel.patches if isinstance(patch, Circle)]
    assert 1 <= len(circles) <= MOST_INFLATED
    radii = [circle.radius for circle in circles if circle.center == ball.centre_m[:2]]
    assert_allclose(radii, [ball.radius_m + margin[closest]], rtol=1e-12)


def test_the_original_apf_inflates_nothing(problem: Problem, block: Block, obstacles: ObstacleSet) -> None:
    figure = uncertainty_figure(problem, track(block.trajectories, "apf", 0), obstacles)
    assert not [patch for axes in figure.axes for patch in axes.patches if isinstance(patch, Circle)]


def test_ellipses_reach_k_sigma_around_the_estimate(
    problem: Problem, obstacles: ObstacleSet, napf: Track
) -> None:
    k = 2.5
    other = problem.model_copy(update={"planner": problem.planner.model_copy(update={"k": k})})
    figure = uncertainty_figure(other, napf, obstacles)
    panel = next(axes for axes in figure.axes if axes.get_title(loc="left") == "UAV 3")
    first = next(
        patch for patch in panel.patches if isinstance(patch, Ellipse) and not isinstance(patch, Circle)
    )
    assert first.center == pytest.approx(tuple(napf.estimate[0, 2, :2]))
    assert (first.width, first.height) == pytest.approx(tuple(2.0 * k * napf.sigma[0, 2, :2]))
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert any(text.startswith("2.5") and "every 8 s" in text for text in words)
    assert any(text.startswith("obstacle + 2.5") for text in words)


def test_an_estimate_that_is_lost_is_left_out(problem: Problem, obstacles: ObstacleSet, napf: Track) -> None:
    estimate, sigma = napf.estimate.copy(), napf.sigma.copy()
    estimate[:, 1], sigma[:, 1] = np.nan, np.nan
    lost = replace(napf, estimate=estimate, sigma=sigma)
    assert not (acting(problem, lost, obstacles).uav == 1).any()
    uncertainty_figure(problem, lost, obstacles)


def test_encounters_are_the_nearest_moment_of_each_obstacle(
    problem: Problem, obstacles: ObstacleSet, napf: Track
) -> None:
    seen = acting(problem, napf, obstacles)
    for uav in range(4):
        entries = encounters(seen, uav, 100)
        assert len({int(seen.obstacle[entry]) for entry in entries}) == len(entries)
        assert list(seen.rho_m[entries]) == sorted(seen.rho_m[entries])
        for entry in entries:
            same = (seen.uav == uav) & (seen.obstacle == seen.obstacle[entry])
            assert seen.rho_m[entry] == seen.rho_m[same].min()


@pytest.mark.parametrize(
    "shape",
    [
        Box((1.0, 2.0, 5.0), (6.0, 3.0, 10.0), 0.4),
        Prism((np.array([[0.0, 0.0], [8.0, 0.0], [8.0, 6.0], [4.0, 2.0], [0.0, 6.0]]),), 0.0, 20.0),
    ],
)
def test_an_inflated_building_is_the_line_at_the_margin(shape: Box | Prism) -> None:
    axes = Figure().add_subplot()
    scene.draw_inflated(axes, shape, 2.0, 5.0)
    places = np.concatenate([path.vertices for path in axes.collections[0].get_paths()])
    points = np.column_stack([places, np.full(len(places), 5.0)])[None]
    assert len(places) > 100
    assert_allclose(ObstacleSet.from_shapes([shape]).signed_distance(points), 2.0, atol=0.01)


def test_holes_of_buildings_stay_open() -> None:
    outer = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    yard = np.array([[4.0, 4.0], [6.0, 4.0], [6.0, 6.0], [4.0, 6.0]])
    figure = Figure(figsize=(1.0, 1.0), dpi=100)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(-1.0, 11.0), ylim=(-1.0, 11.0))
    axes.set_axis_off()
    building = ObstacleSet.from_shapes([Prism((outer, yard), 0.0, 75.0)])
    scene.draw_plan(axes, building, scene.View((-1.0, 11.0), (-1.0, 11.0)))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., 0]
    assert pixels[50, 50] == 255, "the yard is filled"
    assert pixels[50, 25] < 200, "the building is not"


# ---------------------------------------------------------------------------------------------- contacts


def test_a_contact_between_two_samples_is_marked() -> None:
    # Samples 1 m apart, obstacle of 0.2 m between two of them.
    line = np.linspace([0.0, 0.0, 0.0], [10.0, 0.0, 0.0], 11)[:, None]
    ball = ObstacleSet.from_shapes([Sphere((4.5, 0.05, 0.0), 0.2)])
    (found,) = contacts(straight_track(line), ball, 0.1)
    assert found.uav == 0
    assert found.position[0] == pytest.approx(4.5, abs=1.0 / SUBSTEPS)
    assert found.clearance_m == pytest.approx(0.05 - 0.2 - 0.1, abs=1e-9)
    assert found.time_s == pytest.approx(0.45, abs=0.1 / SUBSTEPS)


def test_each_contact_is_marked_once_and_a_miss_not_at_all() -> None:
    line = np.linspace([0.0, 0.0, 0.0], [10.0, 0.0, 0.0], 101)[:, None]
    balls = ObstacleSet.from_shapes([Sphere((2.0, 0.0, 0.0), 0.5), Sphere((7.0, 0.0, 0.0), 0.5)])
    found = contacts(straight_track(line), balls, 0.1)
    assert [contact.position[0] for contact in found] == pytest.approx([2.0, 7.0], abs=0.02)
    assert contacts(straight_track(line + np.array([0.0, 0.601, 0.0])), balls, 0.1) == []
    assert contacts(straight_track(line), ObstacleSet.empty(), 0.1) == []


def test_contacts_stand_in_both_views(problem: Problem) -> None:
    line = np.linspace([0.0, 0.0, 1.0], [30.0, 0.0, 1.0], 151)[:, None].repeat(4, axis=1)
    line = line + np.array([[0.0, 0.0, 0.0], [0.0, 8.0, 0.0], [0.0, 16.0, 0.0], [0.0, 24.0, 0.0]])
    ball = ObstacleSet.from_shapes([Sphere((15.0, 0.0, 1.0), 1.0)])
    figure = paths_figure(problem, straight_track(line), ball)
    crosses = [
        (float(mark.get_xdata()[0]), float(mark.get_ydata()[0]))
        for axes in figure.axes
        for mark in axes.lines
        if mark.get_marker() == "X"
    ]
    assert_allclose(sorted(crosses), [(15.0, 0.0), (15.0, 1.0)], atol=0.05)


# ---------------------------------------------------------------------------------------------- the paper


@pytest.mark.parametrize(
    ("name", "numbers"),
    [
        ("potential_surface", [3]),
        ("single_uav", [4]),
        ("square_8", [5, 6, 7, 8, 9, 10, 11, 16, 17, 18, 19, 20]),
        ("square_40", [12, 13, 14, 15, 21, 22, 23, 24, 25]),
    ],
)
def test_the_papers_figures_have_its_numbers(
    name: str, numbers: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit = [] if len(numbers) == 1 else ["simulation.time_limit_s=5"]
    drawn = name != "square_40"  # made as square_8's are
    if not drawn:
        monkeypatch.setattr("napf_mpc.plot.paper.save", lambda figure, out, stem: [out / stem, out / stem])
    written = paper_figures(load_problem(name, limit), name, SEED, tmp_path)
    assert sorted({int(path.name[3:5]) for path in written}) == numbers
    assert len(written) == 2 * len(numbers)
    for path in written if drawn else []:
        check_picture(path)


def test_any_other_problem_gets_the_figures_of_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[Any] = []
    monkeypatch.setattr("napf_mpc.plot.paper.run_figures", lambda *given: called.append(given) or [])
    problem = load_problem("street_canyon", ["simulation.time_limit_s=1"])
    paper_figures(problem, "street_canyon", SEED, tmp_path)
    ((given, name, trajectories, obstacles, planners, out, moving),) = called
    assert (given, name, planners, out) == (problem, "street_canyon", ("apf", "napf"), tmp_path)
    assert set(trajectories["planner"]) == {"apf", "napf"}
    assert len(obstacles) > 0
    assert moving is None


def test_without_errors_the_estimate_is_the_truth(problem: Problem) -> None:
    calm = fly_block(without_errors(problem), ["apf"], SEED, range(1), None, 5)
    flown = track(calm.trajectories, "apf", 0)
    assert_array_equal(flown.estimate, flown.position)


def test_the_force_is_the_slope_of_the_potential() -> None:
    problem = load_problem("potential_surface")
    obstacles = goal_scenes(problem)
    places = np.array([[1.0, 2.0], [3.0, 4.0], [4.0, 7.5], [8.0, 3.0]])  # some within rho_0, none at its edge
    h = 1e-5
    slope = np.stack(
        [
            (
                potential_at(problem, obstacles, places + step)[0]
                - potential_at(problem, obstacles, places - step)[0]
            )
            / (2.0 * h)
            for step in (np.array([h, 0.0]), np.array([0.0, h]))
        ],
        axis=-1,
    )
    assert_allclose(potential_at(problem, obstacles, places)[1], -slope, rtol=1e-6)


def test_single_uav_arrives_and_the_limits_are_limits() -> None:
    problem = load_problem("single_uav")
    obstacles = goal_scenes(problem)
    walk = walk_to_goal(problem, obstacles)
    assert walk.arrived
    gap = obstacles.signed_distance(np.column_stack([walk.positions, np.zeros(len(walk.positions))])[None])
    assert gap.min() > 0.0
    for _, blocks in limit_cases(problem):
        assert not walk_to_goal(problem, blocks).arrived
    figure = walk_figure(problem, obstacles)
    assert len(figure.axes) == 3
    assert has_line(figure, *walk.positions.T)
    assert figure.axes[1].get_title(loc="left").endswith("stuck")


@pytest.mark.parametrize(
    "settings",
    [
        ["world.obstacles=[]"],
        ["mission.goal_m=[0, 0]"],
        ['world.obstacles=[{shape="box", centre_m=[5, 7, 0], size_m=[2, 2, 2]}]'],
    ],
)
def test_odd_walks_can_be_drawn(settings: list[str]) -> None:
    problem = load_problem("single_uav", settings)
    surface_figure(problem, goal_scenes(problem)).draw_without_rendering()
    walk_figure(problem, goal_scenes(problem)).draw_without_rendering()


def test_a_formation_has_no_walk(problem: Problem, obstacles: ObstacleSet) -> None:
    with pytest.raises(ProblemError, match=r"mission\.kind"):
        walk_to_goal(problem, obstacles)


# --------------------------------------------------------------------------------------------- comparisons


def bars(figure: Figure, panel: int) -> list[tuple[float, float, float]]:
    """(low, value, high) of the horizontal error bars of a panel."""
    out = []
    for container in figure.axes[panel].containers:
        (point, _, lines) = container.lines
        ends = lines[0].get_segments()[0][:, 0]
        out.append((float(ends[0]), float(point.get_xdata()[0]), float(ends[1])))
    return out


def test_risks_stand_with_their_wilson_intervals_beside_the_papers(
    campaign: tuple[dict[str, Any], dict[str, Any]],
) -> None:
    summary, _ = campaign
    reference = load_problem("table1_8").reference
    assert reference is not None
    figure = risk_figure(summary, reference)
    expected = []
    for name, paper in (("apf", (0.5555, 0.7333, 0.8582)), ("napf", (0.0734, 0.1667, 0.3356))):
        part = summary["planners"][name]
        expected += [(part["collision_risk_low"], part["collision_risk"], part["collision_risk_high"]), paper]
    assert_allclose(bars(figure, 0), expected, atol=1e-4)
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()][::-1]
    assert labels == ["APF, N = 6", "APF, published, N = 30", "NAPF, N = 6", "NAPF, published, N = 30"]
    assert published(reference)["apf"].count == 22
    assert published(reference)["napf"].count == 5
    (note,) = [text.get_text().replace("\n", " ") for text in figure.texts]
    assert reference.note in note
    assert reference.source in note


def test_trades_show_median_and_percentiles(campaign: tuple[dict[str, Any], dict[str, Any]]) -> None:
    summary, _ = campaign
    # Five seconds are too short for a formation error: it counts from 12 s on.
    for name, shape in (("apf", (1.0, 2.0, 4.0)), ("napf", (2.0, 3.0, 5.0))):
        low, median, high = shape
        for metric in ("shape_rms_m", "path_rms_m", "shape_floor_m"):
            summary["planners"][name][metric] = {
                "p05": low,
                "median": median,
                "p95": high,
                "mean": 2.0,
                "n": 6,
            }
    figure = trade_figure(summary)
    assert_allclose(bars(figure, 0), [(1.0, 2.0, 4.0), (2.0, 3.0, 5.0)])
    assert [line.get_xdata()[0] for line in figure.axes[0].lines if len(line.get_xdata()) == 2] == [2.5]


def spread_of(low: float, median: float, high: float) -> dict[str, float]:
    return {"p05": low, "median": median, "p95": high}


def front_point(risk: float, shape: float, finished: float = 1.0) -> dict[str, Any]:
    return {
        "collision_risk": risk,
        "collision_risk_low": 0.5 * risk,
        "collision_risk_high": risk + 0.04,
        "finished": finished,
        "shape_rms_m": spread_of(shape - 0.5, shape, shape + 1.0),
        "path_rms_m": spread_of(shape, shape + 1.0, shape + 3.0),
        "shape_floor_m": spread_of(0.8, 0.9, 1.0),
    }


def fronts() -> dict[str, dict[str, dict[float, dict[str, Any]]]]:
    return {
        "8C filter": {
            "napf": {3.0: front_point(0.04, 3.0), 1.0: front_point(0.3, 1.5)},
            "qp": {1.0: front_point(0.1, 1.2), 3.0: front_point(0.0, 2.0, finished=FINISHED - 0.01)},
        },
        "40C filter": {"napf": {1.0: front_point(0.9, 4.0)}},
    }


def test_fronts_join_the_points_of_a_planner_as_k_grows() -> None:
    figure = fronts_figure(fronts(), note="N = 9 runs a point")
    assert [axes.get_title(loc="left") for axes in figure.axes[::2]] == ["(a) 8C filter", "(b) 40C filter"]
    assert has_line(figure, np.array([1.5, 3.0]), np.array([0.3, 0.04]))  # k = 1, then 3: shape
    assert has_line(figure, np.array([2.2, 3.0]), np.array([0.1, 0.0]))  # and path of the QP
    assert (1.0, 1.5, 2.5) in bars(figure, 0)
    # The risk of 0.3 + 0.04 sets the scale of one cell, that of 0.94 the other's.
    assert [axes.get_ylim()[1] for axes in figure.axes] == [0.5, 0.5, 1.0, 1.0]
    hollow = [container.lines[0].get_markerfacecolor() == "white" for container in figure.axes[0].containers]
    assert hollow == [False, False, False, True]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["NAPF", "QP", "k = 1", "k = 3"]
    assert any("hollow: fewer than 95 %" in text.get_text().replace("\n", " ") for text in figure.texts)


def test_fronts_are_the_same_files_twice_and_need_a_point(tmp_path: Path) -> None:
    first = draw_fronts(fronts(), tmp_path / "a", "fronts")
    assert [path.name for path in first] == ["fronts.png", "fronts.svg"]
    for one, other in zip(first, draw_fronts(fronts(), tmp_path / "b", "fronts"), strict=True):
        check_picture(one)
        assert one.read_bytes() == other.read_bytes()
    with pytest.raises(ValueError, match="fronts is empty"):
        fronts_figure({"8C filter": {"napf": {}}})


def test_many_planners_leave_room_for_the_note(campaign: tuple[dict[str, Any], dict[str, Any]]) -> None:
    parts = {name: front_point(0.1, 2.0, 0.5) for name in ("apf", "napf", "napf_guided", "qp", "qp_unguided")}
    with house_style():
        figure = trade_figure({"planners": parts})
        renderer: Any = FigureCanvasAgg(figure).get_renderer()
        figure.draw(renderer)
        (legend,), (note,) = figure.legends, figure.texts
        frames = [axes.get_window_extent() for axes in figure.axes]
        boxes = [legend.get_window_extent(renderer), note.get_window_extent(renderer)]
    assert not boxes[0].overlaps(boxes[1])
    assert not any(frame.overlaps(box) for frame in frames for box in boxes)
    assert max(box.x1 for box in boxes) <= figure.bbox.x1


@pytest.mark.parametrize(("share", "end"), [(0.0, 0.01), (0.037, 0.05), (0.5, 0.5), (0.51, 1.0), (1.0, 1.0)])
def test_an_axis_of_shares_ends_at_a_round_number(share: float, end: float) -> None:
    assert round_up(share) == end


def test_clearances_are_a_distribution(campaign: tuple[dict[str, Any], dict[str, Any]]) -> None:
    summary, rows = campaign
    figure = clearance_figure(summary, rows)
    known = np.sort(rows["min_clearance_m"][rows["planner"] == "apf"])
    line = figure.axes[0].lines[0]
    assert_array_equal(line.get_xdata()[1:-1], known)
    assert_allclose(line.get_ydata()[1:-1], np.arange(1, 7) / 6)
    x, y = ecdf(np.array([2.0, np.nan, -1.0]))
    assert_array_equal(x, [-np.inf, -1.0, 2.0])
    assert_array_equal(y, [0.0, 0.5, 1.0])
    assert len(ecdf(np.array([np.nan]))[0]) == 0


def test_compare_figures_are_the_same_files_twice_and_bear_undefined_metrics(
    campaign: tuple[dict[str, Any], dict[str, Any]], tmp_path: Path
) -> None:
    summary, rows = campaign
    for part in summary["planners"].values():
        part["shape_rms_m"] = {"median": None, "p05": None, "p95": None, "mean": None, "n": 0}
    first = compare_figures(
        summary, rows, tmp_path / "a", load_problem("table1_8").reference, "Data: somebody"
    )
    second = compare_figures(
        summary, rows, tmp_path / "b", load_problem("table1_8").reference, "Data: somebody"
    )
    assert [path.name for path in first] == [
        f"compare_{kind}.{end}" for kind in ("risk", "trade", "clearance") for end in ("png", "svg")
    ]
    for one, other in zip(first, second, strict=True):
        check_picture(one)
        assert one.read_bytes() == other.read_bytes()


# ------------------------------------------------------------------------------------------ many missions


def test_missions_are_picked_by_rule() -> None:
    rows = {
        "planner": np.array(["apf"] * 5 + ["napf"] * 2),
        "run": np.array([0, 1, 2, 3, 4, 0, 1]),
        "outcome": np.array(["reached", "reached", "collided", "reached", "failed", "reached", "timeout"]),
        "path_rms_m": np.array([1.0, 5.0, 2.0, 9.0, np.nan, 3.0, 4.0]),
        "min_clearance_m": np.array([1.0, 2.0, -0.5, 0.2, np.nan, 1.0, 0.4]),
    }
    assert pick_missions(rows) == [
        Mission("apf", 1, "reached"),
        Mission("apf", 4, "failed"),
        Mission("napf", 0, "reached"),
        Mission("napf", 1, "timeout"),
    ]
    assert [mission.run for mission in pick_missions(rows, 3)][:5] == [1, 0, 3, 4, 2]


def test_overview_shows_the_missions_to_one_scale(
    problem: Problem, block: Block, obstacles: ObstacleSet, tmp_path: Path
) -> None:
    missions = [Mission("apf", 0, "collided"), Mission("napf", 0)]
    figure = overview_figure(problem, block.trajectories, lambda run: obstacles, missions)
    assert [axes.get_title(loc="left") for axes in figure.axes] == [
        "(a) APF, run 0: collided",
        "(b) NAPF, run 0",
    ]
    assert len({(axes.get_xlim(), axes.get_ylim()) for axes in figure.axes}) == 1
    assert has_line(figure, column(block, "apf", "x_m", 3), column(block, "apf", "y_m", 3))
    written = paths_overview(problem, "s8", block.trajectories, lambda run: obstacles, missions, tmp_path)
    assert [path.name for path in written] == ["s8_overview.png", "s8_overview.svg"]
    with pytest.raises(ValueError, match="missions is empty"):
        overview_figure(problem, block.trajectories, lambda run: obstacles, [])


def test_only_buildings_in_view_are_drawn_and_the_taller_the_darker() -> None:
    square = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 5.0], [0.0, 5.0]])
    shapes = [
        Prism((square + shift,), 0.0, top) for shift, top in ((0.0, 20.0), (10.0, 120.0), (500.0, 50.0))
    ]
    axes = Figure().add_subplot()
    scene.draw_plan(axes, ObstacleSet.from_shapes(shapes), scene.View((-5.0, 20.0), (-5.0, 20.0)))
    (drawn,) = axes.collections
    assert len(drawn.get_paths()) == 2
    axes.figure.draw_without_rendering()
    low, high = drawn.get_facecolor()[:, 0]
    assert high < low


# ---------------------------------------------------------------------------------------------- animation


def test_animation_moves_and_is_the_same_file_twice(
    problem: Problem, obstacles: ObstacleSet, tmp_path: Path
) -> None:
    trajectories = fly_block(problem, ["napf"], SEED, range(1), None, 25).trajectories
    one = animation(problem, trajectories, obstacles, tmp_path / "one.gif")
    other = animation(problem, trajectories, obstacles, tmp_path / "deep" / "other.gif", "napf")
    assert one.read_bytes() == other.read_bytes()
    with Image.open(one) as film:
        assert film.n_frames == 10
        first = np.asarray(film.convert("RGB"), dtype=int)
        film.seek(film.n_frames - 1)
        last = np.asarray(film.convert("RGB"), dtype=int)
    assert (np.abs(first - last).sum(-1) > 60).mean() > 0.002
    assert (first[0, 0] == 255).all()
    with pytest.raises(OutputError, match=r"\.gif"):
        animation(problem, trajectories, obstacles, tmp_path / "film.mp4")


# ------------------------------------------------------------------------------------ what can be read


def figures_of(
    problem: Problem, block: Block, obstacles: ObstacleSet, summary: dict[str, Any], rows: dict[str, Any]
) -> dict[str, Figure]:
    apf, napf = track(block.trajectories, "apf", 0), track(block.trajectories, "napf", 0)
    goal, surface = load_problem("single_uav"), load_problem("potential_surface")
    missions = [Mission("apf", 0, "collided"), Mission("napf", 0, "reached")]
    return {
        "paths": paths_figure(problem, napf, obstacles),
        "uncertainty": uncertainty_figure(problem, napf, obstacles),
        "motion": motion_figure(problem, napf),
        "attitude": attitude_figure(problem, napf),
        "distances": distance_figure(problem, napf, obstacles),
        "space": space_figure(problem, napf, obstacles),
        "axis": axis_figure(problem, [apf, napf], 1),
        "angle": angle_figure(problem, [apf], 0),
        "surface": surface_figure(surface, goal_scenes(surface)),
        "walk": walk_figure(goal, goal_scenes(goal)),
        "risk": risk_figure(summary, load_problem("table1_8").reference),
        "trade": trade_figure(summary),
        "fronts": fronts_figure(fronts(), note="N = 9 runs a point"),
        "clearance": clearance_figure(summary, rows),
        "overview": overview_figure(problem, block.trajectories, lambda run: obstacles, missions),
    }


def check_readable(name: str, figure: Figure) -> None:
    """All words lie inside the figure, are large enough, and keep clear of panels and of each other."""
    renderer: Any = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    sides = [axis for axes in figure.axes for axis in axes._axis_map.values()]
    # An axis in space counts ticks beyond its ends that are never drawn; its label is farther out.
    drawn = [
        axis.label.get_window_extent(renderer)
        if hasattr(axis.axes, "zaxis")
        else axis.get_tightbbox(renderer)
        for axis in sides
    ]
    texts = [words for axes in figure.axes for words in (*axes.texts, axes.title) if words.get_text()]
    drawn += [words.get_window_extent(renderer) for words in (*figure.texts, *figure.legends, *texts)]
    box = Bbox.union([part for part in drawn if part is not None])
    inside = (
        box.x0 >= -1.0,
        box.y0 >= -1.0,
        box.x1 <= figure.bbox.x1 + 1.0,
        box.y1 <= figure.bbox.y1 + 1.0,
    )
    assert all(inside), f"{name}: text is cut off (left, bottom, right, top): {inside}"
    for axes in figure.axes:
        for words in (axes.get_xlabel(), axes.get_ylabel()):
            assert not words or any(unit in words for unit in ("(m", "(s)", "(°", "(%)")), f"{name}: {words}"
        texts = [*axes.texts, axes.title, axes.xaxis.label, *axes.get_xticklabels()]
        assert min(text.get_fontsize() for text in texts) >= FONT_PT, name
        for legend in figure.legends:
            if hasattr(axes, "zaxis"):
                continue  # square axes behind the page; the box in space is smaller
            frame, words_box = axes.get_window_extent(), legend.get_window_extent(renderer)
            assert not frame.overlaps(words_box), f"{name}: legend over a panel"
            assert not axes.title.get_window_extent(renderer).overlaps(words_box), (
                f"{name}: legend on a title"
            )
    # Head of the page: title, note, legend, bar of colours with its numbers.
    bars = [axes for axes in figure.axes if hasattr(axes, "_colorbar")]
    head = [words.get_window_extent(renderer) for words in (*figure.texts, *figure.legends)]
    head += [axes.get_tightbbox(renderer) for axes in bars]
    for one, other in combinations(head, 2):
        assert not one.overlaps(other), f"{name}: words of the head over each other"
    for bar in bars:
        numbers = [label.get_window_extent(renderer) for label in bar.get_xticklabels() if label.get_text()]
        assert not any(one.overlaps(other) for one, other in combinations(numbers, 2)), f"{name}: numbers"
        for axes in figure.axes:
            if axes not in bars and not hasattr(axes, "zaxis"):
                assert not axes.get_window_extent().overlaps(bar.get_tightbbox(renderer)), f"{name}: bar"
                assert not axes.title.get_window_extent(renderer).overlaps(bar.get_tightbbox(renderer)), name


def test_every_figure_can_be_read(
    problem: Problem,
    block: Block,
    obstacles: ObstacleSet,
    campaign: tuple[dict[str, Any], dict[str, Any]],
) -> None:
    with house_style():
        for name, figure in figures_of(problem, block, obstacles, *campaign).items():
            check_readable(name, figure)


ALL_PLANNERS = ("apf", "napf", "napf_guided", "qp", "qp_unguided")


@pytest.mark.parametrize("runs", [3, 300, 10_000_000])
@pytest.mark.parametrize(
    "planners",
    [
        ("qp",),
        ("napf", "napf_guided", "qp"),
        ALL_PLANNERS,
        (*ALL_PLANNERS, "a_planner_of_ones_own_with_a_long_name"),
    ],
)
def test_figures_of_any_planners_and_numbers_of_runs_can_be_read(
    planners: tuple[str, ...], runs: int
) -> None:
    parts = {name: front_point(0.1, 2.0, 0.5) | {"runs": runs, "uavs": 4} for name in planners}
    lone = {name: part | {"uavs": 1} for name, part in parts.items()}
    least = np.linspace(-0.5, 40.0, 10 * len(planners))
    rows = {"planner": np.tile(planners, 10), "min_clearance_m": least}
    reference = load_problem("table1_8").reference
    for name, figure in {
        "risk": risk_figure({"planners": parts}),
        "published": risk_figure({"planners": parts}, reference),
        "trade": trade_figure({"planners": parts}),
        "trade of a lone UAV": trade_figure({"planners": lone}),
        "clearance": clearance_figure({"planners": parts}, rows),
        "no clearance": clearance_figure({"planners": parts}, rows | {"min_clearance_m": np.nan * least}),
    }.items():
        check_readable(name, figure)


def test_a_world_without_obstacles_has_no_clearance_and_says_so() -> None:
    summary = {"planners": {"apf": front_point(0.0, 2.0) | {"runs": 2}}}
    rows = {"planner": np.array(["apf", "apf"]), "min_clearance_m": np.array([np.nan, np.nan])}
    (axes,) = clearance_figure(summary, rows).axes
    assert [words.get_text() for words in axes.texts] == ["no obstacles"]
    rows["min_clearance_m"][0] = 1.0
    (axes,) = clearance_figure(summary, rows).axes
    assert [words.get_text() for words in axes.texts] == ["contact"]


def test_a_lone_uav_has_no_shape_to_trade() -> None:
    part = front_point(0.1, 2.0)
    for uavs, panels in ((1, ["Path RMS (m)"]), (2, ["Shape RMS (m)", "Path RMS (m)"])):
        figure = trade_figure({"planners": {"napf": part | {"uavs": uavs}}})
        assert [axes.get_xlabel() for axes in figure.axes] == panels
        assert figure.axes[0].get_ylabel() == "Collision risk (%)"
        assert any("dashed" in text.get_text() for text in figure.texts) == (uavs > 1)


def formation_of(uavs: int, planner: str = "napf_guided") -> Track:
    """Flight of so many UAVs side by side, straight ahead."""
    start = np.column_stack([np.zeros(uavs), np.linspace(0.0, 30.0, uavs), np.linspace(0.0, 3.0, uavs)])
    positions = start + np.linspace([0.0, 0.0, 5.0], [60.0, 0.0, 5.0], 40)[:, None]
    return replace(straight_track(positions), planner=planner)


@pytest.mark.parametrize("uavs", [1, 5, 7, 8, 12, 40])
def test_figures_of_any_formation_can_be_read(problem: Problem, obstacles: ObstacleSet, uavs: int) -> None:
    flown = formation_of(uavs)
    for name, figure in {
        "paths": paths_figure(problem, flown, obstacles),
        "uncertainty": uncertainty_figure(problem, flown, obstacles),
        "motion": motion_figure(problem, flown),
        "attitude": attitude_figure(problem, flown),
        "distances": distance_figure(problem, flown, obstacles),
        "space": space_figure(problem, flown, obstacles),
        "axis": axis_figure(problem, [flown], 1),
        "axes": axis_figure(problem, [flown, flown], 1),
        "angle": angle_figure(problem, [flown], 0),
    }.items():
        check_readable(f"{name} of {uavs}", figure)


@pytest.mark.parametrize("uavs", [4, 7, 8, 12])
def test_an_overview_of_any_formation_can_be_read(
    problem: Problem, monkeypatch: pytest.MonkeyPatch, uavs: int
) -> None:
    monkeypatch.setattr(
        "napf_mpc.plot.overview.track", lambda table, planner, run: formation_of(uavs, planner)
    )
    ball = ObstacleSet.from_shapes([Sphere((15.0, 0.0, 5.0), 1.0)])
    missions = [Mission("apf", 0, "collided"), Mission("napf_guided", 0, "reached")]
    figure = overview_figure(problem, {}, lambda run: ball, missions)
    check_readable(f"overview of {uavs}", figure)
    assert any(text.get_text() == "contact" for text in figure.legends[0].get_texts())


@pytest.mark.parametrize("uavs", [7, 8, 12])
def test_every_line_of_a_formation_has_a_colour_that_is_told(
    problem: Problem, obstacles: ObstacleSet, uavs: int
) -> None:
    flown = formation_of(uavs)
    for figure in (
        motion_figure(problem, flown),
        attitude_figure(problem, flown),
        distance_figure(problem, flown, obstacles),
    ):
        drawn = [matplotlib.colors.to_hex(line.get_color()) for line in figure.axes[0].lines[:uavs]]
        assert len(set(drawn)) == uavs
        if uavs <= 7:
            told = [matplotlib.colors.to_hex(line.get_color()) for line in figure.legends[0].get_lines()]
        else:
            (bar,) = [axes._colorbar.mappable for axes in figure.axes if hasattr(axes, "_colorbar")]
            told = [matplotlib.colors.to_hex(bar.cmap(bar.norm(uav + 1))) for uav in range(uavs)]
            assert any(text.get_text() == "UAV" for text in figure.texts)
        assert told == drawn


def test_credit_of_shared_data_is_on_the_figures(
    problem: Problem, napf: Track, obstacles: ObstacleSet
) -> None:
    city = City(kind="city", file="x.geojson", credit="Buildings: somebody, CC BY 4.0")
    shared = problem.model_copy(update={"world": city})
    assert credit_of(problem) == ""
    assert credit_of(shared) == city.credit
    for figure in (
        paths_figure(shared, napf, obstacles),
        uncertainty_figure(shared, napf, obstacles),
        motion_figure(shared, napf),
        attitude_figure(shared, napf),
        distance_figure(shared, napf, obstacles),
        space_figure(shared, napf, obstacles),
    ):
        assert any(city.credit in text.get_text().replace("\n", " ") for text in figure.texts)


def test_dollars_in_a_credit_are_prices(problem: Problem, napf: Track, tmp_path: Path) -> None:
    """As formulas the first would be an error of the drawing, and the second would lose its signs."""
    for credit in (r"Prices from \\host\c$\maps\d$\list", "$50 per user_seat, $99 per site_seat"):
        shared = problem.model_copy(update={"world": City(kind="city", file="x.geojson", credit=credit)})
        figure = motion_figure(shared, napf)
        assert any(credit in text.get_text().replace("\n", " ") for text in figure.texts)
        assert all(path.stat().st_size > 0 for path in save(figure, tmp_path, "credit"))


def test_empty_worlds_lone_uavs_and_single_samples_can_be_drawn(problem: Problem) -> None:
    lone = straight_track(np.linspace([0.0, 0.0, 5.0], [0.0, 30.0, 5.0], 40)[:, None])
    blink = straight_track(np.zeros((1, 4, 3)))
    with house_style():
        for flown in (lone, blink):
            for figure in (
                paths_figure(problem, flown, ObstacleSet.empty()),
                uncertainty_figure(problem, flown, ObstacleSet.empty()),
                motion_figure(problem, flown),
                attitude_figure(problem, flown),
                distance_figure(problem, flown, ObstacleSet.empty()),
                space_figure(problem, flown, ObstacleSet.empty()),
            ):
                figure.draw_without_rendering()


def test_endless_cylinders_are_drawn_in_space_and_from_the_side(problem: Problem, napf: Track) -> None:
    posts = ObstacleSet.from_shapes([Cylinder((5.0, 1.0), 0.5), Cylinder((8.0, -2.0), 1.0, 0.0, 4.0)])
    with house_style():
        space_figure(problem, napf, posts).draw_without_rendering()
        paths_figure(problem, napf, posts).draw_without_rendering()


@given(st.lists(st.floats(-100.0, 100.0), min_size=1, max_size=8), st.floats(0.1, 20.0))
def test_labels_are_spread_in_order(places: list[float], gap: float) -> None:
    before = np.array(places)
    after = spread(before, gap)
    order = np.argsort(before, kind="stable")
    assert (np.diff(after[order]) >= gap - 1e-9).all()
    assert after.mean() == pytest.approx(before.mean(), abs=1e-9)


def test_neither_pyplot_nor_a_display_nor_the_users_settings_are_touched() -> None:
    code = (
        "import sys, matplotlib\n"
        "matplotlib.rcParams['lines.linewidth'] = 7.5\n"
        # To ask for the backend would choose one.
        "rc = matplotlib.rcParams\n"
        "settings = lambda: {key: rc[key] for key in rc if key != 'backend'}\n"
        "before = settings()\n"
        "from pathlib import Path\n"
        "from napf_mpc.plot import paper_figures\n"
        "from napf_mpc.problem_file import load_problem\n"
        "import tempfile\n"
        "with tempfile.TemporaryDirectory() as out:\n"
        "    paper_figures(load_problem('single_uav'), 'single_uav', 0, Path(out))\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
        "assert settings() == before\n"
    )
    subprocess.run([sys.executable, "-W", "error::UserWarning", "-c", code], check=True, timeout=60)


def test_colours_of_uavs_differ() -> None:
    assert len({matplotlib.colors.to_rgb(uav_colour(uav)) for uav in range(7)}) == 7
    assert uav_colour(7) == uav_colour(0)
    for uavs in (8, 12, 40):
        assert len({uav_colour(uav, uavs) for uav in range(uavs)}) == uavs
