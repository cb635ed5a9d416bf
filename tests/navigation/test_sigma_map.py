"""Sigma(p): what the map says beforehand is what the receiver reports there, and never less near an edge."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.closed_loop import Scenario, build_scenario
from napf_mpc.errors import ProblemError
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.navigation.filtered import FilteredNavigation
from napf_mpc.navigation.gnss_fixes import GnssErrors
from napf_mpc.navigation.gnss_sigma import expected_variance, sigma_map
from napf_mpc.navigation.sigma_map import SigmaMap, largest_around
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.problem import FormationMission, Gnss, Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box

Array = NDArray[np.float64]


def street(**navigation: object) -> Problem:
    keys = {f"navigation.{key}": value for key, value in navigation.items()}
    return load_problem("street_canyon_gnss", {"planner.covariance": "mapped", **keys})


def drawn(problem: Problem, runs: range, seed: int = 3) -> tuple[Scenario, GnssErrors, SigmaMap]:
    scenario = build_scenario(problem, seed, runs)
    assert isinstance(scenario.errors, GnssErrors)
    assert scenario.sigma_map is not None
    return scenario, scenario.errors, scenario.sigma_map


def lanes(problem: Problem, along_m: float, runs: int) -> Array:
    """Places (run, uav, 3) of all slots after a way."""
    assert isinstance(problem.mission, FormationMission)
    slots = formation_offsets(problem.formation) + np.array([along_m, 0.0, 0.0])
    return np.repeat(PathFrame.of_mission(problem.mission).to_world(slots)[None], runs, axis=0)


def test_what_is_expected_is_what_the_emulated_receiver_reports_there() -> None:
    """Along the lanes: the sigma of an axis within a tenth in the middle, a quarter nine times in ten."""
    problem = street(rate_hz=1.0)
    scenario, errors, made = drawn(problem, range(6))
    fixes = errors.begin()
    ratio, mapped = [], []
    for epoch in range(70):
        places = lanes(problem, 2.0 * epoch, 6)
        fix = fixes.fix(epoch, places)
        assert fix.available.all()
        lasting = (fix.common_factor**2).sum(-1)
        reported = np.concatenate([np.einsum("...aa->...a", fix.covariance) - lasting, lasting], axis=-1)
        for run in range(6):
            one = errors.scene.of_run(run, scenario.obstacles.scene(run))
            expected = expected_variance(one, places[run], float(epoch))
            # A lane may lead through a house or a mast, where nobody flies.
            free = np.isfinite(expected[:, 0])
            ratio.extend(np.sqrt(reported[run] / expected)[free].ravel())
        mapped.append(np.sqrt(np.concatenate(made.variance(places), axis=-1) / reported))
    assert np.median(ratio) == pytest.approx(1.0, abs=0.03)
    assert np.median(np.abs(np.array(ratio) - 1.0)) < 0.1
    assert (np.abs(np.array(ratio) - 1.0) < 0.25).mean() > 0.9
    # The map itself leans to the safe side: in the middle a tenth more, and seldom a fifth less.
    assert 1.0 < np.median(mapped) < 1.2
    assert (np.array(mapped) < 0.8).mean() < 0.05


def test_the_map_holds_nothing_that_was_drawn() -> None:
    """Other errors, fading and reflections under the same sky give the same map to the last bit."""
    problem = street()
    _, errors, made = drawn(problem, range(2))
    scene = errors.scene
    waves = type(scene.fields)(*(part + 1.0 for part in scene.fields))
    other = replace(scene, common=scene.common + 3.0, fields=waves)
    np.testing.assert_array_equal(sigma_map(problem, other).nodes, made.nodes)
    assert not any(isinstance(value, type(scene)) for value in vars(made).values())


def test_a_run_has_its_map_whatever_else_is_in_the_block() -> None:
    problem = street()
    both, alone = drawn(problem, range(3))[2], drawn(problem, range(2, 3))[2]
    np.testing.assert_array_equal(both.nodes[2:], alone.nodes)
    places = lanes(problem, 41.3, 3)
    np.testing.assert_array_equal(both.variance(places)[0][2:], alone.variance(places[2:])[0])


def test_a_place_is_that_of_the_moment_at_which_the_formation_is_due() -> None:
    """140 m at 0.05 m/s take 47 min: satellites have gone on by a tenth of a turn, and sigma with them."""
    slow = load_problem(
        "street_canyon_gnss",
        {
            "planner.covariance": "mapped", "mission.speed_mps": 0.05, "simulation.time_limit_s": 3000.0,
            "world": {"kind": "empty"},
        },
    )  # fmt: skip
    assert isinstance(slow.mission, FormationMission)
    _, errors, made = drawn(slow, range(1))
    along = made.low_m[0] + made.cell_m[0] * np.arange(made.nodes.shape[1])
    n = int(np.argmin(np.abs(along - 140.0)))
    at = made.low_m + made.cell_m * np.array([n, 5, 1])
    place = made.frame.to_world(at[None])
    now, due = (
        expected_variance(errors.scene.of_run(0, ObstacleSet.empty()), place, time_s)[0]
        for time_s in (0.0, along[n] / 0.05)
    )
    np.testing.assert_allclose(
        made.nodes[0, n, 5, 1], due, rtol=0.01
    )  # neighbours are due 50 s sooner and later
    assert np.abs(np.sqrt(now / due) - 1.0).max() > 0.03


def made_by_hand(nodes: Array) -> SigmaMap:
    """A map of one run on a grid of 10 m from the origin, the path to the east."""
    frame = PathFrame.from_angles((0.0, 0.0, 0.0), 0.0, 0.0)
    return SigmaMap(frame, np.zeros(3), np.full(3, 10.0), largest_around(nodes))


def test_between_nodes_it_is_never_less_than_at_any_corner_of_the_cell() -> None:
    rng = np.random.default_rng(5)
    nodes = rng.uniform(1.0, 9.0, (1, 6, 5, 1, 6)).repeat(2, axis=3)
    made = made_by_hand(nodes)
    places = rng.uniform([0.0, 0.0, 0.0], [50.0, 40.0, 10.0], (1, 500, 3))
    own, lasting = made.variance(places)
    x, y = (places[0, :, :2] / 10.0).astype(int).T
    for dx in (0, 1):
        for dy in (0, 1):
            assert (own[0] >= nodes[0, x + dx, y + dy, 0, :3] - 1e-12).all()
            assert (lasting[0] >= nodes[0, x + dx, y + dy, 0, 3:] - 1e-12).all()
    # Continuous: a millimetre changes a variance of some square metres by little.
    assert np.abs(made.variance(places + 1e-3)[0] - own).max() < 0.01
    # Outside it is as at the edge; a place that is none has no fix.
    edge, beyond = made.variance(np.array([[[50.0, 40.0, 10.0], [90.0, 70.0, 99.0]]]))[0][0]
    np.testing.assert_array_equal(edge, beyond)
    assert np.isinf(made.variance(np.full((1, 1, 3), np.nan))[0]).all()


def test_without_a_fix_nearby_there_is_none_and_the_inside_of_a_house_has_no_say() -> None:
    nodes = np.full((1, 8, 3, 2, 6), 4.0)
    nodes[0, 1, 1] = np.nan
    nodes[0, 6, 1] = np.inf
    made = made_by_hand(nodes)
    near, free, dark = made.variance(np.array([[[11.0, 11.0, 0.0], [35.0, 9.0, 5.0], [62.0, 12.0, 5.0]]]))[0][
        0
    ]
    np.testing.assert_allclose(near, 4.0)
    np.testing.assert_allclose(free, 4.0)
    assert np.isinf(dark).all()
    assert np.isinf(largest_around(np.full((1, 3, 3, 1, 6), np.nan))).all()


def test_who_reports_more_than_the_map_has_goes_on_by_that_factor_and_less_is_no_promise() -> None:
    made = made_by_hand(np.linspace(4.0, 9.0, 6)[None, :, None, None, None] * np.ones((1, 6, 3, 2, 6)))
    here, places = np.zeros((1, 2, 3)), np.tile([40.0, 0.0, 0.0], (1, 2, 1, 1))
    reported = np.array([[[10.0] * 3, [1.0] * 3]])
    own, lasting = made.ahead([reported, reported], np.ones((1, 2), dtype=bool), here, places)
    np.testing.assert_allclose(own[0, :, 0, 0], [10.0 / 5.0 * 9.0, 9.0])
    np.testing.assert_allclose(lasting, own)
    (whole,) = made.ahead([2.0 * reported], np.ones((1, 2), dtype=bool), here, places)
    np.testing.assert_allclose(whole, 2.0 * own)


def test_an_outage_that_the_map_knows_of_ends_where_it_says_and_another_does_not() -> None:
    nodes = np.full((1, 6, 3, 2, 6), 4.0)
    nodes[0, 0] = np.inf
    made = made_by_hand(nodes)
    here = np.array([[[0.0, 0.0, 0.0], [30.0, 0.0, 0.0]]])
    places = np.tile([40.0, 0.0, 0.0], (1, 2, 1, 1))
    none, reported = np.zeros((1, 2), dtype=bool), np.full((1, 2, 3), 4.0)
    own, _ = made.ahead([reported, reported], none, here, places)
    np.testing.assert_allclose(own[0, 0], 4.0)
    assert np.isinf(own[0, 1]).all()


def canyon(dark: bool = False) -> tuple[NavSolution, SigmaMap]:
    """A filter's solution, fixes of 2 m of their own and 2 m that lasts; a map: 6 m or none from 40 m on."""
    problem = street()
    scenario, _, _ = drawn(problem, range(1))
    still = np.zeros((1, 4, 3))
    navigation = FilteredNavigation(problem.navigation, scenario.errors, 3, range(1), 0.02, 5, still)
    places = lanes(problem, 0.0, 1)
    for tick in range(500):
        nav = navigation.solution(tick, 0.02 * tick, places, still, still, still, np.ones(1, dtype=bool))
    assert nav.forecast is not None
    assert nav.lasting is not None
    nodes = np.empty((1, 10, 3, 2, 6))
    nodes[:, :5] = 2.0**2
    nodes[:, 5:] = np.inf if dark else 6.0**2
    made = made_by_hand(nodes)
    sigma = np.full_like(nav.forecast.sigma, 2.0)
    covariance = nav.covariance - 0.0
    covariance[..., :3, :3] += np.eye(3) * 4.0 - nav.lasting
    nav = replace(
        nav,
        sigma_map=made,
        position=np.zeros_like(nav.position),
        forecast=replace(nav.forecast, sigma=sigma),
        lasting=np.broadcast_to(np.eye(3) * 4.0, nav.lasting.shape).copy(),
        covariance=covariance,
    )
    return nav, made


