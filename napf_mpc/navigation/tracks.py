r"""Tracks of moving obstacles: what planners know of them, from noisy observations of their centres.

A Kalman filter of the constant-velocity model on each axis: between observations the acceleration is white
noise of spectral density ``q = sigma_a^2 x 1 s``,

    x = (p, v),   F = [[1, t], [0, 1]],   Q = q [[t^3 / 3, t^2 / 2], [t^2 / 2, t]].

It assumes that all obstacles are seen each time, by one observer that all UAVs share, without errors of its
own place, that no two are mixed up, and that radii are known. Observations began before the mission.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napf_mpc.problem import World
from napf_mpc.streams import NormalSequence, Seed, Stream
from napf_mpc.world.moving import HOLD_S, MovingObstacles, round_distance

Array = NDArray[np.float64]

WATCHED_S = 2.0
"""Observations begin this long before the mission, and at least two lie before it."""
FIRST_SPEED_SIGMA_MPS = 20.0
"""Sigma of the velocity before the second observation."""
_DRAWN_AHEAD = 4_000_000


@dataclass(frozen=True, eq=False)
class Tracks:
    """Moving obstacles as tracked at one time."""

    position: Array
    """(run, n, 3) estimated centre now [m]."""
    velocity: Array
    """(run, n, 3) estimated [m/s]."""
    covariance: Array
    """(run, n, 6, 6) of position and velocity [m^2, m^2/s, m^2/s^2]."""
    radius: Array
    """(n,) [m]."""
    upright: NDArray[np.bool_]
    """(n,) whether it is a vertical cylinder without ends, not a ball."""
    acceleration_sigma_mps2: float
    """Assumed of each axis, drawn anew every second: what makes the covariance grow ahead."""

    @property
    def count(self) -> int:
        """Number of tracks n."""
        return len(self.radius)

    @property
    def position_covariance(self) -> Array:
        """(run, n, 3, 3) of the position now [m^2]."""
        return self.covariance[..., :3, :3]

    def predicted(self, ahead_s: Array) -> tuple[Array, Array]:
        """Centres (run, n, N, 3) and their covariance (run, n, N, 3, 3) at times (N,) from now.

        ``p + v t`` and ``P_pp + t (P_pv + P_vp) + t^2 P_vv + q t^3 / 3``.
        """
        t = ahead_s[:, None]
        position = self.position[:, :, None] + self.velocity[:, :, None] * t
        t = t[..., None]
        p = self.covariance[:, :, None]
        covariance = p[..., :3, :3] + t * (p[..., :3, 3:] + p[..., 3:, :3]) + t * t * p[..., 3:, 3:]
        grown = self.acceleration_sigma_mps2**2 * HOLD_S * t**3 / 3.0
        return position, covariance + grown * np.eye(3)

    def least_distance(self, points: Array, ahead_s: Array) -> Array:
        """Least signed distance (run, uav) of points (run, uav, N, 3) to where all are expected then [m].

        Parameters
        ----------
        points : array, shape (run, uav, N, 3)
            [m].
        ahead_s : array, shape (N,)
            Times of the points from now [s].
        """
        centres = self.position[:, :, None] + self.velocity[:, :, None] * ahead_s[:, None]
        distance, _ = round_distance(
            points[:, :, :, None], centres.transpose(0, 2, 1, 3)[:, None], self.radius, self.upright
        )
        return np.asarray(distance.min(axis=(2, 3), initial=np.inf))

    def faults(self, runs: int) -> list[str]:
        """What does not fit a number of runs, is not finite or no radius, in words."""
        expected = {
            "position": (runs, self.count, 3),
            "velocity": (runs, self.count, 3),
            "covariance": (runs, self.count, 6, 6),
            "upright": (self.count,),
            "radius": (self.count,),
        }
        found = []
        for name, want in expected.items():
            values = getattr(self, name)
            if values.shape != want:
                found.append(f"tracks.{name} has shape {values.shape}, must be {want}")
            elif not np.isfinite(values).all():
                found.append(f"tracks.{name} has an entry that is not finite")
        if not found and not (self.radius > 0.0).all():
            found.append(f"tracks.radius = {self.radius.tolist()}, must be > 0")
        return found

    def of_run(self, run: int) -> Tracks:
        """Tracks of one run alone."""
        part = slice(run, run + 1)
        return Tracks(
            self.position[part].copy(),
            self.velocity[part].copy(),
            self.covariance[part].copy(),
            self.radius,
            self.upright,
            self.acceleration_sigma_mps2,
        )


class MovingTracker:
    """Observes the moving obstacles of a block of runs and tracks them.

    All are observed at the same times and with the same noise on each axis, so one covariance of a position
    and a velocity serves them all.

    Parameters
    ----------
    world : World
        Noise and rate of the observations, and the acceleration that is assumed.
    moving : MovingObstacles
        The truth that is observed.
    seed : int or Numbers
        Campaign seed, or what stands for it.
    runs : range
        Indices of the runs in their campaign.
    period_s : float
        Length of a tick [s].
    """

    def __init__(
        self, world: World, moving: MovingObstacles, seed: Seed, runs: range, period_s: float
    ) -> None:
        self._moving = moving
        self._period_s = period_s
        self._ticks_per_look = round(1.0 / (world.moving_rate_hz * period_s))
        self._sigma = world.moving_sigma_m
        self._acceleration_sigma = world.moving_acceleration_sigma_mps2
        count = moving.count
        ahead = max(1, min(256, _DRAWN_AHEAD // (3 * count * len(runs))))
        self._noise = NormalSequence(seed, runs, Stream.MOVING_OBSERVATION, count, 3, ahead)
        look_s = self._ticks_per_look * period_s
        looks = max(2, math.ceil(WATCHED_S / look_s))
        self._position = self._observed(-looks * look_s)
        self._velocity = np.zeros_like(self._position)
        self._covariance = (self._sigma**2, 0.0, FIRST_SPEED_SIGMA_MPS**2)
        for look in range(1 - looks, 0):
            self._predict(look_s)
            self._correct(look * look_s)
        self._predict(look_s - period_s)  # the rest of the way to the mission's start is its first tick

    def _observed(self, time_s: float) -> Array:
        return self._moving.position(time_s) + self._sigma * self._noise.take()

    def _predict(self, t: float) -> None:
        pp, pv, vv = self._covariance
        q = self._acceleration_sigma**2 * HOLD_S
        self._position = self._position + self._velocity * t
        self._covariance = (
            pp + 2.0 * t * pv + t * t * vv + q * t**3 / 3.0,
            pv + t * vv + q * t * t / 2.0,
            vv + q * t,
        )

    def _correct(self, time_s: float) -> None:
        pp, pv, vv = self._covariance
        innovation = self._observed(time_s) - self._position
        variance = pp + self._sigma**2
        self._position = self._position + (pp / variance) * innovation
        self._velocity = self._velocity + (pv / variance) * innovation
        # With these gains R / S P and P - K S K^T are the same; the products cannot turn negative.
        left = self._sigma**2 / variance
        self._covariance = (left * pp, left * pv, vv - pv * pv / variance)

    def tick(self, tick: int) -> None:
        """Go on to a tick and observe if one is due then; to be called once a tick, from tick 0 on."""
        self._predict(self._period_s)
        if tick % self._ticks_per_look == 0:
            self._correct(tick * self._period_s)

    def tracks(self) -> Tracks:
        """Tracks now."""
        runs, count = self._position.shape[:2]
        pp, pv, vv = self._covariance
        block = np.kron(np.array([[pp, pv], [pv, vv]]), np.eye(3))
        return Tracks(
            self._position.copy(),
            self._velocity.copy(),
            np.broadcast_to(block, (runs, count, 6, 6)).copy(),
            self._moving.radius.copy(),
            self._moving.upright.copy(),
            self._acceleration_sigma,
        )
