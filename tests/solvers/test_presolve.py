"""Slacks that are left out: which are found, when the rest answers for the whole, and what is handed back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse

from napf_mpc.quadratic_program import QpStatus, QuadraticProgram, Values
from napf_mpc.solvers.presolve import Part, Slacks
from napf_mpc.solvers.solver import make_solver

INF = np.inf
Array = NDArray[np.float64]


def soft_box(
    pull: float = 3.0, price: float = 10.0, high: float = 1.0, low: float = -1.0
) -> QuadraticProgram:
    """Pull x softly into [low, high] by one slack, and above 2 by a slack without a linear price; x <= 9.

    Columns x, s, t; rows x + s >= low, x - s <= high, s >= 0, x + t >= 2, t >= 0, x <= 9.
    """
    a = np.array([[1, 1, 0], [1, -1, 0], [0, 1, 0], [1, 0, 1], [0, 0, 1], [1, 0, 0]], dtype=float)
    return QuadraticProgram(
        sparse.csc_array(np.diag([1.0, 2.0, 4.0])),
        np.array([-pull, price, 0.0]),
        sparse.csc_array(a),
        np.array([low, -INF, 0.0, 2.0, 0.0, -INF]),
        np.array([INF, high, INF, INF, INF, 9.0]),
    )


def dense(part: Part, values: Values) -> Array:
    places = part.sparsity
    matrix = np.zeros((places.constraints, places.variables))
    matrix[places.a_rows, places.a_columns] = values.a[part.a_at]
    return matrix


def test_parts_leave_out_what_says_nothing() -> None:
    sparsity, values = soft_box().split()
    slacks = Slacks.of(sparsity, values)
    assert slacks.priced.tolist() == [False, True, False]
    # t has no linear price: t >= 0 says nothing.
    assert slacks.most.rows.tolist() == [0, 1, 2, 3, 5]
    assert slacks.most.columns.tolist() == [0, 1, 2]
    # Without s its two rows are one, and s >= 0 is gone.
    assert slacks.hard is not None
    assert slacks.hard.rows.tolist() == [0, 3, 5]
    assert slacks.hard.above.tolist() == [1, 3, 5]
    np.testing.assert_array_equal(dense(slacks.hard, values), [[1, 0], [1, 1], [1, 0]])


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"lower": (2, 0.5)}, "held at s >= 0.5"),
        ({"upper": (2, 5.0)}, "held from above too"),
        ({"upper": (0, 4.0)}, "hurts in a row with both bounds"),
        ({"q": (1, -1.0)}, "paid for"),
    ],
)
def test_what_looks_like_a_slack_is_not_left_out(change: dict[str, tuple[int, float]], why: str) -> None:
    sparsity, values = soft_box().split()
    ((name, (at, number)),) = change.items()
    array = getattr(values, name).copy()
    array[at] = number
    other = replace(values, **{name: array})
    assert not Slacks.of(sparsity, other).priced.any(), why
    assert Slacks.of(sparsity, other).hard is None
    assert not Slacks.of(sparsity, values).fit(other), "a program that they do not fit is told apart"


def test_coupled_costs_are_no_slacks() -> None:
    program = soft_box()
    p = program.p.toarray()
    p[0, 1] = p[1, 0] = 0.5
    assert not Slacks.of(*replace(program, p=sparse.csc_array(p)).split()).priced.any()


def test_a_price_that_comes_and_goes_does_not_change_the_parts() -> None:
    sparsity, values = soft_box().split()
    free = replace(values, q=np.array([-3.0, 0.0, 0.0]))
    known = Slacks.of(sparsity, values)
    assert known.fit(free)
    assert not Slacks.of(sparsity, free).fit(values)
    learnt = Slacks.of(sparsity, values, Slacks.of(sparsity, free).priced)
    assert learnt.fit(free)
    assert learnt.fit(values)


def test_a_row_with_two_slacks_becomes_one_with_no_other() -> None:
    """Rows x + s + t >= 0, x - s <= 1, x - t <= 2: the first could pair with either of the others."""
    a = np.array([[1, 1, 1], [1, -1, 0], [1, 0, -1], [0, 1, 0], [0, 0, 1]], dtype=float)
    program = QuadraticProgram(
        sparse.csc_array(np.eye(3)),
        np.array([-9.0, 5.0, 5.0]),
        sparse.csc_array(a),
        np.array([0.0, -INF, -INF, 0.0, 0.0]),
        np.array([INF, 1.0, 2.0, INF, INF]),
    )
    hard = Slacks.of(*program.split()).hard
    assert hard is not None
    assert hard.rows.tolist() == hard.above.tolist() == [0, 1, 2]


def test_multipliers_of_what_was_left_out_complete_the_optimum() -> None:
    """By hand: x is held at 1 by a multiplier of 3 - 1 + 4 = 6; the price of 10 has 4 left for s >= 0."""
    program = soft_box()
    sparsity, values = program.split()
    slacks = Slacks.of(sparsity, values)
    assert slacks.hard is not None
    assert slacks.expected_at_zero(values, np.array([0.9, 0.0, 1.0]))
    z, y, paid = slacks.whole(slacks.hard, values, np.array([1.0, 1.0]), np.array([6.0, -4.0, 0.0]))
    assert paid
    np.testing.assert_array_equal(z, [1.0, 0.0, 1.0])
    np.testing.assert_array_equal(y, [0.0, 6.0, -4.0, -4.0, 0.0, 0.0])
    assert program.residuals(z, y).within(1e-12, 1e-12, 1e-12)
    # A multiplier beyond the price says that the slack should be used.
    cheap = soft_box(price=5.0).split()[1]
    assert not slacks.whole(slacks.hard, cheap, np.array([1.0, 1.0]), np.array([6.0, -4.0, 0.0]))[2]


def test_slacks_that_are_used_and_bounds_that_cross_ask_for_the_whole() -> None:
    sparsity, values = soft_box().split()
    slacks = Slacks.of(sparsity, values)
    assert not slacks.expected_at_zero(values, np.array([1.5, 0.5, 0.5]))
    # OSQP would print a line, keep the old bounds and call the answer solved.
    crossed = soft_box(low=1.5, high=1.0).split()[1]
    assert not slacks.expected_at_zero(crossed, np.zeros(3))


def answer_to(first: QuadraticProgram, then: QuadraticProgram, **settings: object) -> tuple[QpStatus, Array]:
    """Status and point of a program whose guess is the answer to another one."""
    solver = make_solver("osqp", **settings)
    solver.setup(first)
    guess = solver.solve()
    solver.update(then)
    result = solver.solve((guess.z, guess.y))
    assert result.status is not QpStatus.SOLVED or result.residuals.within(1e-7, 1e-6, 1e-6)
    return result.status, result.z


@pytest.mark.parametrize(
    ("then", "z"),
    [
        (soft_box(pull=2.0), (1.0, 0.0, 1.0)),
        (soft_box(pull=-30.0, price=100.0), (-1.0, 0.0, 3.0)),
        # Multipliers beyond the price: (1 + 4) x - pull - 8 + 2 (x - 1) + price = 0.
        (soft_box(pull=3.0, price=2.0), (11.0 / 7.0, 4.0 / 7.0, 3.0 / 7.0)),
        # No x is in both: s is what the rows lack, in sum least at x = 1.25.
        (soft_box(low=1.5, high=1.0, price=1000.0), (1.25, 0.25, 0.75)),
        # x <= 0.5 is hard here and x >= 1 is not.
        (replace(soft_box(low=1.0, high=2.0), upper=np.array([INF, 2, INF, INF, INF, 0.5])), (0.5, 0.5, 1.5)),
        # A slack's row becomes another one: s >= 0.25.
        (replace(soft_box(), lower=np.array([-1, -INF, 0.25, 2, 0, -INF])), (1.25, 0.25, 0.75)),
    ],
)
def test_a_guess_without_slacks_never_changes_the_answer(
    then: QuadraticProgram, z: tuple[float, ...]
) -> None:
    first = soft_box()
    status, found = answer_to(first, then)
    assert status is QpStatus.SOLVED
    np.testing.assert_allclose(found, z, atol=1e-7)


def test_states_of_failure_are_those_of_the_whole() -> None:
    first = soft_box()
    lower, upper = first.lower.copy(), first.upper.copy()
    lower[5] = upper[5] = 10.0
    contrary = replace(first, lower=lower, upper=upper)
    # x = 10 breaks the soft box only.
    status, found = answer_to(first, contrary)
    assert status is QpStatus.SOLVED
    np.testing.assert_allclose(found, (10.0, 9.0, 0.0), atol=1e-6)
    for iterations in (1, 2, 3):
        status, _ = answer_to(first, contrary, max_iter=iterations, check_termination=1)
        assert status in (QpStatus.MAX_ITERATIONS, QpStatus.INACCURATE)


def test_a_program_without_any_point_is_called_so_with_a_guess_too() -> None:
    def pinned(high: float) -> QuadraticProgram:
        """Ask for x >= 2 and x <= high, both hard, beside a soft row that the guess has at zero."""
        a = np.array([[1, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
        return QuadraticProgram(
            sparse.csc_array(np.eye(2)),
            np.array([0.0, 10.0]),
            sparse.csc_array(a),
            np.array([2.0, -INF, 0.0, 0.0]),
            np.array([INF, high, INF, INF]),
        )

    status, _ = answer_to(pinned(3.0), pinned(1.0))
    assert status is QpStatus.PRIMAL_INFEASIBLE


def test_the_whole_is_solved_only_where_it_has_to_be() -> None:
    solver = make_solver("osqp")
    solver.setup(soft_box())
    at_zero = (np.array([1.0, 0.0, 1.0]), np.zeros(6))
    first = solver.solve(at_zero)
    backend = solver._backend
    assert first.status is QpStatus.SOLVED
    assert backend._hard is not None  # type: ignore[union-attr]
    assert backend._most is None  # type: ignore[union-attr]
    solver.update(soft_box(price=2.0))
    assert solver.solve(at_zero).status is QpStatus.SOLVED
    assert backend._most is not None  # type: ignore[union-attr]
    # The same from a workspace that solved others before, and with another one for the whole beside it.
    solver.update(soft_box())
    again = solver.solve(at_zero)
    np.testing.assert_array_equal(again.z, first.z)
    np.testing.assert_array_equal(again.y, first.y)


def test_rows_that_become_one_follow_the_numbers() -> None:
    """Two sides of a row that are no longer the same cannot be one."""
    sparsity, values = soft_box().split()
    slacks = Slacks.of(sparsity, values)
    other = replace(values, a=values.a.copy())
    other.a[np.flatnonzero((sparsity.a_rows == 1) & (sparsity.a_columns == 0))] = 2.0
    assert slacks.expected_at_zero(values, np.zeros(3))
    assert not slacks.expected_at_zero(other, np.zeros(3))
