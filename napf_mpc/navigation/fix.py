"""A position fix of every UAV: the true error in it, and what navigation reports about that error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray

from napf_mpc.navigation.integrity.overbound import Overbound

__all__ = [
    "COAST_SIGMA_MPS",
    "Fix",
    "FixSource",
    "PlacedErrors",
    "PositionErrors",
    "check_shapes",
    "coasting_variance",
    "diagonal",
    "fixes_of_flight",
]

Array = NDArray[np.float64]

COAST_SIGMA_MPS = 0.1
"""Growth of the reported sigma of each axis while there is no fix [m/s].

Without fixes a UAV integrates the last velocity that it knew. A low-cost urban receiver reports that
velocity to 0.10 m/s (sdvn, sdve of the Nagoya log), and an error of velocity grows in proportion to time.
"""


@dataclass(frozen=True)
class Fix:
    """One epoch of the position errors of all UAVs of all runs.

    While a UAV is without a fix, its error stays what it was in the last fix, and the reported covariance
    grows by ``(COAST_SIGMA_MPS * age)**2`` on each axis. The arrays are read-only.
    """

    error: Array
    """(run, uav, 3) to add to the true position [m]; ``error_scale`` is in it."""
    covariance: Array
    """(run, uav, 3, 3) as reported [m^2]; ``reported_sigma_scale`` is in it."""
    common_factor: Array
    """(run, uav, 3, rank) L of the part that UAVs share, as reported [m]: Sigma_ij = L_i L_j^T for i != j."""
    available: NDArray[np.bool_]
    """(run, uav): whether there is a fix at this epoch."""
    overbound: Overbound | None = None
    """Overbound of the reported law; None if none is known."""
    protection: Array | None = None
    """(run, uav, 2) horizontal and vertical protection level [m], not finite where there is none; None if
    the receiver computes none."""

    def __post_init__(self) -> None:
        for array in (self.error, self.covariance, self.common_factor, self.available, self.protection):
            if array is None:
                continue
            array.flags.writeable = False


def check_shapes(fix: Fix, epoch: int, runs: int, uavs: int) -> None:
    """Refuse a fix of other runs or UAVs than are flown: compiled code would read past its end.

    Raises
    ------
    ValueError
        If it is no fix, or naming the array, its shape and the one needed.
    """
    if not isinstance(fix, Fix):
        raise ValueError(f"fix of epoch {epoch} is a {type(fix).__name__}, must be a Fix")
    block = (runs, uavs)
    rank = fix.common_factor.shape[-1:]
    for name, array, needed in (
        ("error", fix.error, (*block, 3)),
        ("covariance", fix.covariance, (*block, 3, 3)),
        ("common_factor", fix.common_factor, (*block, 3, *rank)),
        ("available", fix.available, block),
        ("protection", fix.protection, (*block, 2)),
    ):
        if array is not None and array.shape != needed:
            words = f"({runs}, {uavs}, 3, rank)" if name == "common_factor" else str(needed)
            raise ValueError(
                f"fix of epoch {epoch} has {name} of shape {array.shape}, must be {words}: {runs} runs of "
                f"{uavs} UAVs are flown"
            )


class PositionErrors(Protocol):
    """Position errors of a block of runs, epoch by epoch, drawn beforehand."""

    @property
    def period_s(self) -> float:
        """Time between two epochs [s]."""

    def fix(self, epoch: int) -> Fix:
        """Return the fix of an epoch; epoch 0 is at t = 0."""


class FixSource(Protocol):
    """Fixes of one flight, asked for epoch by epoch."""

    def fix(self, epoch: int, position: Array) -> Fix:
        """Return the fix of the next epoch, at the true places (run, uav, 3) [m]."""


class PlacedErrors(Protocol):
    """Position errors that depend on the true places, as those of an emulated receiver."""

    @property
    def period_s(self) -> float:
        """Time between two epochs [s]."""

    def begin(self) -> FixSource:
        """Return the fixes of one flight, from epoch 0 on; each flight meets the same errors."""


class _DrawnFixes:
    """Fixes whose errors were drawn beforehand, wherever the UAVs are."""

    def __init__(self, errors: PositionErrors) -> None:
        self._errors = errors

    def fix(self, epoch: int, position: Array) -> Fix:
        return self._errors.fix(epoch)


def fixes_of_flight(errors: PositionErrors | PlacedErrors) -> FixSource:
    """Return the fixes of one flight, whatever its errors depend on."""
    begin = getattr(errors, "begin", None)
    return _DrawnFixes(cast(PositionErrors, errors)) if begin is None else cast(FixSource, begin())


def coasting_variance(age_s: Array) -> Array:
    """Variance that a time without a fix adds to each axis [m^2], any shape."""
    return (COAST_SIGMA_MPS * age_s) ** 2


def is_symmetric(covariance: Array) -> NDArray[np.bool_]:
    """Whether matrices (..., 3, 3) are symmetric to a millionth of their sigmas; others are no covariances.

    What is not finite or has no positive variances is not judged here.
    """
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.einsum("...ii->...i", covariance))
        apart = np.abs(covariance - np.swapaxes(covariance, -1, -2))
        astray = apart > 1e-6 * sigma[..., :, None] * sigma[..., None, :]
    return ~np.asarray(astray.any(axis=(-2, -1)))


def diagonal(values: Array) -> Array:
    """Diagonal matrices (..., n, n) with the given diagonals (..., n)."""
    out = np.zeros((*values.shape, values.shape[-1]))
    np.einsum("...ii->...i", out)[...] = values
    return out
