"""The kernel solver: exact answers for the horizons of many UAVs, by a dual active set on the signal kernel.

What the model determines is computed once for a model; a program costs two sweeps along its stages, made side
by side with others', a scan of its rows where no known row is violated, and a certificate. See
:mod:`~napf_mpc.solvers.kernel_signals`, :mod:`~napf_mpc.solvers.kernel_sweep` and
:mod:`~napf_mpc.solvers.kernel_active_set`.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

import numpy as np

from napf_mpc.constraints.constraint import LinearRows
from napf_mpc.qp import STATES, Array, HorizonModel, HorizonQp, Index, Layout, QpError, QpStatus
from napf_mpc.solvers.batch import STATUSES, BatchResult, Mask, WarmStart, checked_guess, why_unusable
from napf_mpc.solvers.kernel_active_set import LIMIT, OPTIMAL, WorkingSet
from napf_mpc.solvers.kernel_program import INFEASIBLE, ROUGH, STUCK, UNUSABLE, Kept, Room, solve_programs
from napf_mpc.solvers.kernel_rows import RowPlaces, RowTable, gather
from napf_mpc.solvers.kernel_signals import SignalMaps, signal_maps
from napf_mpc.solvers.kernel_sweep import Lanes

CHUNK = 32
"""Programs solved side by side: enough to share the model's entries, few enough to stay in the cache."""
_STATUS = {
    OPTIMAL: QpStatus.SOLVED,
    INFEASIBLE: QpStatus.PRIMAL_INFEASIBLE,
    LIMIT: QpStatus.MAX_ITERATIONS,
    ROUGH: QpStatus.INACCURATE,
    UNUSABLE: QpStatus.FAILED,
    STUCK: QpStatus.INACCURATE,
}
_MESSAGES = {
    INFEASIBLE: "hard rows contradict each other",
    LIMIT: "the limit of steps is reached",
    ROUGH: "a KKT residual is above 1e-9 of its largest term",
    STUCK: "rounding ends the method: a row can neither be met nor be shown to contradict hard rows",
}


@dataclass(frozen=True, eq=False)
class _Home:
    """What a model and its kinds of rows need, kept from step to step."""

    model: HorizonModel
    layout: Layout
    maps: SignalMaps
    places: RowPlaces
    first: tuple[tuple[int, int], ...]
    """First family and first row of slacks of each block."""
    table: RowTable
    work: WorkingSet
    room: Room
    kept: Kept
    lanes: dict[int, Lanes]
    """By their number."""
    single: Lanes
    """For programs that are solved alone."""
    steady: dict[int, tuple[LinearRows, int]]
    """Blocks that stand in the table, each for so many programs, by their place in the horizon."""
    outlines: list[Hashable]
    """Of the blocks of the last horizon whose shapes have been looked at, and last its own shape."""

    @classmethod
    def of(cls, horizon: HorizonQp, maps: SignalMaps | None) -> _Home:
        """Home of a horizon; the maps of its model if they are known."""
        maps = signal_maps(horizon.model) if maps is None else maps
        layout = Layout.of(horizon)
        n = layout.stages
        first, families, shelves = [], 0, 0
        for _, count, per_stage, _, _ in layout.kinds:
            first.append((families, shelves))
            families, shelves = families + count, shelves + per_stage
        soft = shelves * n
        work = WorkingSet.empty(families, shelves + 1, n, soft)
        return cls(
            horizon.model, layout, maps, RowPlaces.of(layout, maps.place), tuple(first),
            RowTable.empty(CHUNK, families, shelves, n), work, Room.empty(n, soft, len(work.row)),
            Kept.empty(CHUNK, soft, len(work.row)), {}, Lanes.empty(n, 1), {}, [],
        )  # fmt: skip

    def seen(self, horizon: HorizonQp) -> bool:
        """Whether a horizon has the model and all shapes of one that has been looked at."""
        if horizon.model is not self.model or len(horizon.rows) + 1 != len(self.outlines):
            return False
        if (horizon.initial.shape, horizon.reference.shape) != self.outlines[-1]:
            return False
        for n, block in enumerate(horizon.rows):
            # A steady block that stands in the table is the very one whose shape was looked at.
            if not self.holds(n, block, 1) and block.outline() != self.outlines[n]:
                return False
        return True

    def look_at(self, horizon: HorizonQp) -> None:
        """Remember the shapes of a horizon that fits."""
        self.outlines[:] = [block.outline() for block in horizon.rows]
        self.outlines.append((horizon.initial.shape, horizon.reference.shape))

    def lanes_for(self, count: int) -> Lanes:
        """Room for so many programs side by side."""
        if count not in self.lanes:
            self.lanes[count] = Lanes.empty(self.layout.stages, count)
        return self.lanes[count]

    def holds(self, n: int, block: LinearRows, count: int) -> bool:
        """Whether a block stands in the table for so many programs."""
        kept = self.steady.get(n)
        return kept is not None and kept[0] is block and kept[1] >= count

    def changing(
        self, rows: tuple[LinearRows, ...], step_s: Array, count: int
    ) -> list[tuple[int, int, Blocks]]:
        """Blocks that have to be gathered program by program, each with its first family and row of slacks.

        Steady ones are gathered here, once, for as many programs of the table as are asked for.
        """
        blocks = []
        for n, ((family, shelf), block) in enumerate(zip(self.first, rows, strict=True)):
            if self.holds(n, block, count):
                continue
            self.steady.pop(n, None)
            arrays = _arrays(block)
            if block.steady:
                self.table.sound[:] = 1
                gather(self.table, np.zeros(count, dtype=np.int64), family, shelf, step_s, *arrays)
                if self.table.sound.all():
                    self.steady[n] = block, count
                    continue
            blocks.append((family, shelf, arrays))
        return blocks


