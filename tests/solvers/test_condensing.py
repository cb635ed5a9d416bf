"""Condensing: which variables go, that the rest has the same optimum, and that the multipliers come back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from random_programs import MODELS, hover_model, mixed
from scipy import sparse

from napf_mpc.qp import INPUTS, STATES, Layout
from napf_mpc.quadratic_program import Array, QpStatus, QuadraticProgram
from napf_mpc.solvers.batch import make_batch_solver
from napf_mpc.solvers.condensing import Condensed, Condenser, determined
from napf_mpc.solvers.solver import make_solver

INF = np.inf


def optimum(program: QuadraticProgram) -> tuple[Array, Array]:
    """By a dense active-set method, in which nothing is left to condense."""
    solver = make_solver("casadi-qpoases")
    solver.setup(program)
    result = solver.solve()
    assert result.status is QpStatus.SOLVED
    return result.z, result.y


def rest(condensed: Condensed) -> QuadraticProgram:
    hessian = sparse.csc_array(condensed.hessian)
    return QuadraticProgram(
        0.5 * (hessian + hessian.T), condensed.gradient, sparse.csc_array(condensed.rows), condensed.lower,
        condensed.upper,
    )  # fmt: skip


@pytest.mark.parametrize("grid", sorted(MODELS))
def test_a_condensed_horizon_has_the_optimum_of_the_sparse_one(grid: str) -> None:
    horizon = mixed(3, runs=1, uavs=2, model=hover_model(*MODELS[grid]))
    layout = Layout.of(horizon)
    condenser = Condenser(layout.sparsity)
    sparse_answer = make_batch_solver("kernel").solve_batch(horizon)
    for uav in range(2):
        values = layout.values(horizon).of(0, uav)
        program = horizon.assemble(0, uav)
        condensed = condenser.condense(values)
        assert len(condensed.offset) == STATES * layout.stages
        assert condensed.hessian.shape[0] == layout.sparsity.variables - STATES * layout.stages
        z, y = condensed.expand(*optimum(rest(condensed)))
        wanted = sparse_answer.z[0, uav]
        used = slice(0, (STATES + INPUTS) * layout.stages)  # slacks that cost next to nothing are not unique
        size = max(1.0, float(np.abs(wanted[used]).max()))
        assert np.abs(z[used] - wanted[used]).max() < 1e-8 * size
        assert program.objective(z) == pytest.approx(program.objective(wanted), rel=1e-9, abs=1e-8)
        residuals = program.residuals(z, y)
        scale = max(1.0, float(np.abs(program.p @ z).max()))
        assert residuals.within(1e-8 * size, 1e-8 * scale, 1e-6)


def chain(lower: list[float], upper: list[float], rows: list[list[float]]) -> QuadraticProgram:
    return QuadraticProgram(
        sparse.csc_array(np.eye(3)), np.zeros(3), sparse.csc_array(np.array(rows, dtype=float)),
        np.array(lower), np.array(upper),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("program", "count"),
    [
        (chain([1, 1], [1, 1], [[1, 0, 1], [2, 1, 0]]), 2),
        (chain([1, 1], [1, 2], [[1, 0, 1], [2, 1, 0]]), 1),  # the second is no equality
        (chain([1, 1], [1, 1], [[1, 3, 1], [2, 1, 0]]), 1),  # the first holds the second variable
        (chain([1, 1], [1, 1], [[2, 0, 1], [2, 1, 0]]), 0),  # not a unit
        (chain([1, 1, 1], [1, 1, 1], [[1, 0, 0], [2, 1, 0], [0, 0, 1]]), 2),  # one variable must be left
        (chain([-INF], [INF], [[1, 0, 0]]), 0),
    ],
)
def test_only_what_rows_give_one_after_the_other_goes(program: QuadraticProgram, count: int) -> None:
    sparsity, values = program.split()
    assert determined(sparsity, values) == count
    condensed = Condenser(sparsity).condense(values)
    assert len(condensed.gradient) == 3 - count


def test_multipliers_of_what_is_gone_are_those_of_hand() -> None:
    # The nearest point to the origin with x = 1 - z and y = 1 - 2 x: y = 2 z - 1.
    program = chain([1, 1], [1, 1], [[1, 0, 1], [2, 1, 0]])
    sparsity, values = program.split()
    condensed = Condenser(sparsity).condense(values)
    # (1 - z)^2 + (2 z - 1)^2 + z^2 is least at z = 1/2.
    w = np.linalg.solve(condensed.hessian.toarray(), -condensed.gradient)
    z, y = condensed.expand(w, np.zeros(0))
    np.testing.assert_allclose(z, [0.5, 0.0, 0.5], atol=1e-15)
    np.testing.assert_allclose(y, [-0.5, 0.0], atol=1e-15)


def test_what_is_kept_belongs_to_the_equalities_numbers() -> None:
    program = chain([1, 1], [1, 1], [[1, 0, 1], [2, 1, 0]])
    sparsity, values = program.split()
    condenser = Condenser(sparsity)
    first = condenser.condense(values)
    again = condenser.condense(replace(values, lower=2 * values.lower, upper=2 * values.upper))
    assert again.gain is first.gain
    np.testing.assert_allclose(again.offset, 2 * first.offset)
    other = replace(program, a=sparse.csc_array([[1.0, 0.0, 3.0], [2.0, 1.0, 0.0]])).split()[1]
    np.testing.assert_allclose(condenser.condense(other).gain.toarray(), [[-3.0], [6.0]])
