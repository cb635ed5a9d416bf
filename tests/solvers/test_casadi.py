"""CasADi's plug-ins on horizons: the true answer in stages and condensed, cold, quiet, honest without one."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from random_programs import MODELS, hover_model, mixed
from scipy import sparse

from napf_mpc.qp import INPUTS, STATES, Layout, QpStatus, QuadraticProgram
from napf_mpc.solvers import casadi_
from napf_mpc.solvers.batch import STATUSES, batch_solver_names, make_batch_solver
from napf_mpc.solvers.solver import SolverError, make_solver
from napf_mpc.solvers.stagewise import single_stage, stagewise

NAMES = ("casadi-proxqp", "casadi-qpoases", "casadi-hpipm")
SOLVED = STATUSES.index(QpStatus.SOLVED)


@pytest.mark.parametrize("grid", ["uneven", "planner", "one_stage"])
@pytest.mark.parametrize("name", NAMES)
def test_horizons_have_the_answer_of_the_kernel(
    name: str, grid: str, capfd: pytest.CaptureFixture[str]
) -> None:
    solver, kernel = make_batch_solver(name), make_batch_solver("kernel")
    for seed in (1, 2):
        horizon = mixed(seed, model=hover_model(*MODELS[grid]))
        answer, wanted = solver.solve_batch(horizon), kernel.solve_batch(horizon)
        assert (answer.status == SOLVED).all(), answer.messages
        np.testing.assert_allclose(answer.inputs, wanted.inputs, atol=1e-5 * np.abs(wanted.inputs).max())
        assert answer.primal.max() < 1e-5
    assert capfd.readouterr() == ("", ""), "plug-ins keep quiet"


@pytest.mark.parametrize("name", NAMES)
def test_an_answer_does_not_depend_on_what_was_solved_before(name: str) -> None:
    kept, fresh = make_batch_solver(name), make_batch_solver(name)
    kept.solve_batch(mixed(5))
    guess = kept.solve_batch(mixed(6))
    horizon = mixed(7)
    warm = guess.warm_start(guess.states, guess.inputs)
    np.testing.assert_array_equal(kept.solve_batch(horizon, warm).z, fresh.solve_batch(horizon).z)


@pytest.mark.parametrize("grid", ["uneven", "one_stage"])
def test_stages_hold_their_variables_and_rows(grid: str) -> None:
    horizon = mixed(1, model=hover_model(*MODELS[grid]))
    layout = Layout.of(horizon)
    order, count = stagewise(layout), layout.stages
    n, m = layout.sparsity.variables, layout.sparsity.constraints
    assert sorted(order.variables) == list(range(n))
    assert sorted(order.rows) == list(range(m))
    assert order.states == [0, *[STATES] * count, 0]
    assert order.controls[0] >= INPUTS
    assert order.controls[-1] == 0
    assert sum(order.states) + sum(order.controls) == n
    assert sum(order.states[1:]) + sum(order.others) == m
    # Every row of a stage's dynamics holds its own variables and the next states, every other its own alone.
    a = horizon.assemble(0, 0).a.toarray()[order.rows][:, order.variables]
    column = row = 0
    for j in range(count + 1):
        own = column + order.states[j] + order.controls[j]
        following = row + order.states[j + 1]
        dynamics, others = a[row:following], a[following : following + order.others[j]]
        after = own + order.states[j + 1]
        np.testing.assert_array_equal(dynamics[:, own:after], np.eye(order.states[j + 1]))
        for block, end in ((dynamics, after), (others, own)):
            assert not block[:, :column].any()
            assert not block[:, end:].any()
        column, row = own, following + order.others[j]


def test_a_plain_program_is_a_single_stage() -> None:
    sparsity = QuadraticProgram(
        sparse.csc_array(np.eye(2)), np.zeros(2), sparse.csc_array(np.eye(2)), np.zeros(2), np.ones(2)
    ).split()[0]
    stages = single_stage(sparsity)
    assert (stages.states, stages.controls, stages.others) == ([0, 0], [2, 0], [2, 0])


def test_bounds_alone_are_not_overlooked() -> None:
    # qpOASES's plug-in takes no notice of bounds where there are no rows, and says that it succeeded.
    solver = make_solver("casadi-qpoases")
    solver.setup(
        QuadraticProgram(
            sparse.csc_array([[2.0]]), np.array([-4.0]), sparse.csc_array([[-0.5], [2.0]]),
            np.array([-0.5, -np.inf]), np.array([0.0, 9.0]),
        )
    )  # fmt: skip
    result = solver.solve()
    np.testing.assert_allclose(result.z, [1.0])
    np.testing.assert_allclose(result.y, [-4.0, 0.0])  # 2 z - 4 - 0.5 y = 0, at the lower bound


def test_an_answer_that_leans_on_infinity_is_none() -> None:
    solver = make_solver("casadi-hpipm")
    solver.setup(
        QuadraticProgram(
            sparse.csc_array(np.diag([1.0, 0.0])), np.array([0.0, 1.0]), sparse.csc_array([[1.0, 0.0]]),
            np.array([-1.0]), np.array([1.0]),
        )
    )  # fmt: skip
    result = solver.solve()
    assert result.status is QpStatus.FAILED
    assert "stands for infinity" in result.message


@pytest.mark.parametrize(
    ("name", "settings", "words"),
    [
        ("casadi-proxqp", {"tolerance": 1e-3}, "'tolerance' not recognized"),
        ("casadi-proxqp", {"eps_abs": "tight"}, "type mismatch .*'eps_abs': 'tight'"),
        ("casadi-qpoases", {"tolerance": 1e-3}, "Unknown option: tolerance"),
        ("casadi-qpoases", {"printLevel": 3.5}, "Illegal type for printLevel"),
        ("casadi-hpipm", {"tolerance": 1e-3}, "Unknown option"),
        ("casadi-hpipm", {"iter_max": "few"}, "type mismatch .*'iter_max': 'few'"),
    ],
)
def test_a_wrong_setting_is_told_at_once(name: str, settings: dict[str, object], words: str) -> None:
    for make in (make_solver, make_batch_solver):
        with pytest.raises(SolverError, match=words) as told:
            make(name, **settings)
        assert "\n" not in str(told.value)


@pytest.mark.parametrize("name", NAMES)
def test_a_casadi_without_the_plug_in_is_told(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(casadi_.ca, "has_conic", lambda plugin: False)
    for make in (make_solver, make_batch_solver):
        with pytest.raises(SolverError, match=f"built without its plug-in {name[7:]}"):
            make(name)


def test_every_name_is_there_once() -> None:
    names = batch_solver_names()
    assert len(names) == len(set(names))
    assert set(NAMES) < set(names)


def test_others_may_print_while_a_plug_in_is_made(capsys: pytest.CaptureFixture[str]) -> None:
    with casadi_._muted():
        print("mine is not shown")
        other = threading.Thread(target=print, args=("theirs is",))
        other.start()
        other.join()
    print("and mine is again")
    assert capsys.readouterr().out == "theirs is\nand mine is again\n"