class KernelSolver:
    """Batch solver of the exact structured method; every answer carries its own certificate.

    A warm start takes the rows that push in the guess as its first working set, and nothing else: without a
    guess a solve is cold whatever was solved before, and with one it depends on that UAV's guess alone. One
    object belongs to one thread; the compiled loops hold no GIL, so that objects in several threads run side
    by side.

    Parameters
    ----------
    max_iter : int, optional
        Changes of the working set at most, for one program.

    Raises
    ------
    TypeError
        If max_iter is not a whole number > 0.
    """

    def __init__(self, max_iter: int = 5000) -> None:
        if not isinstance(max_iter, int) or max_iter < 1:
            raise TypeError(f"max_iter = {max_iter!r}, must be a whole number > 0")
        self._limit = max_iter
        self._home: _Home | None = None

    def __getstate__(self) -> dict[str, Any]:
        """What a copy takes along: no workspace, whose arrays share memory that a copy's do not."""
        return vars(self) | {"_home": None}

    def reset(self) -> None:
        """Nothing to forget: a solve depends on its numbers and its guess alone."""

    def solve_batch(
        self, horizon: HorizonQp, warm: WarmStart | None = None, active: Mask | None = None
    ) -> BatchResult:
        """Solve the programs of a horizon.

        Parameters
        ----------
        horizon : HorizonQp
            Programs of all (run, uav). Numbers that are not finite, crossed bounds and negative penalties
            make their own program fail, with a message, and no other.
        warm : WarmStart, optional
            Guesses; cold without.
        active : array of bool, shape (run,), optional
            Runs to solve; the others are skipped, whatever they hold.

        Returns
        -------
        BatchResult
            Answers; iterations are changes of the working set.

        Raises
        ------
        QpError
            If shapes do not fit, the model is not sound, or its cost does not determine the inputs.
        """
        home = self._fitting_home(horizon)
        layout, (runs, uavs, stages) = home.layout, horizon.shape
        batch, n, m = runs * uavs, layout.sparsity.variables, layout.sparsity.constraints
        asked = None if active is None else np.asarray(active, dtype=bool)
        if asked is not None and asked.shape != (runs,):
            raise QpError(f"active has shape {asked.shape}, must be ({runs},)")
        guesses = checked_guess(warm, (runs, uavs, n), (runs, uavs, m))
        z, y = np.empty((batch, n)), np.empty((batch, m))
        residuals, ends, steps = np.full((batch, 3), np.inf), np.full(batch, -1), np.full(batch, -1)
        initial = _plain(horizon.initial).reshape(batch, STATES)
        reference = _plain(horizon.reference).reshape(batch, stages, STATES)
        guess = (z, y)
        if guesses is not None:
            guess = (_plain(guesses.z).reshape(batch, n), _plain(guesses.y).reshape(batch, m))
        step_s = _plain(horizon.model.step_s)
        todo = np.arange(batch) if asked is None else np.flatnonzero(np.repeat(asked, uavs))
        blocks = home.changing(horizon.rows, step_s, min(len(todo), CHUNK)) if len(todo) else []
        for first in range(0, len(todo), CHUNK):
            programs = todo[first : first + CHUNK]
            home.table.sound[:] = 1
            for family, shelf, arrays in blocks:
                gather(home.table, programs, family, shelf, step_s, *arrays)
            solve_programs(
                home.maps, home.places, home.table, programs, home.work, home.room, home.kept,
                home.lanes_for(len(programs)), home.single, initial, reference,
                guesses is not None, *guess, self._limit, z, y, residuals, ends, steps,
            )  # fmt: skip
        return _result(horizon, layout, z, y, residuals, ends, steps)

    def _fitting_home(self, horizon: HorizonQp) -> _Home:
        home = self._home
        if home is not None and home.seen(horizon):
            return home
        horizon.check_shapes()
        if home is None or home.model is not horizon.model:
            horizon.model.check()
            home = _Home.of(horizon, None)
        elif not home.layout.same_rows(horizon):
            home = _Home.of(horizon, home.maps)
        home.look_at(horizon)
        self._home = home
        return home


