"""Benchmarks of control steps: what is timed, how growth is fitted, what is left out and what is kept."""

from __future__ import annotations

import csv
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from napf_mpc.benchmark import planners, run, scaling
from napf_mpc.benchmark.contenders import Scene
from napf_mpc.benchmark.growth import Point, Study, growth
from napf_mpc.benchmark.planners import PILOTS, SKIP, Pilot, installed_pilots, measure_planner
from napf_mpc.benchmark.scaling import CLEAR_M, FROM_S, MIDDLE_M, STUDIES, field_of, grown
from napf_mpc.benchmark.steps import TimedPlanner, step_times
from napf_mpc.benchmark.tables import planner_tables, scaling_tables
from napf_mpc.cli import run_command
from napf_mpc.closed_loop import build_scenario
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.planner import Command
from napf_mpc.planners.registry import make_planner
from napf_mpc.plot.growth import Curve, growth_figure
from napf_mpc.plot.solvers import step_times_figure
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.solvers.solver import SolverError
from napf_mpc.world.obstacles import ObstacleSet

SHORT: dict[str, object] = {"simulation.time_limit_s": 4.0}
SCENE = Scene("study_8s", SHORT)


def short(**overrides: object) -> Problem:
    return load_problem("study_8s", {"navigation.filter": "kalman", **SHORT, **overrides})


class Sleeper:
    """NAPF that waits: 20 ms of wall time, and next to no processor time."""

    name = "sleeper"

    def __init__(self, problem: Problem) -> None:
        self._planner = make_planner("napf", problem)

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        self._planner.reset(obstacles, runs)

    def step(self, nav: NavSolution, time_s: float) -> Command:
        time.sleep(0.02)
        return self._planner.step(nav, time_s)


def test_every_step_is_timed_in_processor_and_wall_time() -> None:
    problem = short()
    timed = TimedPlanner(Sleeper(problem))
    assert timed.name == "sleeper"
    times = step_times(problem, Sleeper(problem), build_scenario(problem, 0, range(2)), 3)
    assert len(times) == 40 - 3
    assert times[0].time_s == pytest.approx(0.3)
    assert {step.uavs for step in times} == {8}
    assert all(step.wall_us >= 20_000.0 for step in times)
    assert np.median([step.cpu_us for step in times]) < 10_000.0


def test_a_timed_flight_is_the_flight() -> None:
    problem = short()
    seen: list[Command] = []

    class Watch(Sleeper):
        def step(self, nav: NavSolution, time_s: float) -> Command:
            seen.append(self._planner.step(nav, time_s))
            return seen[-1]

    for timed in (False, True):
        planner = TimedPlanner(Watch(problem)) if timed else Watch(problem)
        step_times(problem, planner, build_scenario(problem, 0, range(1)), 0)
    assert len(seen) == 80
    for plain, again in zip(seen[:40], seen[40:], strict=True):
        np.testing.assert_array_equal(plain.position, again.position)


def test_a_row_says_how_long_steps_are_and_how_many_miss_the_period(monkeypatch: pytest.MonkeyPatch) -> None:
    row, times = measure_planner("short", SCENE, "napf", Pilot("napf"), missions=2, seed=1)
    assert row.steps == len(times) == 2 * (40 - SKIP)
    assert (row.uavs, row.missions, row.late) == (4, 2, 0)
    assert 0.0 < row.median_us <= row.p95_us <= row.p99_us <= row.max_us
    assert row.median_us == pytest.approx(np.median([step.cpu_us for step in times]))
    assert 0.0 < row.planning < 1.0
    # Planning is a part of the mission: 40 steps of two formations, in lock-step.
    assert row.mission_ms > 0.0
    monkeypatch.setattr(planners, "make_planner", lambda name, problem: Sleeper(problem))
    at_50_hz = Scene("study_8s", {**SHORT, "planner.rate_hz": 50.0, "simulation.time_limit_s": 1.0})
    slow, _ = measure_planner("short", at_50_hz, "napf", Pilot("napf"), missions=1, seed=1)
    assert slow.late == slow.steps == 50 - SKIP


def test_who_is_not_installed_is_left_out_by_name() -> None:
    said: list[str] = []
    there = {"qp": PILOTS["qp"], "gone": Pilot("qp", {"planner.solver": "gone"})}
    assert list(installed_pilots(there, said.append)) == ["qp"]
    assert len(said) == 1
    assert "gone is left out" in said[0]
    with pytest.raises(SolverError, match="none of these is installed: gone"):
        installed_pilots({"gone": there["gone"]}, said.append)


