"""The navigation filter: against a textbook one, against its own covariance, and when sensors misbehave."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.linalg import expm
from scipy.stats import chi2

from napf_mpc.campaign import fly_block, simulate
from napf_mpc.closed_loop import ATTITUDE, POSITION, RATES, VELOCITY, build_scenario, closed_loop
from napf_mpc.navigation import cross_covariance, kalman
from napf_mpc.navigation.consistency import normalised_errors
from napf_mpc.navigation.error_models import gauss_markov_errors, position_errors
from napf_mpc.navigation.filter import KalmanFilter
from napf_mpc.navigation.filter_model import RECEIVER_NOISE_M, FilterModel
from napf_mpc.navigation.filtered import FilteredNavigation
from napf_mpc.navigation.fix import Fix, PositionErrors
from napf_mpc.navigation.fix_record import GATE_PATIENCE_S
from napf_mpc.navigation.sensors import Sensors
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import ConstantBias, GaussMarkov, Navigation, Problem, Recorded
from napf_mpc.problem_file import load_problem
from napf_mpc.streams import NormalSequence, Stream, normals

Array = NDArray[np.float64]

TICK_S, TICKS = 0.02, 5
RUNS, UAVS = 200, 4


def paper(**changes: Any) -> GaussMarkov:
    """Navigation of study_8s (1-5 m, 10 s) with the filter."""
    return GaussMarkov.model_validate({"filter": "kalman"} | changes)


def truth(time_s: float, runs: int, uavs: int) -> tuple[Array, Array]:
    """Every UAV swings on its own: +-3 m at up to 1.8 m/s."""
    k = np.arange(runs * uavs * 3).reshape(runs, uavs, 3)
    w = 0.3 + 0.05 * (k % 7)
    return 3.0 * np.sin(w * time_s + k), 3.0 * w * np.cos(w * time_s + k)


def hover(time_s: float, runs: int, uavs: int) -> tuple[Array, Array]:
    return np.full((runs, uavs, 3), 7.0), np.zeros((runs, uavs, 3))


@dataclass
class Flown:
    """A filtered flight: solution against truth every 0.2 s."""

    navigation: FilteredNavigation
    time_s: Array
    solutions: list[NavSolution]
    error: Array
    """(t, run, uav, 6)"""

    @property
    def covariance(self) -> Array:
        return np.array([nav.covariance for nav in self.solutions])

    @property
    def available(self) -> NDArray[np.bool_]:
        return np.array([nav.available for nav in self.solutions])

    def nees(self) -> tuple[Array, Array]:
        """(t, run, uav) of position and velocity, and of the position."""
        position, whole = np.empty(self.error.shape[:3]), np.empty(self.error.shape[:3])
        for t, nav in enumerate(self.solutions):
            normalised_errors(self.error[t], nav.covariance, position[t], whole[t])
        return whole, position


def flown(
    config: Navigation,
    seconds: float,
    runs: int | range = RUNS,
    uavs: int = UAVS,
    errors: PositionErrors | None = None,
    folder: Path | None = None,
    path: Any = truth,
    every: int = 10,
) -> Flown:
    block = range(runs) if isinstance(runs, int) else runs
    errors = errors or position_errors(config, 11, block, uavs, seconds, folder)
    still = np.zeros((len(block), uavs, 3))
    navigation = FilteredNavigation(
        config,
        errors,
        11,
        block,
        TICK_S,
        round(1 / config.rate_hz / TICK_S),
        path(0.0, block.stop, uavs)[1][block],
    )
    times, solutions, misses = [], [], []
    for tick in range(round(seconds / TICK_S)):
        position, velocity = (part[block] for part in path(tick * TICK_S, block.stop, uavs))
        nav = navigation.solution(
            tick, tick * TICK_S, position, velocity, still, still, np.ones(len(block), dtype=bool)
        )
        if tick % every == 0:
            times.append(tick * TICK_S)
            solutions.append(nav)
            misses.append(np.concatenate([nav.position - position, nav.velocity - velocity], axis=-1))
    return Flown(navigation, np.array(times), solutions, np.array(misses))


@pytest.fixture(scope="module")
def study() -> Flown:
    """200 runs of four UAVs over 75 s, as study_8s."""
    return flown(paper(), 75.0)


# ------------------------------------------------------------------------------------- against a textbook


def textbook(
    config: Navigation,
    tau_s: float,
    changes: Array,
    fixes: Array,
    speeds: Array,
    sigmas: Array,
    available: NDArray[np.bool_],
) -> tuple[Array, Array]:
    """Estimate (t, 2) and covariance (t, 2, 2) of position and velocity of an axis: dense matrices, inverses.

    White error has no state; it is measurement noise.
    """
    dt, white = TICK_S, tau_s == 0.0
    n = 3 if white else 4
    p, v, b, g = 0, 1, 2, 3
    f = np.eye(n)
    f[p, v], f[p, b], f[v, b] = dt, -dt * dt / 2, -dt
    f[b, b] = math.exp(-dt / config.accelerometer_bias_time_s)
    drive = np.zeros(n)
    drive[[p, v]] = dt / 2, 1.0
    q = np.outer(drive, drive) * config.accelerometer_noise_mps_rts**2 * dt
    q[b, b] = config.accelerometer_bias_mps2**2 * (1.0 - f[b, b] ** 2)
    fade = np.eye(n)
    if not white:
        fade[g, g] = math.exp(-TICKS * dt / tau_s)
    new = np.zeros((n, n))
    if not white:
        new[g, g] = 1.0 - fade[g, g] ** 2
    r = np.diag([RECEIVER_NOISE_M**2, config.gnss_velocity_sigma_mps**2])

    x = np.zeros(n)
    x[[p, v]] = fixes[0], speeds[0]
    cov = np.diag([sigmas[0] ** 2 + r[0, 0], r[1, 1], config.accelerometer_bias_mps2**2, 1.0][:n])
    if not white:
        cov[p, g] = cov[g, p] = -sigmas[0]
    means, covariances = [x[:2].copy()], [cov[:2, :2].copy()]
    for k, change in enumerate(changes, start=1):
        x = f @ x + drive * change
        cov = f @ cov @ f.T + q
        if k % TICKS == 0:
            e = k // TICKS
            x, cov = fade @ x, fade @ cov @ fade.T + new
            if available[e]:
                h = np.zeros((2, n))
                h[0, p] = h[1, v] = 1.0
                noise = r.copy()
                if white:
                    noise[0, 0] += sigmas[e] ** 2
                else:
                    h[0, g] = sigmas[e]
                gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + noise)
                x = x + gain @ (np.array([fixes[e], speeds[e]]) - h @ x)
                rest = np.eye(n) - gain @ h
                cov = rest @ cov @ rest.T + gain @ noise @ gain.T
        means.append(x[:2].copy())
        covariances.append(cov[:2, :2].copy())
    return np.array(means), np.array(covariances)


@pytest.mark.parametrize(
    ("config", "tau_s", "tolerance"),
    [
        (paper(innovation_gate_sigma=0.0), 10.0, 1e-9),
        (paper(innovation_gate_sigma=0.0, correlation_time_s=0.0), 0.0, 1e-9),
        (
            paper(innovation_gate_sigma=0.0, filter_correlation_time_s=2.5, accelerometer_bias_time_s=5.0),
            2.5,
            1e-9,
        ),
        # Millimetres of noise beside 5 m of error that never changes: gains lose digits in any arithmetic.
        (ConstantBias(kind="constant", filter="kalman", innovation_gate_sigma=0.0), math.inf, 1e-6),
    ],
    ids=["correlated", "white", "believes another time", "constant"],
)
def test_it_is_the_textbook_filter(config: Navigation, tau_s: float, tolerance: float) -> None:
    """Any numbers as measurements, fixes missing in between: the same estimate and covariance to 1e-9."""
    runs, uavs, ticks = 2, 2, 400
    rng = np.random.default_rng(1)
    shape = (ticks // TICKS + 1, runs, uavs, 3)
    changes = 0.05 * rng.normal(size=(ticks, runs, uavs, 3))
    fixes, speeds = 3.0 * rng.normal(size=shape), 0.3 * rng.normal(size=shape)
    sigmas = rng.uniform(1.0, 5.0, size=shape)
    available = rng.random(shape[:3]) < 0.8
    available[0] = True
    kf = KalmanFilter(FilterModel.of_navigation(config, TICK_S, TICKS), runs, uavs)
    active, zero = np.ones(runs, dtype=bool), np.zeros((runs, uavs, 3))
    solutions = []
    for k in range(ticks + 1):
        if k:
            kf.predict(changes[k - 1], active)
        if k % TICKS == 0:
            e = k // TICKS
            reported = np.einsum("...i,ij->...ij", sigmas[e] ** 2, np.eye(3))
            kf.correct(fixes[e], speeds[e], reported, available[e], True, active)
        solutions.append(kf.solution(k * TICK_S, zero, zero))
    for r, i, a in np.ndindex(runs, uavs, 3):
        mean, covariance = textbook(
            config, tau_s, changes[:, r, i, a], fixes[:, r, i, a], speeds[:, r, i, a], sigmas[:, r, i, a],
            available[:, r, i],
        )  # fmt: skip
        ours = np.array([(nav.position[r, i, a], nav.velocity[r, i, a]) for nav in solutions])
        np.testing.assert_allclose(ours, mean, rtol=tolerance, atol=tolerance)
        block = np.array([nav.covariance[r, i][np.ix_([a, 3 + a], [a, 3 + a])] for nav in solutions])
        np.testing.assert_allclose(block, covariance, rtol=tolerance, atol=tolerance)


def test_the_covariance_stays_positive_over_100_000_ticks() -> None:
    """Half an hour of flight, sigma jumping from millimetres to 50 m, outages: no eigenvalue below zero."""
    rng = np.random.default_rng(3)
    memory = np.array([math.exp(-0.01), 0.0, 1.0])  # 10 s, white, constant: one on each axis
    mean, packed = np.zeros((1, 1, 3, 4)), np.zeros((1, 1, 3, 10))
    active, never = np.ones(1, dtype=bool), np.zeros(3, dtype=bool)
    none, verdict = np.zeros((0, 1, 3, 4, 4)), np.zeros((1, 1), dtype=np.int8)
    zero = np.zeros((1, 1, 3))
    upper = np.triu_indices(4)
    full = np.zeros((3, 4, 4))
    lowest = np.inf
    for tick in range(100_000):
        if tick:
            kalman.predict(mean, packed, zero, TICK_S, math.exp(-2e-4), 2e-6, 1e-6, active)
        if tick % TICKS == 0:
            sigma = np.full((1, 1, 3), 10.0 ** rng.uniform(-3.0, 1.7))
            there = np.array([[tick % 4000 < 3000]])
            kalman.correct(
                mean, packed, 3.0 * sigma * rng.normal(size=3), 0.1 * rng.normal(size=(1, 1, 3)), sigma,
                there, never, memory, 1.0 - memory**2, 1e-6, 0.01, 2.5e-3, 0.0, there & False,
                there & False, there & False, False, np.array([[tick == 0]]),
                active, verdict, none, none[..., 0], np.empty((0, 1, 6)), math.nan,
            )  # fmt: skip
            full[:, upper[0], upper[1]] = packed[0, 0]
            full[:, upper[1], upper[0]] = packed[0, 0]
            scale = np.sqrt(np.einsum("aii->ai", full))
            assert (scale > 0.0).all()
            # In units of each state's own sigma, so that small states count as much as large ones.
            unit = full / (scale[:, :, None] * scale[:, None, :])
            lowest = np.minimum(lowest, np.linalg.eigvalsh(unit).min())
    assert np.isfinite(mean).all()
    assert lowest > 0.0


# --------------------------------------------------------------------------------------------- consistency


def test_errors_are_as_large_as_reported(study: Flown) -> None:
    """Position and velocity of 800 UAVs at six times: chi-square, each inside its 99.99 % interval."""
    whole, position = study.nees()
    for values, size in ((whole, 6), (position, 3)):
        count = size * RUNS * UAVS
        low, high = chi2.ppf([5e-5, 1.0 - 5e-5], count) / count
        for second in (0.0, 1.0, 5.0, 15.0, 40.0, 74.0):
            mean = values[round(second / 0.2)].mean()
            assert low < mean < high, (size, second)
    assert whole.mean() == pytest.approx(1.0, abs=0.03)


def test_rms_is_that_of_the_independent_trial(study: Flown) -> None:
    """Another code measured 0.64 m an axis and a shape floor of 0.95 m; 0.03 m is the scatter of 800 UAVs."""
    late = study.error[study.time_s >= 12.0]
    rms = np.sqrt((late**2).mean(axis=(0, 1, 2)))
    np.testing.assert_allclose(rms[:3], 0.64, atol=0.03)
    assert (rms[3:] < 0.03).all()
    own = late[..., :3] - late[..., :3].mean(axis=2, keepdims=True)
    assert np.sqrt((own**2).sum(-1).mean()) == pytest.approx(0.95, abs=0.05)
    # Unfiltered it is 3.3 m: the mean square of sigma from 1 to 5 m.
    assert study.navigation.gated_fixes.sum() <= 10


def test_claiming_half_the_sigma_shows() -> None:
    half, twice = (flown(paper(reported_sigma_scale=scale), 30.0, runs=50) for scale in (0.5, 2.0))
    assert half.nees()[1].mean() > 2.5
    assert half.nees()[0].mean() > 1.8
    assert twice.nees()[1].mean() < 0.4
    assert half.navigation.gated_fixes.sum() > 0.02 * 300 * 50 * UAVS
    assert twice.navigation.gated_fixes.sum() == 0


@pytest.mark.parametrize(
    ("config", "rms_m"),
    [
        (paper(correlation_time_s=0.0), 0.15),
        (paper(correlation_time_s=2.0), 0.72),
        (ConstantBias(kind="constant", filter="kalman"), 3.2),
        (paper(sigma_min_m=3.0, sigma_max_m=3.0), 2.04),
    ],
    ids=["white", "2 s", "constant", "steady sigma"],
)
def test_other_errors(config: Navigation, rms_m: float) -> None:
    """White noise averages out; a constant error cannot be told from the place, and the filter knows it."""
    flight = flown(config, 40.0, runs=100)
    late = flight.time_s >= 12.0
    assert np.sqrt((flight.error[late][..., :3] ** 2).mean()) == pytest.approx(rms_m, rel=0.12)
    assert flight.nees()[1].mean() == pytest.approx(1.0, abs=0.08)


def test_believing_a_wrong_correlation_time_shows() -> None:
    assert flown(paper(filter_correlation_time_s=2.0), 30.0, runs=50).nees()[1].mean() > 1.5
    assert flown(paper(filter_correlation_time_s=50.0), 30.0, runs=50).nees()[1].mean() > 1.5


def test_a_hovering_uav_is_found() -> None:
    """At rest at 7 m: after a minute known to 0.6 m and 0.03 m/s, without a mean error."""
    flight = flown(paper(), 60.0, runs=100, path=hover)
    last = flight.error[-1].reshape(-1, 6)
    assert np.sqrt((last[:, :3] ** 2).mean()) < 0.65
    assert np.sqrt((last[:, 3:] ** 2).mean()) < 0.03
    assert np.abs(last[:, :3].mean(axis=0)).max() < 0.12
    assert np.abs(last[:, 3:].mean(axis=0)).max() < 0.005


# ----------------------------------------------------------------------------------------- outage and gate


def with_outage(
    config: GaussMarkov, runs: int, start_s: float, stop_s: float, seconds: float
) -> PositionErrors:
    """UAV 0 has no fix between two times, UAV 1 always has."""
    rng = np.random.default_rng(5)
    epochs = round(seconds * config.rate_hz) + 1
    time = np.arange(epochs) / config.rate_hz
    available = np.ones((epochs, runs, 2), dtype=bool)
    available[(time >= start_s - 1e-9) & (time < stop_s - 1e-9), :, 0] = False
    return gauss_markov_errors(
        config,
        rng.normal(size=(runs, 2, 3, epochs)),
        np.zeros((runs, 1, 3, epochs)),
        rng.random((runs, 2, 3)),
        available,
    )


def test_in_an_outage_the_covariance_grows_with_the_error() -> None:
    config = paper(filter_coast_sigma_m=3.0)
    flight = flown(config, 70.0, uavs=2, errors=with_outage(config, RUNS, 20.0, 60.0, 70.0))
    sigma = np.sqrt(np.einsum("...ii->...i", flight.covariance[..., :3, :3]))
    rms = np.sqrt((flight.error[..., 0, :3] ** 2).mean(axis=(1, 2)))
    at = {second: round(second / 0.2) for second in (19.8, 25.0, 40.0, 59.8, 60.2)}
    assert sigma[at[40.0], :, 0].mean() > 3.0 * sigma[at[19.8], :, 0].mean()
    out = (flight.time_s >= 20.0) & (flight.time_s < 60.0)
    assert (np.diff(sigma[out][:, :, 0], axis=0) > 0.0).all()
    for second in (25.0, 40.0, 59.8):
        assert rms[at[second]] == pytest.approx(np.sqrt((sigma[at[second], :, 0] ** 2).mean()), rel=0.12)
    # The other UAV has no outage and knows nothing of this one.
    assert sigma[at[59.8], :, 1].max() < 2.0
    assert flight.available[..., 1].all()
    # Available while the widest axis is below 3 m, and again with the first fix.
    expected = (sigma[..., 0, :].max(-1) <= 3.0) | ~out[:, None]
    np.testing.assert_array_equal(flight.available[..., 0], expected)
    assert flight.available[at[25.0], :, 0].all()
    assert not flight.available[at[59.8], :, 0].any()
    assert flight.nees()[0][at[60.2] :].mean() == pytest.approx(1.0, abs=0.15)


@dataclass(frozen=True)
class Spoiled:
    """Errors with something added to, or made of, UAV 0's fix between two times."""

    good: PositionErrors
    start_s: float
    stop_s: float
    jump_m: float = 0.0
    sigma_m: float | None = None

    @property
    def period_s(self) -> float:
        return self.good.period_s

    def fix(self, epoch: int) -> Fix:
        fix = self.good.fix(epoch)
        if not self.start_s - 1e-9 <= epoch * self.period_s < self.stop_s - 1e-9:
            return fix
        error, covariance = fix.error.copy(), fix.covariance.copy()
        error[:, 0, 1] += self.jump_m
        if self.sigma_m is not None:
            covariance[:, 0, 1, 1] = math.copysign(self.sigma_m**2, self.sigma_m)
        return replace(fix, error=error, covariance=covariance)


