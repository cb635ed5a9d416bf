"""The inner loop: Eq. 13 and 14 by another route, frames, clamps, rotor limits, and flights on the plant."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from napf_mpc.errors import ProblemError
from napf_mpc.problem import Vehicle
from napf_mpc.vehicle.lqr import lqr
from napf_mpc.vehicle.plant import advance
from napf_mpc.vehicle.quadrotor import (
    ATTITUDE,
    POSITION,
    RATES,
    VELOCITY,
    hover_input,
    linearize,
    mixer,
    mixer_inverse,
    parameters,
    rotor_limit,
    rotor_speeds,
)
from napf_mpc.vehicle.tracking import tracking_law

PAPER = Vehicle()
LAW = tracking_law(PAPER)
HOVER = hover_input(PAPER)
EAST = np.array([1.0, 0.0, 0.0])
YAW = 10
PERIOD = 0.02


def commanded(law=LAW, active=None, **given_):
    """Inputs of one UAV (or of whole arrays) with everything that is not given at zero."""
    vectors = ("position", "velocity", "attitude", "rates", "ref_position", "ref_velocity", "direction")
    lead = next((np.shape(v)[:2] for v in given_.values() if np.ndim(v) == 3), (1, 1))
    asked = {name: np.zeros((*lead, 3)) for name in vectors}
    asked |= {"ref_yaw": np.zeros(lead), "feedforward": np.zeros((*lead, 4))}
    asked |= {name: np.broadcast_to(value, asked[name].shape).astype(float) for name, value in given_.items()}
    active = np.ones(lead[0], bool) if active is None else active
    out = law.inputs(**asked, active=active)
    return out if lead != (1, 1) else out[0, 0]


def unclamped(vehicle=PAPER):
    """The law without clamps and rotor limits: plain Eq. 13."""
    return dataclasses.replace(
        tracking_law(vehicle), max_position_error=1e9, max_velocity_error=1e9, rotor_limit=1e9
    )


# --------------------------------------------------------------------------------------- Eq. 13 and 14


def test_no_error_is_hover():
    assert (commanded() == HOVER).all()
    assert (
        commanded(position=(5, 6, 7), ref_position=(5, 6, 7), velocity=EAST, ref_velocity=EAST) == HOVER
    ).all()


def test_small_errors_are_the_linear_law():
    rng = np.random.default_rng(0)
    chi = 0.05 * rng.normal(size=12)
    got = commanded(position=chi[POSITION], velocity=chi[VELOCITY], attitude=chi[ATTITUDE], rates=chi[RATES])
    np.testing.assert_allclose(got, HOVER - LAW.gain @ chi, atol=1e-14)


@pytest.mark.parametrize(
    ("error", "index", "sign"),
    [
        ({"position": (0, 0, 1)}, 0, -1),  # too high: less thrust
        ({"position": (1, 0, 0)}, 2, -1),  # too far east: pitch back
        ({"position": (0, 1, 0)}, 1, +1),  # too far north: roll right, towards -y
        ({"attitude": (0, 0, 0.1)}, 3, -1),
        ({"velocity": (0, 0, -1)}, 0, +1),
    ],
)
def test_each_error_is_pushed_back(error, index, sign):
    push = commanded(**error) - HOVER
    assert np.sign(push[index]) == sign
    assert np.abs(np.delete(push, index)).max() < 1e-12


def test_only_the_cross_track_error_counts_along_a_path():
    """Eq. 14: ahead or behind on the path is no position error; aside of it is."""
    along, aside = (40.0, 0.0, 0.0), (0.0, 0.4, -0.3)
    both = np.add(along, aside)
    np.testing.assert_allclose(commanded(position=along, direction=EAST), HOVER, atol=1e-14)
    np.testing.assert_allclose(
        commanded(position=both, direction=EAST), commanded(position=aside, direction=EAST), atol=1e-13
    )
    slanted = np.array([2.0, -1.0, 0.5])
    projector = np.eye(3) - np.outer(slanted, slanted) / (slanted @ slanted)
    np.testing.assert_allclose(
        commanded(unclamped(), position=both, direction=slanted / np.linalg.norm(slanted)),
        commanded(unclamped(), position=projector @ both),
        atol=1e-12,
    )


def test_the_length_of_the_direction_does_not_matter_and_zero_holds_the_point():
    where = (0.3, 0.5, -0.2)
    np.testing.assert_allclose(
        commanded(position=where, direction=7.0 * EAST), commanded(position=where, direction=EAST), atol=1e-14
    )
    held = commanded(position=where)
    np.testing.assert_allclose(held - HOVER, -LAW.gain[:, 0:6:2] @ np.array(where), atol=1e-14)


def test_feedforward_adds_to_hover():
    extra = np.array([0.5, 0.01, -0.02, 0.003])
    np.testing.assert_allclose(commanded(feedforward=extra), HOVER + extra, atol=1e-15)


# ----------------------------------------------------------------------------------------------- frames


@given(seed=st.integers(0, 2**32 - 1), turn=st.floats(-10.0, 10.0))
def test_turning_the_world_does_not_change_the_answer(seed, turn):
    """Thrust and torques are in the body's frame: a turned world with the same errors asks for the same."""
    rng = np.random.default_rng(seed)
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    world = {
        k: rng.normal(size=3) for k in ("position", "velocity", "ref_position", "ref_velocity", "direction")
    }
    body = {"attitude": 0.3 * rng.normal(size=3), "rates": rng.normal(size=3)}
    turned = {k: rotation @ v for k, v in world.items()}
    turned_body = {"attitude": body["attitude"] + [0.0, 0.0, turn], "rates": body["rates"]}
    here = commanded(**world, **body)
    there = commanded(**turned, **turned_body, ref_yaw=turn)
    np.testing.assert_allclose(there, here, rtol=0, atol=2e-13)


