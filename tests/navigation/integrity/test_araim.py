"""Protection levels hold: limits that are known, and faults injected until they can be counted."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from scipy import special

from napf_mpc.navigation.integrity.araim import (
    IntegrityRequirement,
    ProtectionLevel,
    RangeErrors,
    protection_level,
)
from napf_mpc.risk import wilson
from napf_mpc.streams import Stream, normals, uniforms

# Azimuth and elevation [deg] of eight satellites of one constellation and six of another.
SKY = [
    (10, 20), (60, 45), (105, 15), (150, 65), (200, 35), (245, 75), (290, 25), (335, 50),
    (30, 60), (85, 30), (140, 40), (190, 18), (260, 55), (310, 38),
]  # fmt: skip
COUNTABLE = IntegrityRequirement(
    p_hmi_horizontal=1e-3, p_hmi_vertical=1e-3, p_fa_horizontal=1e-2, p_fa_vertical=1e-2, p_unmonitored=1e-4
)


def directions(sky: list[tuple[int, int]]) -> np.ndarray:
    az, el = np.deg2rad(np.array(sky, dtype=float)).T
    return np.stack([np.cos(el) * np.sin(az), np.cos(el) * np.cos(az), np.sin(el)], axis=-1)


def ranges(count: int = 14, **changes: Any) -> RangeErrors:
    sight = directions(SKY[:count])
    values: dict[str, Any] = {
        "line_of_sight": sight,
        "constellation": np.array([0] * 8 + [1] * 6)[:count],
        "sigma_m": 1.0 + 1.0 / sight[:, 2],
        "bias_m": np.full(count, 0.5),
        "p_satellite": np.full(count, 1e-2),
        "p_constellation": {},
    }
    return RangeErrors(**(values | changes))


def least_squares(r: RangeErrors) -> tuple[np.ndarray, np.ndarray]:
    """Gain (3, n) and sigma (3,) of the plain solution, by other means than the code under test."""
    clocks = np.unique(r.constellation)
    h = np.hstack([-r.line_of_sight, (r.constellation[:, None] == clocks).astype(float)])
    root = h / r.sigma_m[:, None]
    gain = np.linalg.pinv(root) / r.sigma_m
    return gain[:3], np.sqrt(np.diag(np.linalg.inv(root.T @ root))[:3])


def test_without_possible_faults_it_is_k_sigma_and_bias() -> None:
    r = ranges(p_satellite=np.zeros(14))
    level = protection_level(r, COUNTABLE)
    gain, sigma = least_squares(r)
    bias = np.abs(gain) @ r.bias_m
    k = -special.ndtri(np.array([1e-3 / 4, 1e-3 / 4, 1e-3 / 2]))
    np.testing.assert_allclose(level.axis_m, bias + k * sigma, atol=1e-5)
    assert level.horizontal_m == pytest.approx(math.hypot(level.axis_m[0], level.axis_m[1]))
    assert (len(level.prior), level.p_unmonitored) == (0, 0.0)


def test_one_likely_hypothesis_is_threshold_bias_and_k_of_its_own_solution() -> None:
    """One satellite that may fail and is nearly always looked at: its own term decides the level."""
    p = np.zeros(14)
    p[2] = 0.5
    r = ranges(p_satellite=p)
    level = protection_level(r, COUNTABLE)
    assert level.excluded.tolist() == [[i == 2 for i in range(14)]]
    others = [i for i in range(14) if i != 2]
    without = RangeErrors(
        **{
            f.name: (v[others] if isinstance(v := getattr(r, f.name), np.ndarray) else v)
            for f in dataclasses.fields(r)
        }
    )
    gain, _ = least_squares(r)
    gain_without, sigma_without = least_squares(without)
    apart = gain.copy()
    apart[:, others] -= gain_without
    threshold = -special.ndtri(np.array([1e-2 / 4, 1e-2 / 4, 1e-2 / 2])) * np.sqrt(apart**2 @ r.sigma_m**2)
    np.testing.assert_allclose(level.threshold_m[0], threshold, rtol=1e-9)
    bias = np.abs(gain_without) @ without.bias_m
    _, sigma = least_squares(r)
    fault_free = 2.0 * special.ndtr(-(level.axis_m - np.abs(gain) @ r.bias_m) / sigma)
    faulty = 0.5 * special.ndtr(-(level.axis_m - threshold - bias) / sigma_without)
    np.testing.assert_allclose(fault_free + faulty, [5e-4, 5e-4, 1e-3], rtol=1e-4)


def test_more_is_asked_or_more_can_fail_and_the_level_grows() -> None:
    base = protection_level(ranges(), COUNTABLE)
    for other in (
        protection_level(
            ranges(), dataclasses.replace(COUNTABLE, p_hmi_vertical=5e-4, p_hmi_horizontal=5e-4)
        ),
        protection_level(ranges(), dataclasses.replace(COUNTABLE, p_fa_vertical=1e-3, p_fa_horizontal=1e-3)),
        protection_level(ranges(p_satellite=np.full(14, 2e-2)), COUNTABLE),
        protection_level(ranges(p_constellation={1: 1e-3}), COUNTABLE),
        protection_level(ranges(p_nlos=np.full(14, 1e-2)), COUNTABLE),
        protection_level(ranges(bias_m=np.full(14, 1.0)), COUNTABLE),
    ):
        assert other.available
        assert other.vertical_m > base.vertical_m
        assert other.horizontal_m > base.horizontal_m


def test_reflections_need_hypotheses_of_several_at_a_time() -> None:
    clear = protection_level(ranges(p_satellite=np.full(14, 2e-3)), COUNTABLE)
    street = protection_level(ranges(p_nlos=np.where(directions(SKY)[:, 2] < 0.6, 0.05, 0.0)), COUNTABLE)
    assert clear.excluded.sum(-1).max() == 2
    assert street.excluded.sum(-1).max() == 3
    # Where half of all signals may be reflections, too many at a time are too likely.
    lost = protection_level(ranges(p_nlos=np.full(14, 0.5)), COUNTABLE)
    assert not lost.available
    assert math.isinf(lost.horizontal_m)
    assert math.isinf(lost.vertical_m)
    assert "faults that no hypothesis covers have the probability 0.9" in lost.reason


def test_a_constellation_fault_leaves_all_its_satellites_out() -> None:
    level = protection_level(ranges(p_satellite=np.zeros(14), p_constellation={1: 1e-2}), COUNTABLE)
    assert level.excluded.tolist() == [[False] * 8 + [True] * 6]
    assert level.prior == pytest.approx([1e-2])
    # Alone in the sky, its failure cannot be looked at.
    alone = protection_level(ranges(8, p_satellite=np.zeros(8), p_constellation={0: 1e-2}), COUNTABLE)
    assert not alone.available
    assert "probability 0.01, must be below p_hmi = 0.002" in alone.reason


def test_a_prior_of_what_is_out_of_view_changes_nothing() -> None:
    given = protection_level(ranges(8, p_constellation={0: 1e-6, 1: 1e-3}), COUNTABLE)
    alone = protection_level(ranges(8, p_constellation={0: 1e-6}), COUNTABLE)
    assert given.available
    assert given.horizontal_m == alone.horizontal_m
    assert given.vertical_m == alone.vertical_m


@pytest.mark.parametrize("count", [5, 4, 1])
def test_fewer_satellites_than_clocks_and_four_more(count: int) -> None:
    sky = ranges(count, constellation=np.arange(count) % 2) if count > 1 else ranges(1)
    level = protection_level(sky, COUNTABLE)
    assert not level.available
    assert math.isinf(level.horizontal_m)
    assert f"{count} satellites of" in level.reason


def test_satellites_in_one_line_tell_no_position() -> None:
    same = np.tile(directions([(40, 30)]), (8, 1))
    level = protection_level(ranges(8, line_of_sight=same), COUNTABLE)
    assert level.reason == "the satellites in view do not tell the position"


@pytest.mark.parametrize(
    "changes",
    [
        {"line_of_sight": 2.0 * directions(SKY)},
        {"sigma_m": np.zeros(14)},
        {"sigma_m": np.ones(13)},
        {"bias_m": np.full(14, -1.0)},
        {"p_satellite": np.full(14, 1.0)},
        {"p_constellation": {0: -0.1}},
        {"p_nlos": np.full(14, np.nan)},
    ],
)
def test_what_is_no_sky(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="must be"):
        ranges(**changes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"p_constellation": {0: 0.1, 7: 0.9}}, r"p_constellation names 7, must be one of .*: 0, 1"),
        ({"p_constellation": {"1": 0.9}}, r"p_constellation names '1', must be one of constellation: 0, 1"),
        ({"constellation": np.array(["GPS"] * 14)}, r"constellation must hold whole numbers, got <U3"),
        ({"constellation": np.full(14, 0.5)}, r"constellation must hold whole numbers, got float64"),
        ({"sigma_m": ["a"] * 14}, r"sigma_m must hold numbers"),
        ({"line_of_sight": [1.0, 0.0, 0.0]}, r"line_of_sight has shape \(3,\), must be \(n, 3\)"),
    ],
)  # fmt: skip
def test_what_names_no_satellite_or_is_no_number(changes: dict[str, Any], words: str) -> None:
    """A prior of a constellation that is not there would count for nothing, and the level be too small."""
    with pytest.raises(ValueError, match=words):
        ranges(**changes)


def test_lists_do_as_well_as_arrays() -> None:
    r = ranges(p_constellation={1: 1e-3}, p_nlos=np.full(14, 1e-3))
    lists = {
        f.name: v.tolist() if isinstance(v := getattr(r, f.name), np.ndarray) else v
        for f in dataclasses.fields(r)
    }
    ours, theirs = (protection_level(one, COUNTABLE) for one in (r, RangeErrors(**lists)))
    assert ours.available
    np.testing.assert_array_equal(theirs.axis_m, ours.axis_m)


# ------------------------------------------------------------------------------------- faults injected

RUNS = 60_000


def errors_and_alarms(
    r: RangeErrors, level: ProtectionLevel, fault_m: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Position errors (epoch, 3) and alarms (epoch,) of noise, biases at their worst for up, and faults."""
    n = len(r.sigma_m)
    noise = normals(seed, range(1), Stream.OWN_ERROR, n, 1, RUNS)[0, :, 0].T
    drawn = uniforms(seed, range(1), Stream.OUTAGE, n, 1, RUNS)[0, :, 0].T
    worst = r.bias_m * np.sign(level.gain[0, 2])
    nlos = np.zeros(n) if r.p_nlos is None else r.p_nlos
    faulty = drawn < 1.0 - (1.0 - r.p_satellite) * (1.0 - nlos)
    residual = noise * r.sigma_m + worst + fault_m * faulty
    error = np.einsum("qn,en->eq", level.gain[0], residual)
    alarm = np.concatenate([~level.consistent(part) for part in np.array_split(residual, 30)])
    return error, alarm


