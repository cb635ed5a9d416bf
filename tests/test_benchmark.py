"""The solver benchmark: who lies is found out, nobody is lost, files say what was measured."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from napf_mpc.benchmark.contenders import CONTENDERS, OSQP, SCENES, Contender, Scene
from napf_mpc.benchmark.programs import flown
from napf_mpc.benchmark.run import benchmark_solvers
from napf_mpc.benchmark.solvers import ALONE, TOGETHER, Row, measure, summaries
from napf_mpc.cli import run_command
from napf_mpc.plot.solvers import solvers_figure
from napf_mpc.problem_file import load_problem
from napf_mpc.qp import HorizonQp
from napf_mpc.solvers import batch
from napf_mpc.solvers.batch import BatchResult, Mask, WarmStart, make_batch_solver, register_batch_solver

SHORT: dict[str, object] = {"simulation.time_limit_s": 12.0}
SCENE = {"short": Scene("study_8s", SHORT)}
FLIGHT = {"missions": 2, "every": 30, "seed": 3}


class Liar:
    """The kernel's answers with other inputs, called solved all the same."""

    def __init__(self) -> None:
        self._solver = make_batch_solver("kernel")

    def reset(self) -> None:
        self._solver.reset()

    def solve_batch(
        self, horizon: HorizonQp, warm: WarmStart | None = None, active: Mask | None = None
    ) -> BatchResult:
        answer = self._solver.solve_batch(horizon, warm, active)
        return replace(answer, inputs=answer.inputs + 0.3, z=answer.z + 0.3)


@pytest.fixture
def liar(monkeypatch: pytest.MonkeyPatch) -> Contender:
    monkeypatch.setattr(batch, "_BATCH_FACTORIES", dict(batch._BATCH_FACTORIES))
    register_batch_solver("liar", Liar)
    return Contender("liar")


def test_claims_and_truth_are_two_columns(liar: Contender) -> None:
    contenders = {"kernel": CONTENDERS["kernel"], OSQP: CONTENDERS[OSQP], "liar": liar}
    rows = measure(SCENE, contenders, **FLIGHT)
    steps = {row.step for row in rows}
    assert len(rows) == 3 * 2 * len(steps) > 0
    found = {one.contender: one for one in summaries(rows)}
    assert list(found) == list(contenders)
    for name in ("kernel", OSQP):
        one = found[name]
        assert one.claimed == one.correct == one.programs
        assert one.input_error < 1e-4
    assert found["kernel"].residual < 1e-9
    assert found["liar"].claimed == found["liar"].programs
    assert found["liar"].correct == 0
    assert found["liar"].residual > 1e-3
    assert found["liar"].input_error > 0.01
    assert found[OSQP].alone_gain == (1.0, 1.0, 1.0)


def test_every_contender_sees_the_same_programs() -> None:
    rows = measure(SCENE, {name: CONTENDERS[name] for name in ("kernel", "kernel, cold")}, **FLIGHT)
    for calls in (ALONE, TOGETHER):
        shown = [
            [(row.step, row.programs) for row in rows if (row.contender, row.calls) == (name, calls)]
            for name in ("kernel", "kernel, cold")
        ]
        assert shown[0] == shown[1]
        assert {programs for _, programs in shown[0]} == ({1} if calls == ALONE else {8})


def test_who_is_not_installed_is_left_out_by_name() -> None:
    said: list[str] = []
    contenders = {"kernel": CONTENDERS["kernel"], "none": Contender("proxqp", {"no_such_setting": object()})}
    try:
        make_batch_solver("proxqp")
    except Exception:
        rows = measure(SCENE, contenders, **FLIGHT, tell=said.append)
        assert {row.contender for row in rows} == {"kernel"}
        assert any(words.startswith("none is left out") for words in said)
    else:
        pytest.skip("proxqp is installed")


