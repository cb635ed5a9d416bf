"""The nonlinear programs: the plant's own dynamics, the linear answer near hover, files, and bad input."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from random_programs import VEHICLE, hover_model, mixed

from napf_mpc.benchmark import nonlinear, run
from napf_mpc.benchmark.contenders import OSQP, Scene
from napf_mpc.benchmark.nmpc import NonlinearProgram
from napf_mpc.benchmark.nonlinear import KERNEL, NONLINEAR, NONLINEAR_COLD, NonlinearRow, nonlinear_summaries
from napf_mpc.cli import run_command
from napf_mpc.errors import ProblemError
from napf_mpc.qp import Array, HorizonQp, Layout
from napf_mpc.solvers.batch import make_batch_solver
from napf_mpc.vehicle.plant import advance
from napf_mpc.vehicle.quadrotor import hover_input, parameters

SHORT = {"short": Scene("study_8s", {"simulation.time_limit_s": 10.0})}


def gentle(size: float, yaw_rad: float = 0.0) -> HorizonQp:
    """A UAV at rest that is asked a small way to the side and up, without rows but the rotors'."""
    horizon = mixed(0, runs=1, uavs=1, model=hover_model((0.1, 0.1, 0.2, 0.3), yaw_rad))
    initial, reference = np.zeros((1, 1, 12)), np.zeros((1, 1, 4, 12))
    reference[..., 0:6:2] = size * np.array([1.0, -0.5, 0.3])
    initial[..., 10] = reference[..., 10] = yaw_rad
    rotors = tuple(block for block in horizon.rows if block.signal == "input" and not block.soft)
    return replace(horizon, initial=initial, reference=reference, rows=rotors)


def linear(horizon: HorizonQp) -> tuple[Array, Array]:
    answer = make_batch_solver("kernel").solve_batch(horizon)
    return answer.z[0, 0], answer.y[0, 0]


@pytest.mark.parametrize("yaw_rad", [0.0, 0.7])
def test_near_hover_the_answer_is_the_linear_one(yaw_rad: float) -> None:
    apart = []
    for size in (1e-2, 1e-1):
        horizon = gentle(size, yaw_rad)
        program, layout = NonlinearProgram(VEHICLE, horizon), Layout.of(horizon)
        z, _ = linear(horizon)
        answer = program.solve(horizon, None)
        assert answer.solved, answer.words
        apart.append(float(np.abs(layout.inputs(answer.z) - layout.inputs(z)).max()))
        assert apart[-1] < 0.05 * np.abs(layout.inputs(z)).max()
    # What the linearisation leaves out is of second order.
    assert apart[1] > 30.0 * apart[0] > 0.0


def test_a_plan_flies_as_the_plant_does() -> None:
    horizon = gentle(3.0)
    program, layout = NonlinearProgram(VEHICLE, horizon), Layout.of(horizon)
    answer = program.solve(horizon, linear(horizon))
    assert answer.solved, answer.words
    states, inputs = layout.states(answer.z), layout.inputs(answer.z) + hover_input(VEHICLE)
    state, one = horizon.initial.copy(), np.ones(1, dtype=bool)
    for k, step_s in enumerate(horizon.model.step_s):
        advance(state, inputs[None, None, k].copy(), parameters(VEHICLE), float(step_s) / 20, 20, one)
        np.testing.assert_allclose(states[k], state[0, 0], atol=2e-3)
    assert program.violation(horizon, answer.z) < 1e-3
    # The quadratic program's plan is not one of the nonlinear quadrotor.
    assert program.violation(horizon, linear(horizon)[0]) > 1e-2


@pytest.mark.parametrize("seed", [1, 2])
def test_rows_are_kept_from_a_guess_and_from_nothing(seed: int, capfd: pytest.CaptureFixture[str]) -> None:
    horizon = mixed(seed, runs=1, uavs=1)
    program = NonlinearProgram(VEHICLE, horizon)
    for guess in (None, linear(horizon)):
        answer = program.solve(horizon, guess)
        assert answer.solved, answer.words
        assert program.violation(horizon, answer.z) < 0.05
    assert program.violation(horizon, np.full(len(answer.z), np.nan)) == np.inf
    assert capfd.readouterr() == ("", ""), "IPOPT keeps quiet"


