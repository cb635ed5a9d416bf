"""The solver benchmark: who lies is found out, nobody is lost, files say what was measured."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import exactness
import numpy as np
import pytest

from napf_mpc.benchmark import run
from napf_mpc.benchmark.contenders import CONTENDERS, OSQP, SCENES, Contender, Scene
from napf_mpc.benchmark.programs import flown
from napf_mpc.benchmark.solvers import ALONE, TOGETHER, Row, gain, installed, measure, summaries
from napf_mpc.benchmark.tables import tables
from napf_mpc.cli import run_command
from napf_mpc.errors import ProblemError
from napf_mpc.plot.solvers import solvers_figure
from napf_mpc.problem_file import load_problem
from napf_mpc.qp import HorizonQp
from napf_mpc.solvers import batch, solver
from napf_mpc.solvers.batch import BatchResult, Mask, WarmStart, make_batch_solver, register_batch_solver
from napf_mpc.solvers.solver import SolverError

SHORT: dict[str, object] = {"simulation.time_limit_s": 12.0}
SCENE = {"short": Scene("study_8s", SHORT)}
FLIGHT: dict[str, int] = {"missions": 2, "every": 30, "seed": 3}


class Liar:
    """The kernel's answers with other inputs, called solved all the same."""

    def __init__(self) -> None:
        self._solver = make_batch_solver("kernel")
        self.warm: list[bool] = []
        self.resets = 0

    def reset(self) -> None:
        self.resets += 1
        self._solver.reset()

    def solve_batch(
        self, horizon: HorizonQp, warm: WarmStart | None = None, active: Mask | None = None
    ) -> BatchResult:
        self.warm.append(warm is not None)
        answer = self._solver.solve_batch(horizon, warm, active)
        return replace(answer, inputs=answer.inputs + 0.3, z=answer.z + 0.3)


@pytest.fixture
def liars(monkeypatch: pytest.MonkeyPatch) -> list[Liar]:
    """All solvers named liar that are made."""
    monkeypatch.setattr(batch, "_BATCH_FACTORIES", dict(batch._BATCH_FACTORIES))
    monkeypatch.setattr(solver, "_NAMES", set(solver._NAMES))
    made: list[Liar] = []

    def make() -> Liar:
        made.append(Liar())
        return made[-1]

    def absent() -> Liar:
        raise SolverError("its package is missing")

    register_batch_solver("liar", make)
    register_batch_solver("absent", absent)
    return made


def measured(contenders: dict[str, Contender]) -> list[Row]:
    return measure("short", SCENE["short"], contenders, **FLIGHT)


def test_claims_and_truth_are_two_columns(liars: list[Liar]) -> None:
    contenders = {"kernel": CONTENDERS["kernel"], OSQP: CONTENDERS[OSQP], "liar": Contender("liar")}
    rows = measured(contenders)
    steps = {row.step for row in rows}
    assert len(rows) == 3 * (2 + 1) * len(steps) > 0  # two missions alone, and all together
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
    assert found[OSQP].alone_gain[0] == 1.0


def test_every_contender_sees_the_same_programs() -> None:
    rows = measured({name: CONTENDERS[name] for name in ("kernel", "kernel, cold")})
    for calls in (ALONE, TOGETHER):
        shown = [
            [
                (row.step, row.run, row.uav, row.programs)
                for row in rows
                if (row.contender, row.calls) == (name, calls)
            ]
            for name in ("kernel", "kernel, cold")
        ]
        assert shown[0] == shown[1]
        assert {programs for *_, programs in shown[0]} == ({1} if calls == ALONE else {8})


@pytest.mark.parametrize(("keep", "warm"), [(True, True), (True, False), (False, True), (False, False)])
def test_workspaces_and_guesses_are_kept_as_said(liars: list[Liar], keep: bool, warm: bool) -> None:
    measured({"liar": Contender("liar", keep=keep, warm=warm)})
    assert len(liars) == 2  # one for single calls, one for those of all
    for liar in liars:
        assert len(liar.warm) > 2
        assert set(liar.warm) == {warm}
        assert liar.resets == (0 if keep else len(liar.warm))


def test_who_is_not_installed_is_left_out_by_name(liars: list[Liar]) -> None:
    said: list[str] = []
    contenders = {"kernel": CONTENDERS["kernel"], "gone": Contender("absent")}
    assert list(installed(contenders, said.append)) == ["kernel"]
    assert said == ["gone is left out: its package is missing"]
    with pytest.raises(SolverError, match="none of these is installed: gone"):
        installed({"gone": Contender("absent")}, said.append)


def test_summaries_are_quantiles_of_single_programs() -> None:
    def row(step: int, cpu_us: float, calls: str, name: str) -> Row:
        return Row("s", name, calls, step, 0, 0, 1, 1, 1, 1e-12, 1e-9, cpu_us, 2.0 * cpu_us)

    rows = [row(i, 10.0 + i, calls, "mine") for i in range(101) for calls in (ALONE, TOGETHER)]
    rows += [row(i, 20.0 + 2.0 * i, calls, OSQP) for i in range(101) for calls in (ALONE, TOGETHER)]
    mine = summaries(rows)[0]
    assert (mine.median_us, mine.p95_us, mine.p99_us, mine.max_us) == pytest.approx((60, 105, 109, 110))
    assert mine.alone_gain == pytest.approx((2.0, 2.0, 2.0))
    assert mine.programs == 202
    assert mine.calls == 101
    (table,) = tables([mine], "", wide=True)
    cells = dict(zip(table.header, table.rows[0], strict=True))
    assert (cells["p99"], cells["max"]) == ("109", "110")
    (table,) = tables([replace(mine, calls=99)], "", wide=True)
    assert dict(zip(table.header, table.rows[0], strict=True))["p99"] == "-"


