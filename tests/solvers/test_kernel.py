"""The kernel solver against its own certificate, other solvers, and a plain NumPy version of its method."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from plain_active_set import PlainActiveSet
from random_programs import GRID, INF, LONG_GRID, MODELS, hover_model, mixed

from napf_mpc.constraints.constraint import LinearRows
from napf_mpc.qp import HorizonModel, HorizonQp, Layout, QpError, QpStatus
from napf_mpc.solvers.batch import STATUSES, BatchResult, WarmStart, make_batch_solver
from napf_mpc.solvers.kernel_signals import signal_maps
from napf_mpc.solvers.residuals import kkt_residuals
from napf_mpc.solvers.residuals import relative_residuals as compiled_residuals
from napf_mpc.solvers.solver import SolverError

Array = NDArray[np.float64]
CODE = {status: code for code, status in enumerate(STATUSES)}
SOLVED = CODE[QpStatus.SOLVED]


def relative_residuals(horizon: HorizonQp, result: BatchResult) -> Array:
    """(run, uav) largest KKT residual, each over one or its own largest term, from the plain matrices."""
    out = np.empty(result.status.shape)
    for run, uav in np.ndindex(*out.shape):
        program = horizon.assemble(run, uav)
        z, y = result.z[run, uav], result.y[run, uav]
        got = program.residuals(z, y)
        finite = np.where(np.isfinite(program.lower), program.lower, 0.0)
        finite_up = np.where(np.isfinite(program.upper), program.upper, 0.0)
        value = abs(program.a) @ np.abs(z)
        primal = max(1.0, np.abs(program.a.multiply(z[None]).toarray()).max())
        terms = (program.p.multiply(z[None]), program.a.multiply(y[:, None]))
        dual = max(1.0, np.abs(program.q).max(), *(float(abs(t).max()) for t in terms))
        product = max(
            1.0, float((np.abs(y) * np.maximum(value, np.maximum(abs(finite), abs(finite_up)))).max())
        )
        out[run, uav] = max(got.primal / primal, got.dual / dual, got.complementarity / product)
    return out


@pytest.mark.parametrize("seed", range(12))
def test_the_method_in_plain_numpy_says_the_same(seed: int) -> None:
    horizon = mixed(seed, model=hover_model(GRID, 0.3 * (seed % 3)))
    result = make_batch_solver("kernel").solve_batch(horizon)
    for run, uav in np.ndindex(*result.status.shape):
        status, inputs = PlainActiveSet(horizon, run, uav).solve()
        assert status is QpStatus.SOLVED
        assert result.status[run, uav] == SOLVED
        np.testing.assert_allclose(result.inputs[run, uav].ravel(), inputs, atol=1e-6)


# --- Right answers ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("far_m", [0.0, 100.0])
def test_every_program_is_certified(name: str, far_m: float) -> None:
    """The certificate is the solver's own word; here it is taken again from the plain matrices."""
    model, solver = hover_model(*MODELS[name]), make_batch_solver("kernel")
    for seed in range(4):
        horizon = mixed(seed, 3, 2, model, far_m)
        result = solver.solve_batch(horizon)
        assert (result.status == SOLVED).all(), result.messages
        assert relative_residuals(horizon, result).max() < 1e-9
        layout = Layout.of(horizon)
        told = (result.primal, result.dual, result.complementarity)
        again = kkt_residuals(layout.sparsity, layout.values(horizon), result.z, result.y)
        for mine, theirs in zip(told, again, strict=True):
            np.testing.assert_allclose(mine, theirs, atol=1e-8)
        warm = solver.solve_batch(horizon, WarmStart(result.z, result.y))
        assert relative_residuals(horizon, warm).max() < 1e-9
        assert warm.iterations.max() <= max(4, result.iterations.max() // 4)
        np.testing.assert_allclose(warm.inputs, result.inputs, atol=1e-6)


def test_relative_residuals_are_those_of_the_plain_matrices() -> None:
    horizon = mixed(3, 3, 2)
    layout = Layout.of(horizon)
    values = layout.values(horizon)
    result = make_batch_solver("kernel").solve_batch(horizon)
    for z, y in ((1.001, 1.0), (1.0, 0.99), (0.9, 2.0)):
        off = replace(result, z=z * result.z, y=y * result.y)
        expected = relative_residuals(horizon, off)
        assert expected.min() > 1e-6
        np.testing.assert_allclose(
            compiled_residuals(layout.sparsity, values, off.z, off.y), expected, rtol=1e-9
        )
    spoilt = result.z.copy()
    spoilt[1, 1, 5] = np.nan
    got = compiled_residuals(layout.sparsity, values, spoilt, result.y)
    assert np.isinf(got[1, 1])
    assert np.isfinite(got).sum() == got.size - 1


@pytest.mark.slow
def test_thousands_of_programs_are_certified() -> None:
    solver, count = make_batch_solver("kernel"), 0
    for seed in range(100, 160):
        horizon = mixed(seed, 16, 4, hover_model(*list(MODELS.values())[seed % len(MODELS)]))
        result = solver.solve_batch(horizon)
        layout = Layout.of(horizon)
        residuals = kkt_residuals(layout.sparsity, layout.values(horizon), result.z, result.y)
        assert (result.status == SOLVED).all(), (seed, result.messages)
        assert max(float(r.max()) for r in residuals) < 1e-8, seed
        count += result.status.size
    assert count > 3000


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("osqp", {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 20000}),
        ("piqp", {"eps_abs": 1e-11, "eps_rel": 1e-11, "check_duality_gap": True}),
        ("daqp", {}),
    ],
)
def test_other_solvers_say_the_same(name: str, settings: dict[str, object]) -> None:
    pytest.importorskip(name)
    other = make_batch_solver(name, **settings)
    for seed in range(4):
        horizon = mixed(seed, 2, 2)
        mine, theirs = make_batch_solver("kernel").solve_batch(horizon), other.solve_batch(horizon)
        for run, uav in np.argwhere(theirs.status == SOLVED).tolist():
            program = horizon.assemble(run, uav)
            best = program.objective(mine.z[run, uav])
            assert best <= program.objective(theirs.z[run, uav]) + 1e-6 * max(1.0, abs(best))
            np.testing.assert_allclose(mine.inputs[run, uav, 0], theirs.inputs[run, uav, 0], atol=2e-4)
        assert (theirs.status == SOLVED).any()


