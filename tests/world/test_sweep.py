"""Swept verdicts against dense sampling, and what sampling alone would miss."""

from itertools import pairwise

import numpy as np
import pytest

from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Sphere
from napf_mpc.world.sweep import SweptClearance, swept_separation

ELL = np.array([(0.0, 0.0), (20.0, 0.0), (20.0, 8.0), (9.0, 8.0), (9.0, 15.0), (0.0, 15.0)])
COURT = (np.array([(0.0, 0.0), (30.0, 0.0), (30.0, 20.0), (0.0, 20.0)]), ELL * 0.5 + np.array([5.0, 6.0]))
SHAPES = {
    "sphere": Sphere((10.0, 8.0, 6.0), 5.0),
    "cylinder": Cylinder((10.0, 8.0), 5.0, 0.0, 12.0),
    "endless cylinder": Cylinder((10.0, 8.0), 5.0),
    "tower without end": Cylinder((10.0, 8.0), 5.0, 5.0),
    "box": Box((10.0, 8.0, 6.0), (14.0, 6.0, 12.0), 0.4),
    "thin plate": Box((10.0, 8.0, 6.0), (14.0, 14.0, 0.01), 0.4),
    "ell": Prism((ELL,), 0.0, 12.0),
    "thin ell": Prism((ELL,), 5.0, 5.01),
    "endless ell": Prism((ELL,)),
    "courtyard": Prism(COURT, 0.0, 12.0),
}


def swept(obstacles, p0, p1):
    """Clearance of single segments, one a run."""
    sweep = SweptClearance(obstacles, len(p0), 1)
    sweep.update(p0[:, None], p1[:, None])
    return sweep.clearance[:, 0]


@pytest.mark.parametrize("name", SHAPES)
def test_swept_clearance_agrees_with_ten_thousand_samples_a_segment(name):
    """Never above the sampled minimum, and below it by no more than half a sample's step."""
    rng = np.random.default_rng(list(SHAPES).index(name))
    obstacles = ObstacleSet.from_shapes([SHAPES[name]])
    n = 120
    p0 = rng.uniform((-15.0, -15.0, -8.0), (35.0, 30.0, 20.0), (n, 3))
    move = rng.normal(size=(n, 3)) * np.exp(rng.uniform(np.log(0.01), np.log(20.0), (n, 1)))
    # Flights dead level or along the walls are the flat cases where a search could stall.
    move[:30, 2] = 0.0
    move[20:40, 1] = 0.0
    move[40:50] = (0.0, 0.0, -30.0)
    # Half of the segments lead through the solid's surroundings, from half-way before to half-way beyond.
    p0[30:90] = rng.normal((9.0, 6.0, 6.0), 3.0, (60, 3)) - rng.uniform(size=(60, 1)) * move[30:90]
    p1 = p0 + move
    t = np.linspace(0.0, 1.0, 10_001)[None, :, None]
    along = (1.0 - t) * p0[:, None] + t * p1[:, None]
    sampled = obstacles.signed_distance(along.reshape(1, -1, 3)).reshape(n, -1).min(axis=1)
    found = swept(obstacles, p0, p1)
    step = np.linalg.norm(p1 - p0, axis=1) / 10_000
    assert (found <= sampled + 1e-6).all()
    assert (found >= sampled - 0.5 * step - 1e-9).all()
    assert (found < 0.0).sum() >= 10
    assert (found > 1.0).sum() >= 4


def test_thin_pole_between_samples_is_found():
    """A pole of 1 mm, samples 20 m apart, both 10 m clear of it."""
    pole = ObstacleSet.from_shapes([Cylinder((10.0, 0.0), 0.0005, 0.0, 50.0)])
    sweep = SweptClearance(pole, 1, 1)
    sweep.update([[(0.0, 0.0, 10.0)]], [[(20.0, 0.0, 10.0)]])
    assert pole.signed_distance([[(0.0, 0.0, 10.0), (20.0, 0.0, 10.0)]]).min() > 9.9
    assert sweep.clearance[0, 0] == pytest.approx(-0.0005, abs=1e-6)
    assert sweep.contact().all()
    assert sweep.index[0, 0] == 0


@pytest.mark.parametrize("thickness", [1e-3, 1e-6])
def test_a_slab_pierced_from_roof_to_floor_is_found(thickness):
    """Nothing of the path is within a metre of any wall."""
    slab = ObstacleSet.from_shapes([Prism((ELL,), 5.0, 5.0 + thickness)])
    found = swept(slab, np.array([(5.0, 5.0, 20.0)]), np.array([(5.2, 5.1, -20.0)]))
    assert found[0] == pytest.approx(-0.5 * thickness, abs=1e-6)
    assert found[0] < 0.0 or thickness < 2e-6