def test_the_interval_of_a_gain_is_that_of_the_median() -> None:
    rows = []
    for i in range(100):
        for calls in (ALONE, TOGETHER):
            rows.append(Row("s", "mine", calls, i, 0, 0, 1, 1, 1, 0.0, 0.0, 1.0, 1.0))
            rows.append(Row("s", OSQP, calls, i, 0, 0, 1, 1, 1, 0.0, 0.0, float(i + 1), 1.0))
    mine = summaries(rows)[0]
    # Order statistics 40 and 61 of 100 hold the median with 95 % at least (binomial).
    assert mine.alone_gain == (50.5, 40.0, 61.0)


def test_few_calls_have_no_interval() -> None:
    """The whole range of five holds their median with 93.75 % only, that of six with 96.9 %."""
    five, six = ([float(i) for i in range(1, count + 1)] for count in (5, 6))
    assert gain(six, [1.0] * 6) == (3.5, 1.0, 6.0)
    median, low, high = gain(five, [1.0] * 5)
    assert median == 3.0
    assert np.isnan([low, high]).all()
    rows = [
        Row("s", name, calls, i, 0, 0, 1, 1, 1, 0.0, 0.0, 1.0, 1.0)
        for name in ("mine", OSQP)
        for i in range(5)
        for calls in (ALONE, TOGETHER)
    ]
    (table,) = tables(summaries(rows), "", wide=True)
    assert dict(zip(table.header, table.rows[0], strict=True))["gain"] == "1"


def test_scenes_are_what_their_labels_say() -> None:
    rows = {}
    count = {"no obstacles": 0, "8 spheres": 8}
    for label, scene in SCENES.items():
        problem = load_problem(scene.problem, {"navigation.filter": "kalman", **scene.overrides, **SHORT})
        step = flown(problem, missions=1, every=100, seed=0)[0]
        assert problem.world.count == count.get(label, 40)
        rows[label] = (step.horizon.shape[2], sum(block.count for block in step.horizon.rows[:2]))
    assert rows["8 spheres"] == rows["40 cylinders"] == (20, 8)
    assert rows["40 spheres, N = 30"] == (30, 8)
    assert rows["40 spheres, N = 50"] == (50, 8)
    assert rows["40 spheres, 4 rows"] == (20, 4)
    assert rows["40 spheres, 16 rows"] == (20, 16)


def test_files_hold_all_rows_and_where_they_come_from(tmp_path: Path) -> None:
    contenders = {name: CONTENDERS[name] for name in ("kernel", OSQP)}
    said: list[str] = []
    shown, paths = run.benchmark_solvers(SCENE, contenders, 2, 30, 3, tmp_path, said.append)
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
        ("--missions", "0", '"0": must be a number of at least 1'),
        ("--every", "x", '"x": must be a whole number in digits'),
        ("--seed", "-1", "seed = -1: must be a whole number from 0 to 2**63 - 1"),
        ("--seed", str(2**200), "must be a whole number from 0 to 2**63 - 1"),
    ],
)
def test_bad_input_is_one_clear_line(
    option: str, value: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["benchmark", "solvers", option, value]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert "Traceback" not in error


def test_a_folder_that_cannot_be_written_is_told_before_anything_flies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run, "measure", lambda *_, **__: pytest.fail("it flew"))
    (tmp_path / "file").write_text("mine", encoding="utf-8")
    assert run_command(["benchmark", "solvers", "--out", str(tmp_path / "file")]) == 2
    assert str(tmp_path / "file") in capsys.readouterr().err
    assert (tmp_path / "file").read_text(encoding="utf-8") == "mine"


def test_flights_too_short_for_a_step_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ProblemError, match="every = 100000: leaves 0 steps"):
        measure("short", SCENE["short"], {"kernel": CONTENDERS["kernel"]}, missions=1, every=100_000, seed=0)


def test_who_stops_in_the_middle_keeps_the_scenes_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(label: str, *given: Any, **settings: Any) -> list[Row]:
        if label == "second":
            raise KeyboardInterrupt
        return measure(label, *given, **settings)

    monkeypatch.setattr(run, "measure", stopped)
    scenes, contenders = {"first": SCENE["short"], "second": SCENE["short"]}, {OSQP: CONTENDERS[OSQP]}
    with pytest.raises(KeyboardInterrupt):
        run.benchmark_solvers(scenes, contenders, 2, 30, 3, tmp_path, lambda words: None)
    kept = {path.name for path in tmp_path.iterdir()}
    assert {"solvers.csv", "solvers.md", "solvers_1.png", "solvers_1.svg"} <= kept
    assert "first" in (tmp_path / "solvers.csv").read_text(encoding="utf-8")


def test_the_exactness_benchmark_finds_a_liar_out(liars: list[Liar], monkeypatch: pytest.MonkeyPatch) -> None:
    assert exactness.examine("one_stage", 1, 4, 4, 1).sound
    monkeypatch.setattr(
        exactness, "make_batch_solver", lambda name, **given: make_batch_solver(
            "liar" if name == "kernel" else name, **given
        )
    )  # fmt: skip
    found = exactness.examine("one_stage", 1, 4, 4, 1)
    assert not found.sound
    assert found.short == found.programs
    assert found.piqp.first_input > exactness.INPUT
    assert found.plain.first_input > exactness.INPUT
