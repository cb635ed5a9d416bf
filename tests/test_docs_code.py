"""The code of the planner page runs from top to bottom, and does what the text around it says."""

import importlib.util
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from napf_mpc.constraints.clearance import influence_model
from napf_mpc.planners import mpc, registry
from napf_mpc.planners.mpc import default_constraints
from napf_mpc.planners.plan import stage_grid
from napf_mpc.planners.tally import COLUMNS
from napf_mpc.problem import Planner, Vehicle
from napf_mpc.problem_file import load_problem
from napf_mpc.solvers import batch, solver

PAGE = Path(__file__).parents[1] / "docs" / "build_your_own_planner.md"
BLOCKS = re.findall(
    r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
)


@pytest.fixture(scope="module")
def session() -> dict[str, Any]:
    """Names after all blocks, each executed after the one before; what is registered is forgotten again."""
    names: dict[str, Any] = {"__name__": "page"}
    # Small matrices: more threads than one would only wait for each other.
    with pytest.MonkeyPatch.context() as patch, threadpool_limits(1):
        patch.setattr(solver, "_FACTORIES", {})
        patch.setattr(solver, "_NAMES", set(solver._NAMES))
        patch.setattr(batch, "_BATCH_FACTORIES", {})
        patch.setattr(registry, "_OWN", {})
        for place, block in enumerate(BLOCKS):
            exec(compile(block, f"{PAGE.name}, block {place + 1}", "exec"), names)
            names.setdefault("commands", []).append(names["command"])
    return names


def test_there_is_code() -> None:
    assert len(BLOCKS) >= 8


def test_the_first_plan_is_flown_and_keeps_its_margin(session: dict[str, Any]) -> None:
    first = session["commands"][0]
    assert first.planned.all()
    assert (first.solver_status == "solved").all()
    assert session["clearance"] > 1.0 - 0.01  # k sigma, at the nodes of the plan


def test_solvers_of_ones_own_give_the_same_plan(session: dict[str, Any]) -> None:
    assert "interior_point" not in solver.solver_names()
    (place,) = (i for i, block in enumerate(BLOCKS) if "register_solver(" in block)
    assert (session["commands"][place].solver_status == "solved").all()
    places = session["places"]
    np.testing.assert_allclose(places["interior_point"], places["kernel"], atol=1e-5)
    assert len(session["timed"].seconds) == 4


def test_a_solver_of_ones_own_is_benchmarked(session: dict[str, Any]) -> None:
    (table,) = session["tables"]
    correct = {row[0]: row[table.header.index("correct")] for row in table.rows}
    assert correct == {"kernel": "100.0%", "ours": "100.0%"}


def test_lost_navigation_is_an_event_and_a_count(session: dict[str, Any]) -> None:
    command = session["commands"][-1]
    np.testing.assert_array_equal(command.planned[0], [True, False, True, True])
    assert session["counts"]["fall_back_hover"] == 1
    assert [(e.uav, e.cause) for e in session["planner"].ladder.events] == [(1, "navigation")]


def test_every_count_of_the_tally_is_in_the_table() -> None:
    text = PAGE.read_text(encoding="utf-8")
    table = set(re.findall(r"`(\w[\w<>]*|_\w+)`", text.partition("| count |")[2].partition("\n\n")[0]))
    table = {f"fall_back{word}" if word.startswith("_") else word for word in table}
    assert table == {re.sub("^solves_.*", "solves_<status>", name) for name in COLUMNS} | {
        "largest_slack_m",
        "kernel",
    }


def test_the_planner_from_nothing_flies(session: dict[str, Any]) -> None:
    assert str(session["flown"].score.outcome[0]) in ("reached", "collided")
    assert bool(session["flown"].score.finished[0])


def test_the_planner_from_nothing_is_compared_by_its_name(session: dict[str, Any]) -> None:
    assert "over" not in registry.planner_names()
    found = session["summary"]["planners"]
    assert list(found) == ["napf", "over"]
    assert found["over"]["runs"] == found["napf"]["runs"] == 2
    assert found["over"]["path_rms_m"]["mean"] != found["napf"]["path_rms_m"]["mean"]


