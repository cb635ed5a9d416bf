"""Tables of the benchmarks: nobody is lost between runs and reasons, tests are corrected for all of them."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from napf_mpc import store
from napf_mpc.campaign import simulate
from napf_mpc.problem_file import load_problem
from napf_mpc.risk import holm, mcnemar
from napf_mpc.safety_distance import Inflation
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Shape, Sphere

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture
def comparison(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module as its script finds it."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import comparison

    yield comparison
    del sys.modules["comparison"]


@pytest.fixture
def planner_settings(comparison: Any) -> Any:
    """The module, which reads what comparison has flown."""
    import planner_settings

    yield planner_settings
    del sys.modules["planner_settings"]


@pytest.fixture
def orca(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module, with a package that does what it is asked: its geometry needs none."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import orca

    monkeypatch.setattr(orca, "package", lambda: SimpleNamespace(RVOSimulator=Willing))
    yield orca
    del sys.modules["orca"]


class Willing:
    """Simulator of ORCA that lets every agent fly as it prefers."""

    def __init__(self) -> None:
        self.preferred: list[tuple[float, float]] = []

    def __getattr__(self, name: str) -> Any:
        return lambda *given: None

    def add_agent(self, place: tuple[float, float]) -> int:
        self.preferred.append(place)
        return len(self.preferred) - 1

    def set_agent_pref_velocity(self, agent: int, velocity: tuple[float, float]) -> None:
        self.preferred[agent] = velocity

    def get_agent_velocity(self, agent: int) -> Any:
        return SimpleNamespace(x=self.preferred[agent][0], y=self.preferred[agent][1])


def result(**changed: Any) -> dict[str, Any]:
    return {"runs": 10, "finished": 0.5, "failed": 1, "reasons": {"waits for a safe passage": 3}, **changed}


def test_every_run_that_did_not_finish_has_a_reason_or_none_is_claimed(comparison: Any) -> None:
    # 10 runs: 5 finished, 1 failed, 3 waited; the tenth just was too slow.
    assert comparison.reasons(result()) == "3 waits for a safe passage, 1 on the way when time was up"
    assert comparison.reasons(result(finished=1.0, failed=0, reasons={})) == "-"
    assert comparison.reasons(result(finished=0.9, failed=1, reasons={})) == "-"


def test_p_values_are_corrected_for_every_test_under_the_table(comparison: Any) -> None:
    hits = {
        "NAPF, k = 3": [1, 1, 1, 1, 1, 1, 0, 0],
        "QP, k = 3": [0] * 8,
        "QP, k = 1": [0, 0, 0, 0, 1, 1, 1, 0],
    }
    rows = [
        comparison.Flown(cell, label, {}, np.array(hit, dtype=bool))
        for cell in ("8S", "8C")
        for label, hit in hits.items()
    ]
    head, _, first, second = comparison.paired_table(rows, comparison.same_k)
    # One pair of the same k in each of two cells: six runs in which only NAPF hit, p = 2 / 2**6, twice that.
    assert "Holm, 2 tests" in head
    p = mcnemar(6, 0)
    assert p == pytest.approx(2.0 / 2**6)
    expected = f"| NAPF, k = 3 | QP, k = 3 | 0 | 6 | 0 | 2 | {p:.2g} | {holm([p, p])[0]:.2g} |"
    assert first == f"| 8S {expected}"
    assert second == f"| 8C {expected}"
    assert comparison.paired_table(rows[:1], comparison.same_k) == []


def test_labels_may_hold_commas(comparison: Any, capsys: pytest.CaptureFixture[str]) -> None:
    parser, known = comparison.argparse.ArgumentParser(), comparison.CELLS
    assert comparison.chosen(parser, "cells", "8S filter, tau 2 s", known) == ["8S filter, tau 2 s"]
    assert comparison.chosen(parser, "cells", "8S filter,8C raw", known) == ["8S filter", "8C raw"]
    assert comparison.chosen(parser, "cells", "8S filter, tau 2 s;8C raw", known)[0] == "8S filter, tau 2 s"
    for given in ("9S", ";"):
        with pytest.raises(SystemExit):
            comparison.chosen(parser, "cells", given, known)
    assert '"9S" is not one of: 8S filter; 40S filter' in capsys.readouterr().err


def polygons(orca: Any, shapes: list[Shape], k: float, place: tuple[float, float, float]) -> list[np.ndarray]:
    problem = load_problem("study_8c")
    planner = orca.OrcaPlanner(problem, Inflation(k), "orca")
    planner.reset(ObstacleSet.from_shapes(shapes), 1)
    found = planner._polygons(0, np.array(place), np.diag([1.0, 0.25, 1.0]))
    return [np.array(polygon) for polygon in found]


def side_ahead(polygon: np.ndarray, place: tuple[float, float, float]) -> float:
    """Distance from a place to the middle of the polygon's nearest side."""
    middles = 0.5 * (polygon + np.roll(polygon, -1, axis=0))
    return float(np.sqrt(((middles - place[:2]) ** 2).sum(-1)).min())


