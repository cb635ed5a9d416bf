"""Protection levels of emulated receivers: which signals they trust, and the plain position of those."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napf_mpc.navigation.gnss import GnssScene, Observation
from napf_mpc.navigation.integrity.levels import Levels, LevelSettings, protection_levels
from napf_mpc.navigation.pseudorange_solution import PseudorangeSolution, SolverSettings, solve

__all__ = ["TRUSTED", "levels_of", "with_levels"]

Array = NDArray[np.float64]

TRUSTED = 0.1
"""Signals that are likelier than this to be faulty are left out before."""


def levels_of(observed: Observation, scene: GnssScene) -> Levels:
    """Protection levels (receiver,) of all receivers (run, uav) in a row.

    Errors are those of signals in sight; that one is a reflection alone is a fault, of the probability that
    its C/N0 leaves.
    """
    cfg = scene.config
    _, uavs, sats = observed.error.shape
    reflected = scene.p_reflected(observed.directions, observed.carrier_to_noise)
    p_fault = 1.0 - (1.0 - reflected) * (1.0 - cfg.p_satellite)
    usable = observed.tracked & (p_fault <= TRUSTED)
    unit = np.repeat(observed.directions[:, None], uavs, axis=1)
    return protection_levels(
        unit.reshape(-1, sats, 3),
        scene.clock,
        observed.error.reshape(-1, sats),
        _sight_sigma(observed, scene),
        p_fault.reshape(-1, sats),
        usable.reshape(-1, sats),
        LevelSettings(cfg.p_hmi, cfg.false_alarm),
    )


def with_levels(
    found: PseudorangeSolution, levels: Levels, observed: Observation, scene: GnssScene
) -> PseudorangeSolution:
    """Solution (receiver,) with the positions that the levels bound, where there are levels."""
    _, uavs, sats = observed.error.shape
    known = np.asarray(np.isfinite(levels.level_m).all(-1))
    unit = np.repeat(observed.directions[:, None], uavs, axis=1)
    plain = solve(
        unit.reshape(-1, sats, 3),
        scene.clock,
        observed.error.reshape(-1, sats),
        _sight_sigma(observed, scene),
        levels.used & known[:, None],
        SolverSettings("plain", exclude=False, max_pdop=np.inf),
    )

    one, two = known[:, None], known[:, None, None]
    return PseudorangeSolution(
        np.where(one, plain.offset, found.offset),
        np.where(one, plain.clock, found.clock),
        np.where(two, plain.covariance, found.covariance),
        np.where(two, plain.gain, found.gain),
        np.where(one, plain.used, found.used),
        np.where(known, plain.check, found.check),
        np.where(one, plain.dop, found.dop),
        np.where(known, plain.excess, found.excess),
    )


def _sight_sigma(observed: Observation, scene: GnssScene) -> Array:
    """(receiver, sat) sigma of signals in sight [m]."""
    sigma = scene.sight_sigma(observed.directions, observed.carrier_to_noise)
    return np.asarray(sigma.reshape(-1, observed.error.shape[-1]))
