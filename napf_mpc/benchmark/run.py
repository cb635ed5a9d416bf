"""The solver benchmark from flights to files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from napf_mpc.benchmark.contenders import Contender, Scene
from napf_mpc.benchmark.solvers import ALONE, measure, summaries
from napf_mpc.benchmark.tables import machine, tables, write
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
    """Measure, and write ``solvers.csv``, ``solvers.md`` and a figure a scene if there is a folder.

    Returns
    -------
    tables : list of Rows
        One a scene, for a terminal; the files say more.
    paths : list of Path
        What was written.
    """
    rows = measure(scenes, contenders, missions=missions, every=every, seed=seed, tell=tell)
    flights = f"{missions} missions a scene behind the filter, one step in {every}, seed {seed}."
    found = summaries(rows)
    shown = tables(found, flights, wide=False)
    if out is None:
        return shown, []
    paths = write(out, rows, tables(found, flights, wide=True))
    for number, (label, scene) in enumerate(scenes.items()):
        own = [row for row in rows if row.scene == label and row.calls == ALONE]
        times = {name: [row for row in own if row.contender == name] for name in contenders}
        present = {name: of for name, of in times.items() if of}
        paths += draw_solvers(
            {name: np.array([row.cpu_us for row in of]) for name, of in present.items()},
            {name: np.array([row.correct == 1 for row in of]) for name, of in present.items()},
            1.0 / load_problem(scene.problem).planner.rate_hz, out, f"solvers_{number + 1}",
            note=f"{label}; {flights} {machine()}",
        )  # fmt: skip
    return shown, paths
