"""Protection levels of emulated receivers in flight: which signals are trusted, and that levels are true."""

import numpy as np
import pytest

from napf_mpc.block import fly_block
from napf_mpc.errors import ProblemError
from napf_mpc.navigation.gnss import GnssScene, gnss_scene
from napf_mpc.navigation.gnss_fixes import GnssErrors, GnssFixes
from napf_mpc.navigation.gnss_levels import TRUSTED, levels_of
from napf_mpc.navigation.range_errors import carrier_to_noise_dbhz, p_reflected
from napf_mpc.problem import EmptyWorld, Gnss
from napf_mpc.problem_file import load_problem
from napf_mpc.streams import NormalRows, Stream, normals
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box

STREET = "street_canyon_gnss"
LEVELS = ('navigation.integrity="araim"', 'navigation.filter="none"', 'planner.safety="protection_level"')

WALLS = ObstacleSet.from_shapes([Box((0.0, side * 25.0, 30.0), (400.0, 20.0, 60.0)) for side in (-1.0, 1.0)])
"""A street along east, 30 m wide between houses of 60 m."""


def config(**keys: object) -> Gnss:
    return Gnss.model_validate({"kind": "gnss", "rate_hz": 1.0} | keys)


def scene(cfg: Gnss, runs: range, obstacles: ObstacleSet | None = None) -> GnssScene:
    return gnss_scene(cfg, EmptyWorld(kind="empty"), obstacles or ObstacleSet.empty(), 3, runs, 60.0)


def flight(cfg: Gnss, runs: range, uavs: int, obstacles: ObstacleSet) -> GnssFixes:
    return GnssErrors(scene(cfg, runs, obstacles), 3, runs, uavs).begin()


def line(runs: int, uavs: int, x: float, z: float = 10.0) -> np.ndarray:
    """UAVs abreast in the middle of the street at an easting."""
    place = np.zeros((runs, uavs, 3))
    place[..., 0] = x
    place[..., 1] = 5.0 * (np.arange(uavs) - 0.5 * (uavs - 1))
    place[..., 2] = z
    return place


def test_a_weak_signal_is_likely_a_reflection_and_a_strong_one_is_not() -> None:
    """Bayes' rule by hand: N(0, 2 dB) in sight, N(-12, 4 dB) reflected, even odds before."""
    deficit = np.array([0.0, 6.0, 12.0])
    sight = np.exp(-0.5 * (deficit / 2.0) ** 2) / 2.0
    other = np.exp(-0.5 * ((deficit - 12.0) / 4.0) ** 2) / 4.0
    found = p_reflected(-deficit, 2.0, 12.0, 4.0, np.full(3, 0.5))
    np.testing.assert_allclose(found, other / (sight + other), rtol=1e-12)
    assert found[0] < 0.006
    assert found[2] > 0.999
    # Stronger than its kind is no better than as strong, and what cannot be blocked cannot be reflected.
    assert p_reflected(np.array([5.0]), 2.0, 12.0, 4.0, np.array([0.5]))[0] == found[0]
    assert p_reflected(np.array([-12.0]), 2.0, 12.0, 4.0, np.array([0.0]))[0] == 0.0


@pytest.mark.parametrize(("height_m", "over"), [(50.0, 1.0), (10.0, 4.0)])
def test_among_walls_so_many_are_reflections_as_is_said(height_m: float, over: float) -> None:
    """Street of 30 m, houses of 60 m: careful near the roofs, too trusting deep in it (2.2 % for 0.8 %)."""
    receivers = scene(config(), range(30), WALLS)
    said, true = [], []
    for n, x in enumerate((-150.0, -50.0, 50.0, 150.0)):  # places with reflections of their own
        noise = normals(11 + n, range(30), Stream.GNSS_NOISE, 1, len(receivers.names), 1)[..., 0]
        seen = receivers.observe(0.0, line(30, 1, x, height_m), noise)
        p = receivers.p_reflected(seen.directions, seen.carrier_to_noise)
        said.append(p[seen.tracked])
        true.append(~seen.in_sight[seen.tracked])
    p, reflected = np.concatenate(said), np.concatenate(true)
    kept = p <= TRUSTED
    assert reflected[kept].mean() < over * p[kept].mean()
    assert reflected[p > 0.95].mean() > 0.95
    assert kept.mean() > 0.3


