"""The compiled derivative against CasADi; the integrator against mechanics and an independent integrator."""

import math
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from napf_mpc.errors import ProblemError
from napf_mpc.problem import Vehicle
from napf_mpc.vehicle import codegen, derivative_generated
from napf_mpc.vehicle.plant import advance
from napf_mpc.vehicle.quadrotor import (
    ATTITUDE,
    POSITION,
    RATES,
    VELOCITY,
    derivative_function,
    hover_input,
    parameters,
)

PAPER = Vehicle()
LOPSIDED = Vehicle(mass_kg=2.5, inertia_kgm2=(0.01, 0.02, 0.025))
STEP = 0.02


def flown(vehicle, x0, u, step, steps):
    """State after some steps of one UAV."""
    state = np.array(x0, dtype=float).reshape(1, 1, 12)
    inputs = np.array(u, dtype=float).reshape(1, 1, 4)
    advance(state, inputs, parameters(vehicle), step, steps, np.ones(1, bool))
    return state[0, 0]


def batch(runs, uavs, seed=0):
    rng = np.random.default_rng(seed)
    state = rng.normal(size=(runs, uavs, 12))
    inputs = hover_input(PAPER) + 0.1 * rng.normal(size=(runs, uavs, 4))
    return state, inputs


# --------------------------------------------------------------------------------- generated derivative


def worst_relative_error(derivative):
    rng = np.random.default_rng(7)
    worst, exact, out = 0.0, derivative_function(), np.empty(12)
    for _ in range(1000):
        x, u = rng.normal(size=12) * 5.0, rng.normal(size=4) * 10.0
        p = np.exp(rng.normal(size=4))
        derivative(x, u, p, out)
        due = np.array(exact(x, u, p)).ravel()
        worst = max(worst, np.abs(out - due).max() / np.abs(due).max())
        # Also entry by entry, but for the rounding of terms that cancel.
        np.testing.assert_allclose(out, due, rtol=1e-13, atol=1e-13)
    return worst


def test_the_compiled_derivative_is_the_casadi_model():
    assert worst_relative_error(derivative_generated.derivative) <= 1e-13


def test_what_the_generator_writes_now_is_the_casadi_model():
    namespace: dict[str, object] = {}
    source = codegen.generate()
    assert source == codegen.generate()
    assert "python -m napf_mpc.vehicle.codegen" in source
    plain_python = source.replace("@compiled_bare\n", "")
    exec(compile(plain_python, "generated", "exec"), namespace)  # our own text, not input
    assert worst_relative_error(namespace["derivative"]) <= 1e-13


def test_the_generator_writes_the_module_that_flies(tmp_path, monkeypatch):
    target = tmp_path / "derivative_generated.py"
    monkeypatch.setattr(codegen, "_TARGET", target)
    codegen.main()
    assert target.read_text(encoding="utf-8") == codegen.generate()
    shipped = Path(derivative_generated.__file__).read_text(encoding="utf-8")
    assert shipped.partition("    w0 =")[0] == target.read_text(encoding="utf-8").partition("    w0 =")[0]


def test_every_operation_of_the_generator_means_what_casadi_means():
    x, u, p = ca.SX.sym("x", 12), ca.SX.sym("u", 4), ca.SX.sym("p", 4)
    a, b = x[0], x[1]
    terms = [
        a + b,
        a - b,
        a * b,
        a / b,
        -a,
        a**2,
        2 * a,
        1 / a,
        ca.sqrt(b),
        ca.sin(a),
        ca.cos(a),
        ca.tan(a),
        a,
    ]
    function = ca.Function("every", [x, u, p], [ca.vertcat(*terms, ca.SX(0.125))])
    namespace: dict[str, object] = {}
    exec(compile(codegen.generate(function).replace("@compiled_bare\n", ""), "generated", "exec"), namespace)
    state, out = np.array([0.7, 2.3, *np.zeros(10)]), np.empty(14)
    namespace["derivative"](state, np.zeros(4), np.zeros(4), out)
    np.testing.assert_allclose(out, np.array(function(state, 0, 0)).ravel(), rtol=1e-15)


