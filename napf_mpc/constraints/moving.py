r"""Keep clear of moving obstacles as rows of a QP: predicted at constant velocity, less certain with time.

At the end of stage k, t_k from now, obstacle j is expected at ``c = p_j + v_j t_k`` with the covariance

    C_k = P_pp + t_k (P_pv + P_vp) + t_k^2 P_vv + q t_k^3 / 3

of its track, and the UAV at its plan's place p_lin with Sigma_k. Their errors are independent, so along the
unit gradient n of the distance d the shifted distance is

    rho_bar(p) = d(p_lin) + n^T (p - p_lin) - r_uav - k sqrt(n^T (Sigma_k + C_k) n).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from napf_mpc.constraints.clearance import (
    CONTACT_W1,
    CONTACT_W2,
    check_extra,
    check_opening,
    extra_distance,
    opening_distance,
)
from napf_mpc.constraints.constraint import ConstraintError, Horizon, LinearRows, even_prices
from napf_mpc.navigation.tracks import Tracks
from napf_mpc.safety_distance import Inflation
from napf_mpc.world.moving import round_distance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MovingObstacleContact:
    """Stay k sigma clear of where moving obstacles are expected at each stage, ``rho_bar >= extra``.

    Soft with an exact penalty, as for obstacles that stand; the rows of one UAV and stage share one slack, in
    metres. Without tracks all rows are switched off.
    """

    inflation: Inflation | None = None
    """How k sigma enters; by default as the problem's planner section says."""
    obstacles: int = 4
    """Rows of each stage M: the moving obstacles that are nearest then by shifted distance."""
    reach_m: float = 10.0
    """Obstacles with a shifted distance of this or more are left out [m]."""
    extra_m: float = 0.0
    """Distance kept on top of the margin [m], ..."""
    extra_sigmas: float | None = None
    """... or this many sigmas of the distance, if that is less. None keeps ``extra_m``."""
    opening_mps: float | None = None
    """A UAV that is inside a margin now, as it will be at a stage, is asked to leave it at this speed, not at
    once: what is asked for faster than a UAV flies buys a dash and nothing else. None asks at once [m/s]."""
    w1: float = CONTACT_W1
    """Linear price of the slack [1/(m s)]."""
    w2: float = CONTACT_W2
    """Quadratic price of the slack [1/(m^2 s)]."""

    def __post_init__(self) -> None:
        if self.obstacles < 1 or not self.reach_m > 0.0:
            raise ConstraintError(
                f"obstacles = {self.obstacles!r} and reach_m = {self.reach_m!r}: must be >= 1 and > 0"
            )
        check_extra(self.extra_m, self.extra_sigmas)
        check_opening(self.opening_mps)

    @property
    def name(self) -> str:
        """Name in results and errors."""
        return "moving obstacle contact"

    def rows(self, horizon: Horizon) -> LinearRows:
        """Rows ``n^T p >= n^T p_lin - rho_bar(p_lin) + extra - s`` or, where they open first, less [m]."""
        shape = (*horizon.shape, self.obstacles)
        jac, lower = np.zeros((*shape, 3)), np.full(shape, -np.inf)
        tracks = horizon.tracks
        if tracks is not None and tracks.count:
            inflation = self.inflation or Inflation.of_problem(horizon.problem)
            normal, shifted = self._nearest(horizon, tracks, inflation)
            found = shifted.shape[-1]
            along, begun = np.zeros(shifted.shape), np.zeros(shifted.shape)
            for axis in range(3):
                along += normal[..., axis] * horizon.position[..., None, axis]
                begun += normal[..., axis] * horizon.position[:, :, :1, None, axis]
            here, times_s = shifted + (begun - along), horizon.times_s
            asked = opening_distance(np.zeros(shifted.shape), here, self.opening_mps, times_s)
            jac[..., :found, :] = normal
            lower[..., :found] = along + (asked - shifted)
        prices = even_prices((*horizon.shape, 1), self.w1, self.w2)
        return LinearRows("position", jac, lower, None, *prices, shared_slack=True)

    def _nearest(self, horizon: Horizon, tracks: Tracks, inflation: Inflation) -> tuple[Array, Array]:
        """Normals (run, uav, N, m, 3) and shifted distances less the extra (run, uav, N, m), by index."""
        centres, spread = tracks.predicted(horizon.times_s)
        centres, spread = centres.transpose(0, 2, 1, 3)[:, None], spread.transpose(0, 2, 1, 3, 4)[:, None]
        distance, normal = round_distance(
            horizon.position[:, :, :, None], centres, tracks.radius, tracks.upright
        )
        distance = distance - horizon.problem.vehicle.radius_m
        if tracks.count > 2 * self.obstacles:
            # An obstacle a little farther off may act more where it, or the UAV, is less certain.
            few = np.sort(np.argsort(distance, axis=-1, kind="stable")[..., : 2 * self.obstacles], axis=-1)
            distance = np.take_along_axis(distance, few, -1)
            normal = np.take_along_axis(normal, few[..., None], -2)
            spread = np.broadcast_to(spread, (*horizon.shape, tracks.count, 3, 3))
            spread = np.take_along_axis(spread, few[..., None, None], -3)
        relative = horizon.covariance[:, :, :, None] + spread
        sigma = replace(inflation, k=1.0).margin(relative, normal[..., None, :])[..., 0]
        shifted = distance - inflation.k * sigma
        extra = extra_distance(self.extra_m, self.extra_sigmas, sigma)
        shifted = np.where(shifted < self.reach_m, shifted - extra, np.inf)
        # Rows in the order of their obstacles: those that keep their places keep a warm start warm.
        chosen = np.argsort(shifted, axis=-1, kind="stable")[..., : self.obstacles]
        chosen = np.sort(chosen, axis=-1)
        shifted = np.take_along_axis(shifted, chosen, -1)
        normal = np.take_along_axis(normal, chosen[..., None], -2)
        return np.where(np.isfinite(shifted)[..., None], normal, 0.0), shifted
