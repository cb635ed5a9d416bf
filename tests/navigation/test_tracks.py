"""Tracks of moving obstacles: consistent with the truth, honest about the future, independent of totals."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.linalg import solve_discrete_are

from napf_mpc.navigation.tracks import MovingTracker, Tracks
from napf_mpc.problem import EmptyWorld
from napf_mpc.world.moving import MovingObstacles, moving_obstacles

Array = NDArray[np.float64]
TICK_S = 0.02

BALL = {"shape": "sphere", "start_m": (20.0, -5.0, 1.0), "velocity_mps": (-1.0, 2.0, 0.0), "radius_m": 1.0}
MAST = {"shape": "cylinder", "start_m": (0.0, 9.0), "velocity_mps": (3.0, 0.0), "radius_m": 2.0}


def tracked(
    *items: dict[str, Any], ticks: int, runs: range = range(1), seed: int = 1, **keys: Any
) -> tuple[Tracks, MovingObstacles]:
    """Tracks after a number of ticks, and the truth."""
    world = EmptyWorld.model_validate({"kind": "empty", "moving": items, **keys})
    moving = moving_obstacles(world, seed, runs, 60.0)
    assert moving is not None
    tracker = MovingTracker(world, moving, seed, runs, TICK_S)
    for tick in range(ticks + 1):
        tracker.tick(tick)
    return tracker.tracks(), moving


def normalised(tracks: Tracks, moving: MovingObstacles, time_s: float) -> Array:
    """Squared error in sigmas of the whole state (run, n); chi-square with 6 degrees if consistent."""
    speed = (moving.position(time_s) - moving.position(time_s - 1e-4)) / 1e-4
    error = np.concatenate([tracks.position - moving.position(time_s), tracks.velocity - speed], axis=-1)
    return np.einsum("rni,rnij,rnj->rn", error, np.linalg.inv(tracks.covariance), error)


@pytest.mark.parametrize("ticks", [0, 3, 250])
def test_the_covariance_is_that_of_the_errors(ticks: int) -> None:
    """1000 runs of an obstacle that moves as assumed: mean NEES within its 99.9 % range about 1.

    The truth holds each acceleration for a second, the model takes it for white: 5 % are allowed for that.
    """
    runs = 1000
    sigma = 0.0 if ticks < 250 else 0.3
    ball = BALL | {"acceleration_sigma_mps2": sigma}
    tracks, moving = tracked(ball, ticks=ticks, runs=range(runs), moving_acceleration_sigma_mps2=sigma)
    nees = normalised(tracks, moving, ticks * TICK_S)[:, 0]
    low, high = stats.chi2.interval(0.999, 6 * runs) if sigma == 0.0 else (0.0, 6 * 1.05 * runs)
    assert low <= nees.sum() <= high
    if sigma > 0.0:
        assert nees.mean() > 3.0


def test_the_covariance_settles_at_the_riccati_solution() -> None:
    tracks, _ = tracked(BALL, ticks=2000, moving_sigma_m=0.5, moving_rate_hz=5.0)
    t, q = 0.2, 0.3**2
    f = np.array([[1.0, t], [0.0, 1.0]])
    noise = q * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])
    before = solve_discrete_are(f.T, np.array([[1.0], [0.0]]), noise, np.array([[0.25]]))
    after = before - before[:, :1] @ before[:1] / (before[0, 0] + 0.25)
    np.testing.assert_allclose(tracks.covariance[0, 0][np.ix_([1, 4], [1, 4])], after, rtol=1e-6)
    np.testing.assert_array_equal(tracks.covariance[0, 0][0, [1, 2, 4, 5]], 0.0)


def test_at_the_start_of_the_mission_the_speed_is_known() -> None:
    """Two seconds of watching at 10 Hz with 0.2 m: better than 0.5 m/s and 0.2 m, not certain."""
    tracks, moving = tracked(BALL, MAST, ticks=0, runs=range(50))
    sigma = np.sqrt(np.diagonal(tracks.covariance[0, 0]))
    assert (sigma[:3] < 0.2).all()
    assert (sigma[3:] < 0.5).all()
    assert (sigma > 0.05).all()
    assert np.abs(tracks.velocity - moving.velocity).max() < 5.0 * sigma[3]
    np.testing.assert_array_equal(tracks.upright, [False, True])


def test_a_slow_observer_has_seen_each_obstacle_twice_before() -> None:
    tracks, _ = tracked(BALL, ticks=0, moving_rate_hz=0.1)
    assert np.sqrt(tracks.covariance[0, 0, 3, 3]) < 2.0


def test_between_observations_tracks_run_on_and_grow_less_certain() -> None:
    at, after = (tracked(BALL, ticks=ticks, moving_rate_hz=1.0)[0] for ticks in (50, 99))
    np.testing.assert_allclose(after.position, at.position + 0.98 * at.velocity, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(after.velocity, at.velocity, rtol=0.0, atol=0.0)
    _, ahead = at.predicted(np.array([0.98]))
    np.testing.assert_allclose(after.position_covariance, ahead[:, :, 0], rtol=1e-12)


def test_the_prediction_is_right_about_its_own_errors() -> None:
    """3 s ahead: the position's error in sigmas, over 2000 runs of an obstacle that moves as assumed."""
    runs, ahead = 2000, 3.0
    ball = BALL | {"acceleration_sigma_mps2": 0.3}
    tracks, moving = tracked(ball, ticks=200, runs=range(runs))
    place, spread = tracks.predicted(np.array([0.0, ahead]))
    error = place[:, 0, 1] - moving.position(200 * TICK_S + ahead)[:, 0]
    variance = np.diagonal(spread[:, 0, 1], axis1=-2, axis2=-1)
    assert abs((error**2 / variance).mean() - 1.0) < 0.08
    assert (np.diagonal(spread[:, 0, 0], axis1=-2, axis2=-1) < variance).all()


