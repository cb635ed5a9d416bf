"""Virtual structure and motion synchronisation: the paper's figures, signs and invariances."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from napf_mpc.formation import (
    PathFrame,
    commanded_acceleration,
    formation_offsets,
    reference_speed,
    square_geometry,
    synchronisation_error,
    tracking_errors,
)
from napf_mpc.problem import Circle, Formation, FormationMission, Line, Listed, Square, Vee, Vehicle
from napf_mpc.vehicle.tracking import tracking_law

Array = NDArray[np.float64]

angles = st.floats(-math.pi, math.pi)
climbs = st.floats(-math.radians(45.0), math.radians(45.0))
places = st.tuples(*[st.floats(-1e4, 1e4)] * 3)
points = arrays(float, (5, 3), elements=st.floats(-1e3, 1e3))

FORMATIONS: list[Formation] = [
    Square(shape="square"),
    Square(shape="square", side_m=50.0, first_lane_m=15.0),
    Line(shape="line", count=1),
    Line(shape="line", count=7, bearing_deg=30.0),
    Vee(shape="v", count=6),
    Circle(shape="circle", count=9, phase_deg=20.0),
    Listed(shape="list", offsets_m=((5.0, 1.0, 2.0), (1.0, -1.0, 0.0), (9.0, 4.0, -3.0))),
]


# ------------------------------------------------------------------------------------------- the square


def test_the_papers_square() -> None:
    """Eq. 15 and 17 with P1 = (0, 3, 0) and s = 10 m: figures that follow from the paper's numbers."""
    geometry = square_geometry(10.0, 3.0)
    assert math.degrees(geometry.alpha_rad) == pytest.approx(25.104, abs=5e-4)
    assert math.degrees(geometry.beta_rad) == pytest.approx(19.896, abs=5e-4)
    np.testing.assert_allclose(geometry.lanes_m, [3.0, -3.0, -6.403, 6.403], atol=5e-4)
    np.testing.assert_allclose(geometry.along_m, [6.403, -6.403, 3.0, -3.0], atol=5e-4)


def test_the_papers_slots_are_a_square_of_ten_metres() -> None:
    slots = formation_offsets(Square(shape="square"))
    expected = [(6.403, 3.0, 0.0), (-6.403, -3.0, 0.0), (3.0, -6.403, 0.0), (-3.0, 6.403, 0.0)]
    np.testing.assert_allclose(slots, expected, atol=5e-4)
    distance = {(i + 1, j + 1): math.dist(slots[i], slots[j]) for i, j in itertools.combinations(range(4), 2)}
    for pair in ((1, 3), (2, 3), (2, 4), (1, 4)):
        assert distance[pair] == pytest.approx(10.0, abs=1e-12)
    assert distance[1, 2] == pytest.approx(14.142, abs=5e-4)
    assert distance[3, 4] == pytest.approx(14.142, abs=5e-4)


@given(side=st.floats(0.1, 1e4), share=st.floats(-1.0, 1.0))
def test_every_first_lane_gives_a_square_that_keeps_it(side: float, share: float) -> None:
    lane = share * side / math.sqrt(2.0)
    geometry = square_geometry(side, lane)
    slots = np.column_stack([geometry.along_m, geometry.lanes_m])
    assert slots[0, 1] == lane
    np.testing.assert_allclose(np.hypot(*slots.T), side / math.sqrt(2.0), rtol=1e-7)
    for i, j in ((0, 2), (2, 1), (1, 3), (3, 0)):
        assert math.dist(slots[i], slots[j]) == pytest.approx(side, rel=1e-7)
    assert abs(geometry.along_m.sum()) < 1e-9 * side


def test_a_negative_first_lane_is_the_mirror_image() -> None:
    one, other = square_geometry(10.0, 3.0), square_geometry(10.0, -3.0)
    np.testing.assert_array_equal(one.along_m, other.along_m)
    np.testing.assert_array_equal(one.lanes_m, -other.lanes_m)


@pytest.mark.parametrize(
    ("side", "lane"),
    [(10.0, 7.08), (10.0, -7.08), (0.0, 0.0), (-1.0, 0.0), (math.nan, 0.0), (10.0, math.nan)],
)
def test_what_is_no_square_is_refused_by_name(side: float, lane: float) -> None:
    with pytest.raises(ValueError, match=r"side_m = .*first_lane_m = "):
        square_geometry(side, lane)