@dataclass(frozen=True)
class Misshapen:
    """Errors whose fixes are of the given shapes from the second epoch on."""

    good: PositionErrors
    changes: dict[str, Any]

    @property
    def period_s(self) -> float:
        return self.good.period_s

    def fix(self, epoch: int) -> Fix:
        fix = self.good.fix(epoch)
        return replace(fix, **self.changes) if epoch else fix


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"error": np.zeros((1, 3, 3))}, r"error of shape \(1, 3, 3\), must be \(2, 3, 3\)"),
        ({"error": np.zeros((2, 3))}, r"error of shape \(2, 3\), must be \(2, 3, 3\)"),
        ({"covariance": np.zeros((1, 3, 3, 3))}, r"covariance of shape .*, must be \(2, 3, 3, 3\)"),
        ({"covariance": np.zeros((2, 3, 3))}, r"covariance of shape .*, must be \(2, 3, 3, 3\)"),
        ({"available": np.ones((1, 3), dtype=bool)}, r"available of shape \(1, 3\), must be \(2, 3\)"),
        ({"common_factor": np.zeros((2, 1, 3, 1))}, r"common_factor of shape .*, must be \(2, 3, 3, rank\)"),
        ({"common_factor": np.zeros((2, 3, 3))}, r"common_factor of shape .*, must be \(2, 3, 3, rank\)"),
        ({"protection": np.zeros((1, 3, 2))}, r"protection of shape .*, must be \(2, 3, 2\)"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("kind", ["kalman", "point_mass"])
def test_a_fix_of_another_shape_is_named(kind: str, changes: dict[str, Any], words: str) -> None:
    """Compiled filters check no bounds: with too few runs they would read past the end."""
    config = paper(filter=kind)
    errors = Misshapen(position_errors(config, 11, range(2), 3, 5.0, None), changes)
    with pytest.raises(ValueError, match=rf"fix of epoch 1 has {words}"):
        flown(config, 2.0, runs=2, uavs=3, errors=errors)


def spoiled(start_s: float, stop_s: float, config: GaussMarkov | None = None, **what: Any) -> Flown:
    config = config or paper()
    errors = position_errors(config, 11, range(20), UAVS, 45.0, None)
    return flown(config, 40.0, runs=20, errors=Spoiled(errors, start_s, stop_s, **what))


def test_a_jump_of_50_m_is_kept_out() -> None:
    """Two seconds of multipath on one axis: refused, counted, and gone; the others never notice."""
    good, jumped = spoiled(0.0, 0.0), spoiled(20.0, 22.0, jump_m=50.0)
    difference = np.abs(jumped.error - good.error)[..., :3]
    assert difference[..., 0, :].max() < 1.5
    np.testing.assert_array_equal(difference[..., 1:, :], 0.0)
    assert jumped.navigation.gated_fixes.tolist() == [20] * 20
    assert jumped.available.all()
    assert jumped.nees()[0][:, :, 0].mean() < 1.2


def test_without_a_gate_the_jump_goes_through() -> None:
    open_wide = spoiled(20.0, 22.0, paper(innovation_gate_sigma=0.0), jump_m=50.0)
    assert np.abs(open_wide.error[..., 0, 1]).max() > 10.0
    assert open_wide.navigation.gated_fixes.sum() == 0


def test_a_filter_that_refuses_everything_starts_anew() -> None:
    """A jump that stays: after three seconds of refusals the filter believes it."""
    moved = spoiled(20.0, 99.0, jump_m=50.0)
    error = moved.error[:, :, 0, 1]
    before, after = (round((20.0 + GATE_PATIENCE_S + s) / 0.2) for s in (-0.4, 0.4))
    assert np.abs(error[before]).max() < 8.0
    assert np.abs(error[after] - 50.0).max() < 25.0
    # It knows no more than its fix at first, and says so.
    sigma = np.sqrt(moved.covariance[after, :, 0, 1, 1])
    assert (sigma > 0.9).all()
    np.testing.assert_array_equal(moved.navigation.gated_fixes, round(GATE_PATIENCE_S * 10))
    assert np.abs(error[-1] - 50.0).max() < 8.0


def test_refused_fixes_do_not_make_a_solution_available() -> None:
    config = paper(filter_coast_sigma_m=0.01)
    flight = spoiled(20.0, 22.0, config, jump_m=50.0)
    during = (flight.time_s >= 20.0 - 1e-9) & (flight.time_s < 22.0 - 1e-9)
    assert not flight.available[during][..., 0].any()
    assert flight.available[~during].all()
    assert flight.available[..., 1:].all()


@pytest.mark.parametrize(
    "what", [{"jump_m": np.nan}, {"jump_m": np.inf}, {"sigma_m": 0.0}, {"sigma_m": -2.0}, {"sigma_m": np.nan}]
)
@pytest.mark.parametrize("gate", [0.0, 5.0])
def test_unusable_fixes_are_refused(what: dict[str, float], gate: float) -> None:
    """Not a number, or a sigma of zero, below zero, or none: unknown, never certain; also without a gate."""
    flight = spoiled(20.0, 21.0, paper(innovation_gate_sigma=gate), **what)
    assert np.isfinite(flight.error).all()
    assert np.isfinite(flight.covariance).all()
    assert flight.navigation.gated_fixes.tolist() == [10] * 20
    assert np.abs(flight.error[..., :3]).max() < 20.0


def test_a_first_fix_that_is_not_a_number_is_never_a_place() -> None:
    flight = spoiled(0.0, 1.0, jump_m=np.nan)
    assert np.isnan(flight.error[0, :, 0]).all()
    assert not flight.available[0, :, 0].any()
    assert flight.available[0, :, 1:].all()
    assert not flight.solutions[0].trusted()[:, 0].any()
    assert np.isfinite(flight.error[-1]).all()


# -------------------------------------------------------------------------------------- what UAVs share


def test_what_two_uavs_share_is_what_their_errors_share() -> None:
    """c = 0.9, 250 runs: mean of e_i e_j over pairs is Sigma_ij, at five times within 4 standard errors."""
    flight = flown(paper(common_mode_share=0.9), 30.0, runs=250, every=50)
    pairs = list(combinations(range(UAVS), 2))
    relative, naive = [], []
    for nav, error in zip(flight.solutions, flight.error[..., :3], strict=True):
        factor = nav.common_factor
        shared = np.einsum("riak,rjbk->rijab", factor, factor)
        if nav.time_s in (0.0, 1.0, 5.0, 15.0, 29.0):
            off = np.array([error[:, i] * error[:, j] - shared[:, i, j].diagonal(0, 1, 2) for i, j in pairs])
            each = off.mean(axis=0).ravel()  # axes and runs are independent, pairs are not
            assert abs(each.mean()) < 4.0 * each.std() / math.sqrt(each.size), nav.time_s
        own = np.sqrt(np.einsum("riiaa->ria", shared))
        assert (own**2 <= nav.position_covariance.diagonal(0, 2, 3) * (1.0 + 1e-9)).all()
        for i, j in pairs:
            miss = error[:, i] - error[:, j]
            variance = nav.relative_covariance(i, j).diagonal(0, 1, 2)
            relative.append((miss**2 / variance).mean())
            less = nav.position_covariance[:, i] + nav.position_covariance[:, j]
            less = less.diagonal(0, 1, 2) - 2.0 * own[:, i] * own[:, j]
            naive.append((miss**2 / less).mean())
    assert np.mean(relative) == pytest.approx(1.0, abs=0.06)
    # Sigmas that swing apart make UAVs trust different moments: far from fully correlated.
    assert np.mean(naive[len(naive) // 2 :]) > 2.0


def test_between_fixes_what_is_shared_falls_with_the_whole() -> None:
    """One fix a second: in between the variance may fall, and a share beyond it would not be trusted."""
    config = paper(common_mode_share=1.0, sigma_min_m=0.02, sigma_max_m=0.1, sigma_period_s=5.0, rate_hz=1.0)
    flight = flown(config, 20.0, runs=3, every=5)
    fell = 0
    for tick, (before, nav) in enumerate(pairwise(flight.solutions), 1):
        falls = nav.position_covariance < before.position_covariance * (1.0 - 1e-3)
        fell += np.count_nonzero(falls) if tick % 10 else 0  # a fix at every tenth
        assert nav.trusted().all(), nav.time_s
    assert fell > 100


def test_without_the_epoch_that_is_due_what_is_shared_is_carried_on() -> None:
    """Whoever steps the filter by hand may go on without a fix for as long as they like."""
    model = FilterModel.of_navigation(paper(common_mode_share=0.5), 0.02, 5)
    kalman, still, on = KalmanFilter(model, 1, 2), np.zeros((1, 2, 3)), np.ones(1, dtype=bool)
    covariance, fixes = np.tile(4.0 * np.eye(3), (1, 2, 1, 1)), np.ones((1, 2), dtype=bool)
    for _ in range(3):
        kalman.correct(still, still, covariance, fixes, True, on)
    shared = kalman._common[0, 0, 0, 1].copy()
    assert shared[0, 0] > 1.0
    a = np.zeros((4, 4))  # position, velocity, error of fixes, bias: p' = v, v' = -b
    a[0, 1], a[1, 3], a[3, 3] = 1.0, -1.0, np.log(model.bias_memory) / 0.02
    for tick in range(1, 21):
        kalman.predict(still, on)
        nav = kalman.solution(0.02 * tick, still, still)
        factor = nav.common_factor[0]
        carried = expm(0.02 * tick * a)
        expected = (carried @ shared @ carried.T)[0, 0]
        assert (factor[0] @ factor[1].T)[0, 0] == pytest.approx(expected, rel=1e-4)


def test_uavs_with_one_sigma_share_all_that_is_common() -> None:
    """Same sigma at all times: the same gains, so the shares of error and of covariance are one."""
    for share in (0.3, 1.0):
        nav = flown(
            paper(common_mode_share=share, sigma_min_m=3.0, sigma_max_m=3.0), 10.0, runs=2, every=499
        ).solutions[-1]
        shared = np.einsum("riak,rjbk->rijab", nav.common_factor, nav.common_factor)
        for a in range(3):
            np.testing.assert_allclose(shared[:, 0, 1, a, a], shared[:, 2, 2, a, a], rtol=1e-9)
        part = shared[:, 0, 0, 0, 0] / nav.covariance[:, 0, 0, 0]
        assert (part <= share).all()
        assert (part > 0.95 * share).all()
        np.testing.assert_allclose(shared[:, 0, 1, 0, 1], 0.0, atol=1e-12)


def test_the_factor_begins_as_that_of_the_fix() -> None:
    config = paper(common_mode_share=0.5)
    fix = position_errors(config, 11, range(3), UAVS, 1.0, None).fix(0)
    nav = flown(config, 0.1, runs=3).solutions[0]
    for i, j in combinations(range(UAVS), 2):
        np.testing.assert_allclose(
            np.einsum("rak,rbk->rab", nav.common_factor[:, i], nav.common_factor[:, j]),
            np.einsum("rak,rbk->rab", fix.common_factor[:, i], fix.common_factor[:, j]),
            atol=1e-9,
        )


def test_nothing_is_shared_without_a_share_and_in_large_formations() -> None:
    assert not flown(paper(), 1.0, runs=1).solutions[-1].common_factor.any()
    many = flown(paper(common_mode_share=0.9), 1.0, runs=1, uavs=cross_covariance.MAX_UAVS + 1)
    assert not many.solutions[-1].common_factor.any()
    assert flown(paper(common_mode_share=0.9), 1.0, runs=1, uavs=16).solutions[-1].common_factor.any()


def test_a_uav_that_starts_anew_shares_nothing_at_first() -> None:
    config = paper(common_mode_share=0.9)
    errors = Spoiled(position_errors(config, 11, range(5), UAVS, 30.0, None), 10.0, 99.0, jump_m=50.0)
    flight = flown(config, 13.2, runs=5, errors=errors, every=TICKS)
    anew = int(np.argmax(flight.error[:, 0, 0, 1] > 30.0))
    assert flight.time_s[anew] == pytest.approx(10.0 + GATE_PATIENCE_S)
    factor = flight.solutions[anew].common_factor
    shared = np.einsum("riak,rjbk->rijab", factor, factor)
    np.testing.assert_allclose(shared[:, 0, 1:], 0.0, atol=1e-12)
    assert (np.abs(shared[:, 1, 2].diagonal(0, 1, 2)) > 0.0).all()


# ------------------------------------------------------------------------------------------------ recorded


def mini_log(folder: Path, seconds: int = 3000, gap: bool = False) -> None:
    """Made-up log at 1 Hz: 4 m east, 3 m north, correlated by 0.6, 8 s; gaps of 20 s every 100 s if asked."""
    rng = np.random.default_rng(8)
    phi = math.exp(-1.0 / 8.0)
    unit = rng.normal(size=(seconds, 2))
    for k in range(1, seconds):
        unit[k] = phi * unit[k - 1] + math.sqrt(1.0 - phi * phi) * unit[k]
    east = 4.0 * unit[:, 0]
    north = 3.0 * (0.6 * unit[:, 0] + 0.8 * unit[:, 1])
    header = (
        "t_s,available,err_e_m,err_n_m,err_u_m,cov_ee_m2,cov_en_m2,cov_eu_m2,cov_nn_m2,cov_nu_m2,cov_uu_m2"
    )
    lines = [header]
    for k in range(seconds):
        there = int(not (gap and k % 100 >= 80))
        numbers = f"{east[k]:.6f},{north[k]:.6f},0.0,16.0,7.2,0.0,9.0,0.0,25.0" if there else ",,,,,,,,"
        lines.append(f"{k},{there},{numbers}")
    (folder / "log.csv").write_text("\n".join(lines) + "\n")


def recorded(**changes: Any) -> Recorded:
    settings = {"kind": "recorded", "file": "log.csv", "filter": "kalman", "filter_correlation_time_s": 8.0}
    return Recorded.model_validate(settings | changes)


def test_a_log_is_filtered_with_its_barometer(tmp_path: Path) -> None:
    """A log that obeys the filter's law: consistent, and the covariance between axes is the errors'."""
    mini_log(tmp_path, seconds=20_000)
    flight = flown(recorded(), 40.0, folder=tmp_path)
    whole, position = flight.nees()
    assert whole.mean() == pytest.approx(1.0, abs=0.05)
    assert position.mean() == pytest.approx(1.0, abs=0.08)
    late = flight.time_s >= 15.0
    error, covariance = flight.error[late], flight.covariance[late]
    rms = np.sqrt((error**2).mean(axis=(0, 1, 2)))
    assert rms[0] < 0.75 * 4.0
    assert rms[1] < 0.75 * 3.0
    assert rms[2] == pytest.approx(0.97, abs=0.06)  # 1 m over 300 s: it cannot be averaged away
    assert covariance[..., 0, 1].mean() == pytest.approx((error[..., 0] * error[..., 1]).mean(), rel=0.15)
    assert covariance[..., 0, 1].mean() > 0.4 * rms[0] * rms[1]
    np.testing.assert_array_equal(covariance[..., 2, :2], 0.0)
    assert np.linalg.eigvalsh(flight.covariance).min() > 0.0
    # Along the two diagonals of the plane, where the axes alone would say the same.
    for sign in (1.0, -1.0):
        along = (error[..., 0] + sign * error[..., 1]) / math.sqrt(2.0)
        variance = 0.5 * (covariance[..., 0, 0] + covariance[..., 1, 1]) + sign * covariance[..., 0, 1]
        assert (along**2).mean() == pytest.approx(variance.mean(), rel=0.2)


def test_a_sample_that_is_held_is_not_measured_again(tmp_path: Path) -> None:
    """Fixes at 10 Hz from a log at 1 Hz: sigma falls once a second, while the barometer's goes on."""
    mini_log(tmp_path)
    flight = flown(recorded(), 6.0, runs=3, folder=tmp_path, every=TICKS)
    sigma = np.sqrt(flight.covariance[:, 0, 0, 0, 0])
    falls = np.flatnonzero(np.diff(sigma) < 0.0) + 1
    np.testing.assert_allclose(flight.time_s[falls], [1.0, 2.0, 3.0, 4.0, 5.0])


def test_a_barometer_needs_no_fix(tmp_path: Path) -> None:
    """Gaps of 20 s: the horizontal sigma grows, the height's does not, and both stay honest."""
    mini_log(tmp_path, gap=True)
    flight = flown(recorded(gaps="outage", filter_coast_sigma_m=1e3), 60.0, runs=80, folder=tmp_path)
    sigma = np.sqrt(np.einsum("...ii->...i", flight.covariance))
    out = ~np.array([nav.available for nav in flight.solutions])
    assert not out.any()  # coasting
    assert flight.nees()[0].mean() == pytest.approx(1.0, abs=0.08)
    late = flight.time_s > 20.0
    assert sigma[late][..., 2].max() < 1.05
    assert sigma[late][..., 0].max() > 3.0
    assert np.sqrt((flight.error[late][..., 2] ** 2).mean()) == pytest.approx(0.97, abs=0.1)


def test_the_measured_log(data_folder: Path) -> None:
    """Nagoya: real errors obey no such law. The filter helps threefold, and its sigma is too small."""
    settings = {"file": "gnss_nagoya_spp/nav_error_enu_1Hz.csv", "filter_correlation_time_s": 3.0}
    config = recorded(**settings)
    flight = flown(config, 60.0, runs=100, folder=data_folder)
    late = flight.time_s >= 12.0
    rms = np.sqrt((flight.error[late][..., :2] ** 2).mean())
    errors = position_errors(config, 11, range(100), UAVS, 60.0, data_folder)
    raw = np.sqrt(np.mean([errors.fix(k).error[..., :2] ** 2 for k in range(120, 600, 10)]))
    assert raw > 8.0
    assert rms < 0.4 * raw
    assert 1.2 < flight.nees()[1].mean() < 4.0


# ------------------------------------------------------------------------------------- sensors and streams


def test_sensors_err_as_the_problem_says() -> None:
    """3600 series at rest: sigma of the GNSS velocity, of the bias and of the noise, and the bias' memory."""
    config = paper(accelerometer_bias_time_s=2.0, accelerometer_noise_mps_rts=0.002)
    still = np.zeros((300, 4, 3))
    sensors = Sensors(config, 3, range(300), 4, TICK_S, still)
    speed = np.array([sensors.gnss_velocity(still) for _ in range(20)])
    assert speed.std() == pytest.approx(0.1, rel=0.03)
    assert abs((speed[1:] * speed[:-1]).mean()) < 0.03 * 0.01
    change = np.array([sensors.velocity_change(still) for _ in range(200)]) / TICK_S
    assert (change**2).mean() == pytest.approx(0.05**2 + 0.002**2 / TICK_S, rel=0.06)
    assert (np.diff(change, axis=0) ** 2).mean() == pytest.approx(
        2.0 * (0.002**2 / TICK_S + 0.05**2 * 0.01), rel=0.03
    )
    for lag in (50, 100):
        assert (change[lag:] * change[:-lag]).mean() == pytest.approx(
            0.05**2 * math.exp(-lag * TICK_S / 2.0), rel=0.15
        )


def test_error_scale_is_on_every_sensor() -> None:
    still = np.zeros((3, 4, 3))
    for scale in (0.0, 2.0):
        one, other = (Sensors(paper(error_scale=s), 3, range(3), 4, TICK_S, still) for s in (1.0, scale))
        np.testing.assert_allclose(other.gnss_velocity(still), scale * one.gnss_velocity(still), atol=1e-15)
        for _ in range(3):
            np.testing.assert_allclose(
                other.velocity_change(still), scale * one.velocity_change(still), atol=1e-15
            )


@pytest.mark.parametrize("ahead", [1, 7, 100])
def test_numbers_do_not_depend_on_how_far_ahead_they_are_drawn(ahead: int) -> None:
    sequence = NormalSequence(5, range(3, 6), Stream.ACCELEROMETER_NOISE, 2, 3, ahead)
    taken = np.array([sequence.take().copy() for _ in range(40)])
    whole = normals(5, range(3, 6), Stream.ACCELEROMETER_NOISE, 2, 3, 40)
    np.testing.assert_array_equal(taken, np.moveaxis(whole, -1, 0))


def test_streams_keep_their_numbers() -> None:
    assert (Stream.GNSS_VELOCITY, Stream.ACCELEROMETER_BIAS, Stream.ACCELEROMETER_NOISE) == (7, 8, 9)


def test_a_run_is_filtered_alike_in_any_block() -> None:
    config = paper(common_mode_share=0.5, outage_interval_s=5.0, outage_duration_s=2.0)
    whole = flown(config, 12.0, runs=range(6))
    for first, stop in pairwise((0, 1, 4, 6)):
        part = flown(config, 12.0, runs=range(first, stop))
        np.testing.assert_array_equal(part.error, whole.error[:, first:stop])
        np.testing.assert_array_equal(part.covariance, whole.covariance[:, first:stop])
        for a, b in zip(part.solutions, whole.solutions, strict=True):
            np.testing.assert_array_equal(a.common_factor, b.common_factor[first:stop])


def test_the_truth_reaches_the_solution_through_sensors_only() -> None:
    """Arrays of the truth turned to NaN after each call: nothing of them is kept but what was measured."""
    config = paper()
    errors = position_errors(config, 1, range(2), 3, 3.0, None)
    results = []
    for poison in (False, True):
        navigation = FilteredNavigation(config, errors, 1, range(2), TICK_S, TICKS, truth(0.0, 2, 3)[1])
        for tick in range(100):
            state = [part.copy() for part in truth(tick * TICK_S, 2, 3)] + [
                np.ones((2, 3, 3)) for _ in range(2)
            ]
            nav = navigation.solution(tick, tick * TICK_S, *state, np.ones(2, dtype=bool))
            if poison:
                for part in state:
                    part[...] = np.nan
        results.append(nav)
        assert np.abs(nav.velocity - truth(99 * TICK_S, 2, 3)[1]).min() > 1e-6
    for name in ("position", "velocity", "attitude", "body_rates", "covariance"):
        np.testing.assert_array_equal(getattr(results[0], name), getattr(results[1], name))


def test_velocity_comes_from_the_receiver() -> None:
    """A receiver that measures velocity to 20 m/s only: then navigation does not know it either."""
    flight = flown(paper(gnss_velocity_sigma_mps=20.0), 2.0, runs=50)
    first, last = (np.sqrt((flight.error[k][..., 3:] ** 2).mean()) for k in (0, -1))
    assert first == pytest.approx(20.0, rel=0.1)
    assert last > 0.3
    assert flight.nees()[0].mean() == pytest.approx(1.0, abs=0.1)


def test_runs_that_are_over_are_left_alone() -> None:
    kf = KalmanFilter(FilterModel.of_navigation(paper(common_mode_share=0.5), TICK_S, TICKS), 2, 2)
    zero, there = np.zeros((2, 2, 3)), np.ones((2, 2), dtype=bool)
    reported = np.broadcast_to(4.0 * np.eye(3), (2, 2, 3, 3))
    kf.correct(zero, zero, reported, there, True, np.ones(2, dtype=bool))
    before = kf.solution(0.0, zero, zero)
    only = np.array([False, True])
    kf.predict(zero + 1.0, only)
    kf.correct(zero + 99.0, zero, reported, there, True, only)
    after = kf.solution(0.1, zero, zero)
    np.testing.assert_array_equal(after.position[0], before.position[0])
    np.testing.assert_array_equal(after.covariance[0], before.covariance[0])
    np.testing.assert_array_equal(after.common_factor[0], before.common_factor[0])
    assert kf.refused_fixes.tolist() == [[0, 0], [1, 1]]


# -------------------------------------------------------------------------------------- in the closed loop


def short(*settings: str) -> Problem:
    base = ["navigation.filter=kalman", "mission.length_m=30", "simulation.time_limit_s=22"]
    scene = ["world.count=3", "world.along_range_m=[8, 24]"]
    return load_problem("study_8s", [*base, *scene, *settings])


def test_rows_carry_consistency_and_refusals_whatever_the_block() -> None:
    problem = short("navigation.common_mode_share=0.3")
    whole = fly_block(problem, ["napf"], 3, range(6)).rows
    parts = [fly_block(problem, ["napf"], 3, range(a, b)).rows for a, b in pairwise((0, 1, 6))]
    for name, values in whole.items():
        np.testing.assert_array_equal(np.concatenate([part[name] for part in parts]), values, err_msg=name)
    assert (np.abs(whole["nees"] - 1.0) < 0.7).all()
    assert (whole["nees_position"] > 0.0).all()
    assert (whole["gated_fixes"] == 0.0).all()
    plain = fly_block(short("navigation.filter=none"), ["napf"], 3, range(2)).rows
    for name in ("nees", "nees_position", "gated_fixes"):
        assert np.isnan(plain[name]).all()


def test_a_judge_sees_what_the_filter_says_of_itself() -> None:
    """Half the sigma claimed: NEES of a run well above 1; twice: below."""
    low, high = (
        simulate(short(f"navigation.reported_sigma_scale={scale}"), "napf", runs=6).score.metrics
        for scale in (0.5, 2.0)
    )
    assert low["nees_position"].mean() > 2.0
    assert high["nees_position"].mean() < 0.5
    assert low["gated_fixes"].sum() > 0


def test_without_noise_it_flies_as_on_the_truth() -> None:
    """Filter and covariance as ever, but all sensors exact: path and slots to centimetres, NEES near zero."""
    calm = short("navigation.error_scale=0", "world.count=0")
    metrics = simulate(calm, "napf").score.metrics
    assert metrics["path_rms_m"][0] < 0.03
    assert metrics["shape_floor_m"][0] < 0.01
    assert metrics["nees"][0] < 1e-3


def test_planners_fly_the_same_sensors() -> None:
    """The estimation error does not depend on who flies, but for the trapezoidal rule."""
    errors = []
    for planner in ("apf", "napf"):
        track = simulate(short(), planner, seed=5, runs=2, record_every=5).trajectories
        first = track["t_s"] < 10.0
        errors.append(np.stack([track[f"est_{axis}_m"] - track[f"{axis}_m"] for axis in "xyz"])[:, first])
    np.testing.assert_allclose(errors[0], errors[1], atol=5e-3)
    assert np.abs(errors[0]).max() > 1.0


def test_the_loop_flies_on_the_filters_velocity() -> None:
    """What the inner loop and the judge are given is not the truth's memory, and not its numbers."""
    seen: list[float] = []

    class Look:
        def moved(self, *_: object) -> None:
            pass

        def ticked(self, time_s: float, state: Array, nav: NavSolution, *_: object) -> None:
            for mine in (nav.position, nav.velocity, nav.attitude, nav.body_rates):
                assert not np.shares_memory(mine, state)
            np.testing.assert_array_equal(nav.attitude, state[..., ATTITUDE])
            np.testing.assert_array_equal(nav.body_rates, state[..., RATES])
            assert (nav.position != state[..., POSITION]).all()
            assert (nav.velocity != state[..., VELOCITY]).all()
            seen.append(float(np.abs(nav.velocity - state[..., VELOCITY]).max()))

    problem = short("simulation.time_limit_s=3")
    closed_loop(problem, make_planner("napf", problem), build_scenario(problem, 0, range(2)), (Look(),))
    assert len(seen) == 150
    assert 0.03 < max(seen) < 0.6


# ------------------------------------------------------------------------------------------------- the keys


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("gnss_velocity_sigma_mps", 0.0),
        ("accelerometer_bias_mps2", -0.1),
        ("accelerometer_bias_time_s", 0.0),
        ("accelerometer_noise_mps_rts", 0.0),
        ("innovation_gate_sigma", -1.0),
        ("filter_coast_sigma_m", 0.0),
        ("filter_correlation_time_s", -1.0),
        ("filter", "ekf"),
        ("filter_correlation_time_s", math.inf),
    ],
)
def test_keys_are_limited(key: str, value: object) -> None:
    with pytest.raises(ValidationError, match=key):
        paper(**{key: value})


def test_what_the_filter_takes_as_known_follows_the_problem() -> None:
    model = FilterModel.of_navigation(recorded(common_mode_share=0.5), TICK_S, TICKS)
    np.testing.assert_allclose(-0.1 / np.log(model.error_memory), [8.0, 8.0, 300.0])
    np.testing.assert_array_equal(model.common_share, [0.5, 0.5, 0.0])
    assert model.fixless_axis.tolist() == [False, False, True]
    log = FilterModel.of_navigation(recorded(vertical="recorded"), TICK_S, TICKS)
    np.testing.assert_allclose(log.error_memory, math.exp(-0.1 / 8.0))
    assert not log.fixless_axis.any()
    assert not FilterModel.of_navigation(paper(), TICK_S, TICKS).coupled
