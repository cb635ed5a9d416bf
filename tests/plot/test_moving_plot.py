"""What moves in figures: its path, where it was when it came closest, contacts with it."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.patches import Circle
from numpy.typing import NDArray
from PIL import Image, ImageSequence

from napf_mpc.block import Missions, simulate
from napf_mpc.figures import draw_stored
from napf_mpc.mission import fly_mission
from napf_mpc.plot.animate import animation
from napf_mpc.plot.flight import paths_figure
from napf_mpc.plot.overview import Mission, overview_figure
from napf_mpc.plot.states import distance_figure
from napf_mpc.plot.tracks import Track, clearances, contacts, track
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]
NOTHING = ObstacleSet.empty()


@pytest.fixture(scope="module")
def flown() -> tuple[Problem, Missions, Track]:
    """A flight that does not look, so that it is hit."""
    settings = ["mission.length_m=30", "planner.repulsive_gain=0", "navigation.error_scale=0"]
    settings += ["world.moving[0].acceleration_sigma_mps2=0"]
    problem = load_problem("crossing_traffic", settings)
    missions = simulate(problem, "apf", seed=102, runs=1, record_every=5)
    return problem, missions, track(missions.trajectories, "apf", 0)


def test_clearance_counts_what_moves(flown: tuple[Problem, Missions, Track]) -> None:
    """The least of all recorded samples is the judge's but for what happens between two of them."""
    problem, missions, flight = flown
    assert missions.scenario.moving is not None
    radius = problem.vehicle.radius_m
    assert np.isinf(clearances(flight, NOTHING, radius)).all()
    least = float(clearances(flight, NOTHING, radius, missions.scenario.moving).min())
    assert missions.score.metrics["min_clearance_m"][0] == pytest.approx(least, abs=0.05)
    (found,) = contacts(flight, NOTHING, radius, missions.scenario.moving)
    assert found.clearance_m == pytest.approx(least, abs=0.05)
    assert missions.score.obstacle_contact[0].tolist() == [uav == found.uav for uav in range(4)]
    assert contacts(flight, NOTHING, radius) == []


def test_the_top_view_shows_paths_and_places(flown: tuple[Problem, Missions, Track]) -> None:
    problem, missions, flight = flown
    moving = missions.scenario.moving
    assert moving is not None
    plan = paths_figure(problem, flight, NOTHING, moving=moving).axes[1]
    path = np.stack([moving.position(time)[0, 0, :2] for time in flight.time_s.tolist()])
    drawn = [np.column_stack(line.get_data()) for line in plan.get_lines()]
    assert any(line.shape == path.shape and np.array_equal(line, path) for line in drawn)
    circles = [patch for patch in plan.patches if isinstance(patch, Circle)]
    assert [circle.radius for circle in circles] == moving.radius.tolist()
    assert len(contacts(flight, NOTHING, 0.3, moving)) == sum(
        line.get_marker() == "X" for line in plan.get_lines()
    )
    without = paths_figure(problem, flight, NOTHING).axes[1]
    assert not without.patches
    assert len(without.get_lines()) == len(drawn) - moving.count - 1


def test_the_other_figures_take_them(flown: tuple[Problem, Missions, Track]) -> None:
    problem, missions, flight = flown
    moving = missions.scenario.moving
    lines = [
        line.get_ydata() for line in distance_figure(problem, flight, NOTHING, moving).axes[0].get_lines()
    ]
    assert any(np.nanmin(np.asarray(line, dtype=float)) < 0.0 for line in lines)
    figure = overview_figure(
        problem, missions.trajectories, lambda run: NOTHING, [Mission("apf", 0)], lambda run: moving
    )
    assert sum(isinstance(patch, Circle) for patch in figure.axes[0].patches) == 3


def test_an_animation_shows_them_in_every_frame(
    flown: tuple[Problem, Missions, Track], tmp_path: Path
) -> None:
    """In the frame at 12 s the ball that is met then darkens the picture where it is."""
    problem, missions, _ = flown
    table = missions.trajectories
    shown = {name: values[np.isin(table["t_s"], [11.5, 12.0])] for name, values in table.items()}
    frames = {}
    for name, moving in (("with", missions.scenario.moving), ("without", None)):
        path = animation(problem, shown, NOTHING, tmp_path / f"{name}.gif", "apf", moving)
        with Image.open(path) as picture:
            frames[name] = [np.asarray(frame.convert("L")) for frame in ImageSequence.Iterator(picture)]
    assert len(frames["with"]) == len(frames["without"]) == 2
    for mine, other in zip(frames["with"], frames["without"], strict=True):
        assert 50 < (np.abs(mine.astype(int) - other) > 30).sum() < 0.2 * mine.size


def test_stored_missions_are_drawn_with_them(tmp_path: Path) -> None:
    problem = load_problem("crossing_traffic", ["mission.length_m=16"])
    fly_mission(problem, "crossing", "napf", seed=1, run=2, out=tmp_path / "run")
    written = draw_stored(tmp_path / "run", tmp_path / "figures")
    (paths,) = (path for path in written if path.name == "crossing_napf_paths.svg")
    assert "moving obstacle when nearest" in paths.read_text(encoding="utf-8")
