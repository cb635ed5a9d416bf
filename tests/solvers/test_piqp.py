"""PIQP's workspace from program to program: rows without bounds, equalities that come and go, settings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import sparse

from napf_mpc.quadratic_program import Array, QpStatus, QuadraticProgram
from napf_mpc.solvers.solver import SolverError, make_solver

pytest.importorskip("piqp")
from napf_mpc.solvers import piqp_


def nearest_to(lower: list[float], upper: list[float]) -> QuadraticProgram:
    """Nearest point to (1, 2, 3) with bounds on x, y, z and x + y + z."""
    a = np.vstack([np.eye(3), np.ones(3)])
    return QuadraticProgram(
        sparse.csc_array(np.eye(3)), -np.array([1.0, 2.0, 3.0]), sparse.csc_array(a), np.array(lower),
        np.array(upper),
    )  # fmt: skip


INF = float("inf")
CASES: list[tuple[list[float], list[float], list[float], list[float]]] = [
    # lower, upper, answer, multipliers
    ([-INF] * 4, [INF] * 4, [1.0, 2.0, 3.0], [0.0] * 4),
    ([-INF] * 4, [0.5, INF, INF, INF], [0.5, 2.0, 3.0], [0.5, 0.0, 0.0, 0.0]),
    ([2.0, -INF, -INF, -INF], [INF] * 4, [2.0, 2.0, 3.0], [-1.0, 0.0, 0.0, 0.0]),
    ([-INF, -INF, -INF, 3.0], [INF, INF, INF, 3.0], [0.0, 1.0, 2.0], [0.0, 0.0, 0.0, 1.0]),
    ([1.5, 2.5, 3.5, 7.5], [1.5, 2.5, 3.5, 7.5], [1.5, 2.5, 3.5], []),
    ([-INF, 1.0, -INF, -INF], [INF, 1.0, INF, 5.5], [1.0, 1.0, 3.0], [0.0, 1.0, 0.0, 0.0]),
]


def checked(answer: Any, wanted: list[float], mult: list[float]) -> None:
    assert answer.status is QpStatus.SOLVED
    np.testing.assert_allclose(answer.z, wanted, atol=1e-7)
    if mult:
        np.testing.assert_allclose(answer.y, mult, atol=1e-6)


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4, 5], [5, 4, 3, 2, 1, 0], [1, 0, 1, 3, 1, 5, 3]])
def test_rows_may_lose_their_bounds_and_become_equalities(
    order: list[int], capfd: pytest.CaptureFixture[str]
) -> None:
    solver = make_solver("piqp")
    for number, which in enumerate(order):
        lower, upper, wanted, mult = CASES[which]
        (solver.update if number else solver.setup)(nearest_to(lower, upper))
        checked(solver.solve(), wanted, mult)
    # PIQP would complain of every row without bounds.
    assert capfd.readouterr().err == ""


def test_the_workspace_is_kept_while_equalities_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []
    real = piqp_.piqp.SparseSolver

    def make() -> Any:
        made.append(1)
        return real()

    solver = make_solver("piqp")
    monkeypatch.setattr(piqp_.piqp, "SparseSolver", make)
    for number, which in enumerate((1, 2, 0, 3, 3, 1)):
        (solver.update if number else solver.setup)(nearest_to(*CASES[which][:2]))
        checked(solver.solve(), *CASES[which][2:])
    assert len(made) == 3  # at first, for the equality, and without it again


def test_an_interrupt_leaves_no_half_made_workspace(monkeypatch: pytest.MonkeyPatch) -> None:
    solver = make_solver("piqp")
    solver.setup(nearest_to(*CASES[1][:2]))
    checked(solver.solve(), *CASES[1][2:])
    solver.update(nearest_to(*CASES[3][:2]))  # another equality: another workspace is being made
    real = piqp_._Rows.of

    def interrupted(*given: Any) -> Array:
        raise KeyboardInterrupt

    monkeypatch.setattr(piqp_._Rows, "of", interrupted)
    with pytest.raises(KeyboardInterrupt):
        solver.solve()
    monkeypatch.setattr(piqp_._Rows, "of", real)
    checked(solver.solve(), *CASES[3][2:])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"eps_abs": "tight"}, "eps_abs = 'tight'"),
        ({"eps_abs": -1.0}, "eps_abs = -1.0, must be >= 0"),
        ({"max_iter": 0}, "max_iter = 0, must be > 0"),
        ({"tolerance": 1e-3}, "no setting 'tolerance'"),
        ({"_pybind11_conduit_v1_": 1}, "no setting"),
    ],
)
def test_a_wrong_setting_is_told_at_once(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(SolverError, match=words):
        make_solver("piqp", **settings)


def test_the_gap_is_held_to_the_same_tolerance() -> None:
    seen = piqp_.maker("piqp", eps_abs=1e-5, eps_rel=1e-4)
    program = nearest_to(*CASES[1][:2])
    backend = seen(program.split()[0])
    assert backend._settings["eps_duality_gap_abs"] == 1e-5
    assert backend._settings["eps_duality_gap_rel"] == 1e-4
