"""Maps of satellite geometry: the open sky is best, walls take satellites, inside a house is nothing."""

import numpy as np
import pytest

from napf_mpc.navigation.gnss import GnssScene, gnss_scene
from napf_mpc.navigation.gnss_map import gnss_map
from napf_mpc.navigation.pseudorange_solution import design_matrix
from napf_mpc.problem import EmptyWorld, Gnss
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box

HOUSE = ObstacleSet.from_shapes([Box((0.0, 0.0, 30.0), (20.0, 20.0, 60.0))])
EAST, NORTH = np.array([-15.0, 0.0, 400.0]), np.array([0.0, 15.0])


def scene(obstacles: ObstacleSet) -> GnssScene:
    return gnss_scene(Gnss(kind="gnss"), EmptyWorld(kind="empty"), obstacles, 5, range(3), 10.0)


def test_a_house_takes_satellites_and_holds_no_value_inside() -> None:
    made = gnss_map(scene(HOUSE), 1, EAST, NORTH, 5.0)
    free = gnss_map(scene(ObstacleSet.empty()), 1, EAST, NORTH, 5.0)
    assert made.in_sight.shape == (2, 3)
    assert np.isnan([made.in_sight[0, 1], made.hdop[0, 1], made.covariance[0, 1, 0, 0]]).all()
    assert made.in_sight[0, 0] < free.in_sight[0, 0] - 2
    assert made.hdop[0, 0] > free.hdop[0, 0]
    assert made.covariance[0, 0, 0, 0] > free.covariance[0, 0, 0, 0]
    assert made.in_sight[0, 2] >= free.in_sight[0, 2] - 1  # 390 m away it is 8 degrees high
    assert np.isinf(gnss_map(scene(HOUSE), 1, np.array([-10.5]), np.array([0.0]), 5.0).hdop).sum() <= 1


def test_under_an_open_sky_it_is_the_dilution_of_all_satellites() -> None:
    drawn = scene(ObstacleSet.empty())
    made = gnss_map(drawn, 2, EAST, NORTH, 5.0)
    unit = drawn.directions(0.0)[2]
    above = unit[:, 2] >= np.sin(np.radians(10.0))
    h = design_matrix(unit, drawn.clock, above)
    shape = np.linalg.inv(h.T @ h)
    np.testing.assert_allclose(made.in_sight, above.sum())
    np.testing.assert_allclose(made.hdop, np.sqrt(shape[0, 0] + shape[1, 1]))
    np.testing.assert_allclose(made.vdop, np.sqrt(shape[2, 2]))
    # About 3 m a range, so sigma is near DOP times that.
    assert np.sqrt(made.covariance[0, 0, 2, 2]) == pytest.approx(2.5 * made.vdop[0, 0], rel=0.5)
    other = gnss_map(drawn, 0, EAST, NORTH, 5.0)
    assert other.hdop[0, 0] != made.hdop[0, 0]


def test_it_holds_the_protection_levels_that_a_place_allows() -> None:
    made = gnss_map(scene(HOUSE), 1, EAST, NORTH, 5.0).protection_m
    free = gnss_map(scene(ObstacleSet.empty()), 1, EAST, NORTH, 5.0).protection_m
    assert np.isnan(made[0, 1]).all()  # in the house
    assert (made[0, 0] > free[0, 0]).all()  # beside it, perhaps none at all
    assert ((free > 5.0) & (free < 40.0)).all()  # metres, at P_HMI = 1e-3