def test_the_generator_refuses_an_operation_it_does_not_know():
    x, u, p = ca.SX.sym("x", 12), ca.SX.sym("u", 4), ca.SX.sym("p", 4)
    with pytest.raises(ValueError, match="no scalar form"):
        codegen.generate(ca.Function("strange", [x, u, p], [ca.erf(x)]))


# -------------------------------------------------------------------------------------------- mechanics


def test_hover_stays_where_it_is_for_a_minute():
    x0 = np.zeros(12)
    x0[POSITION], x0[ATTITUDE] = (1.0, 2.0, 3.0), (0.0, 0.0, 0.8)
    assert np.abs(flown(PAPER, x0, hover_input(PAPER), STEP, 3000) - x0).max() < 1e-9


def test_ballistic_flight_keeps_its_energy_and_lands_where_newton_says():
    x0 = np.zeros(12)
    x0[VELOCITY], x0[POSITION] = (3.0, -4.0, 20.0), (0.0, 0.0, 5.0)
    x0[RATES] = 1.0, -2.0, 0.5  # it spins while it falls
    x = flown(LOPSIDED, x0, np.zeros(4), STEP, 200)
    t = 200 * STEP
    due = [3.0 * t, -4.0 * t, 5.0 + 20.0 * t - 0.5 * 9.81 * t * t]
    np.testing.assert_allclose(x[POSITION], due, atol=1e-10)

    def energy(s):
        return 0.5 * LOPSIDED.mass_kg * (s[VELOCITY] ** 2).sum() + LOPSIDED.mass_kg * 9.81 * s[POSITION][2]

    assert energy(x) == pytest.approx(energy(x0), rel=1e-12)


def test_a_free_spin_keeps_its_energy_and_its_angular_momentum():
    """Torque-free motion of three different inertias: both invariants, through several tumbles."""
    x0 = np.zeros(12)
    x0[RATES] = 0.05, 3.0, 0.02  # about the middle axis: unstable, so the coupling terms all matter
    inertia = np.array(LOPSIDED.inertia_kgm2)
    x, pitch_rates = x0, []
    for _ in range(100):
        x = flown(LOPSIDED, x, np.zeros(4), STEP, 10)
        pitch_rates.append(x[RATES][1])
        assert (inertia * x[RATES] ** 2).sum() == pytest.approx((inertia * x0[RATES] ** 2).sum(), rel=1e-5)
        momentum = np.linalg.norm(inertia * x[RATES])
        assert momentum == pytest.approx(np.linalg.norm(inertia * x0[RATES]), rel=1e-5)
    turned_over = (np.diff(np.sign(pitch_rates)) != 0).sum()
    assert turned_over >= 2, "it must have tumbled, or this shows nothing"


def aerobatic():
    x0 = np.zeros(12)
    x0[ATTITUDE], x0[RATES], x0[VELOCITY] = (0.3, -0.2, 1.0), (2.0, -3.0, 1.5), (1.0, 2.0, 3.0)
    return x0, np.array([30.0, 0.02, -0.03, 0.01])


def test_integration_agrees_with_an_independent_integrator_and_is_of_fourth_order():
    x0, u = aerobatic()
    p = parameters(LOPSIDED)
    f = derivative_function()
    truth = solve_ivp(
        lambda _, s: np.array(f(s, u, p)).ravel(), (0.0, 0.8), x0, method="DOP853", rtol=1e-13, atol=1e-13
    ).y[:, -1]
    steps = np.array([10, 20, 40, 80, 160])
    errors = np.array([np.abs(flown(LOPSIDED, x0, u, 0.8 / n, n) - truth).max() for n in steps])
    order = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert order == pytest.approx(4.0, abs=0.2)
    assert errors[2] < 1e-5, "at the 0.02 s of the simulator the step itself must not matter"


