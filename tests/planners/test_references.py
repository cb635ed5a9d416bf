"""References: slots that move at V_r, pulls that are bounded, lanes bent by a guide; in metres."""

import math

import numpy as np
import pytest

from napf_mpc.formation import PathFrame
from napf_mpc.planners.guide import Guide
from napf_mpc.planners.references import LARGEST_PULL_M, SlotReference

TIMES = np.array([0.5, 1.0, 4.0])
OFFSETS = np.array([[4.0, 2.0, 0.0], [-4.0, -2.0, 1.0]])


def slots(heading_deg: float = 0.0) -> SlotReference:
    frame = PathFrame.from_angles((10.0, 20.0, 5.0), math.radians(heading_deg), 0.0)
    return SlotReference(frame, OFFSETS, 2.0)


def places(reference: SlotReference, along: float, miss: np.ndarray | None = None) -> np.ndarray:
    """Positions (1, uav, 3) on the slots of a formation whose centre is somewhere, plus a miss."""
    wanted = OFFSETS + np.array([along, 0.0, 0.0])
    return reference.frame.to_world(wanted + (0.0 if miss is None else miss))[None]


@pytest.mark.parametrize("heading_deg", [0.0, 37.0, 90.0, 200.0])
def test_on_its_slot_a_uav_is_asked_to_fly_straight_on(heading_deg: float) -> None:
    reference = slots(heading_deg)
    out = reference.over(places(reference, 30.0), TIMES)
    path = reference.frame.to_path(out[0, :, :, 0:6:2])
    np.testing.assert_allclose(path[..., 0], OFFSETS[:, :1] + 30.0 + 2.0 * TIMES, atol=1e-12)
    np.testing.assert_allclose(path[..., 1:], np.repeat(OFFSETS[:, None, 1:], 3, axis=1), atol=1e-12)
    np.testing.assert_allclose(out[0, :, :, 1:6:2], np.broadcast_to(2.0 * reference.frame.along, (2, 3, 3)))
    np.testing.assert_allclose(out[..., 10], math.radians(heading_deg))


def test_one_ahead_is_asked_to_drop_back_by_what_it_is_ahead_of_its_slot() -> None:
    reference = slots()
    out = reference.over(places(reference, 30.0, np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])), TIMES)
    # The centre is where it was, so that both are asked back to the same slots as before.
    np.testing.assert_allclose(out[0, :, 0, 0] - 10.0, OFFSETS[:, 0] + 30.0 + 2.0 * TIMES[0])


def test_a_pull_is_no_longer_than_a_lunge() -> None:
    reference = slots()
    far = places(reference, 30.0, np.array([[20.0, 30.0, 40.0], [-20.0, 0.0, 0.0]]))
    pull = reference.over(far, np.array([0.0]))[0, :, 0, 0:6:2] - far[0]
    assert pull[0, 0] == -LARGEST_PULL_M
    assert pull[1, 0] == LARGEST_PULL_M
    assert math.hypot(pull[0, 1], pull[0, 2]) == pytest.approx(LARGEST_PULL_M)
    np.testing.assert_allclose(pull[0, 1:] / LARGEST_PULL_M, [-0.6, -0.8])


def test_a_measurements_error_is_believed_axis_by_axis() -> None:
    """1 m along, left and up of the slots; what sigma explains is not asked for, on its own axis only."""
    reference = slots(37.0)
    miss = np.array([[1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
    here = places(reference, 30.0, miss)

    def asked(sigma_m: np.ndarray | float) -> np.ndarray:
        out = reference.over(here, np.array([0.0]), sigma_m)[0, :, 0, 0:6:2]
        return reference.frame.to_path(out) - reference.frame.to_path(here[0])

    np.testing.assert_allclose(asked(np.zeros((1, 2, 3))), -miss, atol=1e-12)
    np.testing.assert_allclose(asked(0.0), -miss, atol=1e-12)
    for axis in range(3):
        sigma = np.full((1, 2, 3), 0.1)
        sigma[..., axis] = 10.0
        part = np.full(3, 1.0 / 1.01)
        part[axis] = 1.0 / 101.0
        np.testing.assert_allclose(asked(sigma), -miss * part, atol=1e-12)
    only_one = np.zeros((1, 2, 3))
    only_one[0, 0] = 1.0
    np.testing.assert_allclose(asked(only_one), [[-0.5, -0.5, 0.5], [1.0, 1.0, -1.0]], atol=1e-12)


def test_a_far_slot_is_believed_whatever_sigma_says_of_its_other_axes() -> None:
    reference = slots()
    high = places(reference, 30.0, np.array([[0.0, 0.0, 20.0], [0.0, 0.0, 0.0]]))
    sigma = np.broadcast_to([50.0, 50.0, 1.0], (1, 2, 3))
    pull = reference.over(high, np.array([0.0]), sigma)[0, 0, 0, 0:6:2] - high[0, 0]
    np.testing.assert_allclose(pull, [0.0, 0.0, -LARGEST_PULL_M * 400.0 / 401.0], atol=1e-9)


def bend(pace: float = 1.0) -> Guide:
    """Offset that grows by 0.5 m to the left each metre from 2 m ahead on, up to 3 m, for the first UAV."""
    ahead = np.arange(0.0, 21.0)
    offset = np.zeros((1, 2, 21, 2))
    offset[0, 0, :, 0] = np.clip(0.5 * (ahead - 2.0), 0.0, 3.0)
    return Guide(ahead, offset, np.full((1, 2), pace), np.zeros((1, 2), dtype=np.int8), np.zeros((1, 2)))


def test_a_guide_bends_the_lane_and_the_velocity_with_it() -> None:
    reference = slots()
    out = reference.over(places(reference, 30.0), TIMES, guide=bend())
    left = reference.frame.to_path(out[0, :, :, 0:6:2])[..., 1] - OFFSETS[:, None, 1]
    # 1, 2 and 8 m ahead.
    np.testing.assert_allclose(left, [[0.0, 0.0, 3.0], [0.0, 0.0, 0.0]], atol=1e-12)
    halfway = reference.over(places(reference, 30.0), np.array([2.0]), guide=bend())
    np.testing.assert_allclose(halfway[0, 0, 0, 1:6:2], [2.0, 1.0, 0.0])
    np.testing.assert_allclose(halfway[0, 0, 0, 2], 20.0 + 2.0 + 1.0)


def test_pace_slows_the_slot_and_zero_holds_it() -> None:
    reference = slots()
    slow = reference.over(places(reference, 30.0), TIMES, guide=bend(0.25))
    np.testing.assert_allclose(slow[0, :, :, 0] - 10.0 - 30.0 - OFFSETS[:, :1], [0.5 * TIMES] * 2)
    held = reference.over(places(reference, 30.0), TIMES, guide=bend(0.0))
    assert not held[0, :, :, 1:6:2].any()


def test_a_guide_ends_level_and_is_never_read_outside() -> None:
    guide = bend()
    far = np.full((1, 2, 1), 1e6)
    np.testing.assert_array_equal(guide.at(far)[0, 0, 0], [3.0, 0.0])
    np.testing.assert_array_equal(guide.at(-far)[0, 0, 0], [0.0, 0.0])