class Stopped:
    """Stands for IPOPT after Ctrl-C."""

    def __call__(self, **given: object) -> dict[str, Array]:
        return {"x": np.zeros(3)}

    def stats(self) -> dict[str, object]:
        return {"success": False, "return_status": "User_Requested_Stop", "iter_count": 1}


def test_an_interrupt_taken_by_ipopt_is_handed_on() -> None:
    program = NonlinearProgram(VEHICLE, gentle(1.0))
    program._cold_solver = Stopped()
    with pytest.raises(KeyboardInterrupt):
        program.solve(gentle(1.0), None)


def test_all_contenders_see_the_same_programs_and_claims_are_counted() -> None:
    rows = nonlinear.measure_nonlinear("short", SHORT["short"], missions=1, every=30, seed=3)
    places = {name: [(r.step, r.run, r.uav) for r in rows if r.contender == name] for name in LABELS}
    assert places[KERNEL]
    assert all(own == places[KERNEL] for own in places.values())
    found = {one.contender: one for one in nonlinear_summaries(rows)}
    assert list(found) == list(LABELS)
    assert found[KERNEL].off_max < 1e-12
    assert found[OSQP].off_max < 1e-3
    assert found[OSQP].gain[0] == 1.0
    assert found[NONLINEAR].claimed == found[NONLINEAR].programs == len(places[KERNEL])
    assert 0.0 < found[NONLINEAR].off_median < 0.5
    assert found[NONLINEAR].violation < found[KERNEL].violation


LABELS = (KERNEL, OSQP, NONLINEAR, NONLINEAR_COLD)


def test_an_answer_that_is_none_is_infinitely_off() -> None:
    rows = [
        NonlinearRow("s", name, step, 0, 0, step > 1, 9, np.inf if step == 1 else 0.1, 0.0, 10.0 * step, 1.0)
        for step in (1, 2, 3)
        for name in LABELS
    ]
    one = nonlinear_summaries(rows)[0]
    assert (one.programs, one.claimed, one.off_median, one.off_p95, one.off_max) == (
        3,
        2,
        0.1,
        np.inf,
        np.inf,
    )
    assert (one.median_us, one.max_us) == (20.0, 30.0)


def test_files_hold_all_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def measured(label: str, scene: Scene, *, missions: int, every: int, seed: int) -> list[NonlinearRow]:
        return [NonlinearRow(label, name, 1, 0, 0, True, 7, 0.01, 0.0, 10.0, 10.0) for name in LABELS]

    monkeypatch.setattr(run, "measure_nonlinear", measured)
    scenes = {"a": SHORT["short"], "b": SHORT["short"]}
    shown, paths = run.benchmark_nonlinear(scenes, 2, 30, 3, tmp_path, print)
    assert {path.name for path in paths} == {"nonlinear.csv", "nonlinear.md"}
    with (tmp_path / "nonlinear.csv").open(encoding="utf-8") as file:
        assert [row["scene"] for row in csv.DictReader(file)] == ["a"] * 4 + ["b"] * 4
    words = (tmp_path / "nonlinear.md").read_text(encoding="utf-8")
    assert "seed 3" in words
    assert "casadi 3" in words
    assert [table.title for table in shown] == ["a", "b"]


def test_bad_input_is_one_clear_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["benchmark", "nonlinear", "--scenes", "9 spheres"]) == 2
    assert "does not know '9 spheres'" in capsys.readouterr().err
    with pytest.raises(ProblemError, match="every = 100000: leaves 0 steps"):
        nonlinear.measure_nonlinear("short", SHORT["short"], missions=1, every=100_000, seed=0)