def _result(
    horizon: HorizonQp, layout: Layout, z: Array, y: Array, residuals: Array, ends: Index, steps: Index
) -> BatchResult:
    runs, uavs, _ = horizon.shape
    messages = {}
    if ends.any():
        skipped = ends < 0
        z[skipped], y[skipped] = np.nan, np.nan
        for i in np.flatnonzero(ends > OPTIMAL).tolist():
            run, uav = divmod(i, uavs)
            messages[run, uav] = (
                why_unusable(layout, horizon, run, uav) if ends[i] == UNUSABLE else _MESSAGES[ends[i]]
            )
    z, y = z.reshape(runs, uavs, z.shape[1]), y.reshape(runs, uavs, y.shape[1])
    primal, dual, complementarity = residuals.T.reshape(3, runs, uavs)
    return BatchResult(
        _CODES[ends].reshape(runs, uavs), layout.states(z), layout.inputs(z), layout.block_slacks(z),
        z, y, primal, dual, complementarity, steps.reshape(runs, uavs), messages,
    )  # fmt: skip


_CODES = np.full(len(_STATUS) + 1, STATUSES.index(QpStatus.SKIPPED), dtype=np.int8)
"""Code of each end; the last is that of programs that were not asked, whose end is -1."""
for _end, _status in _STATUS.items():
    _CODES[_end] = STATUSES.index(_status)

_NONE = np.empty((0, 0, 0, 0))


Blocks = tuple[Array, Array, Array, Array, Array]
"""Arrays of a block of rows as :func:`~napf_mpc.solvers.kernel_rows.gather` takes them."""


def _arrays(block: LinearRows) -> Blocks:
    return (
        _plain(block.jac),
        _NONE if block.lower is None else _plain(block.lower),
        _NONE if block.upper is None else _plain(block.upper),
        _NONE if block.w1 is None else _plain(block.w1),
        _NONE if block.w2 is None else _plain(block.w2),
    )


def _plain(values: Array) -> Array:
    """Values as one writable block of memory, the only kind that is compiled for."""
    return (
        values
        if values.flags.carray and values.dtype == np.float64
        else np.array(values, dtype=np.float64, order="C")
    )