def test_runs_obstacles_and_ticks_do_not_change_with_the_totals() -> None:
    wild = BALL | {"acceleration_sigma_mps2": 0.2}
    few, _ = tracked(wild, ticks=40, runs=range(3, 5))
    many, _ = tracked(wild, MAST, ticks=40, runs=range(2, 9))
    for name in ("position", "velocity", "covariance"):
        np.testing.assert_array_equal(getattr(many, name)[1:3, :1], getattr(few, name))


def test_tracks_hold_neither_the_truth_nor_the_trackers_memory() -> None:
    world = EmptyWorld.model_validate({"kind": "empty", "moving": (BALL,)})
    moving = moving_obstacles(world, 1, range(2), 10.0)
    assert moving is not None
    tracker = MovingTracker(world, moving, 1, range(2), TICK_S)
    tracker.tick(0)
    first = tracker.tracks()
    for name in ("position", "velocity", "covariance", "radius"):
        getattr(first, name)[...] = np.nan
    assert tracker.tracks().faults(2) == []
    assert np.isfinite(moving.radius).all()
    assert [fault.split()[0] for fault in first.faults(2)] == [
        "tracks.position", "tracks.velocity", "tracks.covariance", "tracks.radius"
    ]  # fmt: skip
    assert "must be (3, 1, 3)" in tracker.tracks().faults(3)[0]


def test_the_least_distance_to_what_is_expected() -> None:
    """A ball that comes at 2 m/s, met head-on: nearest at the second point."""
    tracks = Tracks(
        position=np.array([[[10.0, 0.0, 0.0]]]),
        velocity=np.array([[[-2.0, 0.0, 0.0]]]),
        covariance=np.eye(6)[None, None],
        radius=np.array([1.0]),
        upright=np.array([False]),
        acceleration_sigma_mps2=0.3,
    )
    points = np.array([[[[0.0, 0.0, 0.0], [4.0, 3.0, 0.0], [-5.0, 0.0, 0.0]]]])
    assert tracks.least_distance(points, np.array([1.0, 3.0, 4.0])) == pytest.approx(np.array([[2.0]]))
