"""The kernel solver: exact answers for the horizons of many UAVs, by a dual active set on the signal kernel.

What the model determines is computed once for a model; a program costs two sweeps along its stages, a scan of
its rows for each change of the working set, and a certificate. See :mod:`~napf_mpc.solvers.kernel_signals`
and :mod:`~napf_mpc.solvers.kernel_active_set`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from napf_mpc.qp import SIGNALS, Array, HorizonModel, HorizonQp, Layout, QpError, QpStatus
from napf_mpc.solvers.batch import STATUSES, BatchResult, Mask, WarmStart, checked_guess, why_unusable
from napf_mpc.solvers.kernel_active_set import INFEASIBLE, LIMIT, OPTIMAL, WorkingSet
from napf_mpc.solvers.kernel_program import ROUGH, UNUSABLE, Room, solve_programs
from napf_mpc.solvers.kernel_rows import WIDTH, RowTable, gather
from napf_mpc.solvers.kernel_signals import FIRST, KINDS, SignalMaps, signal_maps

CHUNK = 16
"""Programs whose rows are gathered together: few enough to stay in the cache."""
_STATUS = {
    OPTIMAL: QpStatus.SOLVED,
    INFEASIBLE: QpStatus.PRIMAL_INFEASIBLE,
    LIMIT: QpStatus.MAX_ITERATIONS,
    ROUGH: QpStatus.INACCURATE,
    UNUSABLE: QpStatus.FAILED,
}
_MESSAGES = {
    INFEASIBLE: "hard rows contradict each other",
    LIMIT: "the limit of steps is reached",
    ROUGH: "a KKT residual is above 1e-9 of its largest term",
}


@dataclass(frozen=True, eq=False)
class _Home:
    """What a model and its kinds of rows need, kept from step to step."""

    model: HorizonModel
    layout: Layout
    maps: SignalMaps
    places: tuple[Array, ...]
    """Of each block: places in the signals of its kind's axes."""
    starts: tuple[tuple[int, int, int, int], ...]
    """Of each block: where its slacks, lower, upper and slack multipliers start."""
    table: RowTable
    work: WorkingSet
    room: Room

    @classmethod
    def of(cls, horizon: HorizonQp, maps: SignalMaps | None) -> _Home:
        """Home of a horizon; the maps of its model if they are known."""
        maps = signal_maps(horizon.model) if maps is None else maps
        layout = Layout.of(horizon)
        n = layout.stages
        places, starts, row, rows, groups = [], [], 12 * n, 0, 0
        for (signal, count, per_stage, low, high), slack in zip(layout.kinds, layout.slacks, strict=True):
            first = int(FIRST[KINDS.index(signal)])
            axes = maps.place[np.minimum(first + np.arange(WIDTH), first + len(SIGNALS[signal]) - 1)]
            places.append(axes * n)
            copies = low + high if per_stage else 1
            upper = row + count * n if copies == 2 else row
            starts.append((slack.start, row, upper, row + copies * count * n))
            row += (copies * count + per_stage) * n
            rows, groups = rows + count * n, groups + per_stage * n
        return cls(
            horizon.model, layout, maps, tuple(places), tuple(starts),
            RowTable.empty(CHUNK, rows, groups), WorkingSet.empty(13 * n, rows, groups), Room.empty(n, groups),
        )  # fmt: skip


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
        horizon.check_shapes()
        home = self._fitting_home(horizon)
        layout, (runs, uavs, stages) = home.layout, horizon.shape
        batch, n, m = runs * uavs, layout.sparsity.variables, layout.sparsity.constraints
        asked = np.ones(runs, dtype=bool) if active is None else np.asarray(active, dtype=bool)
        if asked.shape != (runs,):
            raise QpError(f"active has shape {asked.shape}, must be ({runs},)")
        guesses = checked_guess(warm, (runs, uavs, n), (runs, uavs, m))
        z, y = np.zeros((batch, n)), np.zeros((batch, m))
        residuals, ends = np.full((batch, 3), np.inf), np.full(batch, -1)
        steps = np.full(batch, -1)
        initial = _plain(horizon.initial, (batch, 12))
        reference = _plain(horizon.reference, (batch, stages, 12))
        guess = (z, y) if guesses is None else (_plain(guesses.z, (batch, n)), _plain(guesses.y, (batch, m)))
        step_s = _plain(horizon.model.step_s, (stages,))
        blocks = _arrays(horizon, batch)
        todo = np.flatnonzero(np.repeat(asked, uavs))
        for first in range(0, len(todo), CHUNK):
            programs = todo[first : first + CHUNK]
            table = home.table
            table.rows[:], table.groups[:], table.usable[:] = 0, 0, True
            for places, block, starts in zip(home.places, blocks, home.starts, strict=True):
                gather(table, programs, places, step_s, *block, *starts, y)
            solve_programs(
                home.maps, table, programs, home.work, home.room, initial, reference,
                guesses is not None, *guess, self._limit, z, y, residuals, ends, steps,
            )  # fmt: skip
        return self._result(horizon, layout, asked, z, y, residuals, ends, steps)

    def _result(
        self, horizon: HorizonQp, layout: Layout, asked: Mask,
        z: Array, y: Array, residuals: Array, ends: Array, steps: Array,
    ) -> BatchResult:  # fmt: skip
        runs, uavs, _ = horizon.shape
        messages = {}
        if not asked.all():
            skipped = ~np.repeat(asked, uavs)
            z[skipped], y[skipped] = np.nan, np.nan
        for i in np.flatnonzero(ends > OPTIMAL).tolist():
            run, uav = divmod(i, uavs)
            messages[run, uav] = (
                why_unusable(layout, horizon, run, uav) if ends[i] == UNUSABLE else _MESSAGES[ends[i]]
            )
        z, y = z.reshape(runs, uavs, -1), y.reshape(runs, uavs, -1)
        primal, dual, complementarity = residuals.T.reshape(3, runs, uavs)
        return BatchResult(
            _CODES[ends].reshape(runs, uavs), layout.states(z), layout.inputs(z), layout.block_slacks(z), z, y,
            primal, dual, complementarity, steps.reshape(runs, uavs), messages,
        )  # fmt: skip

    def _fitting_home(self, horizon: HorizonQp) -> _Home:
        home = self._home
        if home is None or home.model is not horizon.model:
            horizon.model.check()
            home = _Home.of(horizon, None)
        elif not home.layout.same_rows(horizon):
            home = _Home.of(horizon, home.maps)
        self._home = home
        return home


