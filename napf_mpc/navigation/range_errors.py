"""How large the errors of pseudoranges are: plain functions of elevation and C/N0, one a cause.

Group delays and satellite clocks are not among them: a receiver corrects for what is broadcast, and what is
left belongs to the signal in space. The receiver's own clock is an unknown of the solution.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "carrier_to_noise_dbhz",
    "code_noise_sigma_m",
    "multipath_sigma_m",
    "obliquity",
    "p_reflected",
    "troposphere_mapping",
]

Array = NDArray[np.float64]

_EARTH_M = 6_378_136.3
_IONOSPHERE_M = 350_000.0


def obliquity(elevation_rad: Array) -> Array:
    """Slant over vertical delay of a thin ionosphere at 350 km: (1 - (Re cos E / (Re + h))^2)^-1/2.

    Source: RTCA DO-229, A.4.4.10.4.
    """
    sine = _EARTH_M * np.cos(elevation_rad) / (_EARTH_M + _IONOSPHERE_M)
    return np.asarray(1.0 / np.sqrt(1.0 - sine**2))


def troposphere_mapping(elevation_rad: Array) -> Array:
    """Slant over vertical residual of the troposphere: 1.001 / sqrt(0.002001 + sin^2 E).

    Source: RTCA DO-229, A.4.2.4, where the vertical residual has a sigma of 0.12 m.
    """
    return np.asarray(1.001 / np.sqrt(0.002001 + np.sin(elevation_rad) ** 2))


def multipath_sigma_m(elevation_rad: Array) -> Array:
    """Sigma of multipath on a visible signal by the airborne model: 0.13 m + 0.53 m exp(-E / 10 deg).

    Source: RTCA DO-229, J.2.4. It is for an aircraft far from everything; scale it for a city.
    """
    return np.asarray(0.13 + 0.53 * np.exp(-np.degrees(elevation_rad) / 10.0))


def carrier_to_noise_dbhz(elevation_rad: Array, horizon_dbhz: float, zenith_dbhz: float) -> Array:
    """C/N0 of a visible signal [dB Hz]: from its value at the horizon to that at the zenith with sin E."""
    return np.asarray(horizon_dbhz + (zenith_dbhz - horizon_dbhz) * np.sin(elevation_rad))


def code_noise_sigma_m(carrier_to_noise: Array, sigma_at_45_m: float) -> Array:
    """Sigma of code noise: in proportion to the noise's amplitude, sigma_45 10^((45 - C/N0) / 20).

    Source: the form of the sigma-epsilon model (Hartinger and Brunner 1999).
    """
    return np.asarray(sigma_at_45_m * 10.0 ** ((45.0 - carrier_to_noise) / 20.0))


def p_reflected(
    excess_db: Array, fading_db: float, loss_db: float, loss_sigma_db: float, prior: Array
) -> Array:
    """Probability that a signal arrives by reflection alone, by Bayes' rule from its C/N0.

    Parameters
    ----------
    excess_db : array
        C/N0 over what is expected at its elevation [dB].
    fading_db : float
        Sigma of a signal in sight about that [dB]; taken as 0.1 at least.
    loss_db, loss_sigma_db : float
        Mean and sigma of the loss of a reflected one [dB]; the sigma is taken as 0.1 at least.
    prior : array
        Probability before its strength is known, < 1.

    Returns
    -------
    array
        At least what the loss' own upper tail leaves: strong signals are nearly certain, none is certain.
    """
    fading, spread = max(fading_db, 0.1), max(loss_sigma_db, 0.1)
    # Of a signal stronger than its kind nobody learns that it is reflected because the tail is thinner there.
    sight = (np.minimum(excess_db, 0.0) / fading) ** 2
    other = ((np.minimum(excess_db, 0.0) + loss_db) / spread) ** 2
    odds = prior / (1.0 - prior) * fading / spread * np.exp(np.clip(0.5 * (sight - other), -700.0, 700.0))
    return np.asarray(odds / (1.0 + odds))