# --- Corners ----------------------------------------------------------------------------------------------


def one(*rows: LinearRows, pull_m: float = 10.0, model: HorizonModel | None = None) -> HorizonQp:
    """A UAV at rest at the origin that is pulled along x."""
    model = hover_model() if model is None else model
    reference = np.zeros((1, 1, model.stages, 12))
    reference[..., 0] = pull_m
    horizon = HorizonQp(model, np.zeros((1, 1, 12)), reference, rows)
    horizon.check_shapes()
    return horizon


def everywhere(values: object, stages: int = len(GRID)) -> Array:
    array = np.asarray(values, dtype=float)
    return np.broadcast_to(array, (1, 1, stages, *array.shape)).copy()


def wall(
    x_m: float, w1: float, w2: float, copies: int = 1, shared: bool = False, sign: float = 1.0
) -> LinearRows:
    """Soft wall ``sign x <= x_m``."""
    prices = [everywhere([w] * (1 if shared else copies)) for w in (w1, w2)]
    jac = everywhere([[sign, 0.0, 0.0]] * copies)
    return LinearRows("position", jac, None, everywhere([x_m] * copies), *prices, shared_slack=shared)


def certified(horizon: HorizonQp) -> BatchResult:
    result = make_batch_solver("kernel").solve_batch(horizon)
    assert (result.status == SOLVED).all(), result.messages
    assert relative_residuals(horizon, result).max() < 1e-9
    return result