AHEAD_S = np.arange(0.5, 6.6, 0.5)


def along(start_m: float, stop_m: float) -> Array:
    places = np.zeros((1, 4, len(AHEAD_S), 3))
    places[..., 0] = np.linspace(start_m, stop_m, len(AHEAD_S))
    return places


def sigmas(nav: NavSolution, places: Array | None) -> Array:
    """Sigma to the east (N,) of the first UAV at times ahead [m]."""
    covariance = nav.position_covariance_ahead(AHEAD_S, True, places)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    return np.asarray(np.sqrt(covariance[0, 0, :, 0, 0]))


def test_a_planned_walk_into_a_canyon_grows_the_covariance_and_one_out_of_it_shrinks_it() -> None:
    nav, _ = canyon()
    stay, walk_in = sigmas(nav, along(10.0, 10.0)), sigmas(nav, along(10.0, 80.0))
    np.testing.assert_allclose(stay, sigmas(nav, None), rtol=1e-6)  # the map says what is reported
    assert walk_in[0] == pytest.approx(stay[0], rel=1e-9)
    # What lasts triples at once; the filter's own part holds on to what it knew.
    assert walk_in[-1] > 6.0 > 3.0 > stay[-1]
    inside = replace(nav, position=nav.position + np.array([80.0, 0.0, 0.0]))
    assert nav.forecast is not None
    wide = replace(nav.forecast, sigma=np.full_like(nav.forecast.sigma, 6.0))
    inside = replace(inside, forecast=wide, lasting=9.0 * np.asarray(nav.lasting))
    covariance = inside.covariance.copy()
    covariance[..., :3, :3] += np.eye(3) * 32.0
    inside = replace(inside, covariance=covariance)
    out = sigmas(inside, along(80.0, 10.0))
    assert out[0] == pytest.approx(sigmas(inside, None)[0], rel=1e-6)
    assert out[-1] < 0.6 * out[0]


