r"""Protection levels by solution separation with multiple hypotheses (ARAIM), for one epoch.

After J. Blanch, T. Walter, P. Enge, Y. Lee, B. Pervan, M. Rippl, A. Spletter, V. Kropp, "Baseline advanced
RAIM user algorithm and possible improvements", IEEE Trans. AES 51(1), 2015. Each fault hypothesis k leaves
out the satellites that it spoils. Its solution :math:`S_k` is compared with that of all in view, :math:`S_0`:
with :math:`|(S_k - S_0) y|_q \le T_{k,q}` no alarm is raised, and then the error of the all-in-view solution
along axis q is under hypothesis k at most :math:`T_{k,q}` more than that of :math:`S_k`. The protection level
is the least L with

.. math:: 2 \bar\Phi\!\left(\frac{L - b_{0,q}}{\sigma_{0,q}}\right) + \sum_k p_k
          \bar\Phi\!\left(\frac{L - T_{k,q} - b_{k,q}}{\sigma_{k,q}}\right) = P_{HMI,q}
          \left(1 - \frac{P_{unmonitored}}{P_{HMI}}\right).

Faults are of three kinds: of a satellite, of a whole constellation, and a signal that arrives by reflection
alone (NLOS). The last is in a street no rare event, so hypotheses of several faults at a time are what it
takes; where too many of them are too likely to be looked at, there is no protection level, and the answer
says so.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import special

__all__ = ["IntegrityRequirement", "ProtectionLevel", "RangeErrors", "protection_level"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAX_CONDITION = 1e8
"""A hypothesis whose remaining geometry is worse conditioned than this cannot be solved."""


@dataclass(frozen=True)
class IntegrityRequirement:
    """What is asked of a protection level; the defaults are those of LPV-200 in the paper's Table 1."""

    p_hmi_horizontal: float = 2e-9
    """Probability that the horizontal error exceeds its level without an alarm."""
    p_hmi_vertical: float = 9.8e-8
    """The same for the vertical error."""
    p_fa_horizontal: float = 9e-8
    """Probability of an alarm without a fault, by horizontal separations."""
    p_fa_vertical: float = 3.9e-6
    """The same by vertical ones."""
    p_unmonitored: float = 9e-8
    """Hypotheses are added by number of faults until what is left is as unlikely as this."""
    max_faults: int = 3
    """Most faults at a time that a hypothesis has."""

    def __post_init__(self) -> None:
        names = ("p_hmi_horizontal", "p_hmi_vertical", "p_fa_horizontal", "p_fa_vertical", "p_unmonitored")
        for name in names:
            value = getattr(self, name)
            if not 0.0 < value < 1.0:
                raise ValueError(f"{name} = {value!r} must be > 0 and < 1")
        if not 1 <= self.max_faults <= 6:
            raise ValueError(f"max_faults = {self.max_faults!r} must be from 1 to 6")

    @property
    def p_hmi(self) -> float:
        """Of both together."""
        return self.p_hmi_horizontal + self.p_hmi_vertical


