"""Position from measured pseudoranges and satellites' places, from any start: Gauss-Newton on the earth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pymap3d
from numpy.typing import NDArray

from napf_mpc.navigation.ephemeris import LIGHT_MPS
from napf_mpc.navigation.pseudorange_solution import Check, PseudorangeSolution, SolverSettings, solve
from napf_mpc.navigation.sky import east_north_up, turned

__all__ = ["EarthFix", "fix_from_pseudoranges"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.int64]

_PLAIN = SolverSettings("plain", exclude=False, max_pdop=1e6)
_STEPS = 25
_STILL_M = 1e-4


@dataclass(frozen=True)
class EarthFix:
    """A position on the earth, and how it was found."""

    place: Array
    """(3,) earth-fixed [m]."""
    solution: PseudorangeSolution
    """Of the last step, for one receiver; its ``offset`` is the last correction."""

    @property
    def check(self) -> Check:
        """What the residuals say; :attr:`Check.NONE` if there is no position."""
        return Check(int(self.solution.check[0]))


def fix_from_pseudoranges(
    pseudorange: Array,
    satellite: Array,
    clock: Index,
    sigma: Array,
    settings: SolverSettings,
    start: Array | None = None,
    earth_turns: bool = True,
) -> EarthFix:
    """Solve for place and clocks; first plain until it stands still, then as the settings say.

    Parameters
    ----------
    pseudorange : array, shape (sat,)
        With the satellites' clocks and the atmosphere removed [m].
    satellite : array, shape (sat, 3)
        When they sent, earth-fixed axes of that moment [m].
    clock : array of int, shape (sat,)
        Which of the receiver's clocks a satellite is measured against.
    sigma : array, shape (sat,)
        Of the errors, as believed [m].
    settings : SolverSettings
        Weights, fault exclusion, limits.
    start : array, shape (3,), optional
        Where to begin, earth-fixed [m]; by default under the mean of the satellites.
    earth_turns : bool
        Whether to take the earth's turn during the signals' flight into account. Without, places come out
        some tens of metres too far west or east.

    Returns
    -------
    EarthFix
        East, north, up of its solution are those at the place.
    """
    if start is None:
        middle = satellite.mean(axis=0)
        start = 6.37e6 * middle / np.linalg.norm(middle)
    place = np.array(start, dtype=np.float64)
    tracked = np.ones((1, len(pseudorange)), dtype=np.bool_)
    stage = _PLAIN
    for _ in range(_STEPS):
        latitude, longitude, _ = pymap3d.ecef2geodetic(*place)
        axes = east_north_up(float(latitude), float(longitude))
        flight = np.linalg.norm(satellite - place, axis=-1) / LIGHT_MPS
        away = (turned(satellite, flight) if earth_turns else satellite) - place
        distance = np.linalg.norm(away, axis=-1)
        unit = (away / distance[:, None]) @ axes.T
        # Clocks are solved for in every step, so what is left is small and the sums keep their digits.
        found = solve(unit[None], clock, (pseudorange - distance)[None], sigma[None], tracked, stage)
        if found.check[0] == Check.NONE:
            break
        place = place + found.offset[0] @ axes
        if np.linalg.norm(found.offset[0]) < _STILL_M:
            if stage is settings:
                break
            stage = settings
    return EarthFix(place, found)