@pytest.mark.parametrize("shape", [Cylinder((6.0, 0.0), 2.0), Sphere((6.0, 0.0, 9.0), 2.0)])
def test_a_polygon_is_as_near_as_its_circle_grown_by_k_sigma(shape: Shape, orca: Any) -> None:
    here = (0.0, 0.0, 0.0)
    for k, left in ((0.0, 4.0), (3.0, 1.0)):  # 6 m less 2 m, less 3 sigma of 1 m towards east
        (polygon,) = polygons(orca, [shape], k, here)
        assert side_ahead(polygon, here) == pytest.approx(left, abs=1e-9)
        x, y = polygon.T
        area = 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
        assert area > np.pi * (6.0 - left) ** 2  # anticlockwise, and the circle is inside


def test_sigma_is_that_towards_the_obstacle(orca: Any) -> None:
    (polygon,) = polygons(orca, [Cylinder((0.0, 6.0), 2.0)], 3.0, (0.0, 0.0, 0.0))
    assert side_ahead(polygon, (0.0, 0.0, 0.0)) == pytest.approx(6.0 - 2.0 - 3.0 * 0.5, abs=1e-9)


def test_an_estimate_inside_a_grown_obstacle_stays_outside_its_polygon(orca: Any) -> None:
    for place in ((3.5, 0.0, 0.0), (4.5, 0.0, 0.0)):  # in the margin, and in the obstacle itself
        (polygon,) = polygons(orca, [Cylinder((6.0, 0.0), 2.0)], 3.0, place)
        assert side_ahead(polygon, place) == pytest.approx(orca.SHUT_M, abs=1e-9)
    assert polygons(orca, [Cylinder((6.0, 0.0), 2.0)], 3.0, (6.0, 0.0, 0.0)) == []  # no way out of its middle
    assert polygons(orca, [Cylinder((90.0, 0.0), 2.0)], 3.0, (0.0, 0.0, 0.0)) == []  # too far to matter


def test_what_is_not_round_is_refused(orca: Any) -> None:
    with pytest.raises(orca.ProblemError, match="holds a Box: ORCA here knows round ones only"):
        polygons(orca, [Box((6.0, 0.0, 0.0), (1.0, 1.0, 1.0))], 0.0, (0.0, 0.0, 0.0))


def test_a_formation_that_orca_leaves_alone_flies_its_lanes(orca: Any) -> None:
    problem = load_problem(
        "study_8c", {"world.count": 0, "navigation.error_scale": 0.0, "mission.length_m": 40}
    )
    score = simulate(problem, orca.OrcaPlanner(problem, Inflation(3.0), "orca"), runs=1).score
    assert [str(outcome) for outcome in score.outcome] == ["reached"]
    assert score.metrics["path_rms_m"][0] < 0.5


def test_the_table_of_wrong_sigmas_counts_first_alarms_and_bounds_medians(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import monitor_scale

    # The true median of 100 values lies outside of the 40th and 61st in one case of 28.
    assert monitor_scale.median_interval(np.arange(100.0, 0.0, -1.0)) == (40.0, 61.0)
    cause = "reported sigma up too small for its innovations"
    events = {
        "run": [0, 0, 0, 1, 1],
        "uav": [0, 0, 2, 0, 1],
        "t_s": [30.0, 20.0, 50.0, 40.0, 1.0],
        "cause": [cause, cause, cause, cause, "upset"],
    }
    assert sorted(monitor_scale.first_alarms(events)) == [20.0, 40.0, 50.0]


def test_differences_of_settings_are_those_of_pairs_with_their_interval(
    planner_settings: Any, tmp_path: Path
) -> None:
    """Runs in any order: 1 m more in each but one, which has no number; 0.1 m to and fro; nothing."""
    run = np.arange(101)
    path = 5.0 + np.sin(run)
    for label, extra, order in (("as shipped", 0.0, run), ("two passes", 1.0, run[::-1])):
        folder = planner_settings.folder_of(tmp_path, "8S filter", label)
        folder.mkdir()
        shape = 2.0 + extra * 0.1 * np.where(run % 2, 1.0, -1.0)
        columns = {"path_rms_m": path + extra, "shape_rms_m": shape, "control_effort": 9.0 - path}
        columns["path_rms_m"][100] = columns["shape_rms_m"][100] = np.nan
        store.write_table(folder / "runs.parquet", {"run": order} | {k: v[order] for k, v in columns.items()})
    planner_settings.SETTINGS = {"as shipped": [], "two passes": ["planner.passes=2"]}
    *_, line = planner_settings.difference_table(tmp_path, ["8S filter"])
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    half = 1.96 * np.std([0.1, -0.1] * 50, ddof=1) / 10.0
    assert cells == [
        "8S filter", "two passes", "+1.000 [+1.000, +1.000]",
        f"+0.000 [{-half:+.3f}, {half:+.3f}]", "+0.000 [+0.000, +0.000]",
    ]  # fmt: skip
    assert half == pytest.approx(0.0197, abs=1e-4)