def test_no_rows_and_rows_that_are_all_inactive_give_the_same_plan() -> None:
    bare = certified(one())
    off = certified(one(wall(INF, 1.0, 1.0), wall(1e6, 100.0, 0.0, copies=3, shared=True)))
    np.testing.assert_array_equal(bare.states, off.states)
    assert bare.iterations[0, 0] == 0
    assert off.slacks[1].max() == 0.0


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize(("w1", "w2"), [(500.0, 10.0), (0.0, 10.0), (0.5, 0.1), (500.0, 0.0), (0.5, 0.0)])
def test_repeated_rows_count_once_if_they_share_a_slack(w1: float, w2: float, shared: bool) -> None:
    single, many = certified(one(wall(0.2, w1, w2))), certified(one(wall(0.2, w1, w2, 4, shared)))
    if shared:
        np.testing.assert_allclose(many.states, single.states, atol=1e-8)
    # Four slacks of a quarter of the price are one slack.
    quarter = certified(one(wall(0.2, w1 / 4.0, w2 / 4.0, 4)))
    np.testing.assert_allclose(quarter.states, single.states, atol=1e-8)


@pytest.mark.parametrize("w2", [0.0, 1e-9, 1e-3])
def test_a_linear_price_is_a_bounded_force(w2: float) -> None:
    """A slack with no quadratic price is undetermined by it; its multiplier then stands at the price."""
    horizon = one(wall(-1.0, 2.0, w2))
    result = certified(horizon)
    push = result.y[0, 0, 12 * len(GRID) : 13 * len(GRID)]
    opened = result.slacks[0][0, 0, :, 0] > 1e-6
    assert opened.any()
    expected = (2.0 + w2 * result.slacks[0][0, 0, :, 0]) * np.array(GRID)
    np.testing.assert_allclose(push[opened], expected[opened], rtol=1e-9)
    assert (push <= expected * (1.0 + 1e-9)).all()


@pytest.mark.parametrize("w2", [1e-14, 1e-10, 1e-6, 1e-2])
@pytest.mark.parametrize("copies", [1, 3])
def test_a_slack_of_one_row_without_a_linear_price_may_be_as_soft_as_it_likes(w2: float, copies: int) -> None:
    """It pulls with w2 times its slack: next to nothing, but to the digit; softest ones to 1e-12."""
    result = certified(one(wall(-1.0, 0.0, w2, copies)))
    slack, stages = result.slacks[0][0, 0], len(GRID)
    beyond = np.repeat(result.states[0, 0, :, :1] + 1.0, copies, axis=1)
    np.testing.assert_allclose(slack, np.maximum(0.0, beyond), atol=1e-9)
    pull = result.y[0, 0, 12 * stages : (12 + copies) * stages].reshape(stages, copies)
    np.testing.assert_allclose(
        pull, w2 * slack * np.array(GRID)[:, None], rtol=1e-6, atol=1e-14 if w2 > 1e-12 else 1e-12
    )


def test_a_slack_that_costs_nothing_holds_nothing() -> None:
    result = certified(one(wall(-1.0, 0.0, 0.0)))
    np.testing.assert_allclose(result.states, certified(one()).states, atol=1e-6)


@pytest.mark.parametrize("signal", ["position", "velocity", "attitude"])
@pytest.mark.parametrize("size", [0.0, 1e-3, 1e-2, 0.1, 1.0])
@pytest.mark.parametrize(("w1", "w2"), [(0.0, 0.05), (0.0, 1e-3), (1.0, 0.0), (50.0, 0.01)])
def test_rows_of_any_size_share_a_soft_slack(signal: str, size: float, w1: float, w2: float) -> None:
    """Rows that hardly move, or have no coefficients at all, do not slow down those beside them."""
    jac = np.random.default_rng(0).normal(size=(6, 3))
    jac[3:] *= size
    bound, prices = everywhere([-1.0] * 6), (everywhere([w1]), everywhere([w2]))
    certified(one(LinearRows(signal, everywhere(jac), None, bound, *prices, shared_slack=True)))


@pytest.mark.parametrize(
    ("signal", "w1", "w2"),
    [("position", 300.0, 1e-5), ("velocity", 0.0, 1e-6), ("attitude", 0.0, 1e-5), ("attitude", 300.0, 1e-5)],
)
@pytest.mark.parametrize("shared", [False, True])
def test_slacks_between_soft_and_stiff(signal: str, w1: float, w2: float, shared: bool) -> None:
    """What is soft for a row is measured by its own signal: an attitude gives much less than a position."""
    model, jac = hover_model(*MODELS["fine"]), np.random.default_rng(0).normal(size=(4, 3))
    n, slacks = model.stages, 1 if shared else 4
    prices = (everywhere([w] * slacks, n) for w in (w1, w2))
    block = LinearRows(
        signal, everywhere(jac, n), None, everywhere([-0.3] * 4, n), *prices, shared_slack=shared
    )
    certified(one(block, model=model))


