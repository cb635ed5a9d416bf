"""Horizons of many UAVs: assembly, exact penalties, one bad program among good ones, masks, acceptance."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from napf_mpc.constraints.constraint import LinearRows
from napf_mpc.problem import Vehicle
from napf_mpc.qp import HorizonModel, HorizonQp, Layout, QpError, QpStatus, QuadraticProgram, Sparsity, Values
from napf_mpc.solvers.acceptance import AcceptanceLimits, Refusal, accepted, refusals
from napf_mpc.solvers.batch import (
    STATUSES,
    BatchResult,
    PerUavSolver,
    WarmStart,
    batch_solver_names,
    make_batch_solver,
    register_batch_solver,
)
from napf_mpc.solvers.residuals import kkt_residuals, relative_residuals
from napf_mpc.solvers.solver import Answer, SolverError, Warm, backend_maker, make_solver, register_solver
from napf_mpc.vehicle.quadrotor import discretize, hover_input, linearize, mixer_inverse, rotor_limit

Array = NDArray[np.float64]
VEHICLE = Vehicle()
STEP_S = np.array([0.1, 0.1, 0.1, 0.2, 0.4, 0.4])
STAGES = len(STEP_S)
SOLVED = STATUSES.index(QpStatus.SOLVED)
FAILED = STATUSES.index(QpStatus.FAILED)
SKIPPED = STATUSES.index(QpStatus.SKIPPED)
CASADI = ("casadi-proxqp", "casadi-qpoases", "casadi-hpipm")
ROTORS = mixer_inverse(VEHICLE)
ROTOR_LOW = -ROTORS @ hover_input(VEHICLE)
ROTOR_HIGH = rotor_limit(VEHICLE) + ROTOR_LOW


def hover_model() -> HorizonModel:
    pairs = [discretize(*linearize(VEHICLE), float(s)) for s in STEP_S]
    a, b = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    q = np.eye(12) * STEP_S[:, None, None]
    r = np.diag([0.1, 10.0, 10.0, 10.0]) * STEP_S[:, None, None]
    q[-1] = solve_discrete_are(a[-1], b[-1], q[-1], r[-1])
    q[-1] = 0.5 * (q[-1] + q[-1].T)
    return HorizonModel(STEP_S, a, b, q, r)


MODEL = hover_model()
LIMITS = AcceptanceLimits.of(MODEL, ROTORS, ROTOR_LOW, ROTOR_HIGH)


def everywhere(values: object, shape: tuple[int, int]) -> Array:
    array = np.asarray(values, dtype=float)
    return np.broadcast_to(array, (*shape, STAGES, *array.shape)).copy()


def flight(runs: int, uavs: int, seed: int = 0, wall_m: float | None = None) -> HorizonQp:
    """UAVs that fly along x at 2 m/s; a soft wall x <= wall_m, two obstacles' half-spaces, all limits."""
    rng = np.random.default_rng(seed)
    shape = (runs, uavs)
    initial = 0.3 * rng.normal(size=(*shape, 12)) * np.array([1, 0.5] * 3 + [0.1, 0.1] * 3)
    reference = np.zeros((*shape, STAGES, 12))
    reference[..., 0], reference[..., 1] = 2.0 * np.cumsum(STEP_S), 2.0
    normals = rng.normal(size=(*shape, STAGES, 2, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    gap = rng.uniform(-1.0, 2.0, size=(*shape, STAGES, 2))
    near = (normals * reference[..., None, :6:2]).sum(-1) - gap
    near[rng.uniform(size=near.shape) < 0.3] = -np.inf
    w2 = rng.uniform(0.5, 50.0, size=near.shape)
    ones = everywhere([1.0], shape)
    wall = everywhere([np.inf if wall_m is None else wall_m], shape)
    three = everywhere([1.0] * 3, shape)
    rotors = [everywhere(values, shape) for values in (ROTORS, ROTOR_LOW, ROTOR_HIGH)]
    rows = (
        LinearRows("position", normals, lower=near, w1=100 * ones, w2=50 * ones, shared_slack=True),
        LinearRows("position", normals, lower=near + 1.0, w1=0.0 * w2, w2=w2),
        LinearRows("position", everywhere([[1.0, 0, 0]], shape), upper=wall, w1=200 * ones, w2=10 * ones),
        LinearRows("velocity", everywhere(np.eye(3), shape), -3 * three, 3 * three, 50 * three, 10 * three),
        LinearRows("input", *rotors),
    )
    horizon = HorizonQp(MODEL, initial, reference, rows)
    horizon.check()
    return horizon


def written_by_hand(horizon: HorizonQp, run: int, uav: int) -> tuple[float, Array, Array]:
    """Objective, first input and slack of the same horizon as one writes it in cvxpy, block by block."""
    cp = pytest.importorskip("cvxpy")
    model, at = horizon.model, (run, uav)
    x, u = cp.Variable((STAGES + 1, 12)), cp.Variable((STAGES, 4))
    cost, given = 0.0, [x[0] == horizon.initial[at]]
    for k in range(STAGES):
        given.append(x[k + 1] == model.a[k] @ x[k] + model.b[k] @ u[k])
        error = x[k + 1] - horizon.reference[at][k]
        cost += 0.5 * cp.quad_form(error, model.q[k]) + 0.5 * cp.quad_form(u[k], model.r[k])
    first = None
    for block in horizon.rows:
        slack = cp.Variable((STAGES, block.slack_count), nonneg=True) if block.soft else None
        first = slack if first is None else first
        for k in range(STAGES):
            places = {"position": [0, 2, 4], "velocity": [1, 3, 5], "attitude": [6, 8, 10]}
            signal = u[k] if block.signal == "input" else x[k + 1][places[block.signal]]
            value = block.jac[at][k] @ signal
            for i in range(block.count):
                give = 0.0 if slack is None else slack[k, 0 if block.shared_slack else i]
                if block.lower is not None and np.isfinite(block.lower[at][k, i]):
                    given.append(value[i] >= block.lower[at][k, i] - give)
                if block.upper is not None and np.isfinite(block.upper[at][k, i]):
                    given.append(value[i] <= block.upper[at][k, i] + give)
            if slack is not None and block.w1 is not None and block.w2 is not None:
                w1, w2 = block.w1[at][k], block.w2[at][k]
                cost += STEP_S[k] * (w1 @ slack[k] + 0.5 * cp.sum(cp.multiply(w2, cp.square(slack[k]))))
    problem = cp.Problem(cp.Minimize(cost), given)
    problem.solve(solver="CLARABEL", tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11)
    assert problem.status == "optimal"
    return float(problem.value), np.array(u.value[0]), np.array(first.value)


@pytest.mark.parametrize("seed", range(2))
def test_assembled_horizon_is_the_one_written_by_hand(seed: int) -> None:
    horizon = flight(2, 2, seed, wall_m=1.5)
    result = make_batch_solver("osqp").solve_batch(horizon)
    for run, uav in (((0, 1), (1, 0))[seed],):
        value, first_input, slack = written_by_hand(horizon, run, uav)
        # The assembled objective leaves out the constant of the references.
        reference = horizon.reference[run, uav]
        constant = 0.5 * sum(reference[k] @ MODEL.q[k] @ reference[k] for k in range(STAGES))
        mine = horizon.assemble(run, uav).objective(result.z[run, uav]) + constant
        assert mine == pytest.approx(value, rel=1e-6)
        np.testing.assert_allclose(result.inputs[run, uav, 0], first_input, atol=1e-6)
        np.testing.assert_allclose(result.slacks[0][run, uav], slack, atol=1e-6)


def test_plan_obeys_the_model_and_slacks_are_the_gaps_in_metres() -> None:
    horizon = flight(3, 2, seed=5, wall_m=1.0)
    result = make_batch_solver("osqp").solve_batch(horizon)
    assert (result.status == SOLVED).all()
    state = horizon.initial
    for k in range(STAGES):
        state = np.einsum("ij,ruj->rui", MODEL.a[k], state)
        state = state + np.einsum("ij,ruj->rui", MODEL.b[k], result.inputs[:, :, k])
        np.testing.assert_allclose(result.states[:, :, k], state, atol=1e-7)
    contact = horizon.rows[0]
    values = np.einsum("rukmd,rukd->rukm", contact.jac, result.states[..., :6:2])
    gap = np.maximum(contact.lower - values, 0.0).max(-1)
    assert gap.max() > 0.05, "the scene must break some row"
    np.testing.assert_allclose(result.slacks[0][..., 0], gap, atol=1e-6)


@pytest.mark.parametrize("name", ["osqp", "cvxpy", "piqp", "daqp", "clarabel", *CASADI])
@pytest.mark.parametrize("pull_m", [0.5, 2.0, 10.0])
def test_one_feasible_soft_row_is_kept_to_a_micrometre(name: str, pull_m: float) -> None:
    """The references lie beyond a wall; its price is above what the wall pushes with, so nothing leaks."""
    pytest.importorskip(name.partition("-")[0])
    solver = make_batch_solver(name)
    initial = np.zeros((1, 1, 12))
    reference = np.zeros((1, 1, STAGES, 12))
    reference[..., 0] = pull_m
    price = everywhere([500.0], (1, 1))
    wall = LinearRows(
        "position", everywhere([[1.0, 0.0, 0.0]], (1, 1)), upper=everywhere([0.2], (1, 1)), w1=price, w2=price
    )
    horizon = HorizonQp(MODEL, initial, reference, (wall,))
    result = solver.solve_batch(horizon)
    multipliers = result.y[0, 0, 12 * STAGES : 13 * STAGES]
    assert multipliers.max() > 1e-3, "the wall must be touched"
    assert (multipliers < 500.0 * STEP_S).all(), "and the price be above its push"
    assert np.abs(result.slacks[0]).max() < 1e-6
    assert result.states[..., 0].max() < 0.2 + 1e-6


def test_too_low_a_price_leaks() -> None:
    horizon = HorizonQp(
        MODEL,
        np.zeros((1, 1, 12)),
        everywhere(np.eye(12)[0] * 10.0, (1, 1)),
        (
            LinearRows(
                "position", everywhere([[1.0, 0.0, 0.0]], (1, 1)), upper=everywhere([0.2], (1, 1)),
                w1=everywhere([0.1], (1, 1)), w2=everywhere([0.1], (1, 1)),
            ),
        ),
    )  # fmt: skip
    assert make_batch_solver("osqp").solve_batch(horizon).slacks[0].max() > 0.1


def pick(horizon: HorizonQp, runs: slice, uavs: slice) -> HorizonQp:
    def cut(values: Array | None) -> Array | None:
        return None if values is None else values[runs, uavs].copy()

    rows = tuple(
        replace(b, jac=cut(b.jac), lower=cut(b.lower), upper=cut(b.upper), w1=cut(b.w1), w2=cut(b.w2))
        for b in horizon.rows
    )
    return HorizonQp(horizon.model, cut(horizon.initial), cut(horizon.reference), rows)


def bits(result: BatchResult) -> list[Array]:
    return [result.z, result.y, result.primal, result.dual, result.complementarity, *result.slacks]


@pytest.mark.parametrize("name", ["osqp", "piqp", *CASADI])
def test_batch_is_one_by_one_bit_for_bit(name: str) -> None:
    """Three steps with warm starts, so that kept workspaces are part of it."""
    pytest.importorskip(name.partition("-")[0])
    together = make_batch_solver(name)
    alone = {(r, u): make_batch_solver(name) for r in range(5) for u in range(3)}
    warm: WarmStart | None = None
    for seed in (1, 2, 3):
        horizon = flight(5, 3, seed, wall_m=1.5)
        whole = together.solve_batch(horizon, warm)
        for (r, u), solver in alone.items():
            own = (
                None
                if warm is None
                else WarmStart(warm.z[r : r + 1, u : u + 1], warm.y[r : r + 1, u : u + 1])
            )
            one = solver.solve_batch(pick(horizon, slice(r, r + 1), slice(u, u + 1)), own)
            for mine, theirs in zip(bits(one), bits(whole), strict=True):
                np.testing.assert_array_equal(mine[0, 0], theirs[r, u])
        warm = whole.warm_start(whole.states, whole.inputs)


class Remembering:
    """A back-end whose answers show how many programs it has seen."""

    def __init__(self, sparsity: Sparsity) -> None:
        self._sparsity, self._seen = sparsity, 0

    def solve(self, values: Values, warm: Warm | None) -> Answer:
        self._seen += 1
        z, y = np.full(self._sparsity.variables, float(self._seen)), np.zeros(self._sparsity.constraints)
        return Answer(QpStatus.SOLVED, z, y, self._seen)


def test_workspace_history_is_forgotten_by_reset() -> None:
    fresh, used, kept = (PerUavSolver(Remembering) for _ in range(3))
    for seed in (7, 8, 9):
        used.solve_batch(flight(2, 2, seed))
        kept.solve_batch(flight(2, 2, seed))
    used.reset()
    horizon = flight(2, 2, 10)
    assert not np.array_equal(kept.solve_batch(horizon).z, fresh.solve_batch(horizon).z)
    fresh.reset()
    for mine, theirs in zip(bits(used.solve_batch(horizon)), bits(fresh.solve_batch(horizon)), strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("polishing", [True, False])
def test_osqp_answers_depend_on_the_program_alone(polishing: bool) -> None:
    # Unpolished answers would show in their last digits how they were reached.
    fresh, used, kept = (make_batch_solver("osqp", polishing=polishing) for _ in range(3))
    for seed in (7, 8, 9):
        used.solve_batch(flight(2, 2, seed))
        kept.solve_batch(flight(2, 2, seed))
    used.reset()
    horizon = flight(2, 2, 10)
    expected = bits(fresh.solve_batch(horizon))
    for solver in (used, kept):
        for mine, theirs in zip(bits(solver.solve_batch(horizon)), expected, strict=True):
            np.testing.assert_array_equal(mine, theirs)


def test_masked_runs_are_skipped_whatever_they_hold() -> None:
    horizon = flight(4, 2, 3)
    whole = make_batch_solver("osqp").solve_batch(horizon)
    active = np.array([True, False, True, False])
    spoilt = replace(horizon, initial=horizon.initial.copy())
    spoilt.initial[1] = np.nan
    spoilt.rows[2].jac[3] = np.inf
    result = make_batch_solver("osqp").solve_batch(spoilt, active=active)
    assert (result.status[~active] == SKIPPED).all()
    assert np.isnan(result.z[~active]).all()
    assert not result.messages
    for mine, theirs in zip(bits(result), bits(whole), strict=True):
        np.testing.assert_array_equal(mine[active], theirs[active])
    assert result.counts()["solved"] == 4
    assert (refusals(result, LIMITS)[~active] == Refusal.SKIPPED).all()


def spoil_initial(horizon: HorizonQp) -> None:
    horizon.initial[1, 0, 4] = np.nan


def spoil_reference(horizon: HorizonQp) -> None:
    horizon.reference[1, 0, 2, 1] = np.inf


def spoil_normal(horizon: HorizonQp) -> None:
    horizon.rows[0].jac[1, 0, 0, 0, 0] = np.nan


def spoil_bound(horizon: HorizonQp) -> None:
    horizon.rows[1].lower[1, 0, 3, 1] = np.nan  # type: ignore[index]


def cross_bounds(horizon: HorizonQp) -> None:
    horizon.rows[4].lower[1, 0, 3, 1] = 1e9  # type: ignore[index]


def lower_at_infinity(horizon: HorizonQp) -> None:
    horizon.rows[0].lower[1, 0, 3, 1] = np.inf  # type: ignore[index]


def negative_penalty(horizon: HorizonQp) -> None:
    horizon.rows[1].w2[1, 0, 3, 1] = -5.0  # type: ignore[index]


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (spoil_initial, "NaN"),
        (spoil_reference, "q has an entry that is not finite"),
        (spoil_normal, "A has an entry that is not finite"),
        (spoil_bound, "NaN"),
        (cross_bounds, r"l\[\d+\] = 1e\+09 > u"),
        (lower_at_infinity, r"\+inf"),
        (negative_penalty, "negative penalty"),
    ],
)
def test_one_bad_program_fails_alone_and_recovers(spoil: Callable[[HorizonQp], None], words: str) -> None:
    solver = make_batch_solver("osqp")
    good = flight(2, 2, 4)
    before = solver.solve_batch(good)
    bad = flight(2, 2, 4)
    spoil(bad)
    result = solver.solve_batch(bad)
    assert result.status[1, 0] == FAILED
    assert list(result.messages) == [(1, 0)]
    assert "not shown to the solver" in result.messages[1, 0]
    np.testing.assert_array_equal(np.argwhere(result.status != SOLVED), [[1, 0]])
    assert re.search(words, result.messages[1, 0])
    assert not accepted(result, LIMITS)[1, 0]
    after = solver.solve_batch(good)
    assert (after.status == SOLVED).all()
    np.testing.assert_allclose(after.z, before.z, atol=1e-6)


def test_shapes_that_do_not_fit_are_refused() -> None:
    solver, horizon = make_batch_solver("osqp"), flight(2, 2)
    with pytest.raises(QpError, match="active has shape"):
        solver.solve_batch(horizon, active=np.ones(3, dtype=bool))
    with pytest.raises(QpError, match="warm start has shapes"):
        solver.solve_batch(horizon, WarmStart(np.zeros((2, 2, 3)), np.zeros((2, 2, 3))))
    with pytest.raises(QpError, match="initial has shape"):
        solver.solve_batch(replace(horizon, initial=np.zeros((2, 3, 12))))
    with pytest.raises(QpError, match=r"rows\[1\].w2 has shape"):
        solver.solve_batch(replace(horizon, rows=(horizon.rows[0], replace(horizon.rows[1], w2=np.ones(3)))))
    with pytest.raises(QpError, match="q has a negative eigenvalue"):
        solver.solve_batch(replace(horizon, model=replace(MODEL, q=-MODEL.q)))
    with pytest.raises(QpError, match="r is not symmetric"):
        solver.solve_batch(replace(horizon, model=replace(MODEL, r=MODEL.r + np.tri(4, k=-1))))
    with pytest.raises(QpError, match="a has an entry that is not finite"):
        solver.solve_batch(replace(horizon, model=replace(MODEL, a=MODEL.a * np.nan)))


def test_another_layout_starts_new_workspaces() -> None:
    solver, horizon = make_batch_solver("osqp"), flight(1, 2)
    solver.solve_batch(horizon)
    fewer = replace(horizon, rows=horizon.rows[1:])
    expected = make_batch_solver("osqp").solve_batch(fewer)
    np.testing.assert_array_equal(solver.solve_batch(fewer).z, expected.z)
    # A model with entries elsewhere: yaw couples the two horizontal chains.
    turned = [discretize(*linearize(VEHICLE, 0.7), float(s)) for s in STEP_S]
    model = replace(MODEL, a=np.array([t[0] for t in turned]), b=np.array([t[1] for t in turned]))
    other = replace(fewer, model=model)
    result = solver.solve_batch(other)
    assert accepted(result, LIMITS).all()
    np.testing.assert_array_equal(result.z, make_batch_solver("osqp").solve_batch(other).z)


def test_layout_has_no_place_for_the_zeros_of_the_model() -> None:
    sparsity = Layout.of(flight(1, 1)).sparsity
    dynamics = sparsity.a_rows < 12 * STAGES
    # Four chains: at most 2 x 10 + 2 x 3 entries of A, 2 x 4 + 2 x 2 of B and the identity a stage.
    assert dynamics.sum() <= STAGES * (26 + 12 + 12)
    program = flight(1, 1).assemble(0, 0)
    assert program.p.shape == (sparsity.variables, sparsity.variables)
    program.check_convex()


def test_residuals_of_the_batch_are_those_of_the_programs() -> None:
    horizon = flight(2, 2, 6)
    result = make_batch_solver("osqp", max_iter=10, polishing=False).solve_batch(horizon)
    assert result.dual.max() > 1e-3, "unfinished answers on purpose"
    for run in range(2):
        for uav in range(2):
            own = horizon.assemble(run, uav).residuals(result.z[run, uav], result.y[run, uav])
            mine = (result.primal[run, uav], result.dual[run, uav], result.complementarity[run, uav])
            np.testing.assert_allclose(
                mine, (own.primal, own.dual, own.complementarity), rtol=1e-9, atol=1e-12
            )


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_residuals_of_a_number_that_is_not_finite_are_infinite(bad: float) -> None:
    horizon = flight(1, 2, 6)
    layout = Layout.of(horizon)
    result = make_batch_solver("osqp").solve_batch(horizon)
    z, y = result.z.copy(), result.y.copy()
    z[0, 0, 5], y[0, 1, 3] = bad, bad
    for residual in kkt_residuals(layout.sparsity, layout.values(horizon), z, y):
        np.testing.assert_array_equal(residual, np.inf)


@pytest.mark.parametrize("name", ["p", "q", "a", "lower", "upper"])
def test_a_program_with_a_number_that_is_none_has_no_residuals(name: str) -> None:
    """A comparison with NaN is false: unasked, its rows would pass as met and its gradient as zero."""
    horizon = flight(1, 2, 6)
    layout, result = Layout.of(horizon), make_batch_solver("osqp").solve_batch(horizon)
    values = layout.values(horizon)
    spoilt = getattr(values, name).copy()
    spoilt[0, 1, -1] = np.nan
    bad = replace(values, **{name: spoilt})
    relative = relative_residuals(layout.sparsity, bad, result.z, result.y)
    for residual in (*kkt_residuals(layout.sparsity, bad, result.z, result.y), relative):
        assert np.isfinite(residual[0, 0])
        assert residual[0, 1] == np.inf


def test_warm_start_saves_iterations_and_skips_what_failed() -> None:
    solver, horizon = make_batch_solver("osqp"), flight(2, 2, 4)
    cold = solver.solve_batch(horizon)
    warm = cold.warm_start(cold.states, cold.inputs)
    np.testing.assert_array_equal(warm.z, cold.z)
    # No guess means a cold start, although the workspace stands at the answer.
    assert solver.solve_batch(horizon).iterations.sum() > 0.8 * cold.iterations.sum()
    again = solver.solve_batch(horizon, warm)
    assert again.iterations.sum() < 0.6 * cold.iterations.sum()
    np.testing.assert_allclose(again.z, cold.z, atol=1e-6)
    horizon.initial[0, 1] = np.nan
    failed = solver.solve_batch(horizon, warm)
    assert np.isnan(failed.warm_start(cold.states, cold.inputs).z[0, 1]).any()
    assert np.isfinite(failed.warm_start(cold.states, cold.inputs).z[1, 1]).all()


def test_empty_batch() -> None:
    result = make_batch_solver("osqp").solve_batch(pick(flight(1, 1), slice(0, 0), slice(0, 1)))
    assert result.states.shape == (0, 1, STAGES, 12)
    assert accepted(result, LIMITS).shape == (0, 1)


# --- What may be flown ------------------------------------------------------------------------------------


def test_good_answers_are_accepted() -> None:
    for seed in range(10):
        result = make_batch_solver("osqp").solve_batch(flight(2, 2, seed, wall_m=1.5))
        assert accepted(result, LIMITS).all()


class Stub:
    """Solves as OSQP does, then tells something else."""

    def __init__(self, sparsity: Sparsity, lie: Callable[[Answer], Answer]) -> None:
        self._real, self._lie = backend_maker("osqp")(sparsity), lie

    def solve(self, values: Values, warm: Warm | None) -> Answer:
        return self._lie(self._real.solve(values, warm))


def claims(z: object, y: object = None, status: QpStatus = QpStatus.SOLVED) -> Callable[[Answer], Answer]:
    def lie(answer: Answer) -> Answer:
        return Answer(
            status, z * np.ones_like(answer.z), answer.y if y is None else y * np.ones_like(answer.y)
        )

    return lie


def raises(answer: Answer) -> Answer:
    raise RuntimeError("garbage")


def outside(answer: Answer) -> Answer:
    z = answer.z.copy()
    z[12 * STAGES] += 100.0
    return replace(answer, z=z)


def one_nan_slack(answer: Answer) -> Answer:
    z = answer.z.copy()
    z[-1] = np.nan
    return replace(answer, z=z)


STUBS = [
    ("infeasible point", claims(2.14e9), Refusal.INPUT),
    ("infeasible", claims(2.14e9, status=QpStatus.PRIMAL_INFEASIBLE), Refusal.STATUS),
    ("nan", claims(np.nan), Refusal.STATUS),
    ("one nan", one_nan_slack, Refusal.STATUS),
    ("inf", claims(np.inf), Refusal.STATUS),
    ("nan multipliers", lambda answer: replace(answer, y=answer.y * np.nan), Refusal.STATUS),
    ("zeros", claims(0.0, 0.0), Refusal.PRIMAL),
    ("exception", raises, Refusal.STATUS),
    ("wrong length", lambda answer: replace(answer, z=answer.z[:-1]), Refusal.STATUS),
    ("empty", lambda answer: replace(answer, z=np.zeros(0), y=np.zeros(0)), Refusal.STATUS),
    ("input outside", outside, Refusal.INPUT),
    ("no multipliers", lambda answer: replace(answer, y=0.0 * answer.y), Refusal.DUAL),
    ("other multipliers", lambda answer: replace(answer, y=-answer.y), Refusal.DUAL),
    ("inaccurate", lambda answer: replace(answer, status=QpStatus.INACCURATE), Refusal.STATUS),
    ("unfinished", lambda answer: replace(answer, status=QpStatus.MAX_ITERATIONS), Refusal.STATUS),
]


@pytest.mark.parametrize(("name", "lie", "why"), STUBS, ids=[s[0] for s in STUBS])
def test_garbage_is_refused(name: str, lie: Callable[[Answer], Answer], why: Refusal) -> None:
    solver = PerUavSolver(lambda sparsity: Stub(sparsity, lie))
    result = solver.solve_batch(flight(2, 2, 4, wall_m=1.5))
    assert not accepted(result, LIMITS).any()
    np.testing.assert_array_equal(refusals(result, LIMITS), why)


class Stale:
    """Answers with what it answered first, as OSQP does after bounds that it refused."""

    def __init__(self, sparsity: Sparsity) -> None:
        self._real, self._first = backend_maker("osqp")(sparsity), None

    def solve(self, values: Values, warm: Warm | None) -> Answer:
        if self._first is None:
            self._first = self._real.solve(values, warm)
        return self._first


def test_old_answer_is_refused_once_it_is_wrong() -> None:
    solver = PerUavSolver(Stale)
    horizon = flight(2, 2, 4)
    assert accepted(solver.solve_batch(horizon), LIMITS).all()
    moved = replace(horizon, initial=horizon.initial + 0.2 * np.eye(12)[0])
    result = solver.solve_batch(moved)
    np.testing.assert_array_equal(refusals(result, LIMITS), Refusal.PRIMAL)
    # The old point satisfies all rows of the new program but is not its optimum.
    pulled = replace(horizon, reference=horizon.reference + 1.0 * np.eye(12)[2])
    np.testing.assert_array_equal(refusals(solver.solve_batch(pulled), LIMITS), Refusal.DUAL)


def test_answer_within_the_limits_is_near_the_best() -> None:
    """What the limits mean: the worst answer that passes flies beside the best one by centimetres."""
    worst_m, worst_n, passed, refused = 0.0, 0.0, 0, 0
    for seed in range(12):
        horizon = flight(2, 2, seed, wall_m=1.5)
        best = make_batch_solver("osqp").solve_batch(horizon)
        for tolerance in (1e-2, 3e-3, 1e-3, 3e-4):
            rough = make_batch_solver(
                "osqp", eps_abs=tolerance, eps_rel=0.0, polishing=False, check_termination=1
            ).solve_batch(horizon)
            fine = accepted(rough, LIMITS)
            passed, refused = passed + int(fine.sum()), refused + int((~fine).sum())
            beside = np.abs(rough.states - best.states)[..., :6:2].max(axis=(2, 3))
            worst_m = max(worst_m, beside[fine].max(initial=0.0))
            push = np.abs(rough.inputs - best.inputs)[:, :, 0, 0]
            worst_n = max(worst_n, push[fine].max(initial=0.0))
    assert min(passed, refused) > 10, "both kinds are needed to say anything"
    assert worst_m < 0.1
    assert worst_n < 1.0, "a twentieth of the range of the thrust, whose weight is small"


def test_limits_are_in_the_scale_of_the_cost() -> None:
    heavier = replace(MODEL, q=7.0 * MODEL.q, r=7.0 * MODEL.r)
    limits = AcceptanceLimits.of(heavier, ROTORS, ROTOR_LOW, ROTOR_HIGH)
    assert limits.dual == pytest.approx(7.0 * LIMITS.dual)
    assert limits.complementarity == pytest.approx(7.0 * LIMITS.complementarity)
    assert limits.primal == LIMITS.primal


@pytest.mark.parametrize(
    ("matrix", "lower", "upper", "words"),
    [
        (np.eye(3), np.zeros(3), np.ones(3), "do not fit"),
        (np.eye(4), np.zeros(3), np.ones(4), "do not fit"),
        (np.eye(4), np.ones(4), np.zeros(4), "lower <= upper"),
        (np.eye(4), np.full(4, np.nan), np.ones(4), "lower <= upper"),
        (np.eye(4) * np.nan, np.zeros(4), np.ones(4), "finite"),
    ],
)
def test_limits_that_make_no_sense_are_refused(matrix: Array, lower: Array, upper: Array, words: str) -> None:
    with pytest.raises(QpError, match=words):
        AcceptanceLimits.of(MODEL, matrix, lower, upper)


# --- Registry ---------------------------------------------------------------------------------------------


def test_own_solvers_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("napf_mpc.solvers.solver._FACTORIES", {})
    monkeypatch.setattr("napf_mpc.solvers.batch._BATCH_FACTORIES", {})
    monkeypatch.setattr("napf_mpc.solvers.solver._NAMES", set(batch_solver_names()))
    register_solver("test_stub", lambda **settings: lambda sparsity: Stub(sparsity, claims(0.0)))
    assert not accepted(make_batch_solver("test_stub").solve_batch(flight(1, 1)), LIMITS).any()

    class Structured:
        def reset(self) -> None: ...

        def solve_batch(
            self, horizon: HorizonQp, warm: WarmStart | None = None, active: object = None
        ) -> BatchResult:
            return make_batch_solver("osqp").solve_batch(horizon)

    register_batch_solver("test_structured", Structured)
    assert accepted(make_batch_solver("test_structured").solve_batch(flight(1, 1)), LIMITS).all()
    with pytest.raises(SolverError, match="'test_structured' is not known"):
        make_solver("test_structured")
    for name in ("test_structured", "test_stub", "kernel", "osqp"):
        with pytest.raises(SolverError, match=f"{name!r} exists already"):
            register_batch_solver(name, Structured)
        with pytest.raises(SolverError, match=f"{name!r} exists already"):
            register_solver(name, lambda: lambda sparsity: Stub(sparsity, claims(0.0)))
    with pytest.raises(SolverError, match=r"choose from osqp.*test_structured"):
        make_batch_solver("nothing")
    with pytest.raises(SolverError, match="test_structured"):
        make_batch_solver("test_structured", speed=3)


class Odd:
    """A back-end that solves, and does something to the numbers or the answer."""

    def __init__(self, sparsity: Sparsity, odd: Callable[[Values, Answer], Any]) -> None:
        self.backend, self.odd = backend_maker("osqp")(sparsity), odd

    def solve(self, values: Values, warm: Warm | None) -> Any:
        return self.odd(values, self.backend.solve(values, warm))


def odd(change: Callable[[Values, Answer], Any]) -> BatchResult:
    return PerUavSolver(lambda sparsity: Odd(sparsity, change)).solve_batch(flight(1, 2))


class Scales:
    """A back-end that scales the cost where it stands, and solves that."""

    def __init__(self, sparsity: Sparsity) -> None:
        self.backend = backend_maker("osqp")(sparsity)

    def solve(self, values: Values, warm: Warm | None) -> Answer:
        values.q[:] *= 0.5
        return self.backend.solve(values, warm)


def test_an_answer_is_judged_by_the_numbers_given_and_not_by_what_became_of_them() -> None:
    assert accepted(odd(lambda values, answer: answer), LIMITS).all()
    scaled = PerUavSolver(Scales).solve_batch(flight(1, 2))
    assert not accepted(scaled, LIMITS).any()
    assert (scaled.status == SOLVED).all()
    assert scaled.dual.min() > 0.1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda values, answer: None, "returned a NoneType, must return an Answer"),
        (lambda values, answer: (answer.status, answer.z, answer.y), "returned a tuple"),
        (lambda values, answer: replace(answer, z=answer.z[:, None]), r"z has shape \(\d+, 1\), must be"),
        (lambda values, answer: replace(answer, y=None), "y has shape"),
        (lambda values, answer: replace(answer, status="optimal"), "'optimal' is not a valid QpStatus"),
    ],
)
def test_what_is_no_answer_fails_in_words(change: Callable[[Values, Answer], Any], words: str) -> None:
    result = odd(change)
    assert (result.status == FAILED).all()
    for message in result.messages.values():
        with pytest.raises(AssertionError, match=words):
            raise AssertionError(message)


def test_lists_and_words_for_a_status_will_do() -> None:
    result = odd(
        lambda values, answer: replace(answer, z=answer.z.tolist(), y=answer.y.tolist(), status="solved")
    )
    np.testing.assert_array_equal(result.z, odd(lambda values, answer: answer).z)
    assert accepted(result, LIMITS).all()


def test_program_of_a_horizon_can_be_held_and_given_to_another_solver() -> None:
    horizon = flight(1, 2, 8)
    result = make_batch_solver("osqp").solve_batch(horizon)
    program = horizon.assemble(0, 1)
    assert isinstance(program, QuadraticProgram)
    other = make_solver("osqp")
    other.setup(program)
    np.testing.assert_allclose(other.solve().z, result.z[0, 1], atol=1e-6)


def test_a_program_that_was_not_solved_starts_cold_whatever_point_it_left() -> None:
    answer = make_batch_solver("kernel").solve_batch(flight(1, 2, 4))
    status = answer.status.copy()
    status[0, 1] = STATUSES.index(QpStatus.MAX_ITERATIONS)
    warm = replace(answer, status=status).warm_start(answer.states, answer.inputs)
    assert np.isnan(warm.z[0, 1]).all()
    assert np.isfinite(warm.z[0, 0]).all()
