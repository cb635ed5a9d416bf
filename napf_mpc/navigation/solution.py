"""What navigation tells a planner. The truth is not in here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napf_mpc.navigation.forecast import CovarianceForecast
from napf_mpc.navigation.tracks import Tracks

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NavSolution:
    """One navigation solution of every UAV of every run, as reported.

    A planner receives this type and the map of what stands, and nothing else, so it cannot peek at the truth.
    """

    time_s: float
    """Time since the start of the mission [s]."""
    available: NDArray[np.bool_]
    """(run, uav): whether there is a position fix now; without one the position is carried on."""
    position: Array
    """(run, uav, 3) east, north, up [m]."""
    velocity: Array
    """(run, uav, 3) [m/s]."""
    attitude: Array
    """(run, uav, 3) roll, pitch, yaw [rad]."""
    body_rates: Array
    """(run, uav, 3) rates of roll, pitch, yaw [rad/s]."""
    covariance: Array
    """(run, uav, 6, 6) of position and velocity, as reported [m^2, m^2/s, m^2/s^2]."""
    common_factor: Array
    """(run, uav, 3, rank) factor L of the part that UAVs share: Sigma_ij = L_i L_j^T [m]."""
    airborne: NDArray[np.bool_] | None = None
    """(run, uav): whether the UAV still flies its mission, so a planner has to work for it; None for all."""
    filtered: bool = False
    """Whether it is a filter's estimate, whose error does not depend on it, or a measurement."""
    tracks: Tracks | None = None
    """Moving obstacles as tracked now; None in a world without any."""
    forecast: CovarianceForecast | None = None
    """What the filter knows of its covariance to come; None if the law of the errors is not known."""

    @property
    def position_covariance(self) -> Array:
        """(run, uav, 3, 3) reported covariance of the position [m^2]."""
        return self.covariance[..., :3, :3]

    def relative_covariance(self, i: int, j: int) -> Array:
        """Covariance of the position of UAV i relative to UAV j: Sigma_i + Sigma_j - Sigma_ij - Sigma_ij^T.

        Returns
        -------
        array, shape (run, 3, 3)
            As reported [m^2]. Nearby receivers share part of their error, which drops out.
        """
        cross = np.einsum("rak,rbk->rab", self.common_factor[:, i], self.common_factor[:, j])
        sigma = self.position_covariance
        return np.asarray(sigma[:, i] + sigma[:, j] - cross - cross.transpose(0, 2, 1))

    def position_covariance_ahead(self, ahead_s: Array, with_fixes: bool) -> Array:
        """Covariance of the position at times from now: that of now, grown as the filter expects.

        Never less than now in any direction: the growth of each axis counts where it is positive. Covariance
        between axes is held. Without a forecast all is.

        Parameters
        ----------
        ahead_s : array, shape (N,)
            Times from now, >= 0 and increasing [s].
        with_fixes : bool
            Whether fixes go on as they come now, or none does.

        Returns
        -------
        array, shape (run, uav, N, 3, 3)
            [m^2].
        """
        out = np.repeat(self.position_covariance[:, :, None], len(ahead_s), axis=2)
        if self.forecast is not None:
            np.einsum("...ii->...i", out)[...] += self.forecast.growth(ahead_s, with_fixes)
        return out

    def trusted(self) -> NDArray[np.bool_]:
        """(run, uav): a fix is there, all numbers are finite, and the covariance of the position is one.

        A variance of zero, a negative one or NaN means "unknown", never "certain", and so does a matrix with
        a negative eigenvalue: such a solution is not to be planned with.
        """
        finite = np.isfinite(self.position).all(-1) & np.isfinite(self.velocity).all(-1)
        finite &= np.isfinite(self.attitude).all(-1) & np.isfinite(self.body_rates).all(-1)
        finite &= np.isfinite(self.covariance).all((-1, -2))
        variances = np.einsum("...ii->...i", self.position_covariance)
        sound = (variances > 0.0).all(-1) & _semidefinite(self.position_covariance)
        return np.asarray(self.available & finite & sound)


def _semidefinite(c: Array) -> NDArray[np.bool_]:
    """Whether 3x3 matrices (..., 3, 3) have no negative eigenvalue beyond rounding, by their minors."""
    xy, xz, yz = (0.5 * (c[..., i, j] + c[..., j, i]) for i, j in ((0, 1), (0, 2), (1, 2)))
    x, y, z = c[..., 0, 0], c[..., 1, 1], c[..., 2, 2]
    # Each minor is measured against the product of its variances, whatever their unit's size.
    with np.errstate(invalid="ignore", over="ignore"):
        slack = 1e-9
        sound = xy * xy <= x * y * (1.0 + slack)
        sound &= (xz * xz <= x * z * (1.0 + slack)) & (yz * yz <= y * z * (1.0 + slack))
        determinant = x * (y * z - yz * yz) - xy * (xy * z - yz * xz) + xz * (xy * yz - y * xz)
        return np.asarray(sound & (determinant >= -slack * x * y * z))