def test_many_steps_in_one_call_are_the_same_as_many_calls():
    state, inputs = batch(3, 2)
    again = state.copy()
    active = np.ones(3, bool)
    advance(state, inputs, parameters(PAPER), STEP, 25, active)
    for _ in range(25):
        advance(again, inputs, parameters(PAPER), STEP, 1, active)
    assert (state == again).all()
    advance(again, inputs, parameters(PAPER), STEP, 0, active)
    assert (state == again).all()


# ------------------------------------------------------------------------------------------ independence


@pytest.mark.parametrize(("runs", "uavs"), [(1, 1), (2, 3), (7, 4), (64, 4)])
def test_a_uav_flies_the_same_bits_in_any_company(runs, uavs):
    state, inputs = batch(64, 4)
    p = parameters(LOPSIDED)
    part = state[:runs, :uavs].copy()
    advance(state, inputs, p, STEP, 50, np.ones(64, bool))
    advance(part, inputs[:runs, :uavs], p, STEP, 50, np.ones(runs, bool))
    assert (part == state[:runs, :uavs]).all()


def test_inactive_runs_keep_every_bit():
    state, inputs = batch(5, 3)
    before = state.copy()
    active = np.array([True, False, True, False, False])
    advance(state, inputs, parameters(PAPER), STEP, 10, active)
    assert (state[~active] == before[~active]).all()
    assert (state[active] != before[active]).any(axis=-1).all()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", ["state", "input"])
def test_a_number_that_is_not_finite_stays_visible_and_alone(where, bad):
    state, inputs = batch(3, 3)
    sound = state.copy()
    clean = inputs.copy()
    (state if where == "state" else inputs)[1, 2, 0 if where == "input" else 7] = bad
    active = np.ones(3, bool)
    advance(state, inputs, parameters(PAPER), STEP, 20, active)
    advance(sound, clean, parameters(PAPER), STEP, 20, active)
    assert not np.isfinite(state[1, 2]).all()
    others = np.ones((3, 3), bool)
    others[1, 2] = False
    assert (state[others] == sound[others]).all()


def test_no_run_and_no_uav_is_no_work():
    advance(np.empty((0, 4, 12)), np.empty((0, 4, 4)), parameters(PAPER), STEP, 1, np.empty(0, bool))
    advance(np.empty((3, 0, 12)), np.empty((3, 0, 4)), parameters(PAPER), STEP, 1, np.ones(3, bool))


def test_inputs_may_be_a_view():
    state, inputs = batch(4, 2)
    again = state.copy()
    wide = np.zeros((4, 2, 8))
    wide[..., ::2] = inputs
    active = np.ones(4, bool)
    advance(state, inputs, parameters(PAPER), STEP, 3, active)
    advance(again, wide[..., ::2], parameters(PAPER), STEP, 3, active)
    assert (state == again).all()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"state": np.zeros((2, 3, 11))}, "state must have shape"),
        ({"state": np.zeros((3, 12))}, "state must have shape"),
        ({"state": np.zeros((2, 3, 12), np.float32)}, "float64"),
        ({"state": np.zeros((2, 3, 24))[..., ::2]}, "C-contiguous"),
        ({"inputs": np.zeros((2, 2, 4))}, "inputs must have shape"),
        ({"active": np.ones(3, bool)}, "active must have shape"),
        ({"parameters": np.ones(3)}, "parameters"),
        ({"parameters": np.array([0.0, 1.0, 1.0, 1.0])}, "parameters"),
        ({"parameters": np.array([1.0, math.nan, 1.0, 1.0])}, "parameters"),
        ({"step_s": 0.0}, "step_s"),
        ({"step_s": math.nan}, "step_s"),
        ({"steps": -1}, "steps"),
    ],
)
def test_arrays_that_do_not_fit_are_refused_before_the_compiled_code(change, says):
    good = {
        "state": np.zeros((2, 3, 12)),
        "inputs": np.zeros((2, 3, 4)),
        "parameters": parameters(PAPER),
        "step_s": STEP,
        "steps": 1,
        "active": np.ones(2, bool),
    }
    with pytest.raises(ProblemError, match=says):
        advance(**{**good, **change})
