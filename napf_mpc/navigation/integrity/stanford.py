"""Judgement of protection levels by the truth: which epochs are misleading, and how badly.

Classes of the Stanford diagram (M. Tossaint et al., "The Stanford-ESA integrity diagram", Navigation 54(2),
2007).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

__all__ = ["Integrity", "IntegrityCount", "classify", "count_classes"]

Array = NDArray[np.float64]


class Integrity(IntEnum):
    """What an epoch's protection level was worth."""

    NOMINAL = 0
    """error <= PL <= AL: available and true."""
    MISLEADING = 1
    """PL < error <= AL: the bound did not hold, the limit did."""
    HAZARDOUS = 2
    """PL <= AL < error: available, and beyond the limit."""
    UNAVAILABLE = 3
    """AL < PL, error <= PL: not to be used, and so it said."""
    UNAVAILABLE_MISLEADING = 4
    """AL < PL < error: not to be used, and yet the bound did not hold."""
    NONE = 5
    """No protection level or no error to compare."""


def classify(error_m: Array, level_m: Array, alert_limit_m: float) -> NDArray[np.int8]:
    """Class of each epoch: misleading is error > PL, hazardously misleading is error > AL >= PL.

    Parameters
    ----------
    error_m : array, any shape
        Size of the position error [m].
    level_m : array, the same shape
        Protection level [m]; NaN or infinite for none.
    alert_limit_m : float
        Alert limit [m], > 0.

    Returns
    -------
    array of int8
        Codes of :class:`Integrity`.
    """
    if not (math.isfinite(alert_limit_m) and alert_limit_m > 0.0):
        raise ValueError(f"alert_limit_m = {alert_limit_m!r} must be a finite number > 0")
    error, level = np.abs(error_m), np.asarray(level_m, dtype=np.float64)
    beyond, usable = error > level, level <= alert_limit_m
    out = np.where(
        usable,
        np.where(beyond, np.where(error > alert_limit_m, Integrity.HAZARDOUS, Integrity.MISLEADING), 0),
        np.where(beyond, Integrity.UNAVAILABLE_MISLEADING, Integrity.UNAVAILABLE),
    )
    return np.where(np.isfinite(error) & np.isfinite(level), out, Integrity.NONE).astype(np.int8)


@dataclass(frozen=True)
class IntegrityCount:
    """How many epochs were of each class."""

    by_class: dict[Integrity, int]
    """Class -> epochs."""

    @property
    def total(self) -> int:
        """Epochs with a protection level and an error."""
        return sum(count for kind, count in self.by_class.items() if kind is not Integrity.NONE)

    @property
    def misleading(self) -> int:
        """Epochs with error > PL, hazardous or not, available or not."""
        false = (Integrity.MISLEADING, Integrity.HAZARDOUS, Integrity.UNAVAILABLE_MISLEADING)
        return sum(self.by_class[kind] for kind in false)


def count_classes(codes: NDArray[np.int8]) -> IntegrityCount:
    """Count codes of :func:`classify`."""
    return IntegrityCount({kind: int((codes == kind).sum()) for kind in Integrity})