@pytest.mark.parametrize("yaw", [0.5, 2.0, -3.0])
def test_the_turned_gain_is_the_lqr_of_the_turned_linearisation(yaw):
    """Same answer as solving the Riccati equation at that yaw (the paper's Q treats x and y alike)."""
    gain = lqr(*linearize(PAPER, yaw), np.diag(PAPER.lqr_q_diagonal), np.diag(PAPER.lqr_r_diagonal)).gain
    rng = np.random.default_rng(1)
    chi = 0.05 * rng.normal(size=12)
    attitude = chi[ATTITUDE] + [0.0, 0.0, yaw]
    got = commanded(
        position=chi[POSITION], velocity=chi[VELOCITY], attitude=attitude, rates=chi[RATES], ref_yaw=yaw
    )
    np.testing.assert_allclose(got, HOVER - gain @ chi, atol=1e-9)


@pytest.mark.parametrize(
    ("yaw", "ref_yaw", "error"),
    [
        (3.1, -3.1, 6.2 - 2 * math.pi),
        (-3.1, 3.1, 2 * math.pi - 6.2),
        (100.0, 100.0, 0.0),
        (0.2 + 8 * math.pi, 0.0, 0.2),
        (math.pi, 0.0, math.pi),
        (-math.pi, 0.0, math.pi),
    ],
)
def test_yaw_goes_the_short_way(yaw, ref_yaw, error):
    got = commanded(unclamped(), attitude=(0.0, 0.0, yaw), ref_yaw=ref_yaw)
    assert got[3] == pytest.approx(-LAW.gain[3, YAW] * error, abs=1e-12)


# ----------------------------------------------------------------------------------------------- clamps


@pytest.mark.parametrize(("name", "limit"), [("position", 1.5), ("velocity", 2.0)])
def test_a_clamp_keeps_the_direction_and_cuts_the_length(name, limit):
    way = np.array([2.0, -1.0, 0.5]) / np.linalg.norm([2.0, -1.0, 0.5])
    at_limit = commanded(**{name: limit * way})
    for length in (limit * 1.001, 15.0, 1e6):
        np.testing.assert_allclose(commanded(**{name: length * way}), at_limit, atol=1e-12)
    inside = commanded(unclamped(), **{name: 0.9 * limit * way})
    np.testing.assert_allclose(commanded(**{name: 0.9 * limit * way}), inside, atol=1e-13)


def test_the_clamp_sees_the_cross_track_error_not_the_along_track_one():
    got = commanded(position=(500.0, 1.0, 0.0), direction=EAST)
    np.testing.assert_allclose(got, commanded(position=(0.0, 1.0, 0.0)), atol=1e-12)


# ----------------------------------------------------------------------------------------- rotor limits

finite = st.floats(-1e6, 1e6)
vectors = st.tuples(finite, finite, finite)


