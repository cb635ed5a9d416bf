"""The compiled passes over clearance rows say what the plain formulas say, to the last bit."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.constraints.clearance import distance_of_force, influence_model
from napf_mpc.constraints.clearance_rows import contact_rows, held_distances, influence_rows, shortfalls

Array = NDArray[np.float64]

SHAPE = (3, 2, 4, 5)
TIMES_S = np.array([0.1, 0.2, 0.4, 0.8])


def samples(seed: int) -> tuple[Array, Array, Array, Array, Array]:
    """Normals, shifted distances (inside margins, far, and none at all), sigmas, plans and other plans."""
    draw = np.random.default_rng(seed)
    normal = draw.normal(size=(*SHAPE, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    shifted = draw.uniform(-4.0, 8.0, SHAPE)
    none = draw.random(SHAPE) < 0.2
    shifted[none], normal[none] = math.inf, 0.0
    sigma = draw.uniform(0.1, 5.0, SHAPE)
    position = draw.uniform(-50.0, 50.0, (*SHAPE[:3], 3))
    return normal, shifted, sigma, position, position + draw.normal(size=position.shape)


def along(normal: Array, position: Array) -> Array:
    """Places along normals, one axis after the other."""
    x = normal * position[..., None, :]
    return np.asarray(x[..., 0] + x[..., 1] + x[..., 2])


@pytest.mark.parametrize("opening_mps", [math.inf, 2.0])
@pytest.mark.parametrize("extra", [(0.0, math.inf), (0.8, math.inf), (0.8, 0.3)])
def test_contact_rows_ask_for_the_extra_or_for_a_gap_that_opens(
    extra: tuple[float, float], opening_mps: float
) -> None:
    normal, shifted, sigma, position, _ = samples(1)
    lower = np.empty(SHAPE)
    contact_rows(normal, shifted, sigma, position, *extra, opening_mps, TIMES_S, lower)
    asked = np.full(SHAPE, extra[0]) if math.isinf(extra[1]) else np.minimum(extra[0], extra[1] * sigma)
    if math.isfinite(opening_mps):
        here = shifted + (along(normal, position[:, :, :1]) - along(normal, position))
        asked = np.minimum(asked, np.minimum(asked, here) + opening_mps * TIMES_S[:, None])
    np.testing.assert_array_equal(lower, along(normal, position) + (asked - shifted))
    assert (lower[np.isinf(shifted)] == -np.inf).all()


def test_the_shortfall_is_that_of_the_worst_row_in_metres() -> None:
    normal, shifted, sigma, planned, position = samples(2)
    most = np.empty(SHAPE[:2])
    shortfalls(normal, shifted, sigma, planned, position, 0.8, 0.3, most)
    moved = along(normal, position) - along(normal, planned)
    short = np.minimum(0.8, 0.3 * sigma) - (shifted + moved)
    np.testing.assert_array_equal(most, np.maximum(short, 0.0).max(axis=(2, 3)))
    assert (most > 0.0).all()
    shortfalls(normal, np.full(SHAPE, math.inf), sigma, planned, position, 0.8, 0.3, most)
    assert (most == 0.0).all(), "nothing is near, so nothing is short"
    position[0, 1, 2, 0] = math.nan
    shortfalls(normal, shifted, sigma, planned, position, 0.8, 0.3, most)
    assert np.isnan(most[0, 1]), "what is not a number is not clear"
    assert np.isfinite(most[0, 0])


@pytest.mark.parametrize(("gain", "most"), [(15.0, 500.0), (15.0, math.inf), (0.0, 500.0), (1e-3, 0.1)])
@pytest.mark.parametrize("widened", [False, True])
def test_influence_rows_are_the_second_order_model(gain: float, most: float, widened: bool) -> None:
    normal, shifted, sigma, position, _ = samples(3)
    influence = 3.0 + (sigma if widened else np.zeros(SHAPE))
    per_speed, least_m = 1.7, 0.1
    ratio = most / (per_speed * gain) if gain > 0.0 else math.inf
    held, lower, w2 = np.empty(SHAPE), np.empty(SHAPE), np.empty(SHAPE)
    held_distances(shifted, influence, least_m, ratio, ratio ** (1.0 / 3.0), held)
    influence_rows(normal, shifted, influence, position, gain, per_speed, held, np.power(held, 4), lower, w2)
    floor: Array | float = least_m
    if math.isfinite(ratio):
        floor = np.maximum(least_m, distance_of_force(ratio, influence))
    weight, target = influence_model(shifted, gain, influence, floor)
    free = per_speed * weight <= 0.0
    bound = along(normal, position) + (target - shifted)
    np.testing.assert_array_equal(w2, np.where(free, 1.0, per_speed * weight))
    np.testing.assert_array_equal(lower, np.where(free | np.isinf(shifted), -np.inf, bound))
