r"""How fast a formation goes on where moving obstacles will cross its way.

A field acts on what is near, too late for what comes fast. Guidance looks where the tracks say that obstacles
will be: for each of a few paces, every UAV is followed along its guide, every obstacle at constant velocity,
and what is missing of radius and k sigma (of both places, the track's growing with time) counts against what
is lost by going slower. A formation that waits keeps its shape.

It slows and never stops for them: what stays in the way is for the UAVs to fly around.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from napf_mpc.formation import PathFrame
from napf_mpc.navigation.tracks import Tracks
from napf_mpc.planners.guide import Guide, Passage
from napf_mpc.safety_distance import Inflation
from napf_mpc.world.moving import round_distance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrafficPace:
    """Chooses the pace of a formation among moving obstacles."""

    frame: PathFrame
    """Frame of the mission's path."""
    speed_mps: float
    """Reference speed at pace 1 [m/s]."""
    radius_m: float
    """Of a UAV [m]."""
    inflation: Inflation
    """Its k and its reading of sigma."""
    paces: tuple[float, ...] = (1.0, 0.8, 0.6, 0.4, 0.2)
    """What there is to choose from."""
    ahead_s: float = 4.0
    """How far it looks; beyond, a track is too uncertain to give way to [s]."""
    step_s: float = 0.25
    """Time between the places that are looked at [s]."""
    short: float = 0.3
    """Price of a metre of missing margin, for each UAV, over that of stopping altogether [1/m]."""
    hit: float = 1.0
    """Price of a metre that is missing of the radius itself, on top [1/m]."""
    keep: float = 0.3
    """Price of changing the pace, over that of losing as much."""

    def pace(self, position: Array, covariance: Array, guide: Guide, tracks: Tracks, last: Array) -> Array:
        """Pace (run,) that costs least.

        Parameters
        ----------
        position, covariance : array, shapes (run, uav, 3) and (run, uav, 3, 3)
            Of the UAVs, as reported [m, m^2].
        guide : Guide
            Where they will leave their lanes.
        tracks : Tracks
            Moving obstacles now.
        last : array, shape (run,)
            Pace so far.
        """
        times = self.step_s * np.arange(1.0, round(self.ahead_s / self.step_s) + 1.0)
        centres, spread = tracks.predicted(times)
        relative = covariance[:, :, None, None] + spread.transpose(0, 2, 1, 3, 4)[:, None]
        place = self.frame.to_path(position)
        aside = place[..., 1:] - guide.at(0.0)
        cost = np.empty((len(position), len(self.paces)))
        for n, pace in enumerate(self.paces):
            ahead = np.broadcast_to(self.speed_mps * pace * times, (*position.shape[:2], len(times)))
            along = place[..., :1] + ahead
            points = np.concatenate([along[..., None], aside[:, :, None] + guide.at(ahead)], axis=-1)
            distance, normal = round_distance(
                self.frame.to_world(points)[:, :, :, None],
                centres.transpose(0, 2, 1, 3)[:, None],
                tracks.radius,
                tracks.upright,
            )
            margin = self.inflation.margin(relative, normal[..., None, :])[..., 0]
            touching = self.radius_m - distance
            missing = np.maximum(margin + touching, 0.0).max(axis=(2, 3))
            inside = np.maximum(touching, 0.0).max(axis=(2, 3))
            cost[:, n] = (1.0 - pace) + self.keep * np.abs(pace - last)
            for uav in range(missing.shape[1]):
                cost[:, n] += self.short * missing[:, uav] + self.hit * inside[:, uav]
        return np.asarray(np.array(self.paces)[np.argmin(cost, axis=1)])


def slowed(guide: Guide, pace: Array) -> Guide:
    """Guide that goes on at a pace (run,) at most."""
    most = np.broadcast_to(pace[:, None], guide.pace.shape)
    reason = np.where(most < guide.pace, np.maximum(guide.reason, Passage.WAIT), guide.reason)
    return replace(guide, pace=np.minimum(guide.pace, most), reason=reason.astype(np.int8))
