"""Compiled levels: those of the reference, true under faults that are counted, and after exclusion."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

from napf_mpc.navigation.integrity.araim import IntegrityRequirement, RangeErrors, protection_level
from napf_mpc.navigation.integrity.levels import Levels, LevelSettings, NoLevel, protection_levels
from napf_mpc.navigation.pseudorange_solution import SolverSettings, solve
from napf_mpc.risk import wilson
from napf_mpc.streams import Stream, normals, uniforms

# Azimuth and elevation [deg] of eight satellites of one constellation and six of another.
SKY = [
    (10, 20), (60, 45), (105, 15), (150, 65), (200, 35), (245, 75), (290, 25), (335, 50),
    (30, 60), (85, 30), (140, 40), (190, 18), (260, 55), (310, 38),
]  # fmt: skip
CLOCK = np.array([0] * 8 + [1] * 6)
AZIMUTH, ELEVATION = np.deg2rad(np.array(SKY, dtype=float)).T
SIGHT = np.stack(
    [np.cos(ELEVATION) * np.sin(AZIMUTH), np.cos(ELEVATION) * np.cos(AZIMUTH), np.sin(ELEVATION)], axis=-1
)
SIGMA = 1.0 + 1.0 / SIGHT[:, 2]
PLAIN = SolverSettings("plain", exclude=False, max_pdop=1e6)


def levels(ranges: np.ndarray, p_fault: float | np.ndarray, /, **changes: Any) -> Levels:
    """Levels of receivers under one sky."""
    shape = ranges.shape
    values: dict[str, Any] = {
        "directions": np.broadcast_to(SIGHT, (*shape, 3)),
        "clock": CLOCK,
        "ranges": ranges,
        "sigma": np.broadcast_to(SIGMA, shape).copy(),
        "p_fault": np.broadcast_to(p_fault, shape).copy(),
        "usable": np.ones(shape, dtype=bool),
        "settings": LevelSettings(2e-3, 2e-2),
    }
    return protection_levels(**(values | changes))


@pytest.mark.parametrize("p_fault", [0.0, 1e-4, 3e-3, 0.02])
def test_levels_of_all_in_view_are_those_of_the_reference(p_fault: float) -> None:
    """Half of P_HMI goes to sets with exclusion; the rest is the reference's sum, to a centimetre above."""
    mine = levels(np.zeros((1, 14)), p_fault)
    unmonitored = 2e-4
    asked = IntegrityRequirement(
        p_hmi_horizontal=5e-4, p_hmi_vertical=5e-4, p_fa_horizontal=1e-2, p_fa_vertical=1e-2,
        p_unmonitored=unmonitored,
    )  # fmt: skip
    ranges = RangeErrors(SIGHT, CLOCK, SIGMA, np.zeros(14), np.full(14, p_fault), {})
    reference = protection_level(ranges, asked)
    # The reference looks at all hypotheses of a number of faults, this at the likely ones; what is left
    # unmonitored is taken from half of P_HMI there, from all of it here.
    tolerance = 0.02 if p_fault == 0.0 else 0.08 * reference.vertical_m
    assert mine.level_m[0] == pytest.approx([reference.horizontal_m, reference.vertical_m], abs=tolerance)
    assert mine.hypotheses[0] <= max(1, len(reference.prior))


def equation(
    used: np.ndarray, p_fault: np.ndarray, share: float, settings: LevelSettings
) -> tuple[float, float]:
    """HPL and VPL by solving anew without each single satellite: two sides of the whole solution's error, one
    of each hypothesis'."""
    geometry = np.zeros((14, 5))
    geometry[:, :3] = -SIGHT
    geometry[np.arange(14), 3 + CLOCK] = 1.0

    def variances(kept: np.ndarray) -> np.ndarray:
        h = geometry[kept] / SIGMA[kept, None]
        return np.diag(np.linalg.inv(h.T @ h))[:3]

    prior = p_fault / (1.0 - p_fault) * np.prod(1.0 - p_fault)
    left = 1.0 - np.prod(1.0 - p_fault) - prior.sum()
    whole, axes = variances(used), []
    for q, (part, alarms) in enumerate([(0.25, 4.0), (0.25, 4.0), (0.5, 2.0)]):
        budget = part * share * (settings.p_hmi - left)
        factor = norm.isf(settings.p_false_alarm / 2.0 / alarms / 14)

        def beyond(level: float, q: int = q, factor: float = factor) -> float:
            total = 2.0 * norm.sf(level / np.sqrt(whole[q]))
            for s in range(14):
                without = variances(used & (np.arange(14) != s))[q]
                room = level - factor * np.sqrt(max(without - whole[q], 0.0))
                total += prior[s] * norm.sf(room / np.sqrt(without))
            return float(total)

        axes.append(brentq(lambda level, b=budget, f=beyond: f(level) - b, 0.1, 500.0))
    return float(np.hypot(axes[0], axes[1])), float(axes[2])