@dataclass(frozen=True)
class RangeErrors:
    """What is known of the errors of n pseudoranges.

    Raises
    ------
    ValueError
        A shape or a type does not fit, a direction is no unit vector, a sigma is not positive, a probability
        not in [0, 1), or a prior is of a constellation that no range is of while another has none.
    """

    line_of_sight: Array
    """(n, 3) unit vectors from the receiver to the satellites, east, north, up."""
    constellation: NDArray[np.int64]
    """(n,) number that tells constellations apart; each has a clock of its own."""
    sigma_m: Array
    """(n,) sigma for integrity, an overbound of the fault-free error [m]."""
    bias_m: Array
    """(n,) nominal bias, bound on what the overbound's mean may be off [m]."""
    p_satellite: Array
    """(n,) prior probability that the satellite is faulty."""
    p_constellation: dict[int, float]
    """Prior probability that a whole constellation is, by its number; none given is zero."""
    p_nlos: Array | None = None
    """(n,) prior probability that the signal arrives by reflection alone; by default zero."""
    sigma_accuracy_m: Array | None = None
    """(n,) sigma for continuity, the error as it usually is [m]; by default that for integrity."""

    def __post_init__(self) -> None:
        for name in ("line_of_sight", "sigma_m", "bias_m", "p_satellite", "p_nlos", "sigma_accuracy_m"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _numbers(name, getattr(self, name)))
        object.__setattr__(self, "constellation", np.asarray(self.constellation))
        n = len(self.line_of_sight) if self.line_of_sight.ndim else 0
        if self.line_of_sight.shape != (n, 3) or n == 0:
            raise ValueError(
                f"line_of_sight has shape {self.line_of_sight.shape}, must be (n, 3) with n >= 1"
            )
        lengths = np.sqrt((self.line_of_sight**2).sum(-1))
        if not (np.abs(lengths - 1.0) < 1e-6).all():
            raise ValueError("line_of_sight must be unit vectors")
        for name in ("constellation", "sigma_m", "bias_m", "p_satellite", "p_nlos", "sigma_accuracy_m"):
            value = getattr(self, name)
            if value is not None and value.shape != (n,):
                raise ValueError(f"{name} has shape {value.shape}, must be ({n},)")
        if self.constellation.dtype.kind not in "iu":
            raise ValueError(
                f"constellation must hold whole numbers, got {self.constellation.dtype}; number them by "
                "np.unique(constellation, return_inverse=True)[1]"
            )
        present = np.unique(self.constellation).tolist()
        strange = [key for key in self.p_constellation if key not in present]
        # One that is out of view may have a prior; beside one in view that has none it is a slip.
        if strange and not self.p_constellation.keys() >= set(present):
            raise ValueError(
                f"p_constellation names {strange[0]!r}, must be one of constellation: "
                f"{', '.join(map(str, present))} (a prior of what is out of view is taken if all in view "
                "have one, if need be of 0)"
            )
        for name in ("sigma_m", "sigma_accuracy_m"):
            value = getattr(self, name)
            if value is not None and not ((value > 0.0) & np.isfinite(value)).all():
                raise ValueError(f"{name} must be > 0 and finite")
        if not ((self.bias_m >= 0.0) & np.isfinite(self.bias_m)).all():
            raise ValueError("bias_m must be >= 0 and finite")
        nlos = () if self.p_nlos is None else self.p_nlos
        for p in (*self.p_satellite, *self.p_constellation.values(), *nlos):
            if not 0.0 <= p < 1.0:
                raise ValueError(f"a prior probability is {p!r}, must be >= 0 and < 1")


def _numbers(name: str, values: object) -> Array:
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must hold numbers: {error}") from error


@dataclass(frozen=True)
class ProtectionLevel:
    """Bounds on the error of the all-in-view solution, and the test that they rest on."""

    horizontal_m: float
    """HPL [m], root of the squares of those of east and north; infinite if there is none."""
    vertical_m: float
    """VPL [m]; infinite if there is none."""
    axis_m: Array
    """(3,) levels of east, north and up [m]."""
    reason: str
    """Why there is none; empty if there is one."""
    excluded: Mask
    """(k, n) satellites that each fault hypothesis leaves out."""
    prior: Array
    """(k,) prior probability of each."""
    p_unmonitored: float
    """Probability of what no hypothesis covers."""
    gain: Array
    """(1 + k, 3, n) solutions as gains on the pseudoranges' residuals, all in view first."""
    threshold_m: Array
    """(k, 3) largest separation without an alarm [m]."""

    @property
    def available(self) -> bool:
        """Whether there is a protection level."""
        return not self.reason

    def consistent(self, residual_m: Array) -> NDArray[np.bool_]:
        """Whether no separation leaves its threshold; if one does, the level is void: exclude, or do without.

        Parameters
        ----------
        residual_m : array, shape (..., n)
            Pseudoranges less those computed at the point of linearisation, clocks left in [m].
        """
        separation = np.einsum("kqn,...n->...kq", self.gain[1:] - self.gain[:1], residual_m)
        return np.asarray((np.abs(separation) <= self.threshold_m).all(axis=(-2, -1)))


