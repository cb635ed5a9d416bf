"""Random streams: one independent generator for each (run, stream, UAV, axis) of a campaign.

Every array is drawn from its own generator in time order, so that the first ticks, runs or UAVs never
change with the total, and no result depends on which worker or block drew it.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Stream(IntEnum):
    """What a random stream is for. Values are part of the seeding contract: never renumber, only append."""

    SCENE = 0
    OWN_ERROR = 1
    COMMON_ERROR = 2
    SIGMA_PHASE = 3
    OUTAGE = 4
    BAROMETER = 5
    RECORD_OFFSET = 6
    GNSS_VELOCITY = 7
    ACCELEROMETER_BIAS = 8
    ACCELEROMETER_NOISE = 9
    MOVING_ACCELERATION = 10
    MOVING_OBSERVATION = 11
    RARE_EVENT = 12
    GNSS_START = 13
    GNSS_COMMON = 14
    GNSS_WAVES = 15
    GNSS_NOISE = 16
    GNSS_PHASES = 17
    BAROMETER_WEATHER = 18
    BAROMETER_DRIFT = 19
    BAROMETER_NOISE = 20


class Numbers(Protocol):
    """Random numbers of one's own, that may stand wherever a campaign seed does."""

    def generator(self, run: int, stream: Stream, uav: int, axis: int) -> np.random.Generator:
        """Return the generator of one stream."""
        ...


Seed = int | Numbers
"""A campaign seed, or numbers of one's own, as a method for rare events has them."""


def generator(seed: Seed, run: int, stream: Stream, uav: int = 0, axis: int = 0) -> np.random.Generator:
    """Return the generator of one stream: ``SeedSequence(seed, spawn_key=(run, stream, uav, axis))``.

    Parameters
    ----------
    seed : int or Numbers
        Campaign seed, 0 <= seed < 2**63, or what stands for it.
    run, uav, axis : int
        Indices from zero; streams of moving obstacles count those instead of UAVs.
    stream : Stream
        What the numbers are for.
    """
    if not isinstance(seed, (int, np.integer)):
        return seed.generator(run, stream, uav, axis)
    return np.random.Generator(
        np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(run, int(stream), uav, axis)))
    )


def normals(seed: Seed, runs: range, stream: Stream, uavs: int, axes: int, count: int) -> NDArray[np.float64]:
    """Draw standard-normal arrays, shape (run, uav, axis, count), each series from its own generator."""
    out = np.empty((len(runs), uavs, axes, count))
    for r, run in enumerate(runs):
        for uav in range(uavs):
            for axis in range(axes):
                generator(seed, run, stream, uav, axis).standard_normal(out=out[r, uav, axis])
    return out


def uniforms(
    seed: Seed, runs: range, stream: Stream, uavs: int, axes: int, count: int
) -> NDArray[np.float64]:
    """Draw uniform arrays on [0, 1), shape (run, uav, axis, count), each series from its own generator."""
    out = np.empty((len(runs), uavs, axes, count))
    for r, run in enumerate(runs):
        for uav in range(uavs):
            for axis in range(axes):
                generator(seed, run, stream, uav, axis).random(out=out[r, uav, axis])
    return out


class NormalSequence:
    """Standard-normal numbers of many streams, one array (run, uav, axis) a step, without holding them all.

    Each stream keeps its generator and is drawn some steps ahead. The numbers are those of :func:`normals`,
    whatever ``ahead`` is.

    Parameters
    ----------
    seed : int or Numbers
        Campaign seed, or what stands for it.
    runs : range
        Indices of the runs.
    stream : Stream
        What the numbers are for.
    uavs, axes : int
        How many.
    ahead : int
        Steps drawn at once: few cost time, many cost memory (8 bytes a number).
    """

    def __init__(
        self, seed: Seed, runs: range, stream: Stream, uavs: int, axes: int = 3, ahead: int = 256
    ) -> None:
        self._generators = [
            generator(seed, run, stream, uav, axis)
            for run in runs
            for uav in range(uavs)
            for axis in range(axes)
        ]
        self._series = np.empty((len(self._generators), ahead))
        self._steps = np.empty((ahead, len(self._generators)))
        self._shape = (len(runs), uavs, axes)
        self._next = ahead

    def take(self) -> NDArray[np.float64]:
        """Return the numbers of the next step (run, uav, axis); not to be kept beyond the next call."""
        if self._next == len(self._steps):
            for numbers, source in zip(self._series, self._generators, strict=True):
                source.standard_normal(out=numbers)
            # A step is read at once, so its numbers are brought together; in bands, which suits caches.
            for first in range(0, len(self._series), 64):
                self._steps[:, first : first + 64] = self._series[first : first + 64].T
            self._next = 0
        step: NDArray[np.float64] = self._steps[self._next].reshape(self._shape)
        self._next += 1
        return step


class NormalRows:
    """Standard-normal rows of many streams, one array (run, uav, width) a step, without holding them all.

    One generator a run and UAV draws row after row, so a row of satellites costs one stream. The numbers do
    not depend on how far ahead they are drawn.

    Parameters
    ----------
    seed : int or Numbers
        Campaign seed, or what stands for it.
    runs : range
        Indices of the runs.
    stream : Stream
        What the numbers are for.
    uavs : int
        How many.
    width : int
        Numbers of one row; other widths are other numbers.
    ahead : int
        Rows drawn at once.
    """

    def __init__(
        self, seed: Seed, runs: range, stream: Stream, uavs: int, width: int, ahead: int = 32
    ) -> None:
        self._generators = [generator(seed, run, stream, uav) for run in runs for uav in range(uavs)]
        self._rows = np.empty((len(self._generators), ahead, width))
        self._shape = (len(runs), uavs, width)
        self._next = ahead

    def take(self) -> NDArray[np.float64]:
        """Return the rows of the next step (run, uav, width); not to be kept beyond the next call."""
        if self._next == self._rows.shape[1]:
            for rows, source in zip(self._rows, self._generators, strict=True):
                source.standard_normal(out=rows)
            self._next = 0
        step: NDArray[np.float64] = self._rows[:, self._next].reshape(self._shape)
        self._next += 1
        return step