def test_where_the_map_has_no_fix_the_filter_coasts() -> None:
    """No measurement is to come: as with "propagated", on top of an error that lasts and stays as it is."""
    nav, _ = canyon(dark=True)
    dark = np.sqrt(nav.position_covariance_ahead(AHEAD_S, True, along(80.0, 80.0))[0, 0, :, 0, 0])
    none = np.sqrt(nav.position_covariance_ahead(AHEAD_S, False)[0, 0, :, 0, 0])
    np.testing.assert_allclose(dark, none, rtol=1e-9)
    assert (np.diff(dark) > 0.0).all()


def test_without_a_filter_the_covariance_takes_the_maps_ratio_and_coasts_where_it_has_none() -> None:
    filtered, _ = canyon()
    raw = replace(
        filtered, forecast=None, lasting=None, filtered=False, common_factor=np.zeros((1, 4, 3, 1)),
        covariance=np.broadcast_to(np.diag([8.0, 8.0, 8.0, 0.0, 0.0, 0.0]), (1, 4, 6, 6)).copy(),
    )  # fmt: skip
    walk = sigmas(raw, along(10.0, 80.0))
    assert walk[0] == pytest.approx(np.sqrt(8.0))
    assert walk[-1] == pytest.approx(np.sqrt(72.0))
    dark = replace(raw, sigma_map=canyon(dark=True)[1])
    variance = sigmas(dark, along(10.0, 80.0)) ** 2
    lost = np.maximum.accumulate(variance > 8.0 + 1e-12)
    assert 3 < lost.sum() < len(lost)
    np.testing.assert_allclose(variance[~lost], 8.0)
    age = 0.5 * np.arange(1, lost.sum() + 1)
    np.testing.assert_allclose(variance[lost], 8.0 + (0.1 * age) ** 2)