def test_a_path_in_steps_is_the_path():
    """The clearance of 400 steps is the smallest of its segments', whatever was skipped on the way."""
    rng = np.random.default_rng(8)
    shapes = []
    for x, y in rng.uniform(0.0, 300.0, (60, 2)):
        shapes += [
            Sphere((x, y, rng.uniform(0.0, 30.0)), rng.uniform(0.5, 4.0)),
            Box((y, x, 5.0), (3.0, 8.0, 20.0), rng.uniform(0.0, 3.0)),
            Prism((ELL * 0.3 + rng.uniform(0.0, 300.0, 2),), 0.0, rng.uniform(5.0, 40.0)),
        ]
    obstacles = ObstacleSet.from_shapes(shapes)
    speed = rng.uniform(0.05, 3.0, (6, 4, 1))
    heading = rng.uniform(0.0, 6.3, (6, 4)) + np.cumsum(rng.normal(0.0, 0.1, (400, 6, 4)), axis=0)
    steps = speed * np.stack(
        [np.cos(heading), np.sin(heading), 0.1 * rng.normal(size=heading.shape)], axis=-1
    )
    path = rng.uniform(100.0, 200.0, (6, 4, 3)) * (1.0, 1.0, 0.1) + np.cumsum(steps, axis=0)
    sweep = SweptClearance(obstacles, 6, 4)
    expected = np.full((6, 4), np.inf)
    for a, b in pairwise(path):
        sweep.update(a, b)
        fresh = swept(obstacles, a.reshape(-1, 3), b.reshape(-1, 3)).reshape(6, 4)
        expected = np.minimum(expected, fresh)
        np.testing.assert_allclose(sweep.clearance, expected, atol=2e-7)
    assert (sweep.clearance < 0.0).any()
    # The obstacle named is the one that was met.
    for run in range(6):
        for uav in range(4):
            alone = ObstacleSet.from_shapes([shapes[sweep.index[run, uav]]])
            line = swept(alone, path[:-1, run, uav], path[1:, run, uav])
            assert line.min() == pytest.approx(sweep.clearance[run, uav], abs=2e-7)


def test_a_jump_between_steps_is_seen_but_not_swept():
    """The travel budget must not trust that a step begins where the last one ended."""
    obstacles = ObstacleSet.from_shapes([Sphere((1000.0, 0.0, 0.0), 5.0), Sphere((500.0, 0.0, 0.0), 5.0)])
    sweep = SweptClearance(obstacles, 1, 1)
    sweep.update([[(0.0, 0.0, 0.0)]], [[(0.1, 0.0, 0.0)]])
    sweep.update([[(1003.0, 0.0, 0.0)]], [[(1003.0, 0.1, 0.0)]])
    assert sweep.clearance[0, 0] == pytest.approx(-2.0, abs=1e-6)
    assert sweep.index[0, 0] == 0


def test_verdict_does_not_depend_on_the_batch():
    """Fifty runs together, and each alone: the same bits, every step."""
    rng = np.random.default_rng(9)
    centres, radii = rng.uniform(0.0, 60.0, (50, 8, 3)), rng.uniform(1.0, 4.0, (50, 8))
    obstacles = ObstacleSet.from_spheres(centres, radii)
    path = np.cumsum(rng.normal(0.0, 0.5, (60, 50, 4, 3)), axis=0) + 30.0
    together = SweptClearance(obstacles, 50, 4)
    alone = [SweptClearance(obstacles.scene(run), 1, 4) for run in range(50)]
    for a, b in pairwise(path):
        together.update(a, b)
        for run, one in enumerate(alone):
            one.update(a[run : run + 1], b[run : run + 1])
    for run, one in enumerate(alone):
        assert one.clearance[0].tobytes() == together.clearance[run].tobytes()
        assert one.index[0].tobytes() == together.index[run].tobytes()


