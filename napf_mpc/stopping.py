r"""When a campaign has flown enough: an interval of a rate that stays valid however often one looks at it.

A Wilson interval misses the true rate in 5 % of campaigns whose number of runs was fixed beforehand. Looked
at after every run, to stop once it is narrow or low enough, it misses far more often. The interval here is a
confidence sequence: with a probability of at least 95 % it holds the true rate after every run at once.

Under the rate p the likelihood ratio of the runs so far, with the rate mixed over a Beta(a, b) law,

.. math:: M_n(p) = \int_0^1 \frac{q^s (1 - q)^{n - s}}{p^s (1 - p)^{n - s}} \, d\mathrm{Beta}_{a, b}(q)
                 = \frac{B(a + s, b + n - s)}{B(a, b) \, p^s (1 - p)^{n - s}},

s contacts in n runs, is a non-negative martingale that starts at 1, so by Ville's inequality it ever reaches
1 / alpha with a probability of at most alpha. The rates at which it has not reached it are the interval
(Robbins 1970; Howard, Ramdas, McAuliffe and Sekhon 2021, section 3). a = b = 1/2 is the mixture of
Krichevsky and Trofimov (1981), which pays at most log(n) / 2 + log(2) for not knowing the rate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.special import betaln, xlog1py, xlogy

from napf_mpc.errors import ProblemError
from napf_mpc.words import shown_number

ALPHA = 0.05
"""Chance that the sequence of intervals ever misses the true rate, at most."""
FAILED = "failed"
"""Outcome of a mission whose numbers stopped being finite, as rows of runs have it."""
MIXTURE = (0.5, 0.5)
"""Parameters a, b of the Beta law over which the likelihood is mixed."""


def log_evidence(count: ArrayLike, total: ArrayLike, rate: ArrayLike) -> NDArray[np.float64]:
    """Log of the mixture martingale M_n(p): how strongly the runs so far speak against a rate.

    Parameters
    ----------
    count, total : array_like of int
        Runs in which it happened, and all runs; 0 <= count <= total.
    rate : array_like of float
        p, 0 to 1.

    Returns
    -------
    array
        Infinite for a rate that cannot be: 0 after a contact, 1 after a clean run.
    """
    hits, runs, p = np.asarray(count), np.asarray(total), np.asarray(rate, dtype=np.float64)
    a, b = MIXTURE
    mixed = betaln(a + hits, b + runs - hits) - betaln(a, b)
    return np.asarray(mixed - xlogy(hits, p) - xlog1py(runs - hits, -p))


def sequential_interval(count: int, total: int) -> tuple[float, float]:
    """95 % interval of a rate that is valid at whatever run one looks at it, or stops.

    Parameters
    ----------
    count, total : int
        Runs in which it happened, and all runs.

    Returns
    -------
    low, high : float
        Ends of the interval. It is wider than the Wilson interval of the same runs.

    Raises
    ------
    ValueError
        If not 0 <= count <= total, or total is 0.
    """
    if total < 1 or not 0 <= count <= total:
        raise ValueError(f"need 0 <= count <= total and total >= 1, got count {count}, total {total}")

    def above(rate: float) -> float:
        return float(log_evidence(count, total, rate)) + math.log(ALPHA)

    value = count / total
    # The evidence is convex in the rate, least at count / total, and infinite at the ends but for 0 and all.
    tiny = 1e-300
    low = 0.0 if count == 0 else _root(above, tiny, value)
    high = 1.0 if count == total else _root(above, math.nextafter(1.0, 0.0), value)
    return low, high


def _root(above: Callable[[float], float], outer: float, inner: float) -> float:
    return float(brentq(above, outer, inner, xtol=1e-14, rtol=1e-12)) if above(outer) > 0.0 else outer


@dataclass(frozen=True)
class StoppingRule:
    """Stop a campaign once the sequential interval of the collision risk is narrow or low enough.

    With both limits, one that is met is enough. With several planners all have to meet one.
    """

    width: float | None = None
    """Stop once the interval is narrower than this."""
    upper: float | None = None
    """Stop once its upper end is below this."""

    def __post_init__(self) -> None:
        faults = []
        for name, limit in (("until-width", self.width), ("until-upper", self.upper)):
            if limit is not None and not 0.0 < limit < 1.0:
                faults.append(f"{name} = {shown_number(limit)}: must be a rate above 0 and below 1")
        if self.width is None and self.upper is None:
            faults.append("give until-width or until-upper")
        if faults:
            raise ProblemError("campaign", faults)

    def __str__(self) -> str:
        limits = (("until-width", self.width), ("until-upper", self.upper))
        return " or ".join(f"{name} {shown_number(limit)}" for name, limit in limits if limit is not None)

    def __call__(self, rows: Mapping[str, NDArray[Any]]) -> bool:
        """Whether the runs so far are enough.

        Parameters
        ----------
        rows : mapping of str to array
            Columns of :func:`napf_mpc.block.score_rows`, of all runs from 0 on without gaps.
        """
        # A mission that failed is not a safe one: a campaign must not stop because of it.
        contact = np.asarray(rows["obstacle_contact"], dtype=bool) | (rows["outcome"] == FAILED)
        planner = rows["planner"]
        if (planner == planner[0]).all():
            return self.met(int(contact.sum()), len(contact))
        return all(
            self.met(int(contact[planner == name].sum()), int((planner == name).sum()))
            for name in np.unique(planner)
        )

    def met(self, count: int, total: int) -> bool:
        """Whether so many contacts in so many runs are enough."""
        enough = -math.log(ALPHA)
        # No need to look for the upper end to know on which side of a rate it is.
        if (
            self.upper is not None
            and count / total < self.upper
            and log_evidence(count, total, self.upper) > enough
        ):
            return True
        if self.width is None:
            return False
        low, high = sequential_interval(count, total)
        return high - low < self.width
