"""Positions from ranges: what covariances, tests of residuals and exclusions are worth, in metres."""

import numpy as np
import pymap3d
import pytest
from scipy import stats

from napf_mpc.navigation.almanac import nominal_constellation
from napf_mpc.navigation.ephemeris import LIGHT_MPS
from napf_mpc.navigation.pseudorange_solution import (
    HUBER,
    Check,
    PseudorangeSolution,
    SolverSettings,
    design_matrix,
    solve,
)
from napf_mpc.navigation.pseudoranges import fix_from_pseudoranges
from napf_mpc.navigation.sky import directions, east_north_up, elevation_rad, ranges
from napf_mpc.streams import Stream, generator

PLAIN = SolverSettings("plain", exclude=False)
STEP = 1.3e9
CLOCKS_M = np.array([3e5, -40.0])


def sky(count: int, clocks: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Directions (sat, 3) and clocks of some satellites of a real constellation, well spread."""
    constellation = nominal_constellation()
    unit = directions(constellation, 50.0, 10.0, np.array([STEP]))[0]
    high = np.flatnonzero(elevation_rad(unit) > np.radians(10.0))
    order = high[np.argsort(constellation.system[high] + 0.1 * (np.arange(len(high)) % 3), kind="stable")]
    chosen = order if count > len(order) else order[np.linspace(0, len(order) - 1, count).round().astype(int)]
    return unit[chosen], np.minimum(constellation.system[chosen], clocks - 1)


def one(
    unit: np.ndarray, clock: np.ndarray, y: np.ndarray, sigma: np.ndarray, settings: SolverSettings
) -> PseudorangeSolution:
    """Solve for many receivers under one sky."""
    shape = y.shape
    every = np.ones(shape, dtype=bool)
    return solve(
        np.broadcast_to(unit, (*shape, 3)), clock, y, np.broadcast_to(sigma, shape).copy(), every, settings
    )


def test_it_is_the_least_squares_solution_with_its_covariance() -> None:
    unit, clock = sky(11)
    stream = generator(1, 0, Stream.GNSS_NOISE)
    sigma = stream.uniform(0.5, 4.0, 11)
    true = np.array([30.0, -20.0, 12.0])
    y = -unit @ true + CLOCKS_M[clock] + sigma * stream.standard_normal(11)
    found = one(unit, clock, y[None], sigma, PLAIN)
    h = design_matrix(unit, clock, np.ones(11, dtype=bool))
    w = np.diag(sigma**-2.0)
    expected = np.linalg.solve(h.T @ w @ h, h.T @ w @ y)
    np.testing.assert_allclose(found.offset[0], expected[:3], atol=1e-6)
    np.testing.assert_allclose(found.clock[0, :2], expected[3:], atol=1e-6)
    assert np.isnan(found.clock[0, 2:]).all()
    # With weights that are the inverse of C, S C S^T is (H^T W H)^-1.
    np.testing.assert_allclose(found.covariance[0], np.linalg.inv(h.T @ w @ h)[:3, :3], rtol=1e-9)
    np.testing.assert_allclose(
        found.dop[0],
        [
            np.sqrt(np.trace(np.linalg.inv(h.T @ h)[:2, :2])),
            np.sqrt(np.linalg.inv(h.T @ h)[2, 2]),
            np.sqrt(np.trace(np.linalg.inv(h.T @ h)[:3, :3])),
        ],
        rtol=1e-9,
    )


def test_reweighted_covariance_is_s_c_s_and_no_longer_the_inverse() -> None:
    """One range 100 m off: Huber turns its weight to next to nothing and the covariance grows accordingly."""
    unit, clock = sky(11)
    sigma = np.ones(11)
    y = -unit @ np.array([1.0, 2.0, 3.0]) + CLOCKS_M[clock]
    y[4] += 100.0
    plain = one(unit, clock, y[None], sigma, PLAIN)
    for weighting, rest_m in (("huber", 3.0), ("cauchy", 0.5)):
        robust = one(unit, clock, y[None], sigma, SolverSettings(weighting, exclude=False))  # type: ignore[arg-type]
        assert np.linalg.norm(robust.offset[0] - [1.0, 2.0, 3.0]) < rest_m
        assert np.linalg.norm(plain.offset[0] - [1.0, 2.0, 3.0]) > 10.0
        s = robust.gain[0]
        np.testing.assert_allclose(robust.covariance[0], s @ s.T, rtol=1e-12)
        np.testing.assert_allclose(s @ (-unit), np.eye(3), atol=1e-9)  # S H = I: unbiased
        assert np.trace(robust.covariance[0]) > np.trace(plain.covariance[0])
    assert HUBER == 1.345


def test_the_covariance_is_that_of_many_solutions_and_shared_errors_correlate_receivers() -> None:
    """Two receivers with other satellites in sight: S_i C_shared S_j^T, over 20000 drawings."""
    unit, clock = sky(12)
    stream = generator(2, 0, Stream.GNSS_NOISE)
    n = 20_000
    shared, own = np.full(12, 1.5), np.linspace(0.5, 2.0, 12)
    common = shared * stream.standard_normal((n, 12))
    sigma = np.sqrt(shared**2 + own**2)
    tracked = np.ones((2, 12), dtype=bool)
    tracked[1, [0, 5]] = False
    places, gains, covariances = [], [], []
    for sees in tracked:
        y = common + own * stream.standard_normal((n, 12))
        found = solve(
            np.broadcast_to(unit, (n, 12, 3)), clock, y, np.broadcast_to(sigma, (n, 12)).copy(),
            np.broadcast_to(sees, (n, 12)).copy(), PLAIN,
        )  # fmt: skip
        places.append(found.offset)
        gains.append(found.gain[0])
        covariances.append(found.covariance[0])
    for place, covariance in zip(places, covariances, strict=True):
        np.testing.assert_allclose(place.T @ place / n, covariance, atol=0.05 * np.trace(covariance))
    between = (gains[0] * shared**2) @ gains[1].T
    np.testing.assert_allclose(places[0].T @ places[1] / n, between, atol=0.05 * np.trace(between))
    assert np.diag(between).min() > 0.3 * np.diag(covariances[0]).min()


@pytest.mark.parametrize(
    ("count", "clocks", "fault_m", "expected"),
    [
        (5, 2, 0.0, Check.UNCHECKED),  # n = m + 3
        (4, 2, 0.0, Check.NONE),
        (6, 2, 0.0, Check.PASSED),  # n = m + 4: a fault can be seen
        (6, 2, 500.0, Check.FAULTY),  # but not told
        (7, 2, 500.0, Check.PASSED),  # n = m + 5: it is excluded
        (4, 1, 0.0, Check.UNCHECKED),
        (5, 1, 500.0, Check.FAULTY),
        (3, 1, 0.0, Check.NONE),
    ],
)
def test_what_can_be_checked_follows_from_the_number_of_satellites(
    count: int, clocks: int, fault_m: float, expected: Check
) -> None:
    unit, clock = sky(count, clocks)
    assert len(unit) == count
    y = CLOCKS_M[clock]
    y[np.argmax(clock == 0)] += fault_m
    found = one(unit, clock, y[None], np.ones(count), SolverSettings("plain", max_pdop=1e6))
    assert found.check[0] == expected
    if expected == Check.PASSED and fault_m:
        assert not found.used[0, np.argmax(clock == 0)]
        np.testing.assert_allclose(found.offset[0], 0.0, atol=1e-5)
    if expected == Check.NONE:
        assert not found.used.any()
        assert (found.covariance == 0.0).all()
        assert np.isinf(found.dop).all()


def test_false_alarms_come_as_rarely_as_asked() -> None:
    unit, clock = sky(9)
    y = generator(3, 0, Stream.GNSS_NOISE).standard_normal((20_000, 9))
    for alarm in (0.01, 0.05):
        found = one(unit, clock, y, np.ones(9), SolverSettings("plain", exclude=True, false_alarm=alarm))
        share = np.mean(found.used.sum(-1) < 9)
        low, high = stats.binom.interval(0.999, 20_000, alarm)
        assert low / 20_000 < share < high / 20_000
    free = one(unit, clock, y, np.ones(9), PLAIN)
    assert free.excess.mean() == pytest.approx(1.0, abs=0.02)  # chi-square over its degrees of freedom


def test_two_faults_among_many_satellites_are_found() -> None:
    unit, clock = sky(16)
    y = CLOCKS_M[clock] + 0.5 * generator(4, 0, Stream.GNSS_NOISE).standard_normal((500, 16))
    y[:, 3] += 40.0
    y[:, 9] += 25.0
    found = one(unit, clock, y, np.full(16, 0.5), SolverSettings("plain"))
    assert np.mean(~found.used[:, 3] & ~found.used[:, 9]) > 0.99
    assert np.median(np.linalg.norm(found.offset, axis=-1)) < 2.0


def test_a_system_with_one_satellite_adds_nothing_but_its_clock() -> None:
    unit, clock = sky(9, 1)
    alone = clock.copy()
    alone[2] = 1
    y = generator(5, 0, Stream.GNSS_NOISE).standard_normal(9)
    tracked = np.ones((1, 9), dtype=bool)
    with_it = solve(
        unit[None], alone, y[None], np.ones((1, 9)), tracked, SolverSettings("plain", max_pdop=100.0)
    )
    tracked[0, 2] = False
    without = solve(
        unit[None], clock, y[None], np.ones((1, 9)), tracked, SolverSettings("plain", max_pdop=100.0)
    )
    np.testing.assert_allclose(with_it.offset, without.offset, atol=1e-9)
    np.testing.assert_allclose(with_it.covariance, without.covariance, atol=1e-9)


def test_satellites_that_stand_badly_give_no_position() -> None:
    unit, clock = sky(8, 1)
    cone = unit.copy()
    cone[:, 2] = 0.5  # all at one elevation: height and clock cannot be told apart
    cone[:, :2] *= np.sqrt(0.75) / np.linalg.norm(cone[:, :2], axis=-1)[:, None]
    found = one(cone, clock, np.zeros((1, 8)), np.ones(8), SolverSettings("huber", max_pdop=1e9))
    assert found.check[0] == Check.NONE
    strict = one(unit, clock, np.zeros((1, 8)), np.ones(8), SolverSettings("plain", max_pdop=1.0))
    assert strict.check[0] == Check.NONE


def test_a_receiver_does_not_depend_on_the_others() -> None:
    unit, clock = sky(10)
    y = 3.0 * generator(6, 0, Stream.GNSS_NOISE).standard_normal((50, 10))
    settings = SolverSettings("huber", false_alarm=0.1)
    together = one(unit, clock, y, np.ones(10), settings)
    for k in (0, 17, 49):
        alone = one(unit, clock, y[k : k + 1], np.ones(10), settings)
        np.testing.assert_array_equal(alone.offset[0], together.offset[k])
        np.testing.assert_array_equal(alone.gain[0], together.gain[k])


@pytest.mark.parametrize(("value", "sigma"), [(np.nan, 1.0), (1.0, 0.0), (1.0, np.nan)])
def test_numbers_that_are_none_are_refused_only_where_they_count(value: float, sigma: float) -> None:
    unit, clock = sky(8)
    y, s, tracked = np.zeros((1, 8)), np.ones((1, 8)), np.ones((1, 8), dtype=bool)
    y[0, 3], s[0, 3] = value, sigma
    with pytest.raises(ValueError, match="must be finite"):
        solve(unit[None], clock, y, s, tracked, PLAIN)
    tracked[0, 3] = False
    assert solve(unit[None], clock, y, s, tracked, PLAIN).check[0] == Check.PASSED


def test_from_full_pseudoranges_the_place_comes_back_and_the_linear_solution_is_right() -> None:
    """Truth to pseudoranges to place; with errors of tens of metres, S e is that place to millimetres."""
    constellation = nominal_constellation()
    place = np.array(pymap3d.geodetic2ecef(35.69, 139.69, 80.0))
    axes = east_north_up(35.69, 139.69)
    distance, sent = ranges(constellation, place, STEP)
    unit = directions(constellation, 35.69, 139.69, np.array([STEP]))[0]
    high = elevation_rad(unit) > np.radians(10.0)
    clock = constellation.system[high]
    sigma = np.ones(high.sum())
    clean = distance[high] + CLOCKS_M[clock]
    # pymap3d's way back from the earth's centre is good to micrometres, the loop stops below 0.1 mm.
    fix = fix_from_pseudoranges(clean, sent[high], clock, sigma, PLAIN)
    assert np.linalg.norm(fix.place - place) < 1e-3
    np.testing.assert_allclose(fix.solution.clock[0, :2], CLOCKS_M, atol=1e-3)
    error = 20.0 * generator(7, 0, Stream.GNSS_NOISE).standard_normal(high.sum())
    spoiled = fix_from_pseudoranges(clean + error, sent[high], clock, sigma, PLAIN)
    linear = solve(
        unit[high][None], clock, error[None], sigma[None], np.ones((1, len(clock)), dtype=bool), PLAIN
    )
    moved = axes @ (spoiled.place - place)
    assert np.linalg.norm(moved) > 3.0
    np.testing.assert_allclose(linear.offset[0], moved, atol=2e-3)
    # Without the earth's turn the place is some 30 m off, to the east.
    still = fix_from_pseudoranges(clean, sent[high], clock, sigma, PLAIN, earth_turns=False)
    east, north, _ = axes @ (still.place - place)
    assert 20.0 < east < 40.0
    assert abs(north) < 5.0
    assert sent.shape == (48, 3)
    assert LIGHT_MPS == 299_792_458.0