@pytest.mark.parametrize("bad", [None, 0, 3, 9, 13])
def test_a_level_solves_its_equation(bad: int | None) -> None:
    """To a centimetre: half of P_HMI for all in view, a quarter over 14 for each set without a satellite."""
    p_fault, settings = np.linspace(5e-4, 9e-4, 14), LevelSettings(2e-3, 2e-2)
    used = np.ones(14, dtype=bool)
    ranges = np.zeros((1, 14))
    if bad is not None:
        used[bad], ranges[0, bad] = False, 100.0
    found = levels(ranges, p_fault, settings=settings)
    assert found.hypotheses[0] == 14  # all single faults, and no others
    np.testing.assert_array_equal(found.used[0], used)
    expected = equation(used, p_fault, 0.5 if bad is None else 0.25 / 14, settings)
    assert found.level_m[0].tolist() == pytest.approx(expected, abs=0.02)


def test_a_fault_that_nothing_can_look_at_is_paid_for() -> None:
    """Alone of its constellation a satellite is never contradicted: its chance is spent, or is too much."""
    clock = np.array([0] * 13 + [1])
    rare, twice, often = (np.append(np.full(13, 1e-5), p) for p in (4e-4, 8e-4, 3e-3))
    first, second, third = (levels(np.zeros((1, 14)), p, clock=clock) for p in (rare, twice, often))
    assert third.why[0] == NoLevel.UNMONITORED
    # Of 2e-3 are left 1.6e-3 and 1.2e-3, and a tail of so much less is farther out.
    assert (second.level_m[0] > first.level_m[0] + 0.03).all()


def test_rank_one_changes_are_solutions_without_a_satellite() -> None:
    """A fault that is seen is excluded, and what is left is the plain solution of the others."""
    for bad in range(14):
        ranges = np.where(np.arange(14) == bad, 60.0, 0.0)[None]
        found = levels(ranges, 3e-3)
        assert found.used[0].tolist() == [s != bad for s in range(14)]
        assert found.excluded[0] == 1
        clean = levels(np.zeros((1, 14)), 3e-3)
        assert (found.level_m[0] > clean.level_m[0]).all()  # its share is a fiftieth of that of all in view
        assert (found.level_m[0] < 6.0 * clean.level_m[0]).all()
        answer = solve(SIGHT[None], CLOCK, ranges, SIGMA[None], found.used, PLAIN)
        np.testing.assert_allclose(answer.offset[0], 0.0, atol=1e-9)


@pytest.mark.parametrize("fault_m", [0.0, 12.0, 60.0])
def test_the_error_leaves_the_level_no_more_often_than_asked(fault_m: float) -> None:
    """10,000 epochs, 4 % of signals wrong by so much, P_HMI 0.002: with exclusion, alarms and all."""
    epochs = 10_000
    noise = normals(5, range(1), Stream.OWN_ERROR, 14, 1, epochs)[0, :, 0].T
    faulty = uniforms(5, range(1), Stream.OUTAGE, 14, 1, epochs)[0, :, 0].T < 0.04
    ranges = noise * SIGMA + fault_m * faulty
    found = levels(ranges, 0.04)
    known = np.isfinite(found.level_m).all(-1)
    wide = np.broadcast_to(SIGHT, (epochs, 14, 3))
    spread = np.broadcast_to(SIGMA, (epochs, 14)).copy()
    error = solve(wide, CLOCK, ranges, spread, found.used & known[:, None], PLAIN).offset
    outside = np.hypot(error[:, 0], error[:, 1]) > found.level_m[:, 0]
    outside |= np.abs(error[:, 2]) > found.level_m[:, 1]
    assert wilson(int((known & outside).sum()), epochs).low <= 2e-3
    assert known.mean() > 0.9
    if fault_m == 0.0:
        assert (found.excluded > 0).mean() < 0.02  # false alarms
    if fault_m == 60.0:
        several = faulty.sum(-1)
        assert (found.excluded[known & (several == 1)] == 1).mean() > 0.95
        plain = solve(wide, CLOCK, ranges, spread, np.ones_like(faulty), PLAIN)
        k_sigma = 3.5 * np.sqrt(plain.covariance[:, 2, 2])
        assert (np.abs(plain.offset[:, 2]) > k_sigma).mean() > 0.05  # what 3.5 sigma are worth here


def test_levels_do_not_depend_on_who_else_there_is() -> None:
    ranges = normals(6, range(1), Stream.OWN_ERROR, 14, 1, 40)[0, :, 0].T * 3.0
    together, alone = levels(ranges, 0.01), levels(ranges[17:18], 0.01)
    np.testing.assert_array_equal(together.level_m[17:18], alone.level_m)
    np.testing.assert_array_equal(together.used[17:18], alone.used)


