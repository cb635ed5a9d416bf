"""Moving obstacles: where each is at any time, in truth.

Each moves from its start with its velocity, and an acceleration of its own in every run that is drawn anew
every second, so that the true path is exact at any time,

    p(t) = p_0 + v_0 t + w(t),    w'' = a_k   for k <= t < k + 1 s,    w(0) = w'(0) = 0.

After a second the velocity has gained the acceleration's sigma, as under white noise of the spectral density
``sigma^2 x 1 s`` that trackers assume. They pass through whatever stands in their way, and each other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from napf_mpc.problem import MovingSphere, World
from napf_mpc.streams import Seed, Stream, generator
from napf_mpc.world.distance import TOUCH_M

Array = NDArray[np.float64]

HOLD_S = 1.0
"""Time for which an acceleration lasts."""


@dataclass(frozen=True, eq=False)
class MovingObstacles:
    """Balls and endless vertical cylinders that move, in one or many runs."""

    radius: Array
    """(n,) [m]."""
    upright: NDArray[np.bool_]
    """(n,) whether it is a vertical cylinder without ends, not a ball."""
    start: Array
    """(n, 3) centre at time 0; of a cylinder at height 0 [m]."""
    velocity: Array
    """(n, 3) at time 0 [m/s]."""
    acceleration: Array
    """(run, n, k, 3) during the k-th second; k = 0 if none ever accelerates [m/s^2]."""

    @property
    def count(self) -> int:
        """Number of obstacles n."""
        return len(self.radius)

    @property
    def runs(self) -> int:
        """Number of runs."""
        return len(self.acceleration)

    @cached_property
    def _wander(self) -> tuple[Array, Array]:
        """Velocity gained and way w at the start of each second, (run, n, k, 3)."""
        gained, way = np.zeros_like(self.acceleration), np.zeros_like(self.acceleration)
        for k in range(1, self.acceleration.shape[2]):
            held = self.acceleration[:, :, k - 1]
            gained[:, :, k] = gained[:, :, k - 1] + held * HOLD_S
            way[:, :, k] = way[:, :, k - 1] + gained[:, :, k - 1] * HOLD_S + held * (0.5 * HOLD_S**2)
        return gained, way

    def position(self, time_s: float) -> Array:
        """Centres (run, n, 3) at a time; before 0 they moved evenly and straight [m]."""
        place = np.repeat((self.start + self.velocity * time_s)[None], self.runs, axis=0)
        seconds = self.acceleration.shape[2]
        if seconds and time_s > 0.0:
            gained, way = self._wander
            k = min(int(time_s / HOLD_S), seconds - 1)
            since = time_s - k * HOLD_S
            place += way[:, :, k] + gained[:, :, k] * since
            place += self.acceleration[:, :, k] * (0.5 * since * since)
        return place

    def of_run(self, index: int) -> MovingObstacles:
        """Those of one run of the block alone."""
        return MovingObstacles(
            self.radius, self.upright, self.start, self.velocity, self.acceleration[index : index + 1]
        )


def moving_obstacles(world: World, seed: Seed, runs: range, duration_s: float) -> MovingObstacles | None:
    """Moving obstacles of some runs of a campaign; None in a world without any.

    Parameters
    ----------
    world : World
        The problem's world.
    seed : int or Numbers
        Campaign seed, or what stands for it.
    runs : range
        Indices of the runs. Accelerations depend on the seed, the run and the obstacle's index only.
    duration_s : float
        Time until which accelerations are drawn; later ones hold the last [s].
    """
    items = world.moving
    if not items:
        return None
    sigma = [item.acceleration_sigma_mps2 for item in items]
    seconds = math.ceil(duration_s / HOLD_S) + 1 if any(sigma) else 0
    acceleration = np.zeros((len(runs), len(items), seconds, 3))
    for i, item in enumerate(items):
        axes = (3 if isinstance(item, MovingSphere) else 2) if sigma[i] > 0.0 else 0
        for r, run in enumerate(runs):
            for axis in range(axes):
                drawn = generator(seed, run, Stream.MOVING_ACCELERATION, i, axis).standard_normal(seconds)
                acceleration[r, i, :, axis] = sigma[i] * drawn
    return MovingObstacles(
        radius=np.array([item.radius_m for item in items]),
        upright=np.array([not isinstance(item, MovingSphere) for item in items]),
        start=np.array([(*item.start_m, 0.0)[:3] for item in items]),
        velocity=np.array([(*item.velocity_mps, 0.0)[:3] for item in items]),
        acceleration=acceleration,
    )


def round_distance(
    points: Array, centres: Array, radius: Array, upright: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Signed distance to balls and endless vertical cylinders, and its gradient.

    Parameters
    ----------
    points, centres : array, broadcast to shape (..., 3)
        [m].
    radius, upright : array, broadcast to shape (...)
        Radii [m], and which are cylinders.

    Returns
    -------
    distance : array, shape (...)
        Negative inside [m].
    normal : array, shape (..., 3)
        Unit vectors away from the obstacle; up at the centre of a ball, east on the axis of a cylinder, as
        for obstacles that stand.
    """
    x, y = points[..., 0] - centres[..., 0], points[..., 1] - centres[..., 1]
    z = np.where(upright, 0.0, points[..., 2] - centres[..., 2])
    length = np.sqrt(x * x + y * y + z * z)
    touching = length < TOUCH_M
    safe = np.where(touching, 1.0, length)
    normal = np.stack(
        [
            np.where(touching, np.where(upright, 1.0, 0.0), x / safe),
            np.where(touching, 0.0, y / safe),
            np.where(touching, np.where(upright, 0.0, 1.0), z / safe),
        ],
        axis=-1,
    )
    return length - radius, normal