def test_masked_runs_keep_their_verdict_and_may_be_nan():
    obstacles = ObstacleSet.from_shapes([Sphere((10.0, 0.0, 0.0), 2.0)])
    sweep = SweptClearance(obstacles, 2, 1)
    p0 = np.zeros((2, 1, 3))
    p1 = p0 + np.array([5.0, 0.0, 0.0])
    sweep.update(p0, p1)
    p0[0], p1[0] = np.nan, np.nan
    with pytest.raises(ValueError, match="p0 is not finite in run 0"):
        sweep.update(p0, p1)
    sweep.update(p1 * (np.array([0.0, 1.0])[:, None, None]), p1 * 2.0, active=np.array([False, True]))
    np.testing.assert_allclose(sweep.clearance, [[3.0], [-2.0]], atol=1e-6)
    p1[1, 0, 2] = np.inf
    with pytest.raises(ValueError, match="p1 is not finite in run 1"):
        sweep.update(np.zeros((2, 1, 3)), p1, active=np.array([False, True]))
    with pytest.raises(ValueError, match="must be bool"):
        sweep.update(p0, p1, active=np.array([0, 1]))
    with pytest.raises(ValueError, match="p0 has shape"):
        sweep.update(p0[:1], p1)


def test_contact_counts_an_exact_touch_and_nothing_before_flight():
    obstacles = ObstacleSet.from_shapes([Sphere((10.0, 0.0, 0.0), 2.0)])
    sweep = SweptClearance(obstacles, 1, 2)
    assert not sweep.contact().any()
    sweep.update([[(0.0, 2.0, 0.0), (0.0, 2.5, 0.0)]], [[(20.0, 2.0, 0.0), (20.0, 2.5, 0.0)]])
    assert sweep.contact().tolist() == [[True, False]]
    assert sweep.contact(0.5).tolist() == [[True, True]]
    assert sweep.contact([[0.0, 0.49]]).tolist() == [[True, False]]
    for bad in (-0.1, np.nan, np.inf):
        with pytest.raises(ValueError, match="radius_m"):
            sweep.contact(bad)
    with pytest.raises(ValueError, match="2 runs do not fit 3 scenes"):
        SweptClearance(ObstacleSet.empty(3), 2, 1)


def test_an_empty_world_is_never_touched():
    sweep = SweptClearance(ObstacleSet.empty(), 3, 2)
    sweep.update(np.zeros((3, 2, 3)), np.ones((3, 2, 3)))
    assert (sweep.clearance == np.inf).all()
    assert (sweep.index == -1).all()
    assert not sweep.contact(5.0).any()


def test_uavs_that_tunnel_through_each_other_are_found():
    """Closing at 20 m/s and sampled every 0.1 s, two UAVs are never seen within 0.4 m, but pass at 0.1 m."""
    p0 = np.array([[(0.0, 0.0, 10.0), (2.4, 0.1, 10.0), (50.0, 0.0, 10.0)]])
    p1 = p0 + np.array([[(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 0.0)]]) * 1.0
    sampled = []
    closest = np.full((1, 3), np.inf)
    for _ in range(3):
        sampled.append(np.linalg.norm(p0[0, 0] - p0[0, 1]))
        closest = np.minimum(closest, swept_separation(p0, p1))
        p0, p1 = p1, 2.0 * p1 - p0
    assert min(sampled) > 0.4
    assert closest[0, 0] == pytest.approx(0.1)
    assert closest[0, 1] == pytest.approx(0.1)
    assert closest[0, 2] > 40.0


def test_separation_agrees_with_dense_sampling():
    rng = np.random.default_rng(10)
    p0, p1 = rng.uniform(-5.0, 5.0, (2, 20, 6, 3))
    t = np.linspace(0.0, 1.0, 2001)[:, None, None, None]
    path = (1.0 - t) * p0 + t * p1
    gap = np.linalg.norm(path[:, :, :, None] - path[:, :, None, :], axis=-1)
    gap[:, :, np.arange(6), np.arange(6)] = np.inf
    sampled = gap.min(axis=(0, 3))
    found = swept_separation(p0, p1)
    assert (found <= sampled + 1e-12).all()
    np.testing.assert_allclose(found, sampled, atol=0.01)
    each = [swept_separation(p0[r : r + 1], p1[r : r + 1]) for r in range(20)]
    assert np.concatenate(each).tobytes() == found.tobytes()


def test_separation_of_one_uav_of_still_uavs_and_of_masked_runs():
    assert swept_separation(np.zeros((2, 1, 3)), np.ones((2, 1, 3))).tolist() == [[np.inf], [np.inf]]
    still = np.array([[(0.0, 0.0, 0.0), (3.0, 4.0, 0.0)]])
    assert swept_separation(still, still).tolist() == [[5.0, 5.0]]
    both = np.concatenate([still * np.nan, still])
    with pytest.raises(ValueError, match="p0 is not finite in run 0"):
        swept_separation(both, both)
    masked = swept_separation(both, both, active=np.array([False, True]))
    assert masked.tolist() == [[np.inf, np.inf], [5.0, 5.0]]
