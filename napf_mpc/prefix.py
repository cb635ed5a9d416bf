"""The first runs of a campaign, as soon as all of them are there: what a stopping rule is asked about."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from napf_mpc.campaign_folder import first_runs
from napf_mpc.store import Columns

LEAST_LOOK = 50
"""Runs from one question to the next, at least."""
LOOK_SHARE = 20
"""And at least one part in so many of what is flown: looking at all rows takes time, too."""


def looks(runs: int) -> list[int]:
    """Numbers of runs after which a stopping rule is asked, whatever blocks and workers there are.

    Parameters
    ----------
    runs : int
        Runs of the whole campaign; the last look.
    """
    places = [min(runs, LEAST_LOOK)]
    while places[-1] < runs:
        places.append(min(runs, places[-1] + max(LEAST_LOOK, places[-1] // LOOK_SHARE)))
    return places


class Prefix:
    """Blocks in any order, and a stopping rule that is asked about the first runs in theirs.

    Parameters
    ----------
    enough : callable
        Takes rows as they would be in ``runs.parquet``; says whether the campaign may end there.
    planners : sequence of str
        Names of planners.
    runs : int
        Runs of the whole campaign.
    """

    def __init__(self, enough: Callable[[Columns], bool], planners: Sequence[str], runs: int) -> None:
        self.answer: int | None = None
        """Runs that are enough; None as long as the rule has not said so."""
        self._enough = enough
        self._planners = planners
        self._looks = looks(runs)
        self._waiting: dict[int, tuple[range, Columns]] = {}
        self._tables: list[Columns] = []
        self._there = 0

    def add(self, block: range, rows: Columns) -> None:
        """Take the rows of a block, and ask as far as all runs before a look are there."""
        self._waiting[block.start] = (block, rows)
        while self._there in self._waiting:
            block, rows = self._waiting.pop(self._there)
            self._tables.append(rows)
            self._there = block.stop
        while self.answer is None and self._looks and self._looks[0] <= self._there:
            look = self._looks.pop(0)
            if self._enough(first_runs(self._tables, self._planners, look)):
                self.answer = look
