"""Emulated receivers: error laws in metres, what buildings do to them, what is reported, and independence."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from napf_mpc.block import simulate
from napf_mpc.closed_loop import build_scenario
from napf_mpc.errors import DataError, ProblemError
from napf_mpc.navigation.filtered import FilteredNavigation
from napf_mpc.navigation.fix import COAST_SIGMA_MPS, Fix
from napf_mpc.navigation.gnss import DEFAULT_ORIGIN_DEG, GnssScene, gnss_scene, origin_deg
from napf_mpc.navigation.gnss_fixes import GnssErrors, GnssFixes, solve_observation, solver_settings
from napf_mpc.navigation.pseudorange_solution import Check
from napf_mpc.navigation.range_errors import (
    code_noise_sigma_m,
    multipath_sigma_m,
    obliquity,
    troposphere_mapping,
)
from napf_mpc.navigation.sky import elevation_rad
from napf_mpc.navigation.wave_field import WAVES, field_value, waves
from napf_mpc.problem import City, EmptyWorld, Gnss
from napf_mpc.problem_file import load_problem
from napf_mpc.provenance import data_files
from napf_mpc.streams import NormalRows, Stream, normals, uniforms
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box

OPEN = EmptyWorld(kind="empty")
WALLS = ObstacleSet.from_shapes([Box((0.0, side * 25.0, 30.0), (400.0, 20.0, 60.0)) for side in (-1.0, 1.0)])
"""A street along east, 30 m wide between houses of 60 m."""


def config(**keys: object) -> Gnss:
    return Gnss.model_validate({"kind": "gnss", "rate_hz": 1.0} | keys)


def scene(
    cfg: Gnss, runs: range = range(4), obstacles: ObstacleSet | None = None, seconds: float = 60.0
) -> GnssScene:
    return gnss_scene(cfg, OPEN, obstacles or ObstacleSet.empty(), 3, runs, seconds)


def flight(cfg: Gnss, runs: range, uavs: int, obstacles: ObstacleSet | None = None) -> GnssFixes:
    return GnssErrors(scene(cfg, runs, obstacles), 3, runs, uavs).begin()


def line(runs: int, uavs: int, x: float, z: float = 10.0, apart_m: float = 5.0) -> np.ndarray:
    """UAVs abreast in the middle of the street at an easting."""
    place = np.zeros((runs, uavs, 3))
    place[..., 0] = x
    place[..., 1] = apart_m * (np.arange(uavs) - 0.5 * (uavs - 1))
    place[..., 2] = z
    return place


# ------------------------------------------------------------------------------------------- error laws


def test_laws_are_those_of_their_sources() -> None:
    zenith, low = np.array([np.pi / 2.0]), np.radians([5.0])
    assert obliquity(zenith)[0] == pytest.approx(1.0)
    assert obliquity(low)[0] == pytest.approx(3.0, abs=0.1)
    assert 0.12 * troposphere_mapping(zenith)[0] == pytest.approx(0.12, abs=1e-3)
    assert 0.12 * troposphere_mapping(low)[0] == pytest.approx(0.12 * 10.2, abs=0.02)
    assert multipath_sigma_m(zenith)[0] == pytest.approx(0.13, abs=1e-3)
    assert multipath_sigma_m(np.zeros(1))[0] == pytest.approx(0.66)
    np.testing.assert_allclose(code_noise_sigma_m(np.array([45.0, 25.0]), 0.3), [0.3, 3.0])


def test_a_field_has_unit_variance_and_its_correlation_over_place_and_time() -> None:
    count = 4000
    normal = normals(1, range(count), Stream.GNSS_WAVES, 1, 1, WAVES * 4).reshape(count, WAVES, 4)
    uniform = uniforms(1, range(count), Stream.GNSS_PHASES, 1, 1, WAVES).reshape(count, WAVES)
    field = waves(normal, uniform, 5.0, 60.0)

    def at(x: float, t: float) -> np.ndarray:
        return np.array(
            [
                field_value(field.vector[k], field.rate[k], field.phase[k], x, 0.0, 0.0, t)
                for k in range(count)
            ]
        )

    here = at(0.0, 0.0)
    assert here.mean() == pytest.approx(0.0, abs=0.06)
    assert here.var() == pytest.approx(1.0, abs=0.08)
    assert np.mean(np.abs(here) > 2.0) == pytest.approx(0.0455, abs=0.012)
    assert np.corrcoef(here, at(5.0, 0.0))[0, 1] == pytest.approx(np.exp(-0.5), abs=0.05)
    assert np.corrcoef(here, at(0.0, 60.0))[0, 1] == pytest.approx(np.exp(-0.5), abs=0.05)
    assert np.corrcoef(here, at(20.0, 0.0))[0, 1] == pytest.approx(0.0, abs=0.06)


def test_under_an_open_sky_ranges_are_as_wrong_as_the_receiver_believes() -> None:
    cfg = config(believed_reflection_m=0.0, elevation_mask_deg=5.0)
    runs = range(400)
    noise = normals(9, runs, Stream.GNSS_NOISE, 2, 48, 1)[..., 0]
    seen = scene(cfg, runs).observe(7.0, line(400, 2, 0.0, apart_m=500.0), noise)
    ratio = (seen.error / np.where(seen.tracked, seen.sigma, 1.0))[seen.tracked]
    assert np.mean(ratio**2) == pytest.approx(1.0, abs=0.05)
    assert np.mean(np.abs(ratio) < 1.0) == pytest.approx(0.683, abs=0.02)
    assert seen.in_sight.sum() == seen.tracked.sum()
    elevation = elevation_rad(seen.directions)
    assert (elevation[seen.tracked.any(1)] >= np.radians(5.0)).all()
    # What two UAVs far apart share is the part of which the receiver says so.
    both = seen.tracked.all(1)
    product = (seen.error[:, 0] * seen.error[:, 1])[both]
    assert product.mean() == pytest.approx((seen.shared_sigma[both] ** 2).mean(), rel=0.1)


def test_behind_walls_signals_come_late_weak_and_rarely() -> None:
    cfg = config(signal_in_space_m=0.0, ionosphere_m=0.0, troposphere_m=0.0, code_noise_m=1e-3)
    runs = range(300)
    seen = scene(cfg, runs, WALLS).observe(0.0, line(300, 1, 0.0, z=5.0), np.zeros((300, 1, 48)))
    above = (elevation_rad(seen.directions) >= np.radians(10.0))[:, None]
    hidden = above & ~seen.in_sight
    reflected = hidden & seen.tracked
    assert 0.3 < hidden.sum() / above.sum() < 0.8
    assert 0.2 < reflected.sum() / hidden.sum() < 0.9
    assert seen.error[reflected].min() >= 0.0
    assert seen.error[reflected].mean() == pytest.approx(20.0, abs=2.0)
    assert np.mean(seen.error[reflected] > 20.0) == pytest.approx(np.exp(-1.0), abs=0.05)
    assert (
        seen.carrier_to_noise[reflected].mean()
        < seen.carrier_to_noise[seen.in_sight & seen.tracked].mean() - 6.0
    )
    assert seen.carrier_to_noise[seen.tracked].min() >= 30.0
    # Weak signals are believed to be bad, whatever they are.
    assert seen.sigma[reflected].mean() > 2.0 * seen.sigma[seen.in_sight & seen.tracked].mean()


def test_broadcast_accuracy_is_taken_where_it_is_asked_for() -> None:
    drawn = scene(config(signal_in_space="broadcast"))
    assert set(np.unique(drawn.signal_in_space_m)) == {2.0, 3.12}
    assert (scene(config()).signal_in_space_m == 1.0).all()


def test_the_origin_is_the_citys_unless_given() -> None:
    city = City(kind="city", file="a.geojson", origin_latitude_deg=35.0, origin_longitude_deg=139.0)
    assert origin_deg(config(), city) == (35.0, 139.0)
    assert origin_deg(config(origin_latitude_deg=1.0, origin_longitude_deg=2.0), city) == (1.0, 2.0)
    assert origin_deg(config(), OPEN) == DEFAULT_ORIGIN_DEG


# ------------------------------------------------------------------------------------------- fixes


def test_positions_under_an_open_sky_are_as_wrong_as_reported() -> None:
    """Share within 1 and 3 sigma of 1000 receivers at one epoch, and what two of them share."""
    fixes = flight(config(believed_reflection_m=0.0), range(500), 2)
    fix = fixes.fix(0, line(500, 2, 0.0, z=50.0, apart_m=300.0))
    assert fix.available.all()
    sigma = np.sqrt(np.einsum("...ii->...i", fix.covariance))
    assert 0.3 < np.median(sigma[..., 0]) < 1.5
    for k, share in ((1.0, 0.683), (2.0, 0.954)):
        np.testing.assert_allclose(np.mean(np.abs(fix.error) < k * sigma, axis=(0, 1)), share, atol=0.05)
    assert (fix.error[..., 2] ** 2 / sigma[..., 2] ** 2).mean() == pytest.approx(1.0, abs=0.15)
    between = np.einsum("rak,rbk->rab", fix.common_factor[:, 0], fix.common_factor[:, 1])
    product = np.einsum("ra,rb->rab", fix.error[:, 0], fix.error[:, 1])
    np.testing.assert_allclose(product.mean(0).diagonal(), between.mean(0).diagonal(), rtol=0.25)
    # The difference of the two is less wrong than either.
    apart = fix.error[:, 0] - fix.error[:, 1]
    assert np.sqrt(np.mean(apart[:, 2] ** 2)) < 0.8 * np.sqrt(2.0) * np.sqrt(np.mean(fix.error[..., 2] ** 2))


def test_street_positions_are_worse_across_than_along_and_get_better_above_the_roofs() -> None:
    runs = range(60)
    low = flight(config(), runs, 1, WALLS).fix(0, line(60, 1, 0.0, z=10.0))
    high = flight(config(), runs, 1, WALLS).fix(0, line(60, 1, 0.0, z=80.0))
    sigma = [
        np.median(np.sqrt(np.einsum("...ii->...i", fix.covariance))[:, 0], axis=0) for fix in (low, high)
    ]
    assert sigma[0][1] > 1.3 * sigma[0][0]
    assert (sigma[0] > 1.3 * sigma[1]).all()
    assert np.median(np.abs(low.error[..., 1])) > 1.5 * np.median(np.abs(high.error[..., 1]))


def test_scales_touch_what_they_should() -> None:
    place = line(5, 2, 0.0)
    plain = flight(config(), range(5), 2, WALLS).fix(0, place)
    errors = flight(config(error_scale=2.0), range(5), 2, WALLS).fix(0, place)
    report = flight(config(reported_sigma_scale=0.5), range(5), 2, WALLS).fix(0, place)
    np.testing.assert_array_equal(errors.error, 2.0 * plain.error)
    np.testing.assert_array_equal(errors.covariance, plain.covariance)
    np.testing.assert_array_equal(report.error, plain.error)
    np.testing.assert_allclose(report.covariance, 0.25 * plain.covariance)
    np.testing.assert_allclose(report.common_factor, 0.5 * plain.common_factor)


def same(a: Fix, b: Fix) -> None:
    for name in ("error", "covariance", "common_factor", "available"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_a_run_does_not_depend_on_its_block_nor_a_uav_on_their_number() -> None:
    cfg = config()
    whole, part = flight(cfg, range(6), 3, WALLS), flight(cfg, range(4, 5), 3, WALLS)
    fewer = flight(cfg, range(6), 2, WALLS)
    for epoch in range(5):
        place = line(6, 3, 3.0 * epoch)
        a, b = whole.fix(epoch, place), part.fix(epoch, place[4:5])
        same(Fix(a.error[4:5], a.covariance[4:5], a.common_factor[4:5], a.available[4:5]), b)
        c = fewer.fix(epoch, place[:, :2])
        np.testing.assert_array_equal(c.error, a.error[:, :2])


def test_every_flight_meets_the_same_errors_at_the_same_places() -> None:
    errors = GnssErrors(scene(config(), range(3), WALLS), 3, range(3), 2)
    first, second, third = errors.begin(), errors.begin(), errors.begin()
    for epoch in range(3):
        a = first.fix(epoch, line(3, 2, 5.0 * epoch))
        same(a, second.fix(epoch, line(3, 2, 5.0 * epoch)))
        elsewhere = third.fix(epoch, line(3, 2, 100.0 - 5.0 * epoch))
        assert (elsewhere.error != a.error).any()
    with pytest.raises(IndexError, match="epoch = 5, but the next one of this flight is 3"):
        first.fix(5, line(3, 2, 0.0))


def test_without_a_fix_the_error_is_held_and_the_report_grows() -> None:
    """Into a tunnel after three epochs, out of it after ten more."""
    tunnel = ObstacleSet.from_shapes([Box((50.0, 0.0, 5.0), (40.0, 40.0, 20.0))])
    cfg = config(carrier_to_noise_mask_dbhz=60.0 - 22.0, fading_db=0.0, reflected_loss_db=40.0)
    fixes = flight(cfg, range(3), 1, tunnel)
    outside, inside = line(3, 1, 0.0, z=50.0), line(3, 1, 50.0, z=5.0)
    for epoch in range(3):
        last = fixes.fix(epoch, outside)
    assert last.available.all()
    for epoch in range(3, 13):
        held = fixes.fix(epoch, inside)
        assert not held.available.any()
        assert (fixes.check == Check.NONE).all()
        np.testing.assert_array_equal(held.error, last.error)
        grown = held.covariance - last.covariance
        expected = (COAST_SIGMA_MPS * (epoch - 2)) ** 2 * np.eye(3)
        np.testing.assert_allclose(grown, np.broadcast_to(expected, grown.shape), atol=1e-12)
        assert (held.common_factor == 0.0).all()
    again = fixes.fix(13, outside)
    assert again.available.all()
    assert (again.error != last.error).any()


def test_who_starts_without_a_fix_carries_one_of_an_open_sky() -> None:
    tunnel = ObstacleSet.from_shapes([Box((0.0, 0.0, 5.0), (40.0, 40.0, 20.0))])
    fix = flight(config(reflected_loss_db=60.0), range(5), 2, tunnel).fix(0, line(5, 2, 0.0, z=5.0))
    assert not fix.available.any()
    sigma = np.sqrt(np.einsum("...ii->...i", fix.covariance))
    assert (sigma > 0.3).all()
    assert np.median(sigma) < 5.0
    assert (fix.error != 0.0).all()


def test_residuals_and_weights_take_out_reflections() -> None:
    """Median horizontal error in the street: exclusion and robust weights against neither."""
    across = {}
    for name, keys in {
        "neither": {"weighting": "plain", "fault_exclusion": "none"},
        "both": {},
    }.items():
        fixes = flight(config(believed_reflection_m=0.5, **keys), range(150), 1, WALLS)
        fix = fixes.fix(0, line(150, 1, 0.0, z=20.0))
        across[name] = np.quantile(np.hypot(fix.error[..., 0], fix.error[..., 1]), [0.5, 0.9])
    assert across["both"][0] < 0.9 * across["neither"][0]


def test_an_undetermined_fault_widens_the_report() -> None:
    fixes = flight(config(reflected_delay_m=300.0, believed_reflection_m=0.0), range(200), 1, WALLS)
    place = line(200, 1, 0.0, z=3.0)
    fix = fixes.fix(0, place)
    faulty = fixes.check[:, 0] == Check.FAULTY
    assert faulty.any()
    drawn = scene(config(reflected_delay_m=300.0, believed_reflection_m=0.0), range(200), WALLS)
    noise = NormalRows(3, range(200), Stream.GNSS_NOISE, 1, len(drawn.names)).take()
    observed = drawn.observe(0.0, place, noise)
    plain = solve_observation(observed, drawn, solver_settings(drawn.config))
    assert (faulty == (plain.check == Check.FAULTY)).all()
    there = plain.covariance[:, 0, 0] > 0.0
    ratio = fix.covariance[:, 0, 0, 0] / np.where(there, plain.covariance[:, 0, 0], 1.0)
    np.testing.assert_allclose(ratio[faulty], plain.excess[faulty])
    assert (ratio[faulty] > 5.0).all()
    np.testing.assert_allclose(ratio[plain.check == Check.PASSED], 1.0)


# ----------------------------------------------------------------------------------- refusals, flights


def test_a_sky_without_satellites_is_refused() -> None:
    with pytest.raises(ProblemError, match=r"stand above elevation_mask_deg = 60 .* lower the mask"):
        scene(config(elevation_mask_deg=60.0, systems=("Galileo",)), range(30))


def test_a_missing_navigation_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"gone\.nav"):
        gnss_scene(config(file="gone.nav"), OPEN, ObstacleSet.empty(), 1, range(1), 10.0, tmp_path)


@pytest.mark.parametrize("planner", ["apf", "napf", "qp"])
@pytest.mark.parametrize("filter_", ["none", "kalman", "point_mass"])
def test_it_flies_with_every_planner_whatever_the_block(planner: str, filter_: str) -> None:
    problem = load_problem(
        "street_canyon_gnss", [f'navigation.filter="{filter_}"', "simulation.time_limit_s=4"]
    )
    both = simulate(problem, planner, seed=2, runs=range(2, 4), record_every=10).trajectories
    alone = simulate(problem, planner, seed=2, runs=range(3, 4), record_every=10).trajectories
    again = both["run"] == 3
    for name in ("x_m", "est_x_m", "est_z_m", "sigma_y_m"):
        np.testing.assert_array_equal(both[name][again], alone[name])
    assert (both["est_x_m"] != both["x_m"]).all()
    assert np.isfinite(both["est_z_m"]).all()
    assert 0.1 < np.median(both["sigma_x_m"]) < 10.0


def test_what_uavs_share_reaches_the_planner_through_the_filter_and_without() -> None:
    for filter_ in ("none", "kalman", "point_mass"):
        problem = load_problem("street_canyon_gnss", [f'navigation.filter="{filter_}"'])
        scenario = build_scenario(problem, 2, range(2))
        fix = scenario.errors.begin().fix(0, scenario.initial_state[..., 0:6:2])  # type: ignore[union-attr]
        between = np.einsum("rak,rbk->rab", fix.common_factor[:, 0], fix.common_factor[:, 1])
        assert (np.einsum("raa->ra", between) > 0.1).all()
        assert data_files(problem) == []


def test_the_loop_asks_at_the_true_places() -> None:
    """Fixes at the places that were recorded as true are the errors that the estimates had there."""
    problem = load_problem("street_canyon_gnss", ['navigation.filter="none"', "simulation.time_limit_s=3"])
    flown = simulate(problem, "apf", seed=6, runs=2, record_every=5)
    track = {name: values.reshape(2, -1, 4) for name, values in flown.trajectories.items()}
    assert isinstance(flown.scenario.errors, GnssErrors)
    fixes = flown.scenario.errors.begin()
    for epoch in range(track["t_s"].shape[1]):
        true = np.stack([track[f"{axis}_m"][:, epoch] for axis in "xyz"], axis=-1)
        told = np.stack([track[f"est_{axis}_m"][:, epoch] for axis in "xyz"], axis=-1)
        np.testing.assert_allclose(told - true, fixes.fix(epoch, true).error, atol=1e-9)


@pytest.mark.parametrize("filter_", ["kalman", "point_mass"])
def test_a_filter_takes_out_what_changes_and_says_that_the_rest_stays(filter_: str) -> None:
    """Standing under an open sky for 20 s: error over reported sigma is 1, far more without L L^T."""
    cfg = config(rate_hz=10.0, filter=filter_, believed_reflection_m=0.0, code_noise_m=1.0)
    runs = range(100)
    errors = GnssErrors(scene(cfg, runs), 3, runs, 2)
    still = np.zeros((100, 2, 3))
    navigation = FilteredNavigation(cfg, errors, 3, runs, 0.02, 5, still)
    place = line(100, 2, 0.0, z=50.0, apart_m=200.0)
    for tick in range(1000):
        nav = navigation.solution(tick, 0.02 * tick, place, still, still, still, np.ones(100, dtype=bool))
    off = nav.position - place
    reported = np.einsum("ruaa->rua", nav.position_covariance)
    assert nav.lasting is not None
    lasting = np.einsum("ruaa->rua", nav.lasting)
    assert np.mean(off**2 / reported) == pytest.approx(1.0, abs=0.25)
    assert np.mean(off**2 / (reported - lasting)) > 2.0
    between = np.einsum("rak,rbk->rab", nav.common_factor[:, 0], nav.common_factor[:, 1])
    shared = np.mean(off[:, 0] * off[:, 1], axis=0)
    np.testing.assert_allclose(shared, np.einsum("raa->a", between) / 100.0, rtol=0.5)
    # Over a horizon, with fixes and without: the filter's part changes, the rest stays.
    ahead = np.array([0.0, 5.0])
    for with_fixes in (True, False):
        then = np.einsum("ruaxx->ruax", nav.position_covariance_ahead(ahead, with_fixes))
        np.testing.assert_allclose(then[:, :, 0], reported)
        assert (then[:, :, 1] > lasting).all()
    assert (then[:, :, 1] > reported).all()


def test_among_real_towers_with_real_ephemerides(data_folder: Path) -> None:
    """Every run at its own time of the day; fixes are there, metres wrong, and the covariance says so."""
    problem = load_problem("nishi_shinjuku_gnss")
    scenario = build_scenario(problem, 4, range(12), data_folder)
    errors = scenario.errors
    assert isinstance(errors, GnssErrors)
    assert len(np.unique(np.round(errors.scene.start_s))) == 12
    fixes = errors.begin()
    place = scenario.initial_state[..., 0:6:2].copy()
    found = []
    for epoch in range(40):
        found.append(fixes.fix(epoch, place))
        place[..., 0] += 60.0 * np.cos(np.radians(155.0)) / 4.0
        place[..., 1] += 60.0 * np.sin(np.radians(155.0)) / 4.0
    assert np.mean([fix.available.mean() for fix in found]) > 0.95
    error = np.concatenate([np.hypot(fix.error[..., 0], fix.error[..., 1])[fix.available] for fix in found])
    assert 0.5 < np.median(error) < 6.0
    inside = [
        (fix.error[..., 0] ** 2 < 9.0 * fix.covariance[..., 0, 0])[fix.available].mean() for fix in found
    ]
    assert np.mean(inside) > 0.85


def test_an_observation_is_not_changed_by_who_else_flies() -> None:
    drawn = scene(config(), range(2), WALLS)
    noise = np.zeros((2, 3, 48))
    three = drawn.observe(1.0, line(2, 3, 0.0), noise)
    one = drawn.observe(1.0, line(2, 3, 0.0)[:, 1:2], noise[:, 1:2])
    np.testing.assert_array_equal(three.error[:, 1:2], one.error)
    elsewhere = replace(drawn, obstacles=ObstacleSet.empty()).observe(1.0, line(2, 3, 0.0), noise)
    assert elsewhere.in_sight.sum() > three.in_sight.sum()