def test_where_there_is_no_level_it_says_why() -> None:
    few = np.zeros((1, 14), dtype=bool)
    few[0, [0, 1, 2, 8, 9]] = True  # five satellites of two systems; six are needed
    found = levels(np.zeros((1, 14)), 1e-3, usable=few)
    assert (NoLevel(int(found.why[0])), found.level_m[0].tolist()) == (NoLevel.FEW, [math.inf, math.inf])
    likely = levels(np.zeros((1, 14)), 0.5)
    assert likely.why[0] == NoLevel.UNMONITORED
    wild = levels(100.0 * np.arange(14.0)[None] ** 2, 1e-3)
    assert wild.why[0] in (NoLevel.ALARM, NoLevel.FEW)
    assert np.isinf(wild.level_m).all()


def test_more_satellites_than_it_looks_at_lose_the_likelier_faulty() -> None:
    sight = np.concatenate([SIGHT] * 3)
    p = np.full(42, 1e-3)
    p[[3, 7, 20, 21, 22, 30, 31, 38, 39, 40]] = 5e-3
    found = protection_levels(
        sight[None], np.zeros(42, dtype=np.int64), np.zeros((1, 42)), np.full((1, 42), 2.0), p[None],
        np.ones((1, 42), dtype=bool), LevelSettings(),
    )  # fmt: skip
    assert found.used[0].sum() == 32
    assert not found.used[0, p == 5e-3].any()


@pytest.mark.parametrize(("sigma_m", "p_fault"), [(0.0, 1e-3), (2.0, 1.0)])
def test_what_is_no_sky(sigma_m: float, p_fault: float) -> None:
    with pytest.raises(ValueError, match="ranges must be finite, sigma > 0 and 0 <= p_fault < 1"):
        levels(np.zeros((1, 14)), p_fault, sigma=np.full((1, 14), sigma_m))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"clock": CLOCK + 5}, r"clock must hold whole numbers from 0 to 3, got 5 to 6"),
        ({"clock": CLOCK - 1}, r"clock must hold whole numbers from 0 to 3, got -1 to 0"),
        ({"clock": CLOCK.astype(float)}, r"clock must hold whole numbers from 0 to 3, got float64"),
        ({"clock": CLOCK[:3]}, r"clock has shape \(3,\), must be \(14,\)"),
        ({"directions": SIGHT[None, :5]}, r"directions has shape \(1, 5, 3\), must be \(1, 14, 3\)"),
        ({"sigma": SIGMA}, r"sigma has shape \(14,\), must be \(1, 14\)"),
        ({"p_fault": np.full(14, 1e-3)}, r"p_fault has shape \(14,\), must be \(1, 14\)"),
        ({"usable": np.ones((1, 13), dtype=bool)}, r"usable has shape \(1, 13\), must be \(1, 14\)"),
        ({"usable": np.ones((1, 14), dtype=int)}, r"usable must be an array of bool, got int64"),
        ({"ranges": np.zeros(14)}, r"ranges has shape \(14,\), must be \(receiver, sat\)"),
        ({"directions": 10.0 * SIGHT[None]}, r"directions must be unit vectors wherever a range is usable"),
        ({"directions": np.full((1, 14, 3), np.nan)}, r"directions must be unit vectors wherever"),
    ],
)  # fmt: skip
def test_what_does_not_fit_together(changes: dict[str, Any], words: str) -> None:
    """Compiled code checks no bounds: each of these was a crash, or a level of the wrong satellites."""
    with pytest.raises(ValueError, match=words):
        levels(np.zeros((1, 14)), 1e-3, **changes)


def test_where_no_range_is_usable_directions_may_be_anything() -> None:
    usable = np.arange(14)[None] != 4
    sight = np.where(usable[..., None], SIGHT, np.nan)
    known = levels(np.zeros((1, 14)), 1e-3, usable=usable)
    np.testing.assert_array_equal(
        levels(np.zeros((1, 14)), 1e-3, usable=usable, directions=sight).level_m, known.level_m
    )
    assert np.isfinite(known.level_m).all()


def test_a_clock_of_any_whole_type_is_the_same_clock() -> None:
    ranges = normals(6, range(1), Stream.OWN_ERROR, 14, 1, 1)[0, :, 0].T * 3.0
    wide = levels(ranges, 0.01).level_m
    np.testing.assert_array_equal(levels(ranges, 0.01, clock=CLOCK.astype(np.int8)).level_m, wide)


def test_what_cannot_be_asked() -> None:
    with pytest.raises(ValueError, match="p_hmi = 0"):
        LevelSettings(p_hmi=0.0)