QP_PAGE = (PAGE.parent / "qp_planner.md").read_text(encoding="utf-8")


def test_keys_and_defaults_of_the_qp_page_are_those_of_the_planner() -> None:
    settings = Planner()
    for key in set(re.findall(r"`planner\.(\w+)`", QP_PAGE)):
        assert key in Planner.model_fields, key
    quoted = re.findall(r"`planner\.(\w+)` (?:= |\(|\| )(\d[\d.]*)", QP_PAGE)
    assert len(quoted) >= 10
    for key, value in quoted:
        assert getattr(settings, key) == float(value), key
    assert f"| `planner.thrust_weight` | as {mpc.THRUST_WEIGHT:g} at {Vehicle().mass_kg:g} kg |" in QP_PAGE
    assert f"| `planner.torque_weight` | as {mpc.TORQUE_WEIGHT:g} at" in QP_PAGE
    words = " ".join(QP_PAGE.split())
    assert (
        f"`planner.contact_price` is {mpc.CONTACT_PRICE:g} /(m s) for formations up to {mpc.FAST_MPS:g} m/s"
        in words
    )
    assert f"{mpc.FAST_CONTACT_PRICE:g} behind a filter and {mpc.FAST_RAW_CONTACT_PRICE:g} on raw" in words
    assert f"`planner.cohesion_room_m` from the lane,\nby default {settings.room_m:g} m" in QP_PAGE


def test_the_grid_of_the_qp_page_is_the_default_one() -> None:
    settings = Planner()
    steps = stage_grid(1.0 / settings.rate_hz, settings.horizon, settings.look_ahead_s)
    same, rest = re.search(r"10 Hz: 0\.1 s (\w+) times, then ([\d., ]+) s\.", QP_PAGE).groups()  # type: ignore[union-attr]
    assert same == "six"
    np.testing.assert_allclose(steps, [0.1] * 6 + [float(step) for step in rest.split(", ")])


def test_rows_of_the_qp_page_are_those_of_the_planner() -> None:
    problem = load_problem("study_8s")
    table = QP_PAGE.partition("| rows |")[2].partition("\n\n")[0]
    rows = [line.split("|")[1].strip() for line in table.splitlines()[2:]]
    assert rows == [constraint.name for constraint in default_constraints(problem)]


def test_counts_of_the_qp_page_are_those_of_the_tally() -> None:
    table = QP_PAGE.partition("| in `summary.json` |")[2].partition("\n\n")[0]
    named = set(re.findall(r"`(\w+)`", table))
    missing = {*COLUMNS, "largest_slack_m"} - named
    assert all(name.startswith("solves_") for name in missing), missing


def test_a_frozen_weight_leaps_and_the_second_order_model_does_not() -> None:
    gain, range_m, rho = 15.0, 3.0, 1.2
    pull = gain * (1.0 / rho - 1.0 / range_m) / rho**2
    frozen = model = rho + 1e-4
    frozen = range_m - pull * range_m * frozen**3 / gain
    weight, target = influence_model(np.array(model), gain, range_m, 0.1)
    model = float(target - pull / weight)
    assert frozen - rho == pytest.approx(-3.0 * (range_m - rho) / rho * 1e-4, rel=1e-3)
    assert abs(model - rho) < 1e-7


@pytest.mark.parametrize("page", [PAGE.read_text(encoding="utf-8"), QP_PAGE], ids=["build", "qp"])
def test_modules_exist(page: str) -> None:
    for name in set(re.findall(r"`(napf_mpc(?:\.\w+)+)`", page)):
        assert importlib.util.find_spec(name), name


def test_errors_of_ones_own_are_flown_and_judged(session: dict[str, Any]) -> None:
    score, errors = session["drifted"], session["scenario"].errors
    assert [str(outcome) for outcome in score.outcome] == ["reached"] * 3
    np.testing.assert_allclose(errors.fix(10).error, errors.drift)  # after a second
    assert (score.metrics["within_k_sigma_east"] > 0.9).all()