@pytest.mark.parametrize("size", [1e-5, 1e-8, 1e-12, 1e-160])
def test_a_row_with_next_to_no_coefficients_takes_its_slack(size: float) -> None:
    result = certified(one(wall(-1.0, 3.0, 1.0, sign=size)))
    np.testing.assert_allclose(result.slacks[0], 1.0, atol=1e-3)


@pytest.mark.parametrize("jac", [[1e308, -1e308, 0.0], [1e308, 0.0, 0.0]])
def test_a_row_whose_value_is_not_finite_is_not_called_solved(jac: list[float]) -> None:
    row = LinearRows("position", everywhere([jac]), everywhere([-1.0]), None, *[everywhere([1.0])] * 2)
    horizon = one(row)
    horizon.reference[..., :6:2] = 10.0
    assert make_batch_solver("kernel").solve_batch(horizon).status[0, 0] == CODE[QpStatus.INACCURATE]


@pytest.mark.parametrize("ratio", [1.0, 1e3])
def test_the_dearer_of_two_walls_that_exclude_each_other_wins(ratio: float) -> None:
    result = certified(one(wall(-1.0, 10.0 * ratio, ratio), wall(-1.5, 10.0, 1.0, sign=-1.0), pull_m=0.25))
    dear, cheap = (slack[0, 0, -1, 0] for slack in result.slacks)
    # x <= -1 and x >= 1.5: between them lie 2.5 m.
    assert dear + cheap == pytest.approx(2.5, abs=1e-9)
    if ratio > 1.0:
        assert dear < 1e-3 < cheap


def test_two_sides_that_exclude_each_other_share_their_slack() -> None:
    block = LinearRows(
        "position", everywhere([[1.0, 0.0, 0.0]]), everywhere([3.0]), everywhere([1.0]),
        everywhere([1000.0]), everywhere([100.0]),
    )  # fmt: skip
    result = certified(one(block))
    # The least that serves both is one metre.
    assert result.slacks[0][0, 0, -1, 0] == pytest.approx(1.0, abs=1e-9)
    assert result.states[0, 0, -1, 0] == pytest.approx(2.0, abs=1e-9)


def test_hard_rows() -> None:
    limit = everywhere([0.5] * 4)
    box = LinearRows("input", everywhere(np.eye(4)), -limit, limit)
    result = certified(one(box))
    assert np.abs(result.inputs).max() <= 0.5 + 1e-9
    fixed = LinearRows("input", everywhere(np.eye(4)), 0.1 * limit, 0.1 * limit)
    np.testing.assert_allclose(certified(one(box, fixed)).inputs, 0.05, atol=1e-9)
    # The same rows again, and their sum, depend on those before.
    again = LinearRows("input", everywhere(np.ones((2, 4))), everywhere([0.2, 0.2]), everywhere([0.2, 0.2]))
    np.testing.assert_allclose(certified(one(box, fixed, again)).inputs, 0.05, atol=1e-9)


def test_hard_rows_that_contradict_each_other_are_infeasible_and_harm_no_other() -> None:
    horizon = mixed(3, 2, 2)
    rows = horizon.rows[-1]
    assert rows.lower is not None
    assert rows.upper is not None
    sum_of_all = LinearRows(
        "input", rows.jac.sum(axis=3, keepdims=True), None, rows.lower.sum(axis=3, keepdims=True) + 1.0
    )
    sum_of_all.upper[1, 0, 2] = rows.lower[1, 0, 2].sum() - 1e-3  # type: ignore[index]
    sum_of_all.upper[0] = sum_of_all.upper[1, 1] = INF  # type: ignore[index]
    solver = make_batch_solver("kernel")
    result = solver.solve_batch(replace(horizon, rows=(*horizon.rows, sum_of_all)))
    assert result.status[1, 0] == CODE[QpStatus.PRIMAL_INFEASIBLE]
    assert list(result.messages) == [(1, 0)]
    assert np.isnan(result.z[1, 0]).all()
    assert np.isinf(result.primal[1, 0])
    assert (np.delete(result.status.ravel(), 2) == SOLVED).all()


