r"""Chance of an error reaching past a half-space or into a ball or disc, and the margin that keeps it down.

A margin of k sigma against a half-space is exact for a flat wall. A small obstacle is not a wall: an error
that goes far enough mostly goes past it. With the error split into its part along the normal, of standard
deviation sigma_n, and the rest, the chance of entering a ball or an endless upright cylinder of radius R from
a centre distance d is

    P(d) <= \int_{-R}^{R} phi((y - d) / sigma_n) / sigma_n L(R^2 - y^2) dy,

where L(w^2) is the most that the rest of the error can put within a distance w: 1 - exp(-w^2 / 2 g) for a
ball, erf(w / sqrt(2 g)) for a cylinder, g the generalised variance across the normal. Of all sets of one
area, the level ellipse of a normal law holds the most, so no correlation and no lateral offset makes the
chance larger: the bound holds all over the row's half-space. It is an equality, the non-central chi-square
law, where the error is equal in all directions.

That is the chance at one moment. In a mission a correlated error comes by a small obstacle more often, and
stays for less long, than behind a wall: for one chance per mission the chance at one moment has to be less by
:func:`mission_share`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled, compiled_bare

Array = NDArray[np.float64]
Index = NDArray[np.int64]

HALF_SPACE, BALL, DISC = 0, 1, 2
"""What an obstacle is taken for: a wall, a sphere, an endless vertical cylinder."""

_REACH = 8.0  # The integrand falls by more than exp(-32) over so many sigmas.
_TOLERANCE = 1e-7  # Of a margin, in sigmas.
_MOST_STEPS = 30
# Chances to 0.1 % where the error is equal in all directions, to 0.3 % where one is ten times another.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)


def half_space_probability(distance: Array | float, sigma: Array | float) -> Array:
    """Chance (...) that a normal error of standard deviation sigma exceeds a distance [m] to one side."""
    from scipy import special

    return np.asarray(special.ndtr(-np.asarray(distance) / sigma))


def ellipsoid_half_space_bound(offset: Array, covariance: Array, half_axes: Array) -> Array:
    """Bound on the chance that two bodies come within an ellipsoid of each other.

    The ellipsoid is turned into the unit ball by scaling the axes; the ball lies in the half-space behind its
    tangent across the line of centres, and the chance of a normal error beyond a plane is exact (Zhu and
    Alonso-Mora 2019, "Chance-constrained collision avoidance for MAVs in dynamic environments").

    Parameters
    ----------
    offset : array, shape (..., 3)
        Mean relative position, not zero [m].
    covariance : array, shape (..., 3, 3)
        Of the relative position [m^2].
    half_axes : array, shape (3,)
        Half-axes of the ellipsoid along east, north, up [m].

    Returns
    -------
    array, shape (...)
        Probability.
    """
    scaled = offset / half_axes
    length = np.sqrt((scaled * scaled).sum(-1))
    towards = scaled / length[..., None] / half_axes
    variance = np.einsum("...a,...ab,...b->...", towards, covariance, towards)
    return half_space_probability(length - 1.0, np.sqrt(variance))


@compiled_bare
def sigma_along(c: Array, x: float, y: float, z: float) -> float:
    """Standard deviation along a unit vector of an error of covariance c (3, 3) [m].

    The compiled twin of :func:`napf_mpc.safety_distance.directional_sigma`, to the last bit.
    """
    variance = c[0, 0] * x * x + c[1, 1] * y * y + c[2, 2] * z * z
    variance = variance + (c[0, 1] + c[1, 0]) * x * y
    variance = variance + (c[0, 2] + c[2, 0]) * x * z
    variance = variance + (c[1, 2] + c[2, 1]) * y * z
    return math.sqrt(max(variance, 0.0))


@compiled
def reach_probability(
    kind: int, radius: float, distance: float, sigma: float, g: float
) -> tuple[float, float]:
    """Chance of entering a ball or disc of some radius from a centre distance, and its slope by distance.

    Parameters
    ----------
    kind : int
        BALL or DISC.
    radius, distance : float
        Radius > 0 and distance to the centre or axis [m].
    sigma : float
        Standard deviation along the line to the centre, > 0 [m].
    g : float
        Generalised variance across it [m^2].

    Returns
    -------
    probability, slope : float
        The slope in 1/m.
    """
    # y = R cos(angle) makes the integrand smooth at both ends.
    last = math.acos(max(-1.0, 1.0 - _REACH * sigma / radius))
    probability = 0.0
    slope = 0.0
    for i in range(len(_NODES)):
        angle = 0.5 * last * (1.0 + _NODES[i])
        width = radius * math.sin(angle)
        if g <= 0.0:
            held = 1.0
        elif kind == BALL:
            held = -math.expm1(-0.5 * width * width / g)
        else:
            held = math.erf(width / math.sqrt(2.0 * g))
        beyond = (distance - radius * math.cos(angle)) / sigma
        part = _WEIGHTS[i] * math.exp(-0.5 * beyond * beyond) * held * width
        probability += part
        slope -= part * beyond / sigma
    scale = 0.5 * last / (math.sqrt(2.0 * math.pi) * sigma)
    return scale * probability, scale * slope


@compiled
def mission_share(
    kind: int,
    radius: float,
    variance: float,
    k: float,
    risk: float,
    active_s: float,
    correlation_time_s: float,
    period_s: float,
) -> float:
    """Chance at one moment in a ball or disc over that behind a wall, for one chance of a mission.

    The chance of a mission is about that of a moment times 1 + T / stay. An error stays tau / k^2 behind a
    wall at k sigma. It diffuses with sigma^2 / tau, and so leaves a ball within R^2 tau / (3 sigma^2) (the
    ball's content over the rate at which diffusion finds it), a disc within about R^2 tau / (2 sigma^2); both
    rates add up. Nor is the chance of a mission ever more than the sum over its fixes. The first is a rule of
    thumb: measured, a mission achieves from a quarter to all of what is asked (docs/risk_budget.md).

    Parameters
    ----------
    kind : int
        BALL or DISC.
    radius : float
        [m], > 0.
    variance : float
        Of the error, in the direction where it is larger [m^2].
    k : float
        Level against a wall.
    risk : float
        Chance of a mission against a wall at that level.
    active_s, correlation_time_s, period_s : float
        Time at the margin, correlation time of the error, time between two fixes (> 0) [s].

    Returns
    -------
    float
        In (0, 1]; 1 for constant errors and for large obstacles, nearly so for white ones.
    """
    fixes = max(active_s / period_s, 1.0)
    share = risk / (fixes * 0.5 * math.erfc(k / math.sqrt(2.0)))
    if correlation_time_s > 0.0:
        across = (3.0 if kind == BALL else 2.0) * variance / (radius * radius)
        times = active_s / correlation_time_s
        share = max(share, (1.0 + times * k * k) / (1.0 + times * (k * k + across)))
    return min(share, 1.0)


@compiled
def reach_margin(kind: int, radius: float, sigma: float, g: float, k: float, share: float = 1.0) -> float:
    """Margin beyond a radius at which the chance of entering is a share of a half-space's at k sigma [m].

    Between zero and k sigma: an obstacle so small that the chance is below the asked one on its surface
    already needs no margin, and the half-space's margin is enough for all that lies in it.
    """
    if sigma <= 0.0 or k <= 0.0:
        return 0.0
    asked = math.log(0.5 * math.erfc(k / math.sqrt(2.0))) + math.log(share)
    margin = k * sigma
    # The logarithm of P is concave and falls with the distance (a normal law and L on a convex body are
    # log-concave), so that Newton's method from the half-space's margin comes down to the root without ever
    # passing it: stopping early is safe.
    for _ in range(_MOST_STEPS):
        probability, slope = reach_probability(kind, radius, radius + margin, sigma, g)
        if not (probability > 0.0 and slope < 0.0):
            return margin
        step = (math.log(probability) - asked) * probability / slope
        if not step > _TOLERANCE * sigma:
            return margin
        margin -= step
        if margin <= 0.0:
            return 0.0
    return margin


@compiled
def exact_margins(
    kind: Index,
    radius: Array,
    normal: Array,
    covariance: Array,
    k: float,
    margin: Array,
    risk: float = 0.0,
    active_s: float = 0.0,
    correlation_time_s: float = 0.0,
    period_s: float = 1.0,
) -> None:
    """Fill in margins (point, m) of obstacles near points, in place.

    Parameters
    ----------
    kind : array, shape (point, m)
        HALF_SPACE, BALL or DISC (normal then horizontal).
    radius : array, shape (point, m)
        Of the ball or disc, the UAV's radius included [m].
    normal : array, shape (point, m, 3)
        Unit vectors from obstacle to UAV; zero for no obstacle.
    covariance : array, shape (point, 3, 3)
        Of the position [m^2].
    k : float
        Sigmas of the half-space whose one-sided chance is asked for.
    margin : array, shape (point, m)
        Result [m].
    risk, active_s, correlation_time_s, period_s : float
        If k is that of a mission: see :func:`mission_share`. Without a risk k speaks of one moment.
    """
    for i in range(kind.shape[0]):
        c = covariance[i]
        plane = c[0, 0] * c[1, 1] - c[0, 1] * c[1, 0]
        space = (
            c[2, 2] * plane
            - c[1, 2] * (c[0, 0] * c[2, 1] - c[0, 1] * c[2, 0])
            + c[0, 2] * (c[1, 0] * c[2, 1] - c[1, 1] * c[2, 0])
        )
        for j in range(kind.shape[1]):
            variance = 0.0
            for a in range(3):
                for b in range(3):
                    variance += normal[i, j, a] * c[a, b] * normal[i, j, b]
            sigma = math.sqrt(max(variance, 0.0))
            if kind[i, j] == HALF_SPACE or sigma == 0.0:
                margin[i, j] = k * sigma
            else:
                across = (
                    math.sqrt(max(space, 0.0) / variance)
                    if kind[i, j] == BALL
                    else max(plane, 0.0) / variance
                )
                share = 1.0
                if risk > 0.0:
                    largest = max(variance, across)
                    share = mission_share(
                        kind[i, j], radius[i, j], largest, k, risk, active_s, correlation_time_s, period_s
                    )
                margin[i, j] = reach_margin(kind[i, j], radius[i, j], sigma, across, k, share)