def test_levels_of_a_flight_are_true_and_belong_to_its_fixes() -> None:
    """Twelve runs of two UAVs for 40 s along the street: where there is a level, the error is inside."""
    cfg = config(integrity="araim")
    guarded, plain = flight(cfg, range(12), 2, WALLS), flight(config(), range(12), 2, WALLS)
    inside, known = [], []
    for epoch in range(40):
        place = line(12, 2, -60.0 + 3.0 * epoch, z=30.0)
        fix, usual = guarded.fix(epoch, place), plain.fix(epoch, place)
        assert usual.protection is None
        assert fix.protection is not None
        there = np.isfinite(fix.protection).all(-1)
        across = np.hypot(fix.error[..., 0], fix.error[..., 1])
        held = (across <= fix.protection[..., 0]) & (np.abs(fix.error[..., 2]) <= fix.protection[..., 1])
        inside.append(held[there])
        known.append(there)
        # Without a level the fix is the usual one.
        np.testing.assert_array_equal(fix.available, usual.available | there)
        fresh = ~there & usual.available
        np.testing.assert_array_equal(fix.error[fresh], usual.error[fresh])
    assert np.concatenate(inside).all()
    assert np.mean(known) > 0.3


def test_a_level_grows_with_what_is_asked() -> None:
    place = line(6, 1, 0.0, z=80.0)
    found = []
    for p_hmi in (1e-2, 1e-4):
        receivers = scene(config(integrity="araim", p_hmi=p_hmi), range(6))
        noise = normals(3, range(6), Stream.GNSS_NOISE, 1, len(receivers.names), 1)[..., 0]
        found.append(levels_of(receivers.observe(0.0, place, noise), receivers).level_m)
    assert (found[1] > found[0]).all()
    assert 5.0 < np.median(found[0][:, 0]) < 40.0  # metres, under an open sky


def test_it_flies_by_levels_whatever_the_block() -> None:
    problem = load_problem(STREET, [*LEVELS, "simulation.time_limit_s=6"])
    together = fly_block(problem, ["napf"], 41, range(3))
    alone = fly_block(problem, ["napf"], 41, range(2, 3))
    for name in ("min_clearance_m", "path_rms_m"):
        np.testing.assert_array_equal(together.rows[name][2:], alone.rows[name])


def test_levels_that_nobody_computes_are_not_flown_by() -> None:
    with pytest.raises(ProblemError, match=r'levels with navigation\.integrity = "araim" only'):
        load_problem(STREET, ['planner.safety="protection_level"', 'navigation.filter="none"'])
    with pytest.raises(ProblemError, match="bounds the error of fixes"):
        load_problem(STREET, ['navigation.integrity="araim"', 'planner.safety="protection_level"'])


def test_before_its_strength_is_known_a_low_signal_is_likelier_a_reflection() -> None:
    """With C/N0 as its elevation lets expect, the prior counts: 0.7 on the horizon to 0 in the zenith."""
    receivers = scene(config(), range(1))
    elevation = np.deg2rad([[15.0, 45.0, 80.0]])
    unit = np.stack([np.cos(elevation), np.zeros((1, 3)), np.sin(elevation)], axis=-1)
    low, high = receivers.config.carrier_to_noise_dbhz
    usual = carrier_to_noise_dbhz(elevation, low, high)[:, None]
    prior = 0.7 * (1.0 - np.array([15.0, 45.0, 80.0]) / 90.0)
    expected = p_reflected(np.zeros(3), 2.0, 12.0, 4.0, prior)
    np.testing.assert_allclose(receivers.p_reflected(unit, usual)[0, 0], expected, rtol=1e-9)


def test_a_fix_with_a_level_is_the_plain_one_of_the_satellites_that_are_trusted() -> None:
    """The level bounds weighted least squares of what it used, not the robust solution of all."""
    cfg, place = config(integrity="araim"), line(8, 1, 20.0, z=30.0)
    fixes = flight(cfg, range(8), 1, WALLS)
    fix = fixes.fix(0, place)
    receivers = scene(cfg, range(8), WALLS)
    noise = NormalRows(3, range(8), Stream.GNSS_NOISE, 1, len(receivers.names)).take()
    seen = receivers.observe(0.0, place, noise)
    levels = levels_of(seen, receivers)
    there = np.isfinite(levels.level_m).all(-1)
    assert there.sum() > 3
    sigma = receivers.sight_sigma(seen.directions, seen.carrier_to_noise)[:, 0]
    for run in np.flatnonzero(there):
        used = levels.used[run]
        h = np.zeros((used.sum(), 5))
        h[:, :3] = -seen.directions[run, used]
        h[np.arange(len(h)), 3 + receivers.clock[used]] = 1.0
        scale = sigma[run, used]
        offset = np.linalg.lstsq(h / scale[:, None], seen.error[run, 0, used] / scale)[0][:3]
        np.testing.assert_allclose(fix.error[run, 0], offset, atol=1e-6)


def test_a_receiver_that_reports_half_its_sigma_reports_half_its_level() -> None:
    place = line(6, 1, 20.0, z=80.0)
    whole, half = (
        flight(config(integrity="araim", reported_sigma_scale=scale), range(6), 1, ObstacleSet.empty())
        .fix(0, place)
        .protection
        for scale in (1.0, 0.5)
    )
    assert whole is not None
    assert half is not None
    np.testing.assert_allclose(half, 0.5 * whole)