@pytest.mark.parametrize("nlos", [0.0, 0.02])
@pytest.mark.parametrize("fault_m", [0.0, 6.0, 12.0, 20.0, 40.0])
def test_the_error_leaves_the_level_unseen_no_more_often_than_asked(fault_m: float, nlos: float) -> None:
    r = ranges(p_nlos=np.full(14, nlos))
    level = protection_level(r, COUNTABLE)
    error, alarm = errors_and_alarms(r, level, fault_m, 21)
    up = wilson(int((~alarm & (np.abs(error[:, 2]) > level.vertical_m)).sum()), RUNS)
    across = np.hypot(error[:, 0], error[:, 1])
    flat = wilson(int((~alarm & (across > level.horizontal_m)).sum()), RUNS)
    assert up.low <= COUNTABLE.p_hmi_vertical
    assert flat.low <= COUNTABLE.p_hmi_horizontal
    if fault_m == 0.0:
        alarms = wilson(int(alarm.sum()), RUNS)
        # Biases at their worst are on top of what the thresholds allow for.
        assert alarms.low <= 1.5 * (COUNTABLE.p_fa_horizontal + COUNTABLE.p_fa_vertical)


def test_without_hypotheses_the_same_faults_leave_k_sigma_far_too_often() -> None:
    """What the levels are for: k sigma of the all-in-view solution alone is no bound when satellites fail."""
    r = ranges()
    level = protection_level(r, COUNTABLE)
    naive = protection_level(ranges(p_satellite=np.zeros(14)), COUNTABLE)
    error, _ = errors_and_alarms(r, level, 20.0, 21)
    plain = wilson(int((np.abs(error[:, 2]) > naive.vertical_m).sum()), RUNS)
    assert plain.low > 3.0 * COUNTABLE.p_hmi_vertical


def test_a_large_fault_is_seen() -> None:
    r = ranges()
    level = protection_level(r, COUNTABLE)
    for i in range(14):
        residual = np.where(np.arange(14) == i, 60.0, 0.0)
        assert not level.consistent(residual)
    assert level.consistent(np.zeros(14))
    # A receiver clock is no fault.
    assert level.consistent(np.where(r.constellation == 0, 1e4, -3e3).astype(float))