def protection_level(ranges: RangeErrors, requirement: IntegrityRequirement | None = None) -> ProtectionLevel:
    """Horizontal and vertical protection level of a weighted least-squares position.

    The position is that with the weights 1 / ``sigma_m``^2 and one clock a constellation.

    Parameters
    ----------
    ranges : RangeErrors
        Geometry, error laws and priors.
    requirement : IntegrityRequirement, optional
        Probabilities asked for.

    Returns
    -------
    ProtectionLevel
        None (infinite, with a reason) with fewer than m + 4 satellites for m constellations, with a geometry
        that cannot be solved, or if hypotheses that nobody looks at are likelier than what is asked for.
    """
    asked = IntegrityRequirement() if requirement is None else requirement
    n = len(ranges.line_of_sight)
    clocks = np.unique(ranges.constellation)
    if n < len(clocks) + 4:
        few = f"{n} satellites of {len(clocks)} constellations, at least {len(clocks) + 4} are needed"
        return _none(n, few)
    excluded, prior, unmonitored = _hypotheses(ranges, asked)
    used = np.vstack([np.ones((1, n), dtype=np.bool_), ~excluded])
    gain, variance, solvable = _solutions(ranges, clocks, used)
    if not solvable[0]:
        return _none(n, "the satellites in view do not tell the position")
    # What cannot be solved without them cannot be looked at: its probability is spent.
    unmonitored += math.fsum(prior[~solvable[1:]].tolist())
    excluded, prior = excluded[solvable[1:]], prior[solvable[1:]]
    gain, variance = gain[solvable], variance[solvable]
    if unmonitored >= asked.p_hmi:
        return _none(
            n,
            f"faults that no hypothesis covers have the probability {unmonitored:.2g}, must be below "
            f"p_hmi = {asked.p_hmi:.2g}",
            unmonitored,
        )
    sigma = np.sqrt(variance)
    bias = np.einsum("kqn,n->kq", np.abs(gain), ranges.bias_m)
    accuracy = ranges.sigma_m if ranges.sigma_accuracy_m is None else ranges.sigma_accuracy_m
    separation = np.sqrt(np.einsum("kqn,n->kq", (gain[1:] - gain[:1]) ** 2, accuracy**2))
    share = np.array([asked.p_fa_horizontal / 4.0] * 2 + [asked.p_fa_vertical / 2.0]) / max(1, len(prior))
    threshold = -special.ndtri(share) * separation
    left = 1.0 - unmonitored / asked.p_hmi
    budget = np.array([asked.p_hmi_horizontal / 2.0] * 2 + [asked.p_hmi_vertical]) * left
    axis = np.array(
        [_level(sigma[:, q], bias[:, q], threshold[:, q], prior, float(budget[q])) for q in range(3)]
    )
    return ProtectionLevel(
        horizontal_m=math.hypot(axis[0], axis[1]),
        vertical_m=float(axis[2]),
        axis_m=axis,
        reason="",
        excluded=excluded,
        prior=prior,
        p_unmonitored=unmonitored,
        gain=gain,
        threshold_m=threshold,
    )


def _none(n: int, reason: str, unmonitored: float = 1.0) -> ProtectionLevel:
    return ProtectionLevel(
        math.inf, math.inf, np.full(3, math.inf), reason, np.zeros((0, n), dtype=np.bool_), np.zeros(0),
        unmonitored, np.zeros((1, 3, n)), np.zeros((0, 3)),
    )  # fmt: skip


