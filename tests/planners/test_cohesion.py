"""How far UAVs follow the one that leaves its lane, in metres, and that they come back."""

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.formation import PathFrame
from napf_mpc.planners.cohesion import ASIDE_PART, drawn_together, gone_along
from napf_mpc.planners.references import LARGEST_PULL_M

Array = NDArray[np.float64]

UAVS, STAGES = 4, 3
ALL = np.ones((1, UAVS), dtype=bool)
FRAMES = [PathFrame.from_angles((0.0, 0.0, 0.0), 0.0, 0.0), PathFrame.from_angles((5.0, -7.0, 2.0), 0.7, 0.3)]


def states(places: Array) -> Array:
    out = np.zeros((1, UAVS, STAGES, 12))
    out[..., 0:6:2] = places[:, None]
    return out


def sideways(frame: PathFrame, left: list[float], up: float = 0.0) -> Array:
    """Places (uav, 3) so far left of, and above, the origin."""
    return np.asarray(np.outer(left, frame.axes[1]) + up * frame.axes[2])


@pytest.mark.parametrize("frame", FRAMES, ids=["along x", "climbing"])
def test_the_others_settle_at_their_share_of_the_way_of_one(frame: PathFrame) -> None:
    """One is held 2 m off; where all others go again and again, they end at d c / (n - c (n - 1))."""
    lanes, share = states(np.zeros((UAVS, 3))), 0.6
    held = sideways(frame, [2.0, 0.0, 0.0, 0.0])[0]
    plans = lanes
    for _ in range(200):
        plans = drawn_together(lanes, lanes, plans, ALL, share, frame)
        plans[0, 0, :, 0:6:2] = held
    settled = 2.0 * share / (UAVS - share * (UAVS - 1))
    np.testing.assert_allclose(plans[0, 1:, :, 0:6:2] @ frame.axes[1], settled, atol=1e-9)
    np.testing.assert_allclose(plans[0, 1:, :, 0:6:2] @ frame.axes[0], 0.0, atol=1e-12)
    # Let go, all return.
    for _ in range(200):
        plans = drawn_together(lanes, lanes, plans, ALL, share, frame)
    np.testing.assert_allclose(plans[..., 0:6:2], 0.0, atol=1e-9)


def test_places_and_speeds_move_by_the_same_share_and_only_sideways() -> None:
    frame = FRAMES[1]
    lanes = states(np.zeros((UAVS, 3)))
    plans = states(sideways(frame, [1.0, 2.0, -0.5, 0.3], up=0.4) + 9.0 * frame.axes[0])
    plans[..., 1:6:2] = 0.2 * frame.axes[1] + 3.0 * frame.axes[0]
    moved = drawn_together(lanes, lanes, plans, ALL, 0.5, frame) - lanes
    expected = 0.5 * (0.7 * frame.axes[1] + 0.4 * frame.axes[2])
    np.testing.assert_allclose(moved[..., 0:6:2], np.broadcast_to(expected, (1, UAVS, STAGES, 3)), atol=1e-12)
    np.testing.assert_allclose(moved[..., 1:6:2] @ frame.axes[1], 0.1, atol=1e-12)
    np.testing.assert_allclose(moved[..., 1:6:2] @ frame.axes[0], 0.0, atol=1e-12)


def test_who_is_not_followed_does_not_count_and_nobody_counts_for_more_than_the_largest_pull() -> None:
    frame = FRAMES[0]
    lanes = states(np.zeros((UAVS, 3)))
    plans = states(sideways(frame, [100.0, 0.0, 0.0, 0.0]))
    counted = ALL.copy()
    drawn = drawn_together(lanes, lanes, plans, counted, 0.8, frame)
    np.testing.assert_allclose(drawn[..., 2], 0.8 * LARGEST_PULL_M / UAVS)
    counted[0, 0] = False
    np.testing.assert_array_equal(drawn_together(lanes, lanes, plans, counted, 0.8, frame), lanes)
    counted[:] = False
    np.testing.assert_array_equal(drawn_together(lanes, lanes, plans, counted, 0.8, frame), lanes)


def test_each_place_has_its_own_share() -> None:
    frame = FRAMES[0]
    lanes = states(np.zeros((UAVS, 3)))
    plans = states(sideways(frame, [2.0, 2.0, 2.0, 2.0]))
    share = np.zeros((1, UAVS, STAGES))
    share[0, 1, 2] = 0.5
    drawn = drawn_together(lanes, lanes, plans, ALL, share, frame)
    assert drawn[0, 1, 2, 2] == pytest.approx(1.0)
    drawn[0, 1, 2, 2] = 0.0
    np.testing.assert_array_equal(drawn, lanes)