def dear(seed: int) -> HorizonQp:
    """Soft rows of sizes and prices that leave them no digit; there is no hard row."""
    rng, stages, rows = np.random.default_rng(seed), len(GRID), 8
    jac = rng.normal(size=(1, 1, stages, rows, 3))
    jac *= 10.0 ** rng.uniform(-6.0, 6.0, size=(1, 1, stages, rows, 1))
    bound = np.linalg.norm(jac, axis=-1) * rng.normal(size=(1, 1, stages, rows))
    price = everywhere([1e6] * rows)
    return one(LinearRows("position", jac, bound, bound, price, price))


@pytest.mark.parametrize("seed", [7, 8, 13])
def test_soft_rows_never_make_a_program_infeasible(seed: int) -> None:
    """Where rounding ends the method, the answer is none, and says no more than that."""
    result = make_batch_solver("kernel").solve_batch(dear(seed))
    assert result.status[0, 0] == CODE[QpStatus.INACCURATE]
    assert "hard rows contradict" not in result.messages[0, 0]


def test_the_method_in_plain_numpy_does_not_call_soft_rows_infeasible() -> None:
    soft = dear(7)
    hard = replace(soft, rows=tuple(replace(block, w1=None, w2=None) for block in soft.rows))
    assert PlainActiveSet(soft, 0, 0).solve()[0] is QpStatus.INACCURATE
    # The same rows have no slack to give then.
    assert PlainActiveSet(hard, 0, 0).contradictory()
    assert make_batch_solver("kernel").solve_batch(hard).status[0, 0] == CODE[QpStatus.PRIMAL_INFEASIBLE]


def lifted(height_m: Array, force: float = 0.5, above: float = 0.0) -> HorizonQp:
    """A UAV that must be at heights (N,) at least, with inputs within a box."""
    box = LinearRows("input", everywhere(np.eye(4)), everywhere([-force] * 4), everywhere([force] * 4))
    low = (height_m + above)[None, None, :, None]
    return one(box, LinearRows("position", everywhere([[0.0, 0.0, 1.0]]), low), mixed(3, 1, 1).rows[0])


def highest_m(force: float = 0.5) -> Array:
    """(N,) heights under the largest thrust."""
    model, state, heights = hover_model(), np.zeros(12), []
    for a, b in zip(model.a, model.b, strict=True):
        state = a @ state + b[:, 0] * force
        heights.append(state[4])
    return np.array(heights)


@pytest.mark.parametrize("beyond", [1e-5, 1.0, 107.0])
def test_hard_rows_beyond_what_the_inputs_reach_are_infeasible(beyond: float) -> None:
    """The farther, the more rounding there is in multipliers that grow without end."""
    horizon = lifted(highest_m(), above=beyond)
    result = make_batch_solver("kernel").solve_batch(horizon)
    assert result.status[0, 0] == CODE[QpStatus.PRIMAL_INFEASIBLE]
    assert result.messages[0, 0] == "hard rows contradict each other"
    assert PlainActiveSet(horizon, 0, 0).solve()[0] is QpStatus.PRIMAL_INFEASIBLE


@pytest.mark.parametrize("room", [1e-5, 1e-2])
def test_hard_rows_just_within_what_the_inputs_reach_are_solved(room: float) -> None:
    certified(lifted(highest_m(), above=-room))


@pytest.mark.parametrize("beside_m", [107.0, 1e4])
@pytest.mark.parametrize("axis", [0, 1])
def test_hard_rows_far_beside_the_path_are_infeasible(beside_m: float, axis: int) -> None:
    """Multipliers then grow by decades; rounding ends the method before it meets a direction without end."""
    model = hover_model(*MODELS["even"])
    horizon = mixed(1, 2, 2, model)
    shape = (*horizon.shape, 1)
    jac, low = np.zeros((*shape, 3)), np.full(shape, beside_m)
    jac[..., axis] = 1.0
    rows = (*horizon.rows, LinearRows("position", jac, low, low + 100.0))
    result = make_batch_solver("kernel").solve_batch(replace(horizon, rows=rows))
    assert (result.status == CODE[QpStatus.PRIMAL_INFEASIBLE]).all()
    assert set(result.messages.values()) == {"hard rows contradict each other"}


