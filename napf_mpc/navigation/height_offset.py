r"""Compiled body of a barometer's offset: a fifth state of the vertical axis.

A barometer measures :math:`z = p + o + w`: the height p, an offset o that nobody knows at the start and that
wanders with the weather and with the sensor, and white noise w. What the offset has in common with the
axis' four states (:mod:`napf_mpc.navigation.kalman`) is kept beside them, so that an axis without a barometer
costs nothing: as the fix's errors are told from the position, so is the offset, and then holds the height
where no fix comes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled, compiled_bare

__all__ = ["NUMBERS", "VERTICAL", "begin", "carry", "follow", "learn", "shift", "take_in_heights"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MEAN, OP, OV, OG, OB, OO = range(6)
"""Numbers of an offset: its estimate, what it has in common with p, v, g and b, and its variance."""
NUMBERS = 6
VERTICAL = 2


@compiled_bare
def begin(offset: Array, variance: float) -> None:
    """Know nothing of an offset but the variance of its law [m^2]."""
    offset[:] = 0.0
    offset[OO] = variance


@compiled_bare
def shift(offset: Array, by: float, variance: float) -> None:
    """Take in that the height was another all the time, so that the offset is off by as much [m]."""
    mean = offset[MEAN] + by
    begin(offset, variance)
    offset[MEAN] = mean


@compiled_bare
def learn(offset: Array, k: Array, h_p: float, h_v: float, h_g: float, spread: float, miss: float) -> None:
    """Take in a measurement of ``h_p p + h_v v + h_g g`` that moved the four states with gains ``k``."""
    seen = h_p * offset[OP] + h_v * offset[OV] + h_g * offset[OG]
    offset[MEAN] += seen / spread * miss
    offset[OO] -= seen / spread * seen
    for n in range(4):
        offset[OP + n] -= k[n] * seen


@compiled_bare
def follow(offset: Array, pv: float, pb: float, prior: float, left: float, moved: float) -> None:
    """Take in that the position alone moved, and that its variance is a part of what it was.

    Velocity and bias were not moved with it; the offset is, by what it had in common with the position.

    Parameters
    ----------
    offset : array, shape (6,)
        Overwritten.
    pv, pb : float
        What the position had in common with velocity and bias.
    prior : float
        Variance of the position before [m^2].
    left : float
        Part of it that is left.
    moved : float
        How far the position moved [m].
    """
    if prior <= 0.0:
        return
    rate = offset[OP] / prior
    offset[MEAN] += rate * moved
    offset[OO] -= rate * (1.0 - left) * offset[OP]
    offset[OV] -= rate * (1.0 - left) * pv
    offset[OB] -= rate * (1.0 - left) * pb
    offset[OP] *= left


@compiled
def carry(offset: Array, period_s: float, bias_memory: float, drift: float, active: Mask) -> None:
    """Carry what offsets have in common with the states over a tick, in place.

    Parameters
    ----------
    offset : array, shape (run, uav, 6)
        Overwritten.
    period_s, bias_memory : float
        As in :func:`napf_mpc.navigation.kalman.predict`.
    drift : float
        Variance by which an offset wanders in a tick [m^2].
    active : array of bool, shape (run,)
        Runs to carry on.
    """
    for r in range(offset.shape[0]):
        if not active[r]:
            continue
        for i in range(offset.shape[1]):
            o = offset[r, i]
            o[OP] += period_s * o[OV] - 0.5 * period_s * period_s * o[OB]
            o[OV] -= period_s * o[OB]
            o[OB] *= bias_memory
            o[OO] += drift


@compiled
def take_in_heights(
    mean: Array,
    packed: Array,
    offset: Array,
    height: Array,
    noise: float,
    variance: float,
    gate: float,
    begun: Mask,
    active: Mask,
) -> None:
    """Update the vertical axes with one height each, in place.

    A height that leaps, farther than ``gate`` of its sigmas from what is expected, is one with a new offset:
    what was known of the old one is forgotten. One that is not finite is none.

    Parameters
    ----------
    mean, packed : array, shape (run, uav, 3, 4) and (run, uav, 3, 10)
        As in :mod:`napf_mpc.navigation.kalman`; the vertical axes are overwritten.
    offset : array, shape (run, uav, 6)
        Overwritten.
    height : array, shape (run, uav)
        Measured [m].
    noise, variance : float
        Variances of the white noise, and of an offset of which nothing is known [m^2].
    gate : float
        Largest innovation in its sigmas; 0 for none.
    begun : array of bool, shape (run, uav)
        UAVs whose filter has begun; the others have no height to compare with.
    active : array of bool, shape (run,)
        Runs that fly.
    """
    seen = np.empty(4)
    for r in range(offset.shape[0]):
        if not active[r]:
            continue
        for i in range(offset.shape[1]):
            if not (begun[r, i] and np.isfinite(height[r, i])):
                continue
            x, c, o = mean[r, i, VERTICAL], packed[r, i, VERTICAL], offset[r, i]
            miss = height[r, i] - x[0] - o[MEAN]
            spread = c[0] + 2.0 * o[OP] + o[OO] + noise
            if gate > 0.0 and miss * miss > gate * gate * spread:
                begin(o, variance)
                miss, spread = height[r, i] - x[0], c[0] + variance + noise
                if miss * miss > gate * gate * spread:
                    # Farther than any offset: taken as it is, so that the next heights can be told from it.
                    shift(o, miss, variance)
                    miss = 0.0
            for n in range(4):
                seen[n] = c[n] + o[OP + n]
            own = o[OP] + o[OO]
            for n in range(4):
                x[n] += seen[n] / spread * miss
                o[OP + n] -= seen[n] / spread * own
            o[MEAN] += own / spread * miss
            o[OO] -= own / spread * own
            n = 0
            for row in range(4):
                for column in range(row, 4):
                    c[n] -= seen[row] / spread * seen[column]
                    n += 1
