"""What benchmarks write: every row as CSV, tables, and where they were measured."""

from __future__ import annotations

import csv
import io
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from napf_mpc import store
from napf_mpc.benchmark.contenders import OSQP, REFERENCE, REFERENCE_SETTINGS
from napf_mpc.benchmark.growth import Point, Study, growth
from napf_mpc.benchmark.nonlinear import NonlinearSummary
from napf_mpc.benchmark.planners import SKIP, PlannerRow
from napf_mpc.benchmark.solvers import CORRECT, Summary
from napf_mpc.provenance import processor
from napf_mpc.report import Rows

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

PACKAGES = (
    "napf-mpc", "numpy", "scipy", "numba", "osqp", "qpsolvers", "piqp", "proxsuite", "daqp", "clarabel",
    "highspy", "cvxpy", "casadi",
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
    return _by_scene([(one.scene, _cells(one, wide)) for one in summaries], notes)


def _by_scene(lines: Sequence[tuple[str, dict[str, str]]], notes: tuple[str, ...]) -> list[Rows]:
    """One table a scene, from lines of column -> cell; notes below the last."""
    scenes = list(dict.fromkeys(scene for scene, _ in lines))
    tables = []
    for scene in scenes:
        own = [cells for of, cells in lines if of == scene]
        rows = tuple(tuple(cells.values()) for cells in own)
        tables.append(Rows(scene, tuple(own[0]), rows, notes if scene == scenes[-1] else ()))
    return tables


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
    return f"{median:.3g}" + (f" [{low:.3g}, {high:.3g}]" if wide and not math.isnan(low) else "")


def nonlinear_tables(summaries: Sequence[NonlinearSummary], flights: str, wide: bool) -> list[Rows]:
    """One table a scene; wide ones with 95th percentiles, largest times and intervals of gains."""
    notes = (
        flights,
        "One program a mission and step. Off: largest difference of a first input to the quadratic "
        "program's, as part of its range. Violation: median of the largest of rows and nonlinear dynamics.",
        "Nonlinear: the quadrotor as it is, by IPOPT; the others are the quadratic program.",
        f"Thread-CPU milliseconds; gain: time of {OSQP!r} over this one's, median [95 %] of the programs.",
        machine(),
    )
    lines = [
        (
            one.scene,
            {
                "program": one.contender,
                "programs": str(one.programs),
                "claimed": f"{one.claimed / one.programs:.1%}",
                "iterations": f"{one.iterations:.0f}",
                "off": f"{one.off_median:.1e}",
                **({"off p95": f"{one.off_p95:.1e}"} if wide else {}),
                "off max": f"{one.off_max:.1e}",
                "violation": f"{one.violation:.0e}",
                "median": f"{1e-3 * one.median_us:.3g}",
                **({"p95": f"{1e-3 * one.p95_us:.3g}", "max": f"{1e-3 * one.max_us:.3g}"} if wide else {}),
                "gain": _ratio(one.gain, wide),
            },
        )
        for one in summaries
    ]
    return _by_scene(lines, notes)


def planner_tables(rows: Sequence[PlannerRow], flights: str) -> list[Rows]:
    """One table a scene."""
    notes = (
        flights,
        "Thread-CPU microseconds of a control step for one formation, without the first "
        f"{SKIP} of a mission; late: wall time beyond the planner's period.",
        "Mission: processor milliseconds of one of those flown in lock-step, with its verdict; planning: the "
        "planner's part of it.",
        machine(),
    )
    lines = [
        (
            row.scene,
            {
                "planner": row.planner,
                "steps": str(row.steps),
                "median": f"{row.median_us:.0f}",
                "p95": f"{row.p95_us:.0f}",
                "p99": f"{row.p99_us:.0f}" if row.steps >= CALLS_FOR_P99 else "-",
                "max": f"{row.max_us:.0f}",
                "late": str(row.late),
                "mission (ms)": f"{row.mission_ms:.1f}",
                "missions/s": f"{1e3 / row.mission_ms:.1f}",
                "planning": f"{row.planning:.0%}",
            },
        )
        for row in rows
    ]
    return _by_scene(lines, notes)


def scaling_tables(
    points: Mapping[str, Sequence[Point]], studies: Mapping[str, Study], flights: str
) -> list[Rows]:
    """One table a study, with its fitted exponent."""
    shown = []
    for label, own in points.items():
        study, fit = studies[label], growth(own)
        lines = tuple(
            (
                f"{point.size:,}", str(point.uavs), str(point.calls), f"{1e-3 * point.cost_us:.3g}",
                f"{1e-3 * point.mean_us:.3g}",
                f"{1e-3 * point.p99_us:.3g}" if point.calls >= CALLS_FOR_P99 else "-",
                f"{study.share_us(point):.3g}",
            )
            for point in own
        )  # fmt: skip
        words = "too few sizes for an exponent"
        if math.isfinite(fit.exponent):
            words = (
                f"Cost ~ size^{fit.exponent:.2f} [{fit.exponent - fit.half_width:.2f}, "
                f"{fit.exponent + fit.half_width:.2f}] (95 %); over the last two sizes ^{fit.last:.2f}."
            )
        notes: tuple[str, ...] = (words,)
        if label == list(points)[-1]:
            notes = (words, flights, machine())
        header = (study.grows, "UAVs a call", "calls", "median ms", "mean ms", "p99 ms", f"us a {study.unit}")
        shown.append(Rows(f"{label}: {study.costs}", header, lines, notes))
    return shown


def write(out: Path, stem: str, rows: Sequence[DataclassInstance], shown: Sequence[Rows]) -> list[Path]:
    """Write ``stem.csv``, all rows, and ``stem.md``, the tables, into a folder.

    Parameters
    ----------
    out : Path
        Folder; made if missing.
    stem : str
        Of the files.
    rows : sequence of dataclass, at least one
        All of one kind.
    shown : sequence of Rows
        Tables.

    Raises
    ------
    OutputError
        If the folder cannot be made or written.
    """
    folder = store.output_folder(out)
    text = io.StringIO(newline="")
    writer: csv.DictWriter[str] = csv.DictWriter(
        text, [field.name for field in fields(rows[0])], lineterminator="\n"
    )
    writer.writeheader()
    values: list[dict[str, Any]] = [asdict(row) for row in rows]
    writer.writerows(values)
    paths = [folder / f"{stem}.csv", folder / f"{stem}.md"]
    words = "\n".join(table.markdown() for table in shown)
    for path, content in zip(paths, (text.getvalue(), words), strict=True):
        store.write_bytes(path, partial(_put, content.encode()))
    return paths


def _put(content: bytes, file: IO[bytes]) -> None:
    file.write(content)
