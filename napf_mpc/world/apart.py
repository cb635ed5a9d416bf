"""Random placement of round obstacles with a least gap between them: random sequential addition."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled

MAX_TRIES = 10_000
"""Places tried for one obstacle before the scene counts as impossible."""

_MAX_CHUNK = 65_536

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ApartRules:
    """Where round obstacles may stand, all ranges as (low, high) in path coordinates [m]."""

    count: int
    along_m: tuple[float, float]
    lateral_m: tuple[float, float]
    height_m: tuple[float, float]
    radius_m: tuple[float, float]
    min_gap_m: float
    climb_sine: float = 0.0
    """Sine of the path's climb, which foreshortens along and height in the horizontal plane."""
    starts_m: tuple[tuple[float, float, float], ...] = ()
    """Points to stay clear of: ahead and left in the horizontal plane, up from where heights count."""
    start_reach_m: float = 0.0
    """Distance that surfaces keep from those points."""
    below_m: float = 0.0
    """How far an obstacle goes on below its height with the same radius, under a cap as round as a ball."""
    above_m: float = 0.0
    """The same above its height. A ball goes on nowhere."""

    @property
    def climb_cosine(self) -> float:
        """Cosine of the path's climb."""
        return math.sqrt(1.0 - self.climb_sine**2)

    def plane_box(self) -> tuple[float, float, float, float]:
        """Bounds of the centres in the horizontal plane: x low, x high, y low, y high [m]."""
        x = [a * self.climb_cosine - h * self.climb_sine for a in self.along_m for h in self.height_m]
        return min(x), max(x), self.lateral_m[0], self.lateral_m[1]

    def surely_too_many(self) -> bool:
        """Whether even the smallest obstacles, packed without waste, need more area than there is."""
        x_low, x_high, y_low, y_high = self.plane_box()
        # Discs widened by half the gap must not overlap, and lie in the box widened by the largest of them.
        smallest = self.radius_m[0] + 0.5 * self.min_gap_m
        largest = self.radius_m[1] + 0.5 * self.min_gap_m
        room = (x_high - x_low + 2.0 * largest) * (y_high - y_low + 2.0 * largest)
        return self.count > 1 and self.count * math.pi * smallest**2 > room


def place_apart(uniforms: Callable[[int], Array], rules: ApartRules) -> Array:
    """Place obstacles one after the other, each uniform over what the earlier ones and the starts leave free.

    An obstacle keeps its radius and height while places are tried for it, so that the law of the radii is not
    bent towards the small ones. Each try uses one row of four uniforms (along, lateral, height, radius; the
    last two count in an obstacle's first try only), so the first obstacles do not change with their number.

    Parameters
    ----------
    uniforms : callable
        ``uniforms(n)`` returns the next n rows of the stream, shape (n, 4), on [0, 1). Fewer rows mean that
        the stream is at its end.
    rules : ApartRules
        Ranges and gap.

    Returns
    -------
    array, shape (placed, 4)
        Along, lateral, height, radius [m]. Fewer rows than ``rules.count`` mean that an obstacle found no
        place in `MAX_TRIES` tries, or that the stream ended.
    """
    count = rules.count
    x_low, x_high, y_low, y_high = rules.plane_box()
    reach = 2.0 * rules.radius_m[1] + rules.min_gap_m
    # Cells at least as wide as the reach of two obstacles, and no more of them than obstacles.
    cells_x = max(1, min(int((x_high - x_low) / reach), count))
    cells_y = max(1, min(int((y_high - y_low) / reach), count // cells_x))
    first = np.full((cells_x, cells_y), -1, dtype=np.int64)
    following = np.full(count, -1, dtype=np.int64)
    ranges = np.array([rules.along_m, rules.lateral_m, rules.height_m, rules.radius_m])
    plane = np.array([rules.climb_cosine, rules.climb_sine, x_low, x_high, y_low, y_high])
    starts = np.array(rules.starts_m, dtype=np.float64).reshape(-1, 3)
    upright = np.array([rules.start_reach_m, rules.below_m, rules.above_m])
    placed = np.empty((count, 4))
    done, tries = 0, 0
    while done < count and tries < MAX_TRIES:
        wanted = min(2 * (count - done) + 16, _MAX_CHUNK)
        rows = uniforms(wanted)
        done, tries = _place(
            rows, ranges, plane, rules.min_gap_m, starts, upright, placed, done, tries, first, following
        )
        if len(rows) < wanted:
            break
    return placed[:done]


@compiled
def _place(
    rows: Array,
    ranges: Array,
    plane: Array,
    gap: float,
    starts: Array,
    upright: Array,
    placed: Array,
    done: int,
    tries: int,
    first: NDArray[np.int64],
    following: NDArray[np.int64],
) -> tuple[int, int]:
    """Use up rows; `first` and `following` list the obstacles in each cell of a grid over the plane."""
    cosine, sine, x_low, x_high, y_low, y_high = plane
    cells_x, cells_y = first.shape
    for row in range(len(rows)):
        if done == len(placed) or tries == MAX_TRIES:
            break
        # Before the first try the slot is still free: the last two columns are drawn once.
        for column in range(2 if tries > 0 else 4):
            low, high = ranges[column]
            placed[done, column] = low + rows[row, column] * (high - low)
        tries += 1
        x = cosine * placed[done, 0] - sine * placed[done, 2]
        y = placed[done, 1]
        i = _cell(x, x_low, x_high, cells_x)
        j = _cell(y, y_low, y_high, cells_y)
        z = sine * placed[done, 0] + cosine * placed[done, 2]
        free = not _near_start(starts, upright, x, y, z, placed[done, 3])
        for near_i in range(max(i - 1, 0), min(i + 2, cells_x)):
            for near_j in range(max(j - 1, 0), min(j + 2, cells_y)):
                other = first[near_i, near_j]
                while other >= 0 and free:
                    dx = cosine * placed[other, 0] - sine * placed[other, 2] - x
                    dy = placed[other, 1] - y
                    least = placed[other, 3] + placed[done, 3] + gap
                    free = dx * dx + dy * dy >= least * least
                    other = following[other]
        if free:
            following[done] = first[i, j]
            first[i, j] = done
            done += 1
            tries = 0
    return done, tries


@compiled
def _near_start(starts: Array, upright: Array, x: float, y: float, z: float, radius: float) -> bool:
    """Whether an obstacle reaches one of the points to stay clear of."""
    reach, below, above = upright
    least = radius + reach
    for k in range(len(starts)):
        dx, dy = starts[k, 0] - x, starts[k, 1] - y
        dz = max(starts[k, 2] - z - above, z - below - starts[k, 2], 0.0)
        if dx * dx + dy * dy + dz * dz <= least * least:
            return True
    return False


@compiled
def _cell(value: float, low: float, high: float, cells: int) -> int:
    if cells == 1:
        return 0
    return min(max(int((value - low) / (high - low) * cells), 0), cells - 1)
