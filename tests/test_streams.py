"""Random streams: prefixes never change with the total, and no two streams share their numbers."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.streams import NormalRows, NormalSequence, Stream, generator, normals, uniforms

Draw = Callable[[int, range, Stream, int, int, int], NDArray[np.float64]]
DRAWS = pytest.mark.parametrize("draw", [normals, uniforms])


@DRAWS
def test_first_ticks_runs_uavs_and_axes_never_change_with_the_total(draw: Draw) -> None:
    large = draw(7, range(6), Stream.OWN_ERROR, 5, 3, 400)
    np.testing.assert_array_equal(draw(7, range(6), Stream.OWN_ERROR, 5, 3, 123), large[..., :123])
    np.testing.assert_array_equal(draw(7, range(2), Stream.OWN_ERROR, 5, 3, 400), large[:2])
    np.testing.assert_array_equal(draw(7, range(3, 5), Stream.OWN_ERROR, 5, 3, 400), large[3:5])
    np.testing.assert_array_equal(draw(7, range(6), Stream.OWN_ERROR, 2, 3, 400), large[:, :2])
    np.testing.assert_array_equal(draw(7, range(6), Stream.OWN_ERROR, 5, 1, 400), large[:, :, :1])


def test_a_series_is_its_documented_stream() -> None:
    """Anyone can redraw a series from the seed, its run, stream, UAV and axis."""
    documented = np.random.default_rng(np.random.SeedSequence(11, spawn_key=(4, int(Stream.BAROMETER), 3, 2)))
    drawn = normals(11, range(4, 5), Stream.BAROMETER, 4, 3, 50)[0, 3, 2]
    np.testing.assert_array_equal(drawn, documented.standard_normal(50))


def test_no_two_streams_share_a_number() -> None:
    """Thousands of series of seeds 7 and 8, runs, streams, UAVs and axes: no seed + i, no overlap."""
    seen: set[float] = set()
    count = 0
    for seed, run, stream, uav, axis in itertools.product((7, 8, 0), range(8), Stream, range(6), range(4)):
        seen.update(generator(seed, run, stream, uav, axis).random(3).tolist())
        count += 3
    assert len(seen) == count


def test_neighbouring_keys_do_not_correlate() -> None:
    """10,000 numbers a series; each pair within 4.5 standard errors of none."""
    series = [
        generator(seed, run, stream, uav, axis).standard_normal(10_000)
        for seed, run, stream, uav, axis in [
            (7, 0, Stream.OWN_ERROR, 0, 0), (8, 0, Stream.OWN_ERROR, 0, 0), (7, 1, Stream.OWN_ERROR, 0, 0),
            (7, 0, Stream.OWN_ERROR, 1, 0), (7, 0, Stream.OWN_ERROR, 0, 1), (7, 0, Stream.COMMON_ERROR, 0, 0),
            (7, 0, Stream.SCENE, 0, 0), (0, 7, Stream.OWN_ERROR, 0, 0), (1, 0, Stream.SCENE, 0, 7),
        ]
    ]  # fmt: skip
    correlation = np.corrcoef(series)
    assert np.abs(correlation - np.eye(len(series))).max() < 4.5 / np.sqrt(10_000)


@pytest.mark.parametrize("ahead", [1, 7, 256])
@pytest.mark.parametrize("uavs", [1, 30])
def test_step_by_step_they_are_the_same_numbers(ahead: int, uavs: int) -> None:
    """Whatever is drawn ahead, and for more series than fit one band."""
    whole = normals(5, range(2, 5), Stream.OWN_ERROR, uavs, 3, 20)
    sequence = NormalSequence(5, range(2, 5), Stream.OWN_ERROR, uavs, ahead=ahead)
    for step in range(20):
        np.testing.assert_array_equal(sequence.take(), whole[..., step])


@pytest.mark.parametrize("ahead", [1, 7, 64])
def test_rows_are_the_same_however_far_ahead_and_with_whom_they_are_drawn(ahead: int) -> None:
    rows = NormalRows(5, range(2, 5), Stream.GNSS_NOISE, 3, 11, ahead)
    alone = NormalRows(5, range(3, 4), Stream.GNSS_NOISE, 2, 11)
    whole = generator(5, 3, Stream.GNSS_NOISE, 1).standard_normal((20, 11))
    for step in range(20):
        taken = rows.take()
        assert taken.shape == (3, 3, 11)
        np.testing.assert_array_equal(taken[1, 1], whole[step])
        np.testing.assert_array_equal(alone.take()[0, 1], whole[step])


def test_laws() -> None:
    z = normals(1, range(20), Stream.OWN_ERROR, 4, 3, 500).ravel()
    assert z.mean() == pytest.approx(0.0, abs=0.01)
    assert z.std() == pytest.approx(1.0, abs=0.01)
    u = uniforms(1, range(20), Stream.SIGMA_PHASE, 4, 3, 500).ravel()
    assert (u >= 0.0).all()
    assert (u < 1.0).all()
    assert u.mean() == pytest.approx(0.5, abs=0.005)
    assert u.var() == pytest.approx(1.0 / 12.0, abs=0.002)


@pytest.mark.parametrize("seed", [0, 2**32, 2**63 - 1])
def test_every_allowed_seed_is_its_own(seed: int) -> None:
    here = normals(seed, range(1), Stream.OWN_ERROR, 1, 1, 8)
    assert not np.intersect1d(here, normals(seed ^ 1, range(1), Stream.OWN_ERROR, 1, 1, 8)).size
    np.testing.assert_array_equal(here, normals(seed, range(1), Stream.OWN_ERROR, 1, 1, 8))


def test_stream_numbers_are_a_contract() -> None:
    """Renumbering would change every published result; new streams go to the end."""
    assert {stream.name: stream.value for stream in list(Stream)[:7]} == {
        "SCENE": 0,
        "OWN_ERROR": 1,
        "COMMON_ERROR": 2,
        "SIGMA_PHASE": 3,
        "OUTAGE": 4,
        "BAROMETER": 5,
        "RECORD_OFFSET": 6,
    }
    assert len({stream.value for stream in Stream}) == len(Stream)