def test_a_limit_of_steps_that_hard_rows_run_into_says_so() -> None:
    """One step tells: no input within its limits reaches a row that is that far away."""
    result = make_batch_solver("kernel", max_iter=1).solve_batch(lifted(highest_m(), above=107.0))
    assert result.messages[0, 0] == "hard rows contradict each other"
    assert result.iterations[0, 0] == 1


def test_a_row_without_coefficients() -> None:
    zero = wall(1.0, 5.0, 1.0, sign=0.0)
    np.testing.assert_array_equal(certified(one(zero)).states, certified(one()).states)
    missed = certified(one(wall(-1.0, 5.0, 1.0, sign=0.0)))
    np.testing.assert_allclose(missed.slacks[0], 1.0, atol=1e-12)
    hard = LinearRows("position", everywhere([[0.0, 0.0, 0.0]]), everywhere([1.0]))
    assert make_batch_solver("kernel").solve_batch(one(hard)).status[0, 0] == CODE[QpStatus.PRIMAL_INFEASIBLE]


def test_limit_of_steps() -> None:
    result = make_batch_solver("kernel", max_iter=3).solve_batch(mixed(3))
    assert (result.status == CODE[QpStatus.MAX_ITERATIONS]).any()
    assert result.iterations.max() <= 3
    with pytest.raises(SolverError, match="max_iter = 0"):
        make_batch_solver("kernel", max_iter=0)
    with pytest.raises(SolverError, match="speed"):
        make_batch_solver("kernel", speed=3)


def test_a_cost_that_leaves_an_input_undetermined_is_refused() -> None:
    model = hover_model()
    blind = replace(model, r=np.zeros_like(model.r), b=model.b * np.array([1.0, 1.0, 1.0, 0.0]))
    with pytest.raises(QpError, match=r'do(es)? not determine the inputs.*"osqp"'):
        make_batch_solver("kernel").solve_batch(one(model=blind))


# --- Batches, histories, guesses --------------------------------------------------------------------------


def test_an_answer_depends_on_its_own_numbers_and_guess_alone() -> None:
    """40 programs are more than one chunk; three steps with warm starts, one with another layout between."""
    together, alone = make_batch_solver("kernel"), make_batch_solver("kernel")
    warm: WarmStart | None = None
    for seed in (1, 2, 3):
        horizon = mixed(seed, 10, 4)
        whole = together.solve_batch(horizon, warm)
        together.solve_batch(mixed(seed, 1, 2, hover_model(LONG_GRID)))
        for run, uav in ((0, 0), (4, 3), (9, 1)):
            at = (slice(run, run + 1), slice(uav, uav + 1))
            guess = None if warm is None else WarmStart(warm.z[at], warm.y[at])
            single = alone.solve_batch(horizon.of_one(run, uav), guess)
            np.testing.assert_array_equal(single.z[0, 0], whole.z[run, uav])
            np.testing.assert_array_equal(single.y[0, 0], whole.y[run, uav])
            assert single.iterations[0, 0] == whole.iterations[run, uav]
        warm = whole.warm_start(whole.states, whole.inputs)


def test_shapes_that_change_from_step_to_step_are_noticed() -> None:
    """More rows, other kinds and another number of UAVs are looked at anew; what does not fit is refused."""
    solver = make_batch_solver("kernel")
    horizon = mixed(1, 2, 2)
    first, *others = horizon.rows

    def begin(values: Array | None) -> Array | None:
        return None if values is None else values[..., :1]

    few = replace(
        first, jac=first.jac[:, :, :, :1], lower=begin(first.lower), upper=begin(first.upper),
        w1=begin(first.w1), w2=begin(first.w2),
    )  # fmt: skip
    for other in (horizon, replace(horizon, rows=(few, *others)), horizon.of_one(1, 0), horizon):
        fresh = make_batch_solver("kernel").solve_batch(other)
        np.testing.assert_array_equal(solver.solve_batch(other).z, fresh.z)
    for broken in (
        replace(horizon, initial=horizon.initial[:1]),
        replace(horizon, reference=horizon.reference[:, :1]),
        replace(horizon, rows=(replace(first, jac=first.jac[:, :, 1:]), *others)),
    ):
        with pytest.raises(QpError, match="has shape"):
            solver.solve_batch(broken)