def point(size: int, cost_us: float, study: str = "obstacles") -> Point:
    return Point(study, size, 16, 100, cost_us, 1.5 * cost_us, 4.0 * cost_us)


def test_the_exponent_of_a_power_is_found_exactly() -> None:
    fit = growth([point(size, 7.0 * size**1.5) for size in (4, 16, 100, 1000)])
    assert (fit.exponent, fit.level_us, fit.last) == pytest.approx((1.5, 7.0, 1.5))
    assert fit.half_width == pytest.approx(0.0, abs=1e-6)


def test_the_interval_of_the_exponent_is_students() -> None:
    """Slope 1 and residuals of -1, 2 and -1 times log 1.1: t(1) 0.975 = 12.706."""
    sizes, off = (1, 10, 100), (1.1**-1, 1.1**2, 1.1**-1)
    fit = growth([point(size, size * factor) for size, factor in zip(sizes, off, strict=True)])
    assert fit.exponent == pytest.approx(1.0)
    error = math.log(1.1) * math.sqrt(6.0) / (math.sqrt(2.0) * math.log(10.0))
    assert fit.half_width == pytest.approx(12.7062 * error, rel=1e-4)
    assert fit.last == pytest.approx(1.0 - 3.0 * math.log10(1.1))


def test_too_few_sizes_have_no_exponent() -> None:
    assert math.isnan(growth([point(8, 1.0), point(16, 2.0)]).exponent)
    assert growth([point(8, 1.0), point(16, 2.0)]).last == pytest.approx(1.0)
    assert math.isnan(growth([point(8, 1.0)]).last)
    own = {"obstacles": [point(8, 1.0)]}
    (table,) = scaling_tables(own, STUDIES, "flights")
    assert "too few sizes" in table.notes[0]