def test_the_map_is_made_for_those_who_ask_and_refused_where_there_are_no_satellites() -> None:
    assert build_scenario(load_problem("street_canyon_gnss"), 0, range(1)).sigma_map is None
    with pytest.raises(ProblemError, match=r'planner.covariance = "mapped".*navigation.kind = "gnss"'):
        load_problem("study_8s", {"planner.covariance": "mapped"})


def test_beside_a_house_the_map_has_more_and_scales_with_what_is_claimed() -> None:
    problem = street()
    _, errors, _ = drawn(problem, range(1))
    walls = ObstacleSet.from_shapes([Box((0.0, 0.0, 30.0), (20.0, 60.0, 60.0))])
    places = np.array([[12.0, 0.0, 5.0], [400.0, 0.0, 5.0], [0.0, 0.0, 5.0]])
    beside, free, inside = expected_variance(errors.scene.of_run(0, walls), places, 0.0)
    assert (beside[:3] > free[:3]).all()
    assert np.isnan(inside).all()
    assert isinstance(problem.navigation, Gnss)
    half = replace(errors.scene, config=problem.navigation.model_copy(update={"reported_sigma_scale": 0.5}))
    np.testing.assert_allclose(expected_variance(half.of_run(0, walls), places[1:2], 0.0)[0], free / 4.0)
