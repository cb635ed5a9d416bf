"""A guide's way pulled taut: to the margin and no farther, on the same side, and back in time."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.formation import PathFrame
from napf_mpc.planners.guide import Guide, Passage
from napf_mpc.planners.guide_clearance import frame_of
from napf_mpc.planners.references import SlotReference
from napf_mpc.planners.taut import NEAR_M, SAME_M, STEPS, Clearance, pulled_taut
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Shape, Sphere

Array = NDArray[np.float64]

STEP, STATIONS = 1.0, 49
RADIUS, SIGMA, K = 0.3, 0.5, 3.0
NEED = RADIUS + K * SIGMA
LANE = np.array([[3.0, 0.0]])
PATH = PathFrame.from_angles((0.0, 0.0, 0.0), 0.0, 0.0)


def pulled(
    profile: Array, shapes: list[Shape], slope: float = 100.0, extra: tuple[float, float] = (0.0, 0.0)
) -> tuple[Array, Array]:
    """Offsets (station, 2) and how loose they are, of one UAV that starts at 0."""
    offsets, loose = pulled_taut(
        profile[None, None], np.zeros((1, 1)), STEP, LANE, frame_of(PATH), ObstacleSet.from_shapes(shapes),
        SIGMA**2 * np.eye(3)[None, None], Clearance(K, RADIUS, *extra), slope,
    )  # fmt: skip
    return offsets[0, 0], loose[0, 0]


def aside(left: float, up: float = 0.0) -> Array:
    return np.tile([left, up], (STATIONS, 1))


def test_without_anything_in_between_the_way_is_the_lane() -> None:
    far = Sphere((24.0, -40.0, 0.0), 1.0)
    offsets, loose = pulled(aside(5.0, 2.0), [far])
    np.testing.assert_allclose(offsets, 0.0, atol=1e-12)
    np.testing.assert_array_equal(loose, 1.0)


def test_beside_an_obstacle_it_keeps_the_margin_and_hardly_more() -> None:
    ball = Sphere((24.0, 3.0, 0.0), 1.0)
    offsets, loose = pulled(aside(5.0), [ball])
    # At the sphere itself: in steps of a fifth of five metres, never nearer than the margin.
    assert 1.0 + NEED <= offsets[24, 0] <= 1.0 + NEED + 1.0
    assert loose[24] == pytest.approx(1.0 - offsets[24, 0] / 5.0)
    places = np.stack([STEP * np.arange(STATIONS), LANE[0, 0] + offsets[:, 0], offsets[:, 1]], axis=-1)
    assert ObstacleSet.from_shapes([ball]).signed_distance(places[None]).min() >= NEED
    np.testing.assert_array_equal(offsets[:20], 0.0)


@pytest.mark.parametrize(("extra", "kept"), [((0.4, 10.0), 0.4), ((9.0, 0.6), 0.3)])
def test_what_is_kept_on_top_is_in_metres_at_most_and_in_sigmas(
    extra: tuple[float, float], kept: float
) -> None:
    ball = Sphere((24.0, 3.0, 0.0), 1.0)
    offsets, _ = pulled(aside(5.0), [ball], extra=extra)
    assert 1.0 + NEED + kept <= offsets[24, 0] <= 1.0 + NEED + kept + 0.05


def test_it_is_not_pulled_across_what_stands_between_it_and_the_lane() -> None:
    """A wall beside the way, the lane free behind it."""
    wall = Box((24.0, 7.0, 0.0), (60.0, 0.5, 50.0))
    offsets, _ = pulled(aside(8.0), [wall])
    assert (LANE[0, 0] + offsets[:, 0] >= 7.25 + NEED).all()


def test_a_way_that_is_inside_a_margin_already_stays() -> None:
    ball = Sphere((24.0, 3.0, 0.0), 1.0)
    offsets, loose = pulled(aside(2.5), [ball])
    assert offsets[24, 0] == 2.5
    assert loose[24] == 0.0


def test_it_leads_back_at_a_slope_that_can_be_flown() -> None:
    wall = Box((40.0, 3.0, 0.0), (4.0, 10.0, 200.0))
    offsets, _ = pulled(aside(8.0), [wall], slope=0.25)
    needed = offsets[38:43, 0].min()
    assert needed >= 5.0 + NEED
    rising = np.diff(offsets[:, 0])[:38]
    assert rising.max() <= 0.25 + 1e-12
    assert offsets[0, 0] == 0.0
    assert offsets[30, 0] > 4.0  # not yet beside the wall, but on the way out
    # Behind the wall nothing asks for more.
    np.testing.assert_array_equal(offsets[46:], 0.0)


WORLDS: dict[str, list[Shape]] = {
    "nothing": [],
    "spheres": [Sphere((6.0 * i, 7.0 * ((3 * i) % 7 - 3), 0.5 * i - 2.0), 0.5 + 0.2 * i) for i in range(9)],
    "trunks": [Cylinder((5.0 * i, 6.0 * ((2 * i) % 5 - 2)), 0.4 + 0.1 * i) for i in range(9)],
    "boxes": [Box((8.0 * i, 8.0 * ((2 * i) % 5 - 2), 0.0), (3.0, 2.0, 4.0), 0.3 * i) for i in range(6)],
    "a courtyard": [
        Prism(
            (
                np.array([(10.0, -9.0), (40.0, -9.0), (40.0, 14.0), (10.0, 14.0)]),
                np.array([(14.0, -5.0), (14.0, 10.0), (36.0, 10.0), (36.0, -5.0)]),
            ),
            -9.0,
            9.0,
        )
    ],
}


@pytest.mark.parametrize("k", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("name", WORLDS)
def test_no_question_that_is_left_out_would_have_changed_anything(name: str, k: float) -> None:
    """Covariances with correlated axes and one far larger than another; each place asked about by itself."""
    rng = np.random.default_rng(7)
    world = ObstacleSet.from_shapes(WORLDS[name])
    for _ in range(8):
        wide = rng.normal(0.0, 1.0, (3, 3)) * (0.9, 0.3, 0.1)
        covariance = wide @ wide.T + 0.01 * np.eye(3)
        profile = np.cumsum(rng.normal(0.0, 0.6, (STATIONS, 2)) * (1.0, 0.3), axis=0)
        given = (
            profile[None, None], np.zeros((1, 1)), STEP, LANE, frame_of(PATH), world, covariance[None, None],
            Clearance(k, RADIUS, 0.75, 0.95), 0.35,
        )  # fmt: skip
        quick = pulled_taut(*given)
        slow = asked_everywhere(profile, world, covariance, k)
        np.testing.assert_allclose(quick[0][0, 0], slow, atol=1e-9)


def asked_everywhere(profile: Array, world: ObstacleSet, covariance: Array, k: float) -> Array:
    """The same, every place by a question of its own."""
    out = profile.copy()
    ahead = 0.0
    for s in range(STATIONS - 1, -1, -1):
        left, up = profile[s]
        size = math.sqrt(left * left + up * up)
        limit = min(size - (ahead - 0.35 * STEP), size)
        ahead = size
        if size < SAME_M or limit <= 0.0:
            continue
        pulled, blocked = 0.0, -1.0
        wants = [limit * step / STEPS for step in range(1, STEPS + 1)]
        while wants or blocked - pulled > NEAR_M:
            want = wants.pop(0) if blocked < 0.0 else 0.5 * (pulled + blocked)
            kept = 1.0 - want / size
            place = np.array([[[s * STEP, LANE[0, 0] + kept * left, LANE[0, 1] + kept * up]]])
            near = world.near(place, np.array([[1e3]]), 1)
            distance, normal = float(near.distance[0, 0, 0]), near.gradient[0, 0, 0]
            sigma = math.sqrt(max(float(normal @ covariance @ normal), 0.0))
            if len(world) and RADIUS + k * sigma + min(0.75, 0.95 * sigma) > distance:
                blocked, wants = want, []
            else:
                pulled = want
        ahead = size - pulled
        out[s] = profile[s] * (1.0 - pulled / size)
    return out


def test_uavs_that_hold_stay_on_the_guides_way() -> None:
    """Guide 1 m to the left and up, its taut way on the lane; one UAV goes on along it, the other holds."""
    offset, taut = np.ones((1, 2, 5, 2)), np.zeros((1, 2, 5, 2))
    reason = np.array([[Passage.DETOUR, Passage.HOLD]], dtype=np.int8)
    guide = Guide(np.arange(5.0), offset, np.ones((1, 2)), reason, np.zeros((1, 2)), taut, np.ones((1, 2, 5)))
    slots = SlotReference(PATH, np.array([[0.0, 2.0, 0.0], [0.0, -2.0, 0.0]]), 2.0)
    lanes = slots.offsets[None]
    ways = slots.ways_from(slots.here(lanes), np.array([0.5, 1.0]), guide)
    left = {name: getattr(ways, name)[0, :, -1, 2] - lanes[0, :, 1] for name in ("way", "pulled", "free")}
    np.testing.assert_allclose(left["way"], [1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(left["pulled"], [0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(left["free"], [0.0, 0.0], atol=1e-12)
    np.testing.assert_array_equal(ways.loose[0, :, -1], [1.0, 0.0])
    np.testing.assert_array_equal(ways.room, 0.0)
    # Room is that of the narrower of two stations, and none for who holds.
    told = replace(guide, room=np.tile([4.0, 3.0, 2.0, 1.0, 0.5], (1, 2, 1)))
    roomy = slots.ways_from(slots.here(lanes), np.array([0.5, 1.2]), told)
    np.testing.assert_array_equal(roomy.room[0], [[2.0, 1.0], [0.0, 0.0]])
    # Each is what a guide of that way alone leads along.
    alone = slots.over_from(slots.here(lanes), np.array([0.5, 1.0]), replace(guide, taut=None, loose=None))
    np.testing.assert_array_equal(ways.way, alone)
