r"""Random fields over place and time, as sums of waves: the same place and moment always has the same value.

.. math:: g(x, t) = \sqrt{2 / K} \sum_k \cos(a_k^T x / l + b_k t / \tau + \varphi_k)

with standard-normal a, b and uniform phases has mean zero, variance one and, over drawings, the correlation
exp(-r^2 / 2 l^2 - t^2 / 2 tau^2); with K = 16 waves its law is nearly normal (kurtosis 2.9). What a receiver
meets at a place then depends neither on how it came there nor on who else flies.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled

__all__ = ["WAVES", "Waves", "field_value", "waves"]

Array = NDArray[np.float64]

WAVES = 16
"""Waves in a field."""


class Waves(NamedTuple):
    """Fields as their waves."""

    vector: Array  # (..., wave, 3) wave vectors [1/m]
    rate: Array  # (..., wave) [1/s]
    phase: Array  # (..., wave) [rad]


def waves(normal: Array, uniform: Array, length_m: float, time_s: float) -> Waves:
    """Map numbers to fields.

    Parameters
    ----------
    normal : array, shape (..., wave, 4)
        Standard normal.
    uniform : array, shape (..., wave)
        Uniform on [0, 1).
    length_m, time_s : float
        Correlation length [m] and time [s], > 0.
    """
    return Waves(
        np.ascontiguousarray(normal[..., :3] / length_m),
        np.ascontiguousarray(normal[..., 3] / time_s),
        np.ascontiguousarray(2.0 * math.pi * uniform),
    )


@compiled
def field_value(vector: Array, rate: Array, phase: Array, x: float, y: float, z: float, t: float) -> float:
    """Value of one field at a place and time.

    Parameters
    ----------
    vector, rate, phase : array, shapes (wave, 3), (wave,), (wave,)
        Its waves.
    x, y, z, t : float
        [m, s].
    """
    total = 0.0
    for k in range(len(rate)):
        total += math.cos(vector[k, 0] * x + vector[k, 1] * y + vector[k, 2] * z + rate[k] * t + phase[k])
    return math.sqrt(2.0 / len(rate)) * total
