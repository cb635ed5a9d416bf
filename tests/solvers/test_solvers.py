"""Every installed solver on one list of small programs, and on numbers that it must never see."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse

from napf_mpc.quadratic_program import QpError, QpStatus, QuadraticProgram
from napf_mpc.solvers.solver import (
    Answer,
    Solver,
    SolverError,
    make_solver,
    register_solver,
    solver_names,
)

INF = np.inf
Array = NDArray[np.float64]


def program(
    p: object, q: object, a: object = None, lower: object = (), upper: object = ()
) -> QuadraticProgram:
    q = np.array(q, dtype=float)
    rows = np.zeros((0, len(q))) if a is None else np.array(a, dtype=float)
    return QuadraticProgram(
        sparse.csc_array(np.array(p, dtype=float)),
        q,
        sparse.csc_array(rows),
        np.array(lower, dtype=float),
        np.array(upper, dtype=float),
    )


@dataclass(frozen=True)
class Case:
    name: str
    program: QuadraticProgram
    answer: tuple[float, ...] | None
    """Known z; None where it is not unique."""
    objective: float
    """Known optimal value."""


EYE = np.eye(2)
CASES = [
    Case("no_rows", program(EYE, [-1, -2]), (1, 2), -2.5),
    Case("one_variable", program([[2.0]], [-4.0], [[1.0]], [0.0], [1.0]), (1,), -3.0),
    Case("all_inactive", program(EYE, [-1, -2], EYE, [-9, -9], [9, 9]), (1, 2), -2.5),
    Case("all_infinite", program(EYE, [-1, -2], EYE, [-INF, -INF], [INF, INF]), (1, 2), -2.5),
    Case("some_infinite", program(EYE, [-1, -2], EYE, [-INF, -INF], [0.5, INF]), (0.5, 2), -2.375),
    Case("upper_only", program(EYE, [-1, -2], [[1, 1]], [-INF], [1]), (0, 1), -1.5),
    Case("lower_only", program(EYE, [1, 2], [[1, 1]], [1], [INF]), (1, 0), 1.5),
    Case("both_sides", program(EYE, [-4, 4], EYE, [-1, -1], [1, 1]), (1, -1), -7.0),
    Case("equality_only", program(EYE, [0, 0], [[1, 1]], [2], [2]), (1, 1), 1.0),
    Case("fully_fixed", program(EYE, [3, -3], EYE, [0.5, 0.25], [0.5, 0.25]), (0.5, 0.25), 0.90625),
    Case(
        "duplicate_rows",
        program(EYE, [-1, -2], [[1, 1], [1, 1], [2, 2]], [-INF] * 3, [1, 1, 2]),
        (0, 1),
        -1.5,
    ),
    Case("duplicate_equalities", program(EYE, [0, 0], [[1, 1], [1, 1]], [2, 2], [2, 2]), (1, 1), 1.0),
    Case(
        "degenerate_corner",
        # Three rows meet at the optimum of a plane.
        program(EYE, [-2, -2], [[1, 0], [0, 1], [1, 1]], [-INF] * 3, [1, 1, 2]),
        (1, 1),
        -3.0,
    ),
    Case(
        "active_without_force",
        program(EYE, [-1, -1], EYE, [-INF, -INF], [1, 1]),
        (1, 1),
        -1.0,
    ),
    Case(
        "soft_row",
        # A slack with w1 = 10 above the multiplier 1 that it must beat.
        program(np.diag([1, 1, 1]), [0, 0, 10], [[1, 0, 1], [0, 0, 1]], [1, 0], [INF, INF]),
        (1, 0, 0),
        0.5,
    ),
    Case(
        "soft_row_broken",
        # x <= 0 is hard, x >= 1 soft: the slack is 1.
        program(np.diag([1, 1]), [0, 10], [[1, 0], [1, 1], [0, 1]], [-INF, 1, 0], [0, INF, INF]),
        (0, 1),
        10.5,
    ),
    Case(
        "semi_definite",
        program([[1, 0], [0, 0]], [-1, 1], [[0, 1]], [-2], [INF]),
        (1, -2),
        -2.5,
    ),
    Case(
        "flat_valley",
        program([[1, 1], [1, 1]], [-1, -1], EYE, [0, 0], [5, 5]),
        None,
        -0.5,
    ),
    Case(
        "badly_scaled",
        program(np.diag([1e-4, 1e4]), [-1e-4, -1e4], [[1e-3, 0], [0, 1e3]], [-INF, -INF], [5e-4, 2e3]),
        (0.5, 1),
        -5000.0000375,
    ),
    Case(
        "far_away",
        program(EYE, [-5000, 3000], EYE, [-INF, -INF], [4000, INF]),
        (4000, -3000),
        0.5 * (4000**2 + 3000**2) - 5000 * 4000 - 3000 * 3000,
    ),
]
INFEASIBLE = program(EYE, [1, 1], [[1, 0], [1, 0]], [1, -INF], [INF, 0])
UNBOUNDED = program([[1, 0], [0, 0]], [0, 1], [[1, 0]], [-1], [1])


def installed() -> list[str]:
    names = []
    for name in solver_names():
        try:
            make_solver(name)
        except SolverError:
            continue
        names.append(name)
    return names


SOLVERS = installed()
LOOSE = {
    # An interior point stops within the gap's root of a bound that does not push.
    ("clarabel", "active_without_force"): 1e-4,
    ("cvxpy", "active_without_force"): 1e-4,
    # Its tolerance is relative to the objective of -5000, on which this variable has an effect of 1e-5.
    ("clarabel", "badly_scaled"): 0.2,
    ("cvxpy", "badly_scaled"): 0.2,
}
"""(solver, case) -> accuracy of z that its settings allow; :data:`ACCURACY` for all others."""
ACCURACY = 1e-5


@pytest.fixture(params=SOLVERS)
def solver_name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def independent_kkt(case: QuadraticProgram, z: Array, y: Array) -> float:
    """Largest KKT residual by dense algebra and the min-form of complementarity, relative to the data."""
    p, a = case.p.toarray(), case.a.toarray()
    rows = a @ z
    stationarity = np.abs(p @ z + case.q + a.T @ y).max()
    feasibility = max([0.0, *(case.lower - rows), *(rows - case.upper)])
    up, down = np.maximum(y, 0.0), np.maximum(-y, 0.0)
    product = max(
        [0.0, *np.minimum(up, np.abs(case.upper - rows)), *np.minimum(down, np.abs(rows - case.lower))]
    )
    size = max(1.0, np.abs(case.q).max(), np.abs(p @ z).max())
    return float(max(stationarity, feasibility, product) / size)


def solved(name: str, case: QuadraticProgram, **settings: object) -> tuple[Solver, Array]:
    solver = make_solver(name, **settings)
    solver.setup(case)
    result = solver.solve()
    assert result.status is QpStatus.SOLVED, result.message
    return solver, result.z


def test_the_default_and_the_readable_solver_are_there() -> None:
    assert "osqp" in SOLVERS
    assert len(SOLVERS) >= 2, "install the extras to test more than one solver"


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_known_answer(solver_name: str, case: Case, capfd: pytest.CaptureFixture[str]) -> None:
    solver = make_solver(solver_name)
    solver.setup(case.program)
    result = solver.solve()
    assert result.status is QpStatus.SOLVED, result.message
    size = max(1.0, abs(case.objective))
    assert case.program.objective(result.z) == pytest.approx(case.objective, abs=ACCURACY * size)
    if case.answer is not None:
        accuracy = LOOSE.get((solver_name, case.name), ACCURACY)
        np.testing.assert_allclose(result.z, case.answer, atol=accuracy * max(1.0, *np.abs(case.answer)))
    assert independent_kkt(case.program, result.z, result.y) < ACCURACY
    assert result.residuals.primal < ACCURACY * size
    assert result.residuals == case.program.residuals(result.z, result.y)
    assert capfd.readouterr() == ("", ""), "solvers keep quiet"


def test_infeasible_is_a_status(solver_name: str) -> None:
    solver = make_solver(solver_name)
    solver.setup(INFEASIBLE)
    result = solver.solve()
    # DAQP, HiGHS and quadprog find out, but their adapter in qpsolvers does not say why they gave up. HPIPM
    # only finds its step too short, and ProxQP goes on for as long as it may.
    silent = {"daqp", "highs", "quadprog", "casadi-hpipm"}
    expected = QpStatus.FAILED if solver_name in silent else QpStatus.PRIMAL_INFEASIBLE
    if solver_name == "casadi-proxqp":
        expected = QpStatus.MAX_ITERATIONS
    assert result.status is expected
    assert result.message
    assert not result.residuals.within(1e-3, 1e-3)


def test_unbounded_is_never_solved(solver_name: str) -> None:
    solver = make_solver(solver_name)
    solver.setup(UNBOUNDED)
    result = solver.solve()
    assert result.status is not QpStatus.SOLVED or not result.residuals.within(1e-3, 1e-3)


def test_healthy_again_after_infeasible(solver_name: str) -> None:
    solver = make_solver(solver_name)
    solver.setup(INFEASIBLE)
    solver.solve()
    feasible = replace(INFEASIBLE, upper=np.array([INF, 2.0]))
    solver.update(feasible)
    result = solver.solve()
    assert result.status is QpStatus.SOLVED
    np.testing.assert_allclose(result.z, [1.0, -1.0], atol=1e-5)


def dense_programs(count: int) -> list[QuadraticProgram]:
    rng = np.random.default_rng(4)
    programs = []
    for _ in range(count):
        root = rng.normal(size=(6, 6))
        rows = rng.normal(size=(9, 6))
        middle = rows @ rng.normal(size=6)
        lower = middle - rng.uniform(0.0, 1.0, 9)
        upper = middle + rng.uniform(0.0, 1.0, 9)
        lower[:2], upper[:2] = middle[:2], middle[:2]
        # Bounds that come and go, as those of rows near obstacles do.
        lower[2 + rng.integers(0, 7)] = -INF
        programs.append(
            program(root @ root.T + 0.1 * np.eye(6), 3.0 * rng.normal(size=6), rows, lower, upper)
        )
    return programs


def test_update_equals_fresh_and_warm_equals_cold(solver_name: str) -> None:
    kept = make_solver(solver_name)
    programs = dense_programs(12)
    kept.setup(programs[0])
    guess = None
    for one in programs:
        kept.update(one)
        warm, cold = kept.solve(guess), kept.solve()
        _, fresh = solved(solver_name, one)
        assert warm.status is QpStatus.SOLVED
        np.testing.assert_allclose(warm.z, fresh, atol=1e-5)
        np.testing.assert_allclose(cold.z, fresh, atol=1e-5)
        guess = (warm.z, warm.y)


def test_solvers_agree(solver_name: str) -> None:
    for one in dense_programs(5):
        _, mine = solved(solver_name, one)
        _, default = solved("osqp", one)
        np.testing.assert_allclose(mine, default, atol=1e-5)


BAD_NUMBERS = [
    (part, bad)
    for part in ("p", "q", "a", "lower", "upper")
    for bad in (np.nan, np.inf, -np.inf)
    # These two say that there is no bound.
    if (part, bad) not in (("lower", -np.inf), ("upper", np.inf))
]


@pytest.mark.parametrize(("part", "bad"), BAD_NUMBERS)
def test_bad_number_is_refused_and_the_solver_stays_healthy(solver_name: str, part: str, bad: float) -> None:
    good = CASES[2].program
    solver = make_solver(solver_name)
    solver.setup(good)
    values = getattr(good, part).copy()
    (values.data if part in "pa" else values)[0] = bad
    with pytest.raises(QpError, match=r"not finite|NaN|inf"):
        solver.update(replace(good, **{part: values}))
    np.testing.assert_allclose(solver.solve().z, [1, 2], atol=1e-5)


@pytest.mark.parametrize("guess", [np.nan, np.inf])
def test_bad_guess_is_a_cold_start(solver_name: str, guess: float) -> None:
    solver = make_solver(solver_name)
    solver.setup(CASES[2].program)
    for warm in (
        (np.full(2, guess), np.zeros(2)),
        (np.zeros(3), np.zeros(2)),
        (np.full(2, 2e9), np.zeros(2)),
    ):
        result = solver.solve(warm)
        assert result.status is QpStatus.SOLVED
        np.testing.assert_allclose(result.z, [1, 2], atol=1e-4)


REFUSED = [
    ("crossed bounds", {"lower": np.array([10.0, -9.0])}, "l\\[0\\] = 10 > u\\[0\\] = 9"),
    ("q too short", {"q": np.array([1.0])}, "shape"),
    ("l too long", {"lower": np.array([1.0, 1.0, 1.0])}, "shape"),
    ("u too long", {"upper": np.array([1.0, 1.0, 1.0])}, "u has shape"),
    ("q with two axes", {"q": np.ones((2, 1))}, "q has 2 axes"),
    ("not convex", {"p": sparse.csc_array(np.diag([1.0, -1.0]))}, "negative eigenvalue -1"),
    ("one triangle only", {"p": sparse.csc_array([[1.0, 0.0], [0.5, 1.0]])}, "both triangles"),
    ("another size", {"p": sparse.csc_array(np.eye(3))}, "P has shape"),
    ("another sparsity", {"a": sparse.csc_array(np.ones((2, 2)))}, "entries elsewhere"),
]


@pytest.mark.parametrize(("name", "change", "words"), REFUSED, ids=[r[0] for r in REFUSED])
def test_refused_by_update_and_the_old_program_stays(
    solver_name: str, name: str, change: dict[str, object], words: str
) -> None:
    solver = make_solver(solver_name)
    solver.setup(CASES[2].program)
    with pytest.raises(QpError, match=words):
        solver.update(replace(CASES[2].program, **change))
    np.testing.assert_allclose(solver.solve().z, [1, 2], atol=1e-5)


def test_not_convex_is_refused_by_setup(solver_name: str) -> None:
    with pytest.raises(QpError, match="not convex"):
        make_solver(solver_name).setup(program(np.diag([1.0, -1.0]), [0, 0]))


def test_index_outside_never_reaches_a_solver() -> None:
    rows = sparse.csc_array(np.eye(2))
    rows.indices[1] = 7
    with pytest.raises(QpError, match="not a valid sparse matrix"):
        replace(CASES[2].program, a=rows)


def test_no_variables_is_refused() -> None:
    with pytest.raises(QpError, match="no variables"):
        QuadraticProgram(
            sparse.csc_array((0, 0)), np.zeros(0), sparse.csc_array((0, 0)), np.zeros(0), np.zeros(0)
        )


def test_unsorted_and_repeated_entries_are_the_same_program(solver_name: str) -> None:
    good = CASES[5].program
    rows = sparse.csc_array(
        (np.array([0.25, 0.75, 1.0]), np.array([0, 0, 0]), np.array([0, 2, 3])), shape=(1, 2)
    )
    _, z = solved(solver_name, replace(good, a=rows))
    np.testing.assert_allclose(z, [0, 1], atol=1e-5)


@pytest.mark.parametrize(
    "form",
    [
        sparse.csc_array, sparse.csr_array, sparse.coo_array, sparse.csr_matrix, sparse.dok_array, np.asarray,
        list,
    ],
)  # fmt: skip
def test_a_matrix_of_any_form_is_the_same_program(form: Any) -> None:
    p, rows = [[2.0, 0.0], [0.0, 2.0]], [[1.0, 2.0], [0.0, 1.0]]
    lower, upper = [-1, -1], [INF, INF]
    # The rows say x + 2 y >= -1 and y >= -1; read as columns they would ask 2 x + y >= -1 instead.
    given = QuadraticProgram(form(p), [2, 2], form(rows), lower, upper)  # type: ignore[arg-type]
    solver = make_solver("osqp")
    solver.setup(given)
    result = solver.solve()
    assert result.status is QpStatus.SOLVED
    np.testing.assert_allclose(result.z, [-0.6, -0.2], atol=1e-6)
    assert given.residuals(result.z, result.y).within(1e-6, 1e-6)
    assert (np.array(rows) @ result.z >= -1 - 1e-6).all()


def test_numbers_that_are_in_form_are_not_copied() -> None:
    good = CASES[2].program
    again = replace(good)
    for name in ("p", "q", "a", "lower", "upper"):
        assert getattr(again, name) is getattr(good, name)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"p": sparse.csc_array(1j * EYE)}, "P does not hold real numbers: they are complex"),
        ({"a": 1j * EYE}, "A does not hold real numbers: they are complex"),
        ({"q": np.array([1j, 0])}, "q does not hold real numbers: they are complex"),
        ({"q": ["a", 0]}, "q does not hold real numbers: could not convert string to float: 'a'"),
        ({"a": [[1.0, 0.0], [1.0]]}, "A does not hold real numbers: .*inhomogeneous"),
        ({"a": None}, "A has 0 axes, must have 2"),
        ({"q": None}, "q has 0 axes, must have 1"),
        ({"upper": 1.0}, "u has 0 axes, must have 1"),
        ({"a": "none"}, "A does not hold real numbers"),
    ],
)
def test_what_is_no_matrix_of_numbers_is_refused_by_name(changes: dict[str, Any], fault: str) -> None:
    with pytest.raises(QpError, match=fault):
        replace(CASES[2].program, **changes)


def test_index_outside_of_rows_never_reaches_a_conversion() -> None:
    rows = sparse.csr_array(np.eye(2))
    rows.indices[1] = 7
    with pytest.raises(QpError, match="A is not a valid sparse matrix"):
        replace(CASES[2].program, a=rows)


def test_order_of_calls() -> None:
    solver = make_solver("osqp")
    with pytest.raises(QpError, match="setup before solve"):
        solver.solve()
    with pytest.raises(QpError, match="setup before update"):
        solver.update(CASES[0].program)


def test_unknown_names_missing_extras_and_settings() -> None:
    with pytest.raises(SolverError, match=r"'gurobbi' is not known; choose from osqp, cvxpy"):
        make_solver("gurobbi")
    with pytest.raises(SolverError, match="setting 'rhoo' is not known"):
        make_solver("osqp", rhoo=1.0)
    for name in set(solver_names()) - set(SOLVERS):
        package = rf"qpsolvers\[{name}\]" if name in ("proxqp", "quadprog") else r"napf-mpc\[solvers\]"
        with pytest.raises(SolverError, match=f"pip install '{package}'"):
            make_solver(name)
    for none in ("", " osqp", "two\nlines", None):
        with pytest.raises(SolverError, match="must be a text without blanks around it"):
            register_solver(none, lambda: lambda sparsity: None)  # type: ignore[arg-type, return-value]
    with pytest.raises(SolverError, match="exists already"):
        register_solver("osqp", lambda: lambda sparsity: None)  # type: ignore[arg-type, return-value]


@pytest.mark.parametrize(
    ("name", "settings", "fault"),
    [
        ("daqp", {"nope": 1}, "nope = 1.*unexpected keyword"),
        ("daqp", {"eps_prox": "small"}, "eps_prox = 'small'.*must be real number"),
        ("clarabel", {"nope": 1}, "nope = 1.*no attribute"),
        ("highs", {"nope": 1}, "nope = 1: is not an option of HiGHS"),
        ("highs", {"time_limit": -1.0}, "time_limit = -1.0: is not .* a value"),
        ("cvxpy", {"nope": 1}, "nope = 1.*unrecognized solver setting"),
        ("cvxpy", {"solver": "NOPE"}, "solver = 'NOPE'.*not installed"),
        ("osqp", {"eps_abs": -1.0}, "eps_abs = -1.0: OSQPException"),
        ("osqp", {"eps_abs": "small"}, "eps_abs = 'small': TypeError"),
        ("piqp", {"nope": 1}, "no setting 'nope'"),
    ],
)
def test_a_setting_that_a_library_does_not_take_is_refused_when_the_solver_is_made(
    name: str, settings: dict[str, Any], fault: str
) -> None:
    if name not in SOLVERS:
        pytest.skip(f"{name} is not installed")
    with pytest.raises(SolverError, match=f"solver '{name}': .*{fault}"):
        make_solver(name, **settings)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("daqp", {"eps_prox": 1e-5}),
        ("clarabel", {"max_iter": 50}),
        ("highs", {"time_limit": 3, "presolve": "off"}),
        ("cvxpy", {"solver": "OSQP", "eps_abs": 1e-9}),
        ("osqp", {"max_iter": 1}),
    ],
)
def test_a_setting_that_a_library_takes_is_taken(name: str, settings: dict[str, Any]) -> None:
    if name not in SOLVERS:
        pytest.skip(f"{name} is not installed")
    make_solver(name, **settings)


def test_highs_gives_up_in_time() -> None:
    """On curvatures 24 powers of ten apart its active-set method goes round for ever, deaf to Ctrl-C."""
    qpsolvers_ = pytest.importorskip("napf_mpc.solvers.qpsolvers_")
    if "highs" not in SOLVERS:
        pytest.skip("highs is not installed")
    assert 1.0 <= qpsolvers_.DEFAULTS["highs"]["time_limit"] <= 10.0
    solver = make_solver("highs", time_limit=0.2)
    solver.setup(program(np.diag([1e12, 1e-12]), [1e6, -1e-6], EYE, [-1e9, -1e9], [1e9, 1e9]))
    began = time.monotonic()
    result = solver.solve()
    assert time.monotonic() - began < 5.0
    assert result.status is QpStatus.MAX_ITERATIONS
    assert result.message == "highs: no solution found in 0.2 s"


def test_max_iterations_is_a_status() -> None:
    solver = make_solver("osqp", max_iter=1, check_termination=1)
    solver.setup(dense_programs(1)[0])
    result = solver.solve()
    assert result.status is QpStatus.MAX_ITERATIONS
    assert result.message


class Interrupted:
    """Stands for OSQP after Ctrl-C: the signal went to the library, Python never saw it."""

    def __init__(self, real: object) -> None:
        self._real = real

    def __getattr__(self, name: str) -> object:
        return getattr(self._real, name)

    def solve(self, **keywords: object) -> object:
        import osqp

        result = self._real.solve(**keywords)  # type: ignore[attr-defined]
        result.info.status_val = osqp.SolverStatus.OSQP_SIGINT
        return result


def test_interrupt_taken_by_osqp_is_handed_on() -> None:
    solver = make_solver("osqp")
    solver.setup(CASES[2].program)
    solver.solve()
    backend = solver._backend
    workspace = backend._most  # type: ignore[union-attr]
    workspace._solver = Interrupted(workspace._solver)
    with pytest.raises(KeyboardInterrupt):
        solver.solve()


def test_solver_that_saw_bad_numbers_is_thrown_away() -> None:
    # Past all checks on purpose: this is what would happen if one of them missed something.
    solver = make_solver("osqp")
    solver.setup(CASES[2].program)
    solver.solve()
    spoilt = solver._backend
    good = solver._values
    solver._values = replace(good, q=np.array([np.nan, 1.0]))  # type: ignore[type-var]
    assert solver.solve().status is not QpStatus.SOLVED
    solver._values = good
    assert solver.solve().z == pytest.approx([1, 2], abs=1e-6)
    assert solver._backend is not spoilt


class Broken:
    """Back-end that raises."""

    made = 0

    def __init__(self) -> None:
        Broken.made += 1

    def solve(self, values: object, warm: object) -> Answer:
        raise RuntimeError("workspace on fire")


def test_exception_is_a_status_with_its_reason() -> None:
    solver = Solver(lambda sparsity: Broken())
    solver.setup(CASES[0].program)
    for count in (1, 2):
        result = solver.solve()
        assert result.status is QpStatus.FAILED
        assert "workspace on fire" in result.message
        assert np.isnan(result.z).all()
        assert not result.residuals.within(np.inf, np.inf) or result.residuals.primal == np.inf
        assert Broken.made == count, "a broken workspace is made anew"