# --------------------------------------------------------------------------------------- any formation


@pytest.mark.parametrize("formation", FORMATIONS, ids=lambda f: f"{f.shape}")
def test_along_track_offsets_have_mean_zero(formation: Formation) -> None:
    """The centre u_c is the mean of the UAVs' coordinates; an offset would make all of them run away."""
    assert formation_offsets(formation)[:, 0].mean() == pytest.approx(0.0, abs=1e-13)


def test_a_line_abreast_and_in_file() -> None:
    abreast = formation_offsets(Line(shape="line", count=5, spacing_m=4.0))
    np.testing.assert_array_equal(abreast[:, 0], np.zeros(5))
    np.testing.assert_allclose(abreast[:, 1], [-8.0, -4.0, 0.0, 4.0, 8.0])
    file = formation_offsets(Line(shape="line", count=3, spacing_m=4.0, bearing_deg=0.0))
    np.testing.assert_allclose(file, [(-4.0, 0.0, 0.0), (0.0, 0.0, 0.0), (4.0, 0.0, 0.0)])


def test_a_v_has_its_leader_in_front_and_its_opening() -> None:
    slots = formation_offsets(Vee(shape="v", count=5, spacing_m=6.0, opening_deg=80.0))
    assert (slots[0, 0] > slots[1:, 0]).all()
    assert slots[0, 1] == 0.0
    left, right = slots[1] - slots[0], slots[2] - slots[0]
    assert left[1] > 0.0 > right[1]
    assert np.linalg.norm(left) == pytest.approx(6.0)
    assert math.degrees(math.acos(left @ right / 36.0)) == pytest.approx(80.0)
    np.testing.assert_allclose(slots[3] - slots[0], 2.0 * left)


def test_a_circle_has_its_radius_and_even_chords() -> None:
    slots = formation_offsets(Circle(shape="circle", count=6, radius_m=8.0, phase_deg=90.0))
    np.testing.assert_allclose(np.hypot(slots[:, 0], slots[:, 1]), 8.0)
    np.testing.assert_allclose(slots[0], (0.0, 8.0, 0.0), atol=1e-12)
    chords = [math.dist(slots[i - 1], slots[i]) for i in range(6)]
    np.testing.assert_allclose(chords, 8.0)


def test_listed_offsets_keep_lanes_and_heights() -> None:
    slots = formation_offsets(FORMATIONS[-1])
    np.testing.assert_allclose(slots, [(0.0, 1.0, 2.0), (-4.0, -1.0, 0.0), (4.0, 4.0, -3.0)])


# ------------------------------------------------------------------------------------ synchronisation


def test_a_uav_ahead_slows_and_one_behind_hurries() -> None:
    """Eq. 18 with k_f = -0.5: one metre ahead of its slot, the others in theirs."""
    offsets = formation_offsets(Square(shape="square"))[:, 0]
    error = synchronisation_error(40.0 + offsets + np.array([1.0, 0.0, 0.0, 0.0]), offsets)
    np.testing.assert_allclose(error, [0.75, -0.25, -0.25, -0.25], atol=1e-12)
    speed = reference_speed(2.0, -0.5, error, 0.4, 3.0)
    np.testing.assert_allclose(speed, [1.625, 2.125, 2.125, 2.125], atol=1e-12)


def test_reference_speed_stays_between_its_bounds() -> None:
    np.testing.assert_array_equal(
        reference_speed(2.0, -0.5, np.array([100.0, 0.0, -100.0]), 0.4, 3.0), [0.4, 2.0, 3.0]
    )


@pytest.mark.parametrize("uavs", [1, 2, 3, 4, 7, 8, 20])
def test_the_error_is_that_of_numpys_mean_to_the_last_bit(uavs: int) -> None:
    """However many fly beside each other: a block of runs must not change a run."""
    rng = np.random.default_rng(uavs)
    along, offsets = rng.normal(size=(50, uavs)) * 100.0, rng.normal(size=uavs)
    wanted = along - (along.mean(-1, keepdims=True) + offsets)
    np.testing.assert_array_equal(synchronisation_error(along, offsets), wanted)
    np.testing.assert_array_equal(synchronisation_error(along[3], offsets), wanted[3])


