"""A grid over problem keys: each point a campaign of its own, all of them in one table."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from napf_mpc import store
from napf_mpc.block import check_campaign
from napf_mpc.campaign import check_flyable, run_campaign
from napf_mpc.campaign_folder import taken
from napf_mpc.errors import NapfError, ProblemError
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.provenance import versions
from napf_mpc.words import shown_text

MAX_POINTS = 1000
FORM = "must be key.path=value,value,... for example planner.k=1,2,3"
RATES = ("collision_risk", "uav_collision_risk", "uav_contact_risk")
"""Columns of the table with a lower and an upper end beside them."""
MEDIANS = (
    "path_rms_m",
    "shape_rms_m",
    "path_length_ratio",
    "finish_time_s",
    "min_clearance_m",
    "min_separation_m",
)
"""Columns of the table that are medians of the runs for which they are defined."""


@dataclass(frozen=True)
class Point:
    """One point of a grid: a problem, and what is set there."""

    settings: Mapping[str, str]
    """Key path -> value as it was written."""
    problem: Problem
    """The problem with these settings."""

    @property
    def folder(self) -> str:
        """Name of its folder: readable, and its own whatever the values hold."""
        words = "_".join(f"{key}={value}" for key, value in self.settings.items())
        return f"{re.sub(r'[^A-Za-z0-9.=+-]+', '_', words)[:80]}-{self.problem.digest()[:10]}"


def parse_vary(lines: Sequence[str]) -> dict[str, list[str]]:
    """Read ``key=v1,v2`` lines; commas inside brackets and quotes belong to the value.

    Returns
    -------
    dict of str to list of str
        Key path -> its values, as they were written, in the order given.

    Raises
    ------
    ProblemError
        Naming every line that is none, and every key or value that is there twice.
    """
    grid: dict[str, list[str]] = {}
    faults = []
    for line in lines:
        key, equals, text = line.partition("=")
        key, values = key.strip(), _values(text)
        if not equals or not key or not all(values):
            faults.append(f'--vary "{shown_text(line, 80)}": {FORM}')
        elif key in grid:
            faults.append(f"--vary {shown_text(key, 80)}: is varied twice; give all its values at once")
        elif key == "planner.kind":
            faults.append("--vary planner.kind: choose planners by --planners")
        elif len(set(values)) < len(values):
            faults.append(f'--vary "{shown_text(line, 80)}": each value may be there once')
        else:
            grid[key] = values
    if not lines:
        faults.append(f"--vary: give at least one; {FORM}")
    if faults:
        raise ProblemError("sweep", faults)
    return grid


def _values(text: str) -> list[str]:
    values, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in "[{":
            depth += 1
        elif letter in "]}":
            depth -= 1
        if letter == "," and not quote and depth == 0:
            values.append("")
        else:
            values[-1] += letter
    return [value.strip() for value in values]


def grid_points(file: str | Path, vary: Sequence[str], settings: Sequence[str] = ()) -> list[Point]:
    """Every combination of the values of some keys, the first key varying slowest.

    Parameters
    ----------
    file : str or Path
        Problem file, or the name of a shipped problem.
    vary : sequence of str
        Lines ``key=v1,v2,...``.
    settings : sequence of str
        Lines ``key=value`` that hold at every point.

    Raises
    ------
    ProblemError
        With every fault of every point, each told once.
    """
    grid = parse_vary(vary)
    count = int(np.prod([len(values) for values in grid.values()], dtype=object))
    if count > MAX_POINTS:
        raise ProblemError(
            "sweep", [f"--vary: {count} points, at most {MAX_POINTS} are flown; give fewer values"]
        )
    both = [key for line in settings if (key := line.partition("=")[0].strip()) in grid]
    if both:
        raise ProblemError(
            "sweep", [f"--set {key}: is varied, too; leave one of the two out" for key in both]
        )
    points: list[Point] = []
    faults: dict[str, None] = {}
    source = str(file)
    for values in product(*grid.values()):
        chosen = dict(zip(grid, values, strict=True))
        try:
            problem = load_problem(file, [*settings, *(f"{key}={value}" for key, value in chosen.items())])
        except ProblemError as error:
            source = error.source
            faults |= dict.fromkeys(error.problems)
            continue
        points.append(Point(chosen, problem))
    if faults:
        raise ProblemError(source, list(faults))
    return points


def run_sweep(
    points: Sequence[Point],
    planners: Sequence[str],
    runs: int,
    seed: int,
    out: str | Path,
    *,
    name: str = "problem",
    workers: int = 1,
    data_folder: Path | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> store.Columns:
    """Fly a campaign at every point, going on where an earlier call stopped.

    Parameters
    ----------
    points : sequence of Point
        See :func:`grid_points`; all with the same keys.
    planners : sequence of str
        Names of planners; all fly the same seeds at every point.
    runs, seed : int
        Number of runs of each point, and campaign seed.
    out : str or Path
        Output folder: a campaign's folder for each point, ``sweep.parquet`` (a key whose values are all
        numbers is a column of numbers there) and ``sweep.csv``. Another grid over the same problem may go
        into the same folder; what it shares is not flown again.
    name : str
        Problem's name in the summaries.
    workers : int
        Processes.
    data_folder : Path, optional
        Where data files lie.
    progress : callable
        Told the number of runs finished so far, of ``len(points) * runs``.

    Returns
    -------
    dict of str to array
        One row a point and planner: the keys as they were written, then rates with their ends, then medians.

    Raises
    ------
    NapfError
        If a setting or a point's problem is not usable, found before anything flies, or the folder is not.
    """
    check_campaign(planners, runs, seed, workers)
    check_points(points, planners, seed, data_folder)
    origin = {"sweep": name, "seed": int(seed), "planners": list(planners), "versions": versions()}
    rows: list[dict[str, Any]] = []
    with taken(out, origin) as out:
        for number, point in enumerate(points):

            def tell(done: int, before: int = number * runs) -> None:
                progress(before + done)

            summary = run_campaign(
                point.problem,
                planners,
                runs,
                seed,
                out / point.folder,
                name=name,
                workers=workers,
                data_folder=data_folder,
                progress=tell,
            )
            rows += [_row(point, planner, part) for planner, part in summary["planners"].items()]
        columns = {key: np.array([row[key] for row in rows]) for key in rows[0]}
        numbers = {key: _numbers(columns[key]) for key in points[0].settings}
        store.write_table(out / "sweep.parquet", columns | numbers)
        store.write_bytes(out / "sweep.csv", lambda file: file.write(_csv(rows).encode()))
    return columns


def check_points(
    points: Sequence[Point], planners: Sequence[str], seed: int = 0, data_folder: Path | None = None
) -> None:
    """Refuse a grid of which a point cannot be flown, before any is.

    Raises
    ------
    NapfError
        Naming the first such point, or two that are the same problem.
    """
    seen: dict[str, str] = {}
    for point in points:
        words = _shown(point)
        twin = seen.setdefault(point.problem.digest(), words)
        if twin != words:
            raise ProblemError("sweep", [f"{words}: is the same problem as {twin}; leave one out"])
        try:
            check_flyable(point.problem, planners, seed, data_folder)
        except NapfError as error:
            raise ProblemError("sweep", [f"{words}: {line}" for line in str(error).splitlines()]) from error


def _shown(point: Point) -> str:
    return shown_text(", ".join(f"{key} = {value}" for key, value in point.settings.items()), 200)


def _row(point: Point, planner: str, part: Mapping[str, Any]) -> dict[str, Any]:
    row: dict[str, Any] = {**point.settings, "planner": planner, "runs": part["runs"]}
    for name in RATES:
        row |= {key: part[key] for key in (name, f"{name}_low", f"{name}_high")}
    row |= {"finished": part["finished"], "joint_success": part["joint_success"]}
    for name in MEDIANS:
        median = part[name]["median"]
        row[name] = np.nan if median is None else median
    return row


def _numbers(texts: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Values of a key as numbers if all are, so that a program need not parse them; else as they are."""
    for kind in (np.int64, np.float64):
        try:
            numbers = texts.astype(kind)
        except (ValueError, OverflowError):
            continue
        if np.isfinite(numbers).all():
            return np.asarray(numbers)
    return texts


def _csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Comma-separated values; what is not defined is empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(rows[0])
    for row in rows:
        writer.writerow("" if isinstance(v, float) and np.isnan(v) else v for v in row.values())
    return text.getvalue()