def test_guesses_of_any_quality_lead_to_the_same_answer() -> None:
    rng = np.random.default_rng(0)
    for seed in range(6):
        horizon = mixed(seed)
        solver = make_batch_solver("kernel")
        cold = solver.solve_batch(horizon)
        guesses = [
            WarmStart(cold.z * np.nan, cold.y),
            WarmStart(cold.z, rng.normal(size=cold.y.shape) * 10.0),
            WarmStart(rng.normal(size=cold.z.shape), -cold.y),
            WarmStart(cold.z * 1e9, cold.y * 1e9),
        ]
        for guess in guesses:
            result = solver.solve_batch(horizon, guess)
            assert (result.status == SOLVED).all(), result.messages
            np.testing.assert_allclose(result.inputs, cold.inputs, atol=1e-6)
        np.testing.assert_array_equal(solver.solve_batch(horizon, guesses[0]).z, cold.z)


def test_warm_starts_along_a_flight_save_steps() -> None:
    """A UAV drifts past a wall that comes nearer: the rows that push change little from step to step."""
    solver, cold_steps, warm_steps = make_batch_solver("kernel"), 0, 0
    warm: WarmStart | None = None
    for step in range(30):
        model = hover_model(LONG_GRID)
        base = mixed(5, 2, 2, model)
        drifted = replace(base, initial=base.initial + 0.02 * step * np.eye(12)[0])
        cold, result = solver.solve_batch(drifted), solver.solve_batch(drifted, warm)
        np.testing.assert_allclose(result.inputs, cold.inputs, atol=1e-6)
        assert (result.status == SOLVED).all()
        if warm is not None:
            cold_steps, warm_steps = cold_steps + cold.iterations.sum(), warm_steps + result.iterations.sum()
        warm = result.warm_start(result.states, result.inputs)
    assert warm_steps < 0.5 * cold_steps


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        ("initial", "NaN"),
        ("reference", "q has an entry that is not finite"),
        ("jac", "A has an entry that is not finite"),
        ("bound", "NaN"),
        ("crossed", r"l\[\d+\] = 1e\+09 > u"),
        ("negative", "negative penalty"),
        ("infinite", "q has an entry that is not finite"),
    ],
)
def test_one_bad_program_fails_alone(spoil: str, words: str) -> None:
    horizon = mixed(4)
    rows = [
        replace(b, jac=b.jac.copy(), lower=None if b.lower is None else b.lower.copy()) for b in horizon.rows
    ]
    bad = replace(
        horizon, initial=horizon.initial.copy(), reference=horizon.reference.copy(), rows=tuple(rows)
    )
    at = (1, 0)
    arrays = {
        "initial": (bad.initial, np.nan), "reference": (bad.reference, np.inf), "jac": (rows[3].jac, np.nan),
        "bound": (rows[1].lower, np.nan), "crossed": (rows[5].lower, 1e9), "negative": (rows[1].w2, -5.0),
        "infinite": (rows[0].w1, np.inf),
    }  # fmt: skip
    array, value = arrays[spoil]
    assert array is not None
    array[at].flat[-1] = value
    solver = make_batch_solver("kernel")
    result = solver.solve_batch(bad)
    assert result.status[at] == CODE[QpStatus.FAILED]
    assert list(result.messages) == [at]
    assert "not shown to the solver" in result.messages[at]
    assert np.isnan(result.z[at]).all()
    np.testing.assert_array_equal(np.argwhere(result.status != SOLVED), [at])
    with pytest.raises(AssertionError, match=words):
        raise AssertionError(result.messages[at])