def test_in_their_slots_all_fly_at_the_reference_speed() -> None:
    """Signed offsets: the printed l2 = u_c - u_2 would make this formation fly abreast."""
    offsets = formation_offsets(Square(shape="square"))[:, 0]
    np.testing.assert_allclose(synchronisation_error(12.5 + offsets, offsets), np.zeros(4), atol=1e-12)
    abreast = synchronisation_error(np.full(4, 12.5), offsets)
    np.testing.assert_allclose(abreast, -offsets)
    assert reference_speed(2.0, -0.5, abreast, 0.0, 10.0)[0] > 2.0  # UAV 1 belongs in front


@given(
    along=arrays(float, (3, 6), elements=st.floats(-1e3, 1e3)),
    offsets=arrays(float, 6, elements=st.floats(-50.0, 50.0)),
    shift=st.floats(-1e4, 1e4),
    order=st.permutations(range(6)),
)
def test_synchronisation_does_not_care_for_the_origin_or_the_labels(
    along: Array, offsets: Array, shift: float, order: list[int]
) -> None:
    offsets = offsets - offsets.mean()
    error = synchronisation_error(along, offsets)
    np.testing.assert_allclose(synchronisation_error(along + shift, offsets), error, atol=1e-9)
    np.testing.assert_allclose(
        synchronisation_error(along[:, order], offsets[order]), error[:, order], atol=1e-10
    )
    np.testing.assert_allclose(error.sum(-1), 0.0, atol=1e-9)


@pytest.mark.parametrize("uavs", [1, 4, 9, 17, 64])
def test_synchronisation_of_a_run_is_the_same_bits_in_any_company(uavs: int) -> None:
    rng = np.random.default_rng(uavs)
    along, offsets = rng.normal(0.0, 30.0, (50, uavs)), rng.normal(0.0, 5.0, uavs)
    together = synchronisation_error(along, offsets)
    for run in range(50):
        np.testing.assert_array_equal(synchronisation_error(along[run : run + 1], offsets)[0], together[run])


# ------------------------------------------------------------------------------------- tracking errors


def test_only_the_distance_from_the_lane_counts() -> None:
    """Eq. 14 with I3 - n n^T: the printed 1 - n n^T would subtract from every entry."""
    direction = np.array([0.6, 0.8, 0.0])
    lane = np.array([1.0, 2.0, 5.0])
    left = np.array([-0.8, 0.6, 0.0])
    cross, velocity = tracking_errors(
        lane + 37.0 * direction + 2.0 * left + np.array([0.0, 0.0, -1.0]),
        np.array([1.2, 1.6, 0.5]),
        lane,
        direction,
        np.array(1.5),
    )
    np.testing.assert_allclose(cross, 2.0 * left - np.array([0.0, 0.0, 1.0]), atol=1e-12)
    np.testing.assert_allclose(velocity, [0.3, 0.4, 0.5], atol=1e-12)


@given(
    position=places, velocity=places, lane=places, heading=angles, climb=climbs, along=st.floats(-50.0, 50.0)
)
def test_the_control_law_is_equation_22(
    position: tuple[float, ...],
    velocity: tuple[float, ...],
    lane: tuple[float, ...],
    heading: float,
    climb: float,
    along: float,
) -> None:
    """Eq. 20-22 written out, the path point with a plus: the sign of the third line is a slip."""
    k_p, k_v, k_f, v_r = 0.7, 1.3, -0.5, 2.0
    n = PathFrame.from_angles((0.0, 0.0, 0.0), heading, climb).along
    x, v, p = (np.array(a) for a in (position, velocity, lane))
    speed = reference_speed(v_r, k_f, np.array(along), -1e9, 1e9)
    cross, e_v = tracking_errors(x, v, p, n, speed)
    acceleration = commanded_acceleration(cross, e_v, k_p, k_v)
    projector = np.eye(3) - np.outer(n, n)
    written_out = -k_p * projector @ x + k_p * projector @ p - k_v * v + k_v * v_r * n + k_v * k_f * along * n
    np.testing.assert_allclose(acceleration, written_out, atol=1e-7)
    moved = tracking_errors(x + 5.0, v, p + 5.0, n, speed)
    np.testing.assert_allclose(commanded_acceleration(*moved, k_p, k_v), acceleration, atol=1e-7)


