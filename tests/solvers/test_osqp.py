"""What is OSQP's own: compliances of variables, and rows whose multipliers have far to go."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from threadpoolctl import threadpool_limits

from napf_mpc.quadratic_program import QpStatus, QuadraticProgram
from napf_mpc.solvers.osqp_ import Compliances
from napf_mpc.solvers.solver import make_solver

Array = NDArray[np.float64]
STEP_S, STAGES = 0.1, 8
SPRING = 0.5
"""Quadratic price of a slack in :func:`chain`, and its compliance's inverse."""


def chain(start_m: float, wall_m: float, price: float, force_n: float = 1.0) -> QuadraticProgram:
    """Push a unit mass along a line: (position, speed) of each stage, forces, slacks of a wall.

    From ``start_m`` at rest, 1 m wanted at all stages, forces within ``force_n``, ``wall_m`` as the softly
    largest position at a linear price.
    """
    n = 4 * STAGES
    model = np.array([[1.0, STEP_S], [0.0, 1.0]])
    held, rows = np.zeros((2 * STAGES, n)), np.zeros((3 * STAGES, n))
    for k in range(STAGES):
        held[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = np.eye(2)
        if k:
            held[2 * k : 2 * k + 2, 2 * k - 2 : 2 * k] = -model
        held[2 * k : 2 * k + 2, 2 * STAGES + k] = [-0.5 * STEP_S**2, -STEP_S]
        rows[k, 2 * STAGES + k] = 1.0
        rows[STAGES + k, [2 * k, 3 * STAGES + k]] = [1.0, -1.0]
        rows[2 * STAGES + k, 3 * STAGES + k] = 1.0
    first = np.zeros(2 * STAGES)
    first[:2] = model @ [start_m, 0.0]
    curvature = np.concatenate([np.tile([1.0, 0.1], STAGES), np.full(STAGES, 0.01), np.full(STAGES, SPRING)])
    pull = np.concatenate([np.tile([-1.0, 0.0], STAGES), np.zeros(STAGES), np.full(STAGES, price)])
    force, free, zero = np.full(STAGES, force_n), np.full(STAGES, np.inf), np.zeros(STAGES)
    return QuadraticProgram(
        sparse.csc_array(np.diag(curvature)),
        pull,
        sparse.csc_array(np.vstack([held, rows])),
        np.concatenate([first, -force, -free, zero]),
        np.concatenate([first, force, np.full(STAGES, wall_m), free]),
    )


def compliances(program: QuadraticProgram) -> Array:
    sparsity, values = program.split()
    return Compliances().of(sparsity, values, 1.0 / program.p.diagonal())


def test_compliance_is_what_a_unit_force_moves() -> None:
    """Held by the dynamics: how far the optimum of the equality rows alone moves, variable by variable."""
    program = chain(0.0, 0.5, 10.0)
    p, a = program.p.toarray(), program.a.toarray()[: 2 * STAGES]
    kkt = np.block([[p, a.T], [a, np.zeros((2 * STAGES, 2 * STAGES))]])
    moved = []
    for j in range(3 * STAGES):
        force = np.zeros(len(kkt))
        force[j] = 1.0
        moved.append(np.linalg.solve(kkt, force)[j])
    np.testing.assert_allclose(compliances(program)[: 3 * STAGES], moved, rtol=1e-4)
    # The first position is hardly moved by any force within one stage, the last one by all of them.
    assert moved[0] < 0.1 * moved[2 * STAGES - 2]
    # A slack stands in no equality row: its own spring is all that holds it.
    np.testing.assert_allclose(compliances(program)[3 * STAGES :], 1.0 / SPRING)


def test_compliances_follow_the_model_and_nothing_else() -> None:
    shared = Compliances()
    programs = [chain(0.0, 0.5, 10.0), chain(0.3, 0.1, 7.0), chain(0.0, 0.5, 10.0)]
    heavier = programs[2].p.toarray()
    heavier[0, 0] = 100.0
    programs[2] = QuadraticProgram(sparse.csc_array(heavier), *[
        getattr(programs[2], name) for name in ("q", "a", "lower", "upper")
    ])  # fmt: skip
    sparsity = programs[0].split()[0]
    first, same, other = (shared.of(sparsity, p.split()[1], 1.0 / p.p.diagonal()) for p in programs)
    np.testing.assert_array_equal(first, same)
    assert other[0] < 0.99 * first[0]


def test_compliances_do_not_depend_on_threads() -> None:
    program = chain(0.0, 0.5, 10.0)
    expected = compliances(program)
    with threadpool_limits(1):
        np.testing.assert_array_equal(compliances(program), expected)


def test_multipliers_climb_to_the_price_of_rows_that_contradict_each_other() -> None:
    """Inside a wall with little force to leave: its multipliers are the price, 1e4 times those of the way."""
    price = 1e4
    program = chain(start_m=0.6, wall_m=0.5, price=price, force_n=2.0)
    solver = make_solver("osqp")
    solver.setup(program)
    # The guess is the answer to a program without a wall, as where rows are new.
    solver.update(chain(start_m=0.6, wall_m=9.0, price=price, force_n=2.0))
    before = solver.solve()
    solver.update(program)
    result = solver.solve((before.z, before.y))
    assert result.status is QpStatus.SOLVED, result.message
    assert result.residuals.within(1e-6, 1e-3)
    depth = result.z[3 * STAGES :]
    assert depth[0] > 0.08, "0.1 m inside, and 2 N move 1 kg by 0.01 m in 0.1 s"
    wall = result.y[3 * STAGES : 4 * STAGES]
    np.testing.assert_allclose(wall[depth > 1e-3], price + SPRING * depth[depth > 1e-3], rtol=1e-6)