def test_masked_runs_are_skipped_whatever_they_hold() -> None:
    horizon = mixed(3, 4, 2)
    whole = make_batch_solver("kernel").solve_batch(horizon)
    active = np.array([True, False, True, False])
    horizon.initial[1] = np.nan
    result = make_batch_solver("kernel").solve_batch(horizon, active=active)
    assert (result.status[~active] == CODE[QpStatus.SKIPPED]).all()
    assert np.isnan(result.z[~active]).all()
    assert not result.messages
    np.testing.assert_array_equal(result.z[active], whole.z[active])
    with pytest.raises(QpError, match="active has shape"):
        make_batch_solver("kernel").solve_batch(horizon, active=np.ones(3, dtype=bool))
    with pytest.raises(QpError, match="warm start has shapes"):
        make_batch_solver("kernel").solve_batch(horizon, WarmStart(np.zeros((2, 2, 3)), np.zeros((2, 2, 3))))


def test_steady_rows_are_read_again_when_they_are_others() -> None:
    near, far = (replace(wall(x_m, 500.0, 10.0), steady=True) for x_m in (2.0, 5.0))
    changing, other = wall(7.0, 500.0, 10.0), wall(1.0, 500.0, 10.0)
    solver, model = make_batch_solver("kernel"), hover_model()
    for rows in ((near, changing), (near, other), (far, other), (far, changing), (near, changing)):
        horizon = one(*rows, model=model)
        answer, fresh = solver.solve_batch(horizon), certified(horizon)
        np.testing.assert_array_equal(answer.states, fresh.states)
        most = min(float(block.upper[0, 0, 0, 0]) for block in rows if block.upper is not None)
        assert answer.states[..., 0].max() == pytest.approx(most, abs=1e-6)


def test_steady_rows_serve_programs_of_every_chunk_and_bad_ones_fail_all() -> None:
    horizon = mixed(5, 12, 3)
    rows = tuple(
        replace(block, **{name: np.broadcast_to(values[:1, :1], values.shape).copy()
                          for name in ("jac", "lower", "upper", "w1", "w2")
                          if (values := getattr(block, name)) is not None})
        for block in horizon.rows
    )  # fmt: skip
    solver = make_batch_solver("kernel")
    plain = make_batch_solver("kernel").solve_batch(replace(horizon, rows=rows))
    steady = replace(horizon, rows=tuple(replace(block, steady=True) for block in rows))
    # One run after one run, then more, then all: what was read for one program must not pass for more.
    for runs in (1, 1, 2, 12, 12):
        active = np.arange(12) < runs
        np.testing.assert_array_equal(solver.solve_batch(steady, active=active).z[:runs], plain.z[:runs])
    spoilt = rows[0].jac.copy()
    spoilt[:, :, 0] = np.nan
    bad = (replace(rows[0], jac=spoilt, steady=True), *steady.rows[1:])
    answer = solver.solve_batch(replace(horizon, rows=bad))
    assert (answer.status == STATUSES.index(QpStatus.FAILED)).all()
    np.testing.assert_array_equal(solver.solve_batch(steady).z, plain.z)


def test_empty_batch() -> None:
    result = make_batch_solver("kernel").solve_batch(mixed(0, 0, 2))
    assert result.states.shape == (0, 2, len(GRID), 12)


# --- The kernel itself ------------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw_rad", [0.0, 0.7])
def test_signal_kernel_is_what_a_force_does(yaw_rad: float) -> None:
    model = hover_model(GRID, yaw_rad)
    maps = signal_maps(model)
    n = model.stages
    oracle = PlainActiveSet(HorizonQp(model, np.zeros((1, 1, 12)), np.zeros((1, 1, n, 12)), ()), 0, 0)
    signals = np.zeros((len(maps.stage), 4 * n))
    for i, (k, target) in enumerate(zip(maps.stage, maps.target, strict=True)):
        signals[i] = oracle.moved[k, target] if target < 12 else np.eye(4 * n)[4 * k + target - 12]
    expected = signals @ np.linalg.solve(oracle.hessian, signals.T)
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(maps.kernel / size / size[:, None], expected / size / size[:, None], atol=1e-7)
    # Four chains at zero yaw; turned, the horizontal ones are one.
    chains = len(set(zip(maps.begin.tolist(), maps.end.tolist(), strict=True)))
    assert chains == (4 if yaw_rad == 0.0 else 3)