def test_the_inner_loop_realises_the_law_with_the_lqrs_gains() -> None:
    """Up and down, where thrust acts at once: thrust / m - g is f of Eq. 22 with k_p, k_v from the LQR."""
    law, vehicle = tracking_law(Vehicle()), Vehicle()
    direction = np.array([math.cos(0.3), 0.0, math.sin(0.3)])
    position, velocity = np.array([[[3.0, 0.2, 0.9]]]), np.array([[[1.9, 0.1, 0.7]]])
    lane = np.zeros((1, 1, 3))
    speed = np.array([[2.0]])
    cross, e_v = tracking_errors(position, velocity, lane, direction, speed)
    expected = commanded_acceleration(
        cross, e_v, law.gain[0, 4] / vehicle.mass_kg, law.gain[0, 5] / vehicle.mass_kg
    )
    level, along = np.zeros((1, 1, 3)), np.broadcast_to(direction, (1, 1, 3))
    yaw, feedforward, active = np.zeros((1, 1)), np.zeros((1, 1, 4)), np.ones(1, dtype=bool)
    inputs = law.inputs(position, velocity, level, level, lane, 2.0 * along, along, yaw, feedforward, active)
    assert inputs[0, 0, 0] / vehicle.mass_kg - 9.81 == pytest.approx(expected[0, 0, 2], abs=1e-12)
    assert abs(expected[0, 0, 2]) > 0.1


# ------------------------------------------------------------------------------------------ path frame


@given(origin=places, heading=angles, climb=climbs, coordinates=points)
def test_path_frame_there_and_back(
    origin: tuple[float, float, float], heading: float, climb: float, coordinates: Array
) -> None:
    frame = PathFrame.from_angles(origin, heading, climb)
    np.testing.assert_allclose(frame.axes @ frame.axes.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(frame.axes) == pytest.approx(1.0)
    world = frame.to_world(coordinates)
    np.testing.assert_allclose(frame.to_path(world), coordinates, atol=1e-8)
    np.testing.assert_allclose(frame.along_track(world), coordinates[:, 0], atol=1e-8)
    lengths = np.linalg.norm(frame.directions_to_world(coordinates), axis=-1)
    np.testing.assert_allclose(lengths, np.linalg.norm(coordinates, axis=-1), atol=1e-9)


def test_a_climbing_path_rises_and_its_lanes_stay_level() -> None:
    frame = PathFrame.from_angles((10.0, 20.0, 30.0), math.radians(90.0), math.radians(30.0))
    np.testing.assert_allclose(frame.to_world(np.array([100.0, 0.0, 0.0])), [10.0, 106.603, 80.0], atol=5e-4)
    np.testing.assert_allclose(frame.to_world(np.array([0.0, 7.0, 0.0])), [3.0, 20.0, 30.0], atol=1e-12)
    assert frame.up[2] == pytest.approx(math.cos(math.radians(30.0)))


@pytest.mark.parametrize(
    ("heading_deg", "along"),
    [(0.0, (1.0, 0.0, 0.0)), (90.0, (0.0, 1.0, 0.0)), (180.0, (-1.0, 0.0, 0.0)), (-90.0, (0.0, -1.0, 0.0))],
)
def test_quarter_turns_are_exact(heading_deg: float, along: tuple[float, ...]) -> None:
    mission = FormationMission(length_m=10.0, heading_deg=heading_deg)
    np.testing.assert_array_equal(PathFrame.of_mission(mission).along, along)


@given(turn=angles, shift=places, heading=angles, climb=climbs, coordinates=points)
def test_turning_and_shifting_the_world_changes_no_path_coordinate(
    turn: float, shift: tuple[float, float, float], heading: float, climb: float, coordinates: Array
) -> None:
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([(c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)])
    here = PathFrame.from_angles((1.0, 2.0, 3.0), heading, climb)
    there_origin = rotation @ here.origin + np.array(shift)
    there = PathFrame.from_angles(tuple(there_origin.tolist()), heading + turn, climb)
    moved = here.to_world(coordinates) @ rotation.T + np.array(shift)
    np.testing.assert_allclose(there.to_path(moved), coordinates, atol=1e-8)


@pytest.mark.parametrize("position", range(3))
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_frame_of_numbers_that_are_not_finite_is_refused(position: int, bad: float) -> None:
    given_ = [0.0, 0.0, 0.0]
    given_[position] = bad
    with pytest.raises(ValueError, match="must be finite"):
        PathFrame.from_angles((given_[0], 0.0, 0.0), given_[1], given_[2])
