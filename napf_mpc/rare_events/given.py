"""Numbers of one's own in place of a campaign's seed: what chance decides in a mission, as one array."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from napf_mpc.streams import Stream, generator

Array = NDArray[np.float64]
Key = tuple[Stream, int, int]
"""Stream, UAV (or moving obstacle) and axis."""

_BELOW_ONE = math.nextafter(1.0, 0.0)
_OPEN = (Stream.SCENE, Stream.OUTAGE)
"""Streams of which another mission may need more: places are tried until one is free."""


@dataclass(frozen=True)
class Layout:
    """Which numbers of a point drive which stream of a mission."""

    places: dict[Key, slice]
    """Where the numbers of each stream stand in a point."""

    @property
    def dimension(self) -> int:
        """Numbers of a point."""
        return max((place.stop for place in self.places.values()), default=0)


class GivenNumbers:
    """Stands for a seed: run r draws from row r of an array of standard-normal numbers.

    Uniform numbers are Phi(z) of theirs. Where a stream is asked for more than it was given, it goes on with
    the numbers of the seed's run 0, in every run: what a mission comes to stays a function of its row.

    Parameters
    ----------
    points : array, shape (run, dimension)
        Standard normal.
    layout : Layout
        What each of them drives.
    seed : int
        Of the numbers beyond.
    """

    def __init__(self, points: Array, layout: Layout, seed: int) -> None:
        self._points, self._places, self._seed = points, layout.places, seed

    def generator(self, run: int, stream: Stream, uav: int, axis: int) -> np.random.Generator:
        """Return the generator of one stream: first the numbers given, then the seed's."""
        given = self._points[run, self._places.get((stream, uav, axis), slice(0))]
        return _Given(given, generator(self._seed, 0, stream, uav, axis).bit_generator)


class DrawnNumbers:
    """Stands for a seed, gives its numbers, and notes how many of each stream are drawn."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._given: list[tuple[Key, _Counted]] = []

    def generator(self, run: int, stream: Stream, uav: int, axis: int) -> np.random.Generator:
        """Return the generator of one stream of the seed."""
        counted = _Counted(generator(self._seed, run, stream, uav, axis).bit_generator)
        self._given.append(((stream, uav, axis), counted))
        return counted

    def counts(self) -> dict[Key, int]:
        """Numbers drawn so far from each stream."""
        return self._most("drawn")

    def layout(self, before: dict[Key, int], share: float) -> Layout:
        """Places for all numbers that a mission can take.

        Parameters
        ----------
        before : dict of Key to int
            :meth:`counts` before take-off: scenes and errors are drawn for all of the time there is.
        share : float
            Of that time, how much was flown: what is drawn in flight will be more in a longer one.
        """
        largest = self._most("largest")
        places, start = {}, 0
        for key, drawn in self.counts().items():
            in_flight = drawn - before.get(key, 0)
            count = before.get(key, 0) * (2 if key[0] in _OPEN else 1)
            if in_flight:
                count += math.ceil(in_flight / share) + largest[key]
            places[key] = slice(start, start + count)
            start += count
        return Layout(places)

    def _most(self, what: str) -> dict[Key, int]:
        most: dict[Key, int] = {}
        for key, counted in self._given:
            most[key] = max(most.get(key, 0), getattr(counted, what))
        return most


class _Drawing(np.random.Generator):
    """A generator of which every draw passes through one place."""

    def take(self, count: int) -> Array:
        """Return the next standard-normal numbers."""
        return super().standard_normal(count)

    def standard_normal(  # type: ignore[override]
        self, size: Any = None, dtype: Any = np.float64, out: Array | None = None
    ) -> Any:
        """Draw as numpy's does; in double precision whatever the type."""
        return self._shaped(lambda z: z, size, out)

    def random(  # type: ignore[override]
        self, size: Any = None, dtype: Any = np.float64, out: Array | None = None
    ) -> Any:
        """Draw as numpy's does; in double precision whatever the type."""
        return self._shaped(lambda z: np.minimum(ndtr(z), _BELOW_ONE), size, out)

    def _shaped(self, law: Any, size: Any, out: Array | None) -> Any:
        shape = out.shape if out is not None else () if size is None else size
        values = law(self.take(math.prod(np.atleast_1d(np.asarray(shape, dtype=np.int64)).tolist())))
        values = values.reshape(shape)
        if out is None:
            return values[()]
        out[...] = values
        return out


class _Given(_Drawing):
    def __init__(self, given: Array, beyond: np.random.BitGenerator) -> None:
        super().__init__(beyond)
        self._given, self._next = given, 0

    def take(self, count: int) -> Array:
        given = self._given[self._next : self._next + count]
        self._next += len(given)
        return (
            given.copy() if len(given) == count else np.concatenate([given, super().take(count - len(given))])
        )


class _Counted(_Drawing):
    def __init__(self, source: np.random.BitGenerator) -> None:
        super().__init__(source)
        self.drawn = self.largest = 0

    def take(self, count: int) -> Array:
        self.drawn += count
        self.largest = max(self.largest, count)
        return super().take(count)
