"""The folder of a campaign: whose it is, which blocks are finished, and the tables made of them.

A finished block is a file ``blocks/rows_<first>_<stop>.parquet``, with ``timing_``, ``events_`` and
``trajectories_`` of the same runs beside it. A block that was lost twice has ``lost_`` instead of ``rows_``:
it is filed, and flown again when the command is repeated. ``runs.parquet``, ``timing.parquet``,
``events.parquet`` and ``summary.json`` are made from the blocks, again whenever the command is repeated.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from napf_mpc import store
from napf_mpc.block import Block
from napf_mpc.errors import DataError, OutputError
from napf_mpc.provenance import differences
from napf_mpc.summary import summarise

MARKER = "campaign.json"
_BLOCK = re.compile(r"(rows|lost)_(\d{8,})_(\d{8,})\.parquet")
_WAY_OUT = "delete this file and repeat the command: its runs are flown again"


@contextlib.contextmanager
def taken(path: str | Path, identity: Mapping[str, Any]) -> Iterator[Path]:
    """Hold a folder that is empty, or holds earlier results of the same identity.

    Parameters
    ----------
    path : str or Path
        Folder; made if missing.
    identity : mapping
        Everything that decides the results; kept in ``campaign.json``.

    Yields
    ------
    Path
        The folder.

    Raises
    ------
    OutputError
        If it is a file, cannot be written, is in use, or holds anything else.
    """
    path = store.output_folder(path)
    # A stranger's folder is refused before anything is written into it.
    _refuse_strangers(path)
    with store.locked(path):
        _refuse_strangers(path)
        marker = path / MARKER
        if not marker.exists():
            store.write_json(marker, identity)
        held = _held(marker)
        # Compared as JSON: there a tuple is a list.
        different = differences(held, json.loads(json.dumps(identity)))
        if different:
            raise OutputError(
                f"{path}: holds results of another origin: {'; '.join(different)}; choose another --out"
            )
        store.remove_partial(path)
        yield path


def _refuse_strangers(path: Path) -> None:
    try:
        entries = list(path.iterdir())
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror}; choose another --out") from error
    if not (path / MARKER).exists() and not all(store.is_ours(entry) for entry in entries):
        raise OutputError(f"{path}: is not empty and holds no results of ours; choose another --out")


def _held(marker: Path) -> dict[str, Any]:
    held = store.read_json(marker)
    if not isinstance(held, dict):
        raise DataError(f"{marker}: is not a table; choose another --out")
    return held


@dataclass(frozen=True)
class Blocks:
    """Finished blocks of a campaign, in its folder."""

    folder: Path
    """``blocks`` in the output folder."""
    identity: Mapping[str, Any]
    """Of the campaign; each block carries its digest."""

    @classmethod
    def of(cls, out: Path, identity: Mapping[str, Any]) -> Blocks:
        """Blocks in an output folder that is :func:`taken`."""
        blocks = cls(store.output_folder(out / "blocks"), identity)
        store.remove_partial(blocks.folder)
        return blocks

    def add(self, runs: range, block: Block, *, lost: bool = False) -> None:
        """Keep a finished block, or file a lost one."""
        tag = _tag(runs)
        store.write_table(self.folder / f"timing_{tag}", block.timing)
        store.write_table(self.folder / f"events_{tag}", block.events)
        if block.trajectories:
            store.write_table(self.folder / f"trajectories_{tag}", block.trajectories)
        # Last: a block counts as finished once its rows are there.
        kind = "lost" if lost else "rows"
        store.write_table(self.folder / f"{kind}_{tag}", block.rows, self._labels(runs))

    def forget_lost(self) -> None:
        """Remove what was filed as lost: the runs count as never flown."""
        for path in self.folder.glob("lost_*.parquet"):
            if _BLOCK.fullmatch(path.name):
                store.remove(path)

    def finished(self) -> list[range]:
        """Runs of every finished block, in order.

        Raises
        ------
        DataError
            If a file is damaged, not of this campaign, or holds runs that another holds too.
        """
        found = self._found("rows")
        for before, after in pairwise(found):
            if after.start < before.stop:
                raise DataError(
                    f"{self.folder / f'rows_{_tag(after)}'}: holds runs that rows_{_tag(before)} holds too; "
                    + _WAY_OUT
                )
        return found

    def lost(self) -> list[range]:
        """Runs of every block that is filed as lost, in order."""
        return self._found("lost")

    def _found(self, kind: str) -> list[range]:
        found = []
        for path in self.folder.glob(f"{kind}_*.parquet"):
            if match := _BLOCK.fullmatch(path.name):
                runs = range(int(match[2]), int(match[3]))
                self._check(path, runs)
                found.append(runs)
        return sorted(found, key=lambda runs: (runs.start, runs.stop))

    def _check(self, path: Path, runs: range) -> None:
        try:
            labels = store.read_labels(path)
        except DataError as error:
            raise DataError(f"{error}; {_WAY_OUT}") from error
        if {key: labels.get(key) for key in self._labels(runs)} != self._labels(runs):
            raise DataError(f"{path}: is not a block of this campaign; {_WAY_OUT}")

    def _labels(self, runs: range) -> dict[str, str]:
        kept = {key: value for key, value in self.identity.items() if key != "problem"}
        return {"campaign": json.dumps(kept), "first_run": str(runs.start), "stop": str(runs.stop)}

    def table(self, kind: str, runs: range) -> store.Columns:
        """Rows, timing or trajectories of one finished block."""
        try:
            return store.read_table(self.folder / f"{kind}_{_tag(runs)}")
        except DataError as error:
            way_out = _WAY_OUT.replace("this file", str(self.folder / f"rows_{_tag(runs)}"))
            raise DataError(f"{error}; {way_out}") from error


def first_runs(tables: Sequence[store.Columns], planners: Sequence[str], runs: int) -> store.Columns:
    """Rows of the first runs by planner, then run, from tables in the order of their runs."""
    return store.stack([_part(table, planner, runs) for planner in planners for table in tables])


def _part(table: store.Columns, planner: str, runs: int) -> store.Columns:
    kept = (table["planner"] == planner) & (table["run"] < runs)
    return {name: values[kept] for name, values in table.items()}


def _tag(runs: range) -> str:
    return f"{runs.start:08d}_{runs.stop:08d}.parquet"


def conclude(out: Path, blocks: Blocks, runs: int) -> dict[str, Any]:
    """Make tables and summary of the first runs from the finished blocks; can be repeated at any time.

    Returns
    -------
    dict
        The summary.

    Raises
    ------
    DataError
        If a run is missing or a block is damaged.
    OutputError
        If the folder cannot be written.
    """
    planners = list(blocks.identity["planners"])
    finished = [block for block in blocks.finished() if block.start < runs]
    lost = [block for block in blocks.lost() if block.start < runs]
    in_order = sorted([*finished, *lost], key=lambda block: block.start)
    rows = first_runs(
        [blocks.table("lost" if block in lost else "rows", block) for block in in_order], planners, runs
    )
    for planner in planners:
        if not np.array_equal(rows["run"][rows["planner"] == planner], np.arange(runs)):
            raise DataError(
                f"{blocks.folder}: not every run of {planner} is there once; choose another --out"
            )
    store.write_table(out / "runs.parquet", rows)
    events = [blocks.table("events", block) for block in in_order]
    store.write_table(out / "events.parquet", first_runs(events, planners, runs))
    timing = [blocks.table("timing", block) for block in in_order]
    store.write_table(out / "timing.parquet", store.stack(timing))
    if blocks.identity.get("record_every") and finished:
        # One block in memory at a time: trajectories are large.
        parts = (
            _part(blocks.table("trajectories", block), planner, runs)
            for planner in planners
            for block in finished
        )
        store.write_tables(out / "trajectories.parquet", parts)
    summary = summarise(rows, blocks.identity)
    store.write_json(out / "summary.json", summary)
    return summary
