"""Rows against moving obstacles: where they are expected, wider with time, metres of slack."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.constraints.clearance import ObstacleContact
from napf_mpc.constraints.constraint import ConstraintError, Horizon, LinearRows
from napf_mpc.constraints.contract import check_constraint, sample_horizon, sample_problem, sample_tracks
from napf_mpc.constraints.moving import MovingObstacleContact
from napf_mpc.navigation.tracks import Tracks
from napf_mpc.safety_distance import Inflation
from napf_mpc.streams import Stream, generator
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Cylinder, Shape, Sphere

Array = NDArray[np.float64]
RADIUS = sample_problem().vehicle.radius_m


def tracks_of(*places: tuple[float, float, float], runs: int = 1, **changes: Any) -> Tracks:
    """Balls of 1 m at rest and certain, the same in each run."""
    n = len(places)
    given: dict[str, Any] = {
        "position": np.repeat(np.array([places]), runs, axis=0),
        "velocity": np.zeros((runs, n, 3)),
        "covariance": np.zeros((runs, n, 6, 6)),
        "radius": np.ones(n),
        "upright": np.zeros(n, dtype=bool),
        "acceleration_sigma_mps2": 0.0,
    }
    return Tracks(**given | changes)


def hover_at(place: tuple[float, float, float], tracks: Tracks | None, sigma_m: float = 0.0) -> Horizon:
    """All UAVs in one place for six stages of half a second."""
    horizon = sample_horizon(generator(1, 0, Stream.SCENE), ObstacleSet.empty(), runs=1)
    return replace(
        horizon,
        step_s=np.full(6, 0.5),
        position=np.broadcast_to(np.array(place), horizon.position.shape).copy(),
        covariance=np.broadcast_to(sigma_m**2 * np.eye(3), horizon.covariance.shape).copy(),
        tracks=tracks,
    )


def shortfall(rows: LinearRows, position: Array) -> Array:
    """How far the position is inside each row; 0 where it is kept or off, (N, m) of the first UAV."""
    return rows.violation(position)[0, 0]


@pytest.mark.parametrize("opening_mps", [None, 0.7])
@pytest.mark.parametrize("upright", [False, True])
def test_at_rest_and_certain_the_rows_are_those_of_obstacles_that_stand(
    upright: bool, opening_mps: float | None
) -> None:
    """400 random plans in front of, in and behind three obstacles: coefficients and bounds to 1e-9."""
    rng = generator(3, 0, Stream.SCENE)
    places = ((4.0, 1.0, 0.5), (-3.0, 5.0, 0.0), (0.0, -4.0, 1.0))
    shapes: list[Shape] = [Cylinder(p[:2], 1.0) if upright else Sphere(p, 1.0) for p in places]
    horizon = sample_horizon(rng, ObstacleSet.from_shapes(shapes), runs=17, spread_m=4.0)
    horizon = replace(horizon, tracks=tracks_of(*places, runs=17, upright=np.full(3, upright)))
    ours = MovingObstacleContact(obstacles=3, opening_mps=opening_mps).rows(horizon)
    theirs = ObstacleContact(obstacles=3, opening_mps=opening_mps).rows(horizon)
    assert (ours.signal, ours.shared_slack) == (theirs.signal, theirs.shared_slack)
    assert ours.lower is not None
    assert theirs.lower is not None
    # Rows that are off stand before or behind the others; by coefficients they are compared without order.
    np.testing.assert_array_equal(np.isfinite(ours.lower).sum(-1), np.isfinite(theirs.lower).sum(-1))
    for mine, other in ((ours.jac, theirs.jac), (ours.lower[..., None], theirs.lower[..., None])):
        on_mine = np.isfinite(ours.lower)
        on_other = np.isfinite(theirs.lower)
        np.testing.assert_allclose(mine[on_mine], other[on_other], rtol=0.0, atol=1e-9)


def test_a_row_stands_where_the_obstacle_is_expected_then() -> None:
    """A ball that comes along x at 2 m/s from 8 m: 0.5 s later 7 m away, after 3 s 2 m; all is certain."""
    tracks = tracks_of((8.0, 0.0, 0.0), velocity=np.array([[[-2.0, 0.0, 0.0]]]))
    rows = MovingObstacleContact(obstacles=1).rows(hover_at((0.0, 0.0, 0.0), tracks))
    assert rows.lower is not None
    np.testing.assert_allclose(rows.jac[0, 0, :, 0], np.tile([-1.0, 0.0, 0.0], (6, 1)), atol=1e-12)
    gap = 8.0 - 2.0 * 0.5 * np.arange(1, 7) - 1.0 - RADIUS
    np.testing.assert_allclose(-rows.lower[0, 0, :, 0], gap, atol=1e-12)


def test_the_slack_is_how_far_a_plan_is_inside_the_margin() -> None:
    rows = MovingObstacleContact(obstacles=2).rows(hover_at((0.5, 0.0, 0.0), tracks_of((0.0, 0.0, 0.0))))
    moved = np.broadcast_to([0.9, 3.0, 0.0], (1, 4, 6, 3))
    np.testing.assert_allclose(shortfall(rows, moved)[:, 0], 1.0 + RADIUS - 0.9, atol=1e-12)
    np.testing.assert_array_equal(shortfall(rows, moved)[:, 1], 0.0)


def test_the_margin_is_k_sigma_of_the_relative_position_and_grows_with_time() -> None:
    """sigma^2 of UAV 0.25, of the track 0.04 + 0.09 t^2, of its acceleration 0.16 t^3 / 3, k = 2."""
    covariance = np.diag([0.04] * 3 + [0.09] * 3)[None, None]
    tracks = tracks_of((8.0, 0.0, 0.0), covariance=covariance, acceleration_sigma_mps2=0.4)
    rows = MovingObstacleContact(Inflation(2.0), reach_m=50.0).rows(hover_at((0.0, 0.0, 0.0), tracks, 0.5))
    assert rows.lower is not None
    t = 0.5 * np.arange(1, 7)
    margin = 2.0 * np.sqrt(0.25 + 0.04 + 0.09 * t**2 + 0.16 * t**3 / 3.0)
    np.testing.assert_allclose(rows.lower[0, 0, :, 0], margin - 7.0 + RADIUS, atol=1e-12)
    assert (np.diff(rows.lower[0, 0, :, 0]) > 0.0).all()


@pytest.mark.parametrize(("extra_sigmas", "kept"), [(None, 0.4), (0.5, 0.25), (0.8, 0.4), (9.0, 0.4)])
def test_the_extra_distance_is_metres_at_most_and_sigmas_of_the_distance(
    extra_sigmas: float | None, kept: float
) -> None:
    """UAV and track together are certain to 0.5 m along x: sigmas of 0.3 and 0.4 m."""
    covariance = np.diag([0.16] * 3 + [0.0] * 3)[None, None]
    horizon = hover_at((0.0, 0.0, 0.0), tracks_of((4.0, 0.0, 0.0), covariance=covariance), 0.3)
    rows = MovingObstacleContact(Inflation(2.0), extra_m=0.4, extra_sigmas=extra_sigmas).rows(horizon)
    assert rows.lower is not None
    np.testing.assert_allclose(rows.lower[0, 0, :, 0], 2.0 * 0.5 + kept + 1.0 + RADIUS - 4.0, atol=1e-12)


def test_only_the_uncertainty_along_the_normal_counts() -> None:
    covariance = np.zeros((1, 1, 6, 6))
    covariance[0, 0, 1, 1] = 9.0
    sure = MovingObstacleContact().rows(hover_at((0.0, 0.0, 0.0), tracks_of((4.0, 0.0, 0.0))))
    across = tracks_of((4.0, 0.0, 0.0), covariance=covariance)
    np.testing.assert_array_equal(
        MovingObstacleContact().rows(hover_at((0.0, 0.0, 0.0), across)).lower, sure.lower
    )
    widest = MovingObstacleContact(Inflation(3.0, reading="largest")).rows(hover_at((0.0, 0.0, 0.0), across))
    assert sure.lower is not None
    assert widest.lower is not None
    assert widest.lower[0, 0, 0, 0] - sure.lower[0, 0, 0, 0] == pytest.approx(9.0)


def test_concentric_there_is_a_way_out_and_no_nan() -> None:
    for upright, away in ((False, [0.0, 0.0, 1.0]), (True, [1.0, 0.0, 0.0])):
        tracks = tracks_of((1.0, 2.0, 3.0), upright=np.array([upright]))
        rows = MovingObstacleContact(obstacles=1).rows(hover_at((1.0, 2.0, 3.0), tracks))
        rows.check((1, 4, 6))
        np.testing.assert_array_equal(rows.jac[0, 0, 0, 0], away)
        here = np.broadcast_to([1.0, 2.0, 3.0], (1, 4, 6, 3))
        np.testing.assert_allclose(shortfall(rows, here), 1.0 + RADIUS, atol=1e-12)


def test_the_nearest_then_are_chosen_in_the_order_of_their_indices() -> None:
    """Ten balls abreast that leave one by one; two rows: the two that are nearest at each stage."""
    places = [(3.0 + i, 0.0, 0.0) for i in range(10)]
    velocity = np.zeros((1, 10, 3))
    velocity[0, 0, 0] = 20.0
    tracks = tracks_of(*places, velocity=velocity, radius=np.full(10, 0.1))
    rows = MovingObstacleContact(obstacles=2).rows(hover_at((0.0, 0.0, 0.0), tracks))
    assert rows.lower is not None
    gaps = np.array([4.0, 5.0]) - 0.1 - RADIUS
    np.testing.assert_allclose(-rows.lower[0, 0], np.broadcast_to(gaps, (6, 2)), atol=1e-12)


def test_out_of_reach_or_without_tracks_every_row_is_off() -> None:
    for tracks in (None, tracks_of((500.0, 0.0, 0.0))):
        rows = MovingObstacleContact().rows(hover_at((0.0, 0.0, 0.0), tracks))
        rows.check((1, 4, 6))
        assert rows.count == 4
        assert np.isneginf(rows.lower).all()
        np.testing.assert_array_equal(rows.jac, 0.0)


@pytest.mark.parametrize(
    "constraint",
    [
        MovingObstacleContact(),
        MovingObstacleContact(obstacles=2, reach_m=3.0, extra_m=0.5),
        MovingObstacleContact(Inflation(2.0, "range", "rms"), obstacles=9),
    ],
    ids=["default", "fewer", "more rows than tracks"],
)
def test_contract(constraint: MovingObstacleContact) -> None:
    check_constraint(constraint)


def test_contract_with_a_crowd() -> None:
    """More tracks than are looked at closely, and a run with none in reach."""
    horizons = []
    for i in range(3):
        rng = generator(7, i, Stream.SCENE)
        horizon = sample_horizon(rng, ObstacleSet.empty())
        horizons.append(replace(horizon, tracks=sample_tracks(rng, 3, count=40)))
    check_constraint(MovingObstacleContact(obstacles=3), horizons)


def test_a_horizon_with_broken_tracks_is_refused() -> None:
    horizon = hover_at((0.0, 0.0, 0.0), tracks_of((np.nan, 0.0, 0.0)))
    with pytest.raises(ConstraintError, match=r"tracks\.position has an entry that is not finite"):
        horizon.check()
    with pytest.raises(ConstraintError, match=r"tracks\.velocity has shape \(2, 1, 3\), must be \(1, 1, 3\)"):
        replace(horizon, tracks=tracks_of((0.0, 0.0, 0.0), runs=2)).check()


@pytest.mark.parametrize(
    "settings", [{"obstacles": 0}, {"reach_m": 0.0}, {"extra_m": -1.0}, {"extra_sigmas": -1.0}]
)
def test_settings_that_mean_nothing_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(ConstraintError, match=next(iter(settings))):
        MovingObstacleContact(**settings)


def test_who_is_inside_a_margin_is_asked_out_at_a_speed() -> None:
    """3 m inside a ball's margin at 1 m/s: 2.5 m after half a second, and all of it after three."""
    horizon = hover_at((4.0, 0.0, 0.0), tracks_of((0.0, 0.0, 0.0)), sigma_m=2.0)
    at_once = MovingObstacleContact(Inflation(3.0), obstacles=1)
    slowly = replace(at_once, opening_mps=1.0)
    # 4 m from the centre: 6 m of margin, 1 m of ball and the UAV's own radius.
    short = 6.0 + 1.0 + RADIUS - 4.0
    np.testing.assert_allclose(shortfall(at_once.rows(horizon), horizon.position)[:, 0], short, atol=1e-9)
    asked = np.minimum(short, 0.5 * np.arange(1, 7))
    np.testing.assert_allclose(shortfall(slowly.rows(horizon), horizon.position)[:, 0], asked, atol=1e-9)
    clear = hover_at((9.0, 0.0, 0.0), tracks_of((0.0, 0.0, 0.0)), sigma_m=2.0)
    np.testing.assert_array_equal(slowly.rows(clear).lower, at_once.rows(clear).lower)
    with pytest.raises(ConstraintError, match=r"opening_mps = 0\.0"):
        replace(at_once, opening_mps=0.0)