def _hypotheses(ranges: RangeErrors, asked: IntegrityRequirement) -> tuple[Mask, Array, float]:
    """Satellites left out (k, n), their probabilities (k,), and that of all that is not among them."""
    n = len(ranges.line_of_sight)
    nlos = np.zeros(n) if ranges.p_nlos is None else ranges.p_nlos
    events: list[tuple[Mask, float]] = []
    for i in range(n):
        p = 1.0 - (1.0 - float(ranges.p_satellite[i])) * (1.0 - float(nlos[i]))
        events.append((np.arange(n) == i, p))
    for name in np.unique(ranges.constellation):
        events.append((ranges.constellation == name, ranges.p_constellation.get(int(name), 0.0)))
    events = [event for event in events if event[1] > 0.0]
    none = math.prod(1.0 - p for _, p in events)
    found: dict[bytes, tuple[Mask, float]] = {}
    covered = none
    for count in range(1, asked.max_faults + 1):
        if 1.0 - covered <= asked.p_unmonitored:
            break
        for out, p in _together(events, count, none):
            covered += p
            key = out.tobytes()  # a satellite beside its own constellation changes nothing
            found[key] = (out, p + (found[key][1] if key in found else 0.0))
    masks = [out for out, _ in found.values()]
    excluded = np.array(masks, dtype=np.bool_).reshape(-1, n)
    prior = np.array([p for _, p in found.values()])
    return excluded, prior, max(0.0, 1.0 - covered)


def _together(events: list[tuple[Mask, float]], count: int, none: float) -> Iterator[tuple[Mask, float]]:
    """Satellites spoilt and probability of each way in which so many faults, and no others, happen."""
    for chosen in combinations(events, count):
        out = chosen[0][0].copy()
        odds = 1.0
        for mask, p in chosen:
            out |= mask
            odds *= p / (1.0 - p)
        yield out, none * odds


def _solutions(ranges: RangeErrors, clocks: NDArray[np.int64], used: Mask) -> tuple[Array, Array, Mask]:
    """Gains (k, 3, n) and variances (k, 3) with the satellites used (k, n), and which solutions there are."""
    n, m = len(ranges.line_of_sight), len(clocks)
    design = np.zeros((n, 3 + m))
    design[:, :3] = -ranges.line_of_sight
    design[:, 3:] = ranges.constellation[:, None] == clocks
    weight = used / ranges.sigma_m**2
    normal = np.einsum("na,kn,nb->kab", design, weight, design)
    # A clock that nobody is left to tell is no unknown.
    idle = ~(normal[:, range(3, 3 + m), range(3, 3 + m)] > 0.0)
    normal[:, range(3, 3 + m), range(3, 3 + m)] += idle
    scale = np.sqrt(np.maximum(np.einsum("kaa->ka", normal), 1e-300))
    scaled = normal / (scale[:, :, None] * scale[:, None, :])
    low = np.linalg.eigvalsh(scaled)[:, 0]
    solvable = low > 1.0 / MAX_CONDITION  # too few satellites leave the matrix singular
    scaled[~solvable] = np.eye(3 + m)
    inverse = np.linalg.inv(scaled) / (scale[:, :, None] * scale[:, None, :])
    gain = np.einsum("kqa,na,kn->kqn", inverse[:, :3], design, weight)
    variance = np.stack([inverse[:, q, q] for q in range(3)], axis=-1)
    return gain, variance, np.asarray(solvable)


def _level(sigma: Array, bias: Array, threshold: Array, prior: Array, budget: float) -> float:
    """Solve for the level of one axis; the sum falls with it."""
    shift = np.concatenate([[0.0], threshold]) + bias
    weight = np.concatenate([[2.0], prior])

    def excess(level: float) -> float:
        return float(weight @ special.ndtr((shift - level) / sigma)) - budget

    low, high = 0.0, float((shift + 9.0 * sigma).max())
    while excess(high) > 0.0:
        high *= 2.0
    if excess(low) <= 0.0:
        return low
    from scipy import optimize  # half a second, and only a level needs it

    return float(optimize.brentq(excess, low, high, xtol=1e-6))