@given(
    error=vectors, velocity=vectors, attitude=vectors, rates=vectors,
    feedforward=st.tuples(finite, finite, finite, finite), yaw=finite,
    ratio=st.floats(1.05, 20.0), mass=st.floats(0.01, 100.0),
)  # fmt: skip
@settings(max_examples=200)
def test_no_rotor_is_ever_asked_for_what_it_cannot_give(
    error, velocity, attitude, rates, feedforward, yaw, ratio, mass
):
    vehicle = Vehicle(mass_kg=mass, thrust_to_weight=ratio)
    law, limit = dataclasses.replace(LAW, rotor_limit=rotor_limit(vehicle)), rotor_limit(vehicle)
    u = commanded(
        law, position=error, velocity=velocity, attitude=attitude, rates=rates, feedforward=feedforward,
        ref_yaw=yaw,
    )  # fmt: skip
    thrusts = mixer_inverse(PAPER) @ u
    assert (thrusts >= -1e-12 * limit).all()
    assert (thrusts <= limit * (1.0 + 1e-12)).all()
    speeds = rotor_speeds(vehicle, u)
    assert np.isfinite(speeds).all()


def test_clipping_is_rotor_by_rotor():
    wanted = HOVER + np.array([6.0, 1.5, -0.8, 0.2])
    due = mixer(PAPER) @ np.clip(mixer_inverse(PAPER) @ wanted, 0.0, rotor_limit(PAPER))
    assert np.abs(due - wanted).max() > 0.5
    np.testing.assert_allclose(commanded(feedforward=wanted - HOVER), due, atol=1e-12)


# ------------------------------------------------------------------------------- batches and bad numbers


def nav_batch(runs, uavs, seed=0):
    rng = np.random.default_rng(seed)
    names = ("position", "velocity", "attitude", "rates", "ref_position", "ref_velocity", "direction")
    batch = {name: 2.0 * rng.normal(size=(runs, uavs, 3)) for name in names}
    batch["ref_yaw"] = rng.normal(size=(runs, uavs))
    batch["feedforward"] = rng.normal(size=(runs, uavs, 4))
    return batch


@pytest.mark.parametrize(("runs", "uavs"), [(1, 1), (3, 2), (17, 4)])
def test_a_uav_gets_the_same_bits_in_any_company(runs, uavs):
    whole = nav_batch(40, 4)
    part = {name: array[:runs, :uavs] for name, array in whole.items()}  # views, not contiguous
    got = LAW.inputs(**part, active=np.ones(runs, bool))
    assert (got == LAW.inputs(**whole, active=np.ones(40, bool))[:runs, :uavs]).all()


def test_runs_that_are_over_get_hover_and_change_nothing():
    batch = nav_batch(4, 3)
    batch["position"][1] = math.nan
    active = np.array([True, False, True, True])
    got = LAW.inputs(**batch, active=active)
    assert (got[1] == HOVER).all()
    assert np.isfinite(got).all()
    batch["position"][1] = 0.0
    assert (LAW.inputs(**batch, active=np.ones(4, bool))[active] == got[active]).all()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", list(nav_batch(1, 1)))
def test_what_is_not_finite_is_never_turned_into_a_command(name, bad):
    """A clamp or a rotor limit must not make a harmless command of an infinite error."""
    batch = nav_batch(2, 2)
    sound = LAW.inputs(**batch, active=np.ones(2, bool))
    batch[name][1, 0, ...] = bad if batch[name].ndim == 2 else [bad, *batch[name][1, 0, 1:]]
    got = LAW.inputs(**batch, active=np.ones(2, bool))
    assert not np.isfinite(got[1, 0]).any()
    assert (got[0] == sound[0]).all()
    assert (got[1, 1] == sound[1, 1]).all()


@pytest.mark.parametrize("name", ["position", "velocity"])
def test_an_error_too_large_to_measure_is_no_small_one(name):
    """Its norm overflows: the clamp must not scale it to nothing."""
    assert not np.isfinite(commanded(**{name: (1e200, 0.0, 0.0)})).any()


@pytest.mark.parametrize("name", list(nav_batch(1, 1)))
def test_shapes_that_do_not_fit_are_refused_by_name(name):
    batch = nav_batch(2, 3)
    batch[name] = batch[name][:, :2] if name != "position" else batch[name][..., :2]
    with pytest.raises(ProblemError, match=f"{name} must have shape"):
        LAW.inputs(**batch, active=np.ones(2, bool))
    with pytest.raises(ProblemError, match="active must have shape"):
        LAW.inputs(**nav_batch(2, 3), active=np.ones(3, bool))