def test_summaries_are_quantiles_of_single_programs() -> None:
    def row(step: int, cpu_us: float, calls: str, name: str) -> Row:
        return Row("s", name, calls, step, 1, 1, 1, 1e-12, 1e-9, cpu_us, 2.0 * cpu_us)

    rows = [row(i, 10.0 + i, calls, "mine") for i in range(101) for calls in (ALONE, TOGETHER)]
    rows += [row(i, 20.0 + 2.0 * i, calls, OSQP) for i in range(101) for calls in (ALONE, TOGETHER)]
    mine = summaries(rows)[0]
    assert (mine.median_us, mine.p95_us, mine.p99_us, mine.max_us) == pytest.approx((60, 105, 109, 110))
    assert mine.alone_gain == pytest.approx((2.0, 2.0, 2.0))
    assert mine.programs == 202


def test_the_interval_of_a_gain_is_that_of_the_median() -> None:
    rows = []
    for i in range(100):
        for calls in (ALONE, TOGETHER):
            rows.append(Row("s", "mine", calls, i, 1, 1, 1, 0.0, 0.0, 1.0, 1.0))
            rows.append(Row("s", OSQP, calls, i, 1, 1, 1, 0.0, 0.0, float(i + 1), 1.0))
    mine = summaries(rows)[0]
    # Order statistics 40 and 61 of 100 hold the median with 95 % at least (binomial).
    assert mine.alone_gain == (50.5, 40.0, 61.0)


def test_scenes_are_what_their_labels_say() -> None:
    rows = {}
    for label, scene in SCENES.items():
        problem = load_problem(scene.problem, {"navigation.filter": "kalman", **scene.overrides, **SHORT})
        step = flown(problem, missions=1, every=100, seed=0)[0]
        rows[label] = (step.horizon.shape[2], sum(block.count for block in step.horizon.rows[:2]))
    assert rows["8 spheres"] == rows["40 cylinders"] == (20, 8)
    assert rows["40 spheres, N = 30"] == (30, 8)
    assert rows["40 spheres, N = 50"] == (50, 8)
    assert rows["40 spheres, 4 rows"] == (20, 4)
    assert rows["40 spheres, 16 rows"] == (20, 16)


def test_files_hold_all_rows_and_where_they_come_from(tmp_path: Path) -> None:
    contenders = {name: CONTENDERS[name] for name in ("kernel", OSQP)}
    said: list[str] = []
    shown, paths = benchmark_solvers(SCENE, contenders, 2, 30, 3, tmp_path, said.append)
    assert {path.name for path in paths} == {"solvers.csv", "solvers.md", "solvers_1.png", "solvers_1.svg"}
    with (tmp_path / "solvers.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["contender"] for row in rows} == set(contenders)
    assert all(float(row["cpu_us"]) > 0.0 for row in rows)
    words = (tmp_path / "solvers.md").read_text(encoding="utf-8")
    assert "seed 3" in words
    assert "osqp 1" in words
    assert "Python 3" in words
    assert len(shown) == 1


def test_an_incorrect_answer_never_arrives_in_the_figure() -> None:
    times = {"fast": np.array([1.0, 1.0, 1.0, 1.0]), "slow": np.array([4.0, 4.0, 4.0, 4.0])}
    correct = {"fast": np.array([True, True, False, False]), "slow": np.ones(4, dtype=bool)}
    left, right = solvers_figure(times, correct, 0.1).axes[:2]
    heights = [line.get_ydata()[-1] for line in left.lines]
    assert heights == [0.5, 1.0]
    assert right.lines[0].get_ydata()[-1] == 0.5
    # Where only the slow one is right it is the fastest that is.
    np.testing.assert_allclose(np.unique(left.lines[1].get_xdata()), [1.0, 4.0])


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--scenes", "9 spheres", "does not know '9 spheres'"),
        ("--solvers", "kernel; gurobi", "does not know 'gurobi'"),
        ("--scenes", ";", "names nothing"),
        ("--missions", "0", "greater than or equal to 1"),
        ("--every", "x", "a valid integer"),
    ],
)
def test_bad_input_is_one_clear_line(
    option: str, value: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["benchmark", "solvers", option, value]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert "Traceback" not in error
