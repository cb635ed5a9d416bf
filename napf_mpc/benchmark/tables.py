"""What the solver benchmark writes: every row as CSV, a table a scene, where it was measured."""

from __future__ import annotations

import csv
import io
import math
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict, fields
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO

from napf_mpc import store
from napf_mpc.benchmark.contenders import OSQP, REFERENCE, REFERENCE_SETTINGS
from napf_mpc.benchmark.solvers import CORRECT, Row, Summary
from napf_mpc.provenance import processor
from napf_mpc.report import Rows

PACKAGES = (
    "napf-mpc", "numpy", "scipy", "numba", "osqp", "qpsolvers", "piqp", "proxsuite", "daqp", "clarabel",
    "highspy", "cvxpy",
)  # fmt: skip
"""Packages whose versions decide the times."""


CALLS_FOR_P99 = 100
"""Of fewer calls the 99th percentile is no more than the largest."""


def machine() -> str:
    """Processor, cores, system, Python and the versions of what was timed, in one line."""
    found = []
    for name in PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    system = f"{platform.system()} {platform.machine()}"
    python = f"Python {platform.python_version()}"
    return ", ".join([processor(), f"{os.cpu_count()} CPUs", system, python, *found])


def tables(summaries: Sequence[Summary], flights: str, wide: bool) -> list[Rows]:
    """One table a scene.

    Parameters
    ----------
    summaries : sequence of Summary
        Of all scenes.
    flights : str
        What was flown, for the notes.
    wide : bool
        With more quantiles, and with intervals: too wide for a terminal.
    """
    notes = (
        flights,
        "Thread-CPU microseconds of calls for one program; together: for all of a step, per program.",
        f"Gain: time of '{OSQP}' over this one's, step by step, median [95 %]: alone, together.",
        f"Correct: first input within {CORRECT:g} of its range of {REFERENCE} at "
        f"{REFERENCE_SETTINGS['eps_abs']:g}, whatever the solver claims. Errors are the largest.",
        machine(),
    )
    scenes = list(dict.fromkeys(one.scene for one in summaries))
    shown = []
    for scene in scenes:
        own = [_cells(one, wide) for one in summaries if one.scene == scene]
        rows = tuple(tuple(cells.values()) for cells in own)
        shown.append(Rows(scene, tuple(own[0]), rows, notes if scene == scenes[-1] else ()))
    return shown


def _cells(one: Summary, wide: bool) -> dict[str, str]:
    """Column -> cell."""
    cells = {
        "solver": one.contender,
        "calls": str(one.calls),
        "programs": str(one.programs),
        "claimed": f"{one.claimed / one.programs:.1%}",
        "correct": f"{one.correct / one.programs:.1%}",
        "KKT": f"{one.residual:.0e}",
        "input": f"{one.input_error:.0e}",
        "median": f"{one.median_us:.0f}",
    }
    if wide:
        cells["p95"] = f"{one.p95_us:.0f}"
    cells["p99"] = f"{one.p99_us:.0f}" if one.calls >= CALLS_FOR_P99 else "-"
    if wide:
        cells["max"] = f"{one.max_us:.0f}"
    cells["together"] = f"{one.together_us:.0f}"
    cells["gain"] = _ratio(one.alone_gain, wide)
    cells["gain together"] = _ratio(one.together_gain, wide)
    return cells


def _ratio(gain: tuple[float, float, float], wide: bool) -> str:
    median, low, high = gain
    if math.isnan(median):
        return "-"
    return f"{median:.3g}" + (f" [{low:.3g}, {high:.3g}]" if wide else "")


def write(out: Path, rows: Sequence[Row], shown: Sequence[Rows]) -> list[Path]:
    """Write ``solvers.csv``, all rows, and ``solvers.md``, the tables, into a folder.

    Raises
    ------
    OutputError
        If the folder cannot be made or written.
    """
    folder = store.output_folder(out)
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, [field.name for field in fields(Row)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    paths = [folder / "solvers.csv", folder / "solvers.md"]
    words = "\n".join(table.markdown() for table in shown)
    for path, content in zip(paths, (text.getvalue(), words), strict=True):
        store.write_bytes(path, partial(_put, content.encode()))
    return paths


def _put(content: bytes, file: IO[bytes]) -> None:
    file.write(content)
