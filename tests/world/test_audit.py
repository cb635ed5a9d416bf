"""The FCL auditor: right where the answer is known, and never fed what crashes or hangs it."""

import math

import numpy as np
import pytest

from napf_mpc.world.audit import audit_clearance
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Sphere

ELL = np.array([(0.0, 0.0), (20.0, 0.0), (20.0, 8.0), (9.0, 8.0), (9.0, 15.0), (0.0, 15.0)])


def test_known_distances():
    shapes = [
        Sphere((0.0, 0.0, 0.0), 2.0),
        Cylinder((100.0, 0.0), 3.0),
        Box((0.0, 100.0, 0.0), (2.0, 4.0, 6.0)),
    ]
    points = [(5.0, 0.0, 0.0), (90.0, 0.0, 1e4), (0.0, 100.0, 10.0), (0.0, 0.0, -9.0)]
    np.testing.assert_allclose(audit_clearance(shapes, points, 0.5), (2.5, 6.5, 6.5, 6.5), atol=1e-9)


def test_a_city_of_all_kinds_agrees_with_our_distances():
    """One manager with 90 solids, 400 points."""
    rng = np.random.default_rng(1)
    shapes = []
    for corner in rng.uniform(0.0, 200.0, (30, 2)):
        x, y = corner
        shapes += [
            Sphere((x, y, 60.0), rng.uniform(1.0, 9.0)),
            Cylinder((y, x), rng.uniform(1.0, 5.0)),
            Prism((ELL + corner, ELL * 0.3 + corner + 2.0), 0.0, rng.uniform(10.0, 80.0)),
        ]
    points = rng.uniform((0.0, 0.0, -20.0), (200.0, 200.0, 120.0), (400, 3))
    ours = np.maximum(ObstacleSet.from_shapes(shapes).signed_distance(points[None])[0] - 0.3, 0.0)
    assert (ours == 0.0).sum() > 20
    np.testing.assert_allclose(audit_clearance(shapes, points, 0.3), ours, atol=1e-9)


def test_coinciding_centres_are_contact_and_return():
    """Signed distances of these pairs never come back; the unsigned ones do."""
    at = (1.0, 2.0, 3.0)
    posts = [Cylinder(at[:2], 0.5), Cylinder(at[:2], 0.5, 0.0, 6.0)]
    for shape in [Sphere(at, 0.5), Sphere(at, 2.0), *posts]:
        assert audit_clearance([shape], [at], 0.5).tolist() == [0.0]


def test_deep_inside_a_mesh_is_contact_and_a_courtyard_is_free():
    """A mesh is only a surface: without the even-odd test the first two would count as free."""
    outer = np.array([(0.0, 0.0), (60.0, 0.0), (60.0, 60.0), (0.0, 60.0)])
    house = Prism((outer, ELL + np.array([30.0, 20.0])), 0.0, 50.0)
    found = audit_clearance([house], [(15.0, 30.0, 25.0), (30.0, 10.0, 25.0), (34.0, 30.0, 25.0)], 0.5)
    assert found[:2].tolist() == [0.0, 0.0]
    assert found[2] == pytest.approx(3.5)
    assert audit_clearance([Prism((outer,))], [(15.0, 30.0, 1e5)], 0.5).tolist() == [0.0]


def test_half_endless_solids_far_above_and_below_their_end():
    """Cut at the points, or past the finite end if all points are beyond it."""
    tower, well = Cylinder((0.0, 0.0), 1.0, 100.0), Prism((ELL,), top_m=-50.0)
    np.testing.assert_allclose(
        audit_clearance([tower], [(0.0, 0.0, 0.0), (5.0, 0.0, 900.0)], 0.5), (99.5, 3.5)
    )
    np.testing.assert_allclose(audit_clearance([well], [(5.0, 5.0, 0.0)], 0.5), [49.5])


def test_input_that_would_crash_it_is_refused():
    one = [Sphere((0.0, 0.0, 0.0), 1.0)]
    assert audit_clearance([], [(0.0, 0.0, 0.0)], 0.5).tolist() == [np.inf]
    assert audit_clearance(one, np.zeros((0, 3)), 0.5).shape == (0,)
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match="points"):
            audit_clearance(one, [(0.0, 0.0, bad)], 0.5)
    for radius in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="radius_m"):
            audit_clearance(one, [(0.0, 0.0, 0.0)], radius)
    with pytest.raises(ValueError, match="points has shape"):
        audit_clearance(one, [0.0, 0.0, 0.0], 0.5)