_CODES = np.full(len(_STATUS) + 1, STATUSES.index(QpStatus.SKIPPED), dtype=np.int8)
"""Code of each end; the last is that of programs that were not asked, whose end is -1."""
for _end, _status in _STATUS.items():
    _CODES[_end] = STATUSES.index(_status)

_NONE = np.empty((0, 0, 0))


def _arrays(horizon: HorizonQp, batch: int) -> list[tuple[object, ...]]:
    """Arrays of each block with (run, uav) as one axis, as :func:`gather` takes them."""
    stages, out = horizon.shape[2], []
    for block in horizon.rows:
        m, dim = block.jac.shape[3:]
        jac = _plain(block.jac, (batch, stages, m, dim))
        bounds = [
            _NONE if v is None else _plain(v, (batch, stages, m)) for v in (block.lower, block.upper)
        ]
        if block.w1 is None or block.w2 is None:
            prices = [np.empty((batch, stages, 0))] * 2
        else:
            prices = [_plain(v, (batch, stages, block.slack_count)) for v in (block.w1, block.w2)]
        out.append((jac, *bounds, *prices, block.lower is not None, block.upper is not None))
    return out


def _plain(values: Array, shape: tuple[int, ...]) -> Array:
    """Values as one writable block of memory, the only kind that is compiled for."""
    flat = np.ascontiguousarray(values, dtype=np.float64).reshape(shape)
    return flat if flat.flags.writeable else flat.copy()