ROOM_M = 3.0


def along(own: Array, lanes: Array, plans: Array, frame: PathFrame, loose: float, room: float) -> Array:
    """References of :func:`gone_along` with a share of 0.8, the same looseness and room everywhere."""
    part, free = np.full((2, 1, UAVS, STAGES), [[[[loose]]], [[[room]]]])
    return gone_along(own, lanes, plans, ALL, 0.8, frame, part, free, ROOM_M)


@pytest.mark.parametrize("frame", FRAMES, ids=["along x", "climbing"])
@pytest.mark.parametrize(
    ("mean", "room", "left", "up"),
    [
        ((3.0, 0.0), 3.0, 2.4, 0.0),  # they are farther out than its own metre: to c times the mean
        ((3.0, 0.0), 2.0, 2.0 + 0.25 * 0.4, 0.0),  # as far as there is room, and beyond by its looseness
        ((3.0, 0.0), 0.0, 1.0 + 0.25 * 1.4, 0.0),  # without room by its looseness alone
        ((1.0, 0.0), 3.0, 1.0, 0.0),  # less far out: it stays, the two do not add up
        ((-1.0, 0.0), 3.0, 1.0 - 0.25 * 0.8, 0.0),  # inwards is what it passes
        ((0.0, 1.0), 0.0, 1.0, 0.8 * 0.25),  # aside by its looseness,
        ((0.0, 1.0), 3.0, 1.0, 0.8 * (0.25 + 0.75 * ASIDE_PART)),  # and a part of the rest with all the room
        ((0.0, 1.0), 2.0, 1.0, 0.8 * (0.25 + 0.75 * ASIDE_PART * 0.5)),  # half of that with half of it
    ],
)
def test_who_passes_something_goes_along_outwards_as_far_as_there_is_room(
    frame: PathFrame, mean: tuple[float, float], room: float, left: float, up: float
) -> None:
    """All keep a metre to the left of their lanes, a quarter loose, and plan to be off by the mean."""
    lanes, own = states(np.zeros((UAVS, 3))), states(sideways(frame, [1.0] * UAVS))
    plans = states(sideways(frame, [mean[0]] * UAVS, mean[1]))
    drawn = along(own, lanes, plans, frame, 0.25, room)
    np.testing.assert_allclose(drawn[..., 0:6:2] @ frame.axes[1], left, atol=1e-12)
    np.testing.assert_allclose(drawn[..., 0:6:2] @ frame.axes[2], up, atol=1e-12)
    np.testing.assert_allclose(drawn[..., 0:6:2] @ frame.axes[0], 0.0, atol=1e-12)


def test_velocities_go_along_where_places_do() -> None:
    frame = FRAMES[1]
    lanes, own = states(np.zeros((UAVS, 3))), states(sideways(frame, [1.0] * UAVS))
    lanes[..., 1:6:2] = 2.0 * frame.axes[0]
    own[..., 1:6:2] = 2.0 * frame.axes[0] + 0.3 * frame.axes[1]
    for mean, speed in ((3.0, 0.8 * 0.5), (1.0, 0.3), (-1.0, 0.3 + 0.25 * 0.8 * 0.5)):
        plans = states(sideways(frame, [mean] * UAVS))
        plans[..., 1:6:2] = 2.0 * frame.axes[0] + 0.5 * frame.axes[1]
        drawn = along(own, lanes, plans, frame, 0.25, ROOM_M)
        np.testing.assert_allclose(drawn[..., 1:6:2] @ frame.axes[1], speed, atol=1e-12)
        np.testing.assert_allclose(drawn[..., 1:6:2] @ frame.axes[0], 2.0, atol=1e-12)


def test_on_the_lane_both_rules_are_one() -> None:
    frame = FRAMES[1]
    lanes = states(np.zeros((UAVS, 3)))
    plans = states(sideways(frame, [1.0, 2.0, -0.5, 0.3], up=0.4))
    expected = drawn_together(lanes, lanes, plans, ALL, 0.8 * 0.5, frame)
    np.testing.assert_allclose(along(lanes, lanes, plans, frame, 0.5, ROOM_M), expected, atol=1e-12)


def test_nobody_goes_along_with_plans_that_nobody_follows() -> None:
    frame = FRAMES[0]
    lanes, own = states(np.zeros((UAVS, 3))), states(sideways(frame, [1.0] * UAVS))
    plans = states(sideways(frame, [3.0] * UAVS))
    whole = np.ones((1, UAVS, STAGES))
    drawn = gone_along(own, lanes, plans, ~ALL, 0.8, frame, whole, ROOM_M * whole, ROOM_M)
    np.testing.assert_array_equal(drawn, own)