# ---------------------------------------------------------------------------------- flights on the plant


def fly(law, vehicle, x, seconds, reference):
    """Fly runs of one UAV with true navigation; return final states and the largest tilt of each [rad]."""
    runs = len(x)
    state = x.reshape(runs, 1, 12).copy()
    active, tilt = np.ones(runs, bool), np.zeros(runs)
    zero_yaw, nothing = np.zeros((runs, 1)), np.zeros((runs, 1, 4))
    for tick in range(round(seconds / PERIOD)):
        shift, gust, point, velocity, direction = reference(tick, state)
        u = law.inputs(
            state[..., POSITION] + shift, state[..., VELOCITY] + gust,
            state[..., ATTITUDE], state[..., RATES],
            point, velocity, direction, zero_yaw, nothing, active,
        )  # fmt: skip
        advance(state, u, parameters(vehicle), PERIOD, 1, active)
        tilt = np.maximum(tilt, np.arccos(np.cos(state[:, 0, 6]) * np.cos(state[:, 0, 8])))
    return state[:, 0], tilt


def directions(rng, runs):
    v = rng.normal(size=(runs, 1, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def held_point(runs):
    zero = np.zeros((runs, 1, 3))
    return lambda tick, state: (zero, zero, zero, zero, zero)


def storm(runs, every):
    """Navigation that jumps by 15 m and 8 m/s in a new random direction every so many ticks."""
    rng, zero = np.random.default_rng(3), np.zeros((runs, 1, 3))
    jump = [zero, zero]

    def reference(tick, state):
        if tick % every == 0:
            jump[:] = 15.0 * directions(rng, runs), 8.0 * directions(rng, runs)
        return jump[0], jump[1], zero, zero, zero

    return reference


def three_metres_off(runs):
    x = np.zeros((runs, 12))
    x[:, POSITION] = 3.0 * directions(np.random.default_rng(2), runs)[:, 0]
    return x


def test_it_comes_home_from_three_metres():
    x, tilt = fly(LAW, PAPER, three_metres_off(50), 20.0, held_point(50))
    assert np.abs(x).max() < 1e-5
    assert np.degrees(tilt).max() < 15.0


@pytest.mark.parametrize("yaw_deg", [90.0, 179.0])
def test_it_comes_home_with_the_nose_the_wrong_way(yaw_deg):
    start = three_metres_off(50)
    start[:, YAW] = math.radians(yaw_deg)
    x, tilt = fly(LAW, PAPER, start, 25.0, held_point(50))
    assert np.abs(x).max() < 1e-5
    assert np.degrees(tilt).max() < 45.0


@pytest.mark.parametrize("every", [1, 5, 50, 250])
def test_jumps_of_eight_metres_a_second_and_fifteen_metres_do_not_tumble_it(every):
    """The paper's gains at 50 Hz on the nonlinear plant, navigation jumping at 50 Hz to every 5 s."""
    runs = 100
    x, tilt = fly(LAW, PAPER, three_metres_off(runs), 15.0, storm(runs, every))
    assert np.isfinite(x).all()
    assert np.degrees(tilt).max() < 50.0


def test_without_the_clamps_the_same_jumps_tumble_it():
    runs = 100
    free = dataclasses.replace(LAW, max_position_error=1e9, max_velocity_error=1e9)
    _, tilt = fly(free, PAPER, three_metres_off(runs), 15.0, storm(runs, 50))
    assert (np.degrees(tilt) > 90.0).mean() > 0.9


def test_it_follows_a_lane_at_the_commanded_speed():
    """Eq. 14 and 20-22: off the lane and at rest, it ends on the lane at the speed, wherever along it is."""
    n = np.array([0.8, 0.6, 0.0])
    reference = (
        np.zeros((1, 1, 3)),
        np.zeros((1, 1, 3)),
        np.zeros((1, 1, 3)),
        2.0 * n[None, None],
        n[None, None],
    )
    start = np.zeros((1, 12))
    start[0, POSITION] = 1.0, -3.0, 2.0
    x, _ = fly(LAW, PAPER, start, 20.0, lambda tick, state: reference)
    position, velocity = x[0, POSITION], x[0, VELOCITY]
    assert np.linalg.norm(position - n * (n @ position)) < 1e-3
    np.testing.assert_allclose(velocity, 2.0 * n, atol=1e-3)
    assert 30.0 < n @ position < 40.0