def test_a_size_that_would_take_too_long_is_left_out_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each takes a hundred times its size in seconds of a clock of its own; 40 would be 4000 s."""
    now = [0.0]
    measured: list[int] = []

    def measure(size: int, seed: int) -> Point:
        measured.append(size)
        now[0] += 100.0 * size
        return point(size, 1.0)

    monkeypatch.setattr(scaling.time, "perf_counter", lambda: now[0])
    said: list[str] = []
    study = Study("things", "UAV", (1, 2, 10, 40, 80), "control step", measure)
    points = list(grown("things", study, 0, 3000.0, said.append))
    assert [each.size for each in points] == [1, 2, 10]
    assert measured == [1, 1, 2, 10]  # the first time does not count
    assert said == ["things: 40, 80 left out, would take longer than 3000 s each"]


def test_a_field_has_one_density_and_a_clear_start() -> None:
    for count in (100, 10_000):
        field = field_of(count, 5)
        assert len(field) == count
        assert field.signed_distance(np.zeros((1, 1, 3)))[0, 0] >= CLEAR_M - 2.0
        lower, upper = field.bounds()
        # Spheres reach out of the square of their centres by their radii, 2 m at most.
        area = float(np.prod((upper - lower)[:2] - 3.0))
        np.testing.assert_allclose((upper + lower)[:2] / 2.0, [MIDDLE_M, 0.0], atol=2.5)
        assert area == pytest.approx(90.0 * count, rel=0.1 if count == 100 else 0.02)
        np.testing.assert_array_equal(field_of(count, 5).bounds(), field.bounds())
    # Of eight, too, some are near where steps are timed: 20 to 40 m along the path.
    lower, upper = field_of(8, 5).bounds()
    assert lower[0] < 2.0 * FROM_S + 5.0
    assert upper[0] > 35.0


@pytest.mark.parametrize("label", [label for label in STUDIES if label != "missions"])
def test_studies_time_steps_among_obstacles(label: str) -> None:
    size = STUDIES[label].sizes[0]
    measured = STUDIES[label].measure(size, 3)
    assert (measured.study, measured.size) == (label, size)
    assert measured.uavs == (4 if "UAVs" in label else 16)
    assert measured.calls == round(10 * (20.0 - FROM_S))
    assert 0.0 < measured.cost_us <= measured.p99_us
    assert STUDIES[label].share_us(measured) == pytest.approx(measured.cost_us / measured.uavs)


def test_a_formation_that_grows_stands_on_a_grid() -> None:
    measured = STUDIES["UAVs of a formation"].measure(9, 3)
    assert measured.uavs == 9


def test_missions_are_whole_and_cost_processor_time(monkeypatch: pytest.MonkeyPatch) -> None:
    flown: list[range] = []

    def fly(problem: Problem, names: list[str], seed: int, runs: range) -> None:
        flown.append(runs)
        time.sleep(0.2)  # wall time is not what is asked for

    monkeypatch.setattr(scaling, "fly_block", fly)
    study = STUDIES["missions"]
    measured = study.measure(1000, 3)
    assert [run for block in flown for run in block] == list(range(1000))
    assert measured.cost_us < 1e5 * len(flown)
    assert study.share_us(measured) == pytest.approx(1e-3 * measured.cost_us)


def test_files_hold_what_was_measured(tmp_path: Path) -> None:
    said: list[str] = []
    pilots = {name: PILOTS[name] for name in ("napf", "qp")}
    shown, paths = run.benchmark_planners({"short": SCENE}, pilots, 1, 3, tmp_path, said.append)
    assert {path.name for path in paths} == {
        "planners.csv", "planners.md", "planners_1.png", "planners_1.svg"
    }  # fmt: skip
    assert [row[0] for row in shown[0].rows] == ["napf", "qp"]
    with (tmp_path / "planners.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["planner"] for row in rows] == ["napf", "qp"]
    # The QP plans twenty stages; a field looks at one place.
    assert float(rows[1]["median_us"]) > float(rows[0]["median_us"]) > 0.0
    words = (tmp_path / "planners.md").read_text(encoding="utf-8")
    assert "seed 3" in words
    assert "Python 3" in words

    def measure(size: int, seed: int) -> Point:
        if size == 3:
            raise KeyboardInterrupt
        return point(size, 1e3 * size, "things")

    studies = {"things": Study("things", "UAV", (1, 2, 3), "control step", measure)}
    with pytest.raises(KeyboardInterrupt):
        run.benchmark_scaling(studies, 3, 60.0, tmp_path, said.append)
    with (tmp_path / "scaling.csv").open(encoding="utf-8") as file:
        assert [row["size"] for row in csv.DictReader(file)] == ["1", "2"]
    _, paths = run.benchmark_scaling(
        {"things": replace(studies["things"], sizes=(1, 2))}, 3, 60.0, tmp_path, said.append
    )
    assert {path.name for path in paths} == {"scaling.csv", "scaling.md", "scaling.png", "scaling.svg"}


def test_a_percentile_of_few_steps_is_not_shown() -> None:
    row, _ = measure_planner("short", SCENE, "napf", Pilot("napf"), missions=1, seed=1)
    for steps, cell in ((99, "-"), (100, f"{row.p99_us:.0f}")):
        (table,) = planner_tables([replace(row, steps=steps)], "")
        assert dict(zip(table.header, table.rows[0], strict=True))["p99"] == cell


def test_figures_show_medians_and_the_fit() -> None:
    curve = Curve("obstacles", (1, 10, 100), (1.0, 10.0, 100.0), (2.0, 20.0, np.nan), 1.0, 1.0)
    (axes,) = growth_figure({"obstacles": curve}).axes
    medians, _, fit = axes.lines
    np.testing.assert_allclose(medians.get_ydata(), [1.0, 10.0, 100.0])
    np.testing.assert_allclose(fit.get_ydata(), [1.0, 100.0])
    (axes,) = step_times_figure({"a": np.array([1.0, 3.0, 3.0, 9.0])}, 0.1).axes
    steps = axes.lines[0]
    np.testing.assert_allclose(steps.get_ydata()[-1], 1.0)
    assert axes.lines[-1].get_xdata()[0] == 1e5


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("planners --scenes nowhere", "does not know 'nowhere'"),
        ("planners --planners pq", "does not know 'pq'"),
        ("planners --missions 0", '"0": must be a number of at least 1'),
        ("planners --seed -1", "seed = -1"),
        ("scaling --studies weather", "does not know 'weather'"),
        ("scaling --budget 0", '"0": must be a number of at least 0.1'),
        ("scaling --budget nan", '"nan": must be a number of at most 1000000'),
        ("scaling --seed -1", "seed = -1"),
        ("weather", "weather"),
        ("", "of what? choose from solvers, nonlinear, planners, scaling"),
    ],
)
def test_bad_input_is_one_clear_line(arguments: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["benchmark", *arguments.split()]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert "Traceback" not in error
    assert len(error.splitlines()) == 1
