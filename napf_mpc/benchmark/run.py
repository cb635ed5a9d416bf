"""The solver benchmark from flights to files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from napf_mpc import store
from napf_mpc.benchmark.contenders import Contender, Scene
from napf_mpc.benchmark.solvers import ALONE, Row, installed, measure, summaries
from napf_mpc.benchmark.tables import machine, tables, write
from napf_mpc.block import check_campaign
from napf_mpc.plot import draw_solvers
from napf_mpc.problem_file import load_problem
from napf_mpc.report import Rows


def benchmark_solvers(
    scenes: Mapping[str, Scene],
    contenders: Mapping[str, Contender],
    missions: int,
    every: int,
    seed: int,
    out: Path | None,
    tell: Callable[[str], None],
) -> tuple[list[Rows], list[Path]]:
    """Measure scene by scene.

    If there is a folder, ``solvers.csv`` and ``solvers.md`` of all scenes so far, and a figure of each, are
    written after every scene: who stops in the middle keeps what is measured.

    Returns
    -------
    tables : list of Rows
        One a scene, for a terminal; the files say more.
    paths : list of Path
        What was written.

    Raises
    ------
    NapfError
        If a setting is out of range, no solver is installed, or the folder cannot be written: before anything
        is flown. If flights are too short for a scene.
    """
    check_campaign(["qp"], missions, seed)
    if out is not None:
        store.output_folder(out)
    present = installed(contenders, tell)
    flights = f"{missions} missions a scene behind the filter, one step in {every}, seed {seed}."
    rows: list[Row] = []
    paths: dict[Path, None] = {}
    for number, (label, scene) in enumerate(scenes.items(), start=1):
        own = measure(label, scene, present, missions=missions, every=every, seed=seed)
        rows += own
        tell(f"{label}: {len({row.step for row in own})} steps timed")
        if out is not None:
            paths |= dict.fromkeys(write(out, rows, tables(summaries(rows), flights, wide=True)))
            note = f"{label}; {flights} {machine()}"
            paths |= dict.fromkeys(_draw(own, list(present), scene, out, f"solvers_{number}", note))
    return tables(summaries(rows), flights, wide=False), list(paths)


def _draw(
    rows: list[Row], names: list[str], scene: Scene, out: Path, stem: str, note: str
) -> list[Path]:  # fmt: skip
    """Figure of the calls for single programs of one scene."""
    alone = {name: [row for row in rows if (row.contender, row.calls) == (name, ALONE)] for name in names}
    return draw_solvers(
        {name: np.array([row.cpu_us for row in of]) for name, of in alone.items()},
        {name: np.array([row.correct == 1 for row in of]) for name, of in alone.items()},
        1.0 / load_problem(scene.problem, scene.overrides).planner.rate_hz, out, stem, note,
    )  # fmt: skip
