"""Benchmarks from flights to files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from napf_mpc import store
from napf_mpc.benchmark.contenders import Contender, Scene
from napf_mpc.benchmark.growth import Point, Study, growth
from napf_mpc.benchmark.nonlinear import NonlinearRow, measure_nonlinear, nonlinear_summaries
from napf_mpc.benchmark.planners import Pilot, PlannerRow, installed_pilots, measure_planner
from napf_mpc.benchmark.scaling import grown
from napf_mpc.benchmark.solvers import ALONE, Row, installed, measure, summaries
from napf_mpc.benchmark.steps import StepTime
from napf_mpc.benchmark.tables import (
    machine,
    nonlinear_tables,
    planner_tables,
    scaling_tables,
    tables,
    write,
)
from napf_mpc.block import check_campaign
from napf_mpc.plot import Curve, draw_growth, draw_solvers, draw_step_times
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
            paths |= dict.fromkeys(write(out, "solvers", rows, tables(summaries(rows), flights, wide=True)))
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


def benchmark_nonlinear(
    scenes: Mapping[str, Scene],
    missions: int,
    every: int,
    seed: int,
    out: Path | None,
    tell: Callable[[str], None],
) -> tuple[list[Rows], list[Path]]:
    """Measure what the linearisation costs; files are kept as in :func:`benchmark_solvers`.

    Returns
    -------
    tables : list of Rows
        One a scene.
    paths : list of Path
        What was written: ``nonlinear.csv`` and ``nonlinear.md``.

    Raises
    ------
    NapfError
        If a setting is out of range or the folder cannot be written: before anything is flown. If flights
        are too short for a scene.
    """
    check_campaign(["qp"], missions, seed)
    if out is not None:
        store.output_folder(out)
    flights = f"{missions} missions a scene behind the filter, one step in {every}, seed {seed}."
    rows: list[NonlinearRow] = []
    paths: dict[Path, None] = {}
    for label, scene in scenes.items():
        rows += measure_nonlinear(label, scene, missions=missions, every=every, seed=seed)
        tell(f"{label}: {len({row.step for row in rows if row.scene == label})} steps timed")
        if out is not None:
            wide = nonlinear_tables(nonlinear_summaries(rows), flights, wide=True)
            paths |= dict.fromkeys(write(out, "nonlinear", rows, wide))
    return nonlinear_tables(nonlinear_summaries(rows), flights, wide=False), list(paths)


def benchmark_planners(
    scenes: Mapping[str, Scene],
    pilots: Mapping[str, Pilot],
    missions: int,
    seed: int,
    out: Path | None,
    tell: Callable[[str], None],
) -> tuple[list[Rows], list[Path]]:
    """Measure planner by planner and scene by scene; files are kept as in :func:`benchmark_solvers`.

    Returns
    -------
    tables : list of Rows
        One a scene.
    paths : list of Path
        What was written: ``planners.csv``, ``planners.md`` and a figure a scene.

    Raises
    ------
    NapfError
        If a setting is out of range or the folder cannot be written: before anything is flown.
    """
    check_campaign(["qp"], missions, seed)
    if out is not None:
        store.output_folder(out)
    present = installed_pilots(pilots, tell)
    flights = f"{missions} missions a scene behind the filter, seed {seed}."
    rows: list[PlannerRow] = []
    paths: dict[Path, None] = {}
    for number, (label, scene) in enumerate(scenes.items(), start=1):
        times: dict[str, list[StepTime]] = {}
        for name, pilot in present.items():
            row, times[name] = measure_planner(label, scene, name, pilot, missions=missions, seed=seed)
            rows.append(row)
            tell(f"{label}, {name}: {row.steps} steps timed")
        if out is None:
            continue
        paths |= dict.fromkeys(write(out, "planners", rows, planner_tables(rows, flights)))
        period_s = 1.0 / load_problem(scene.problem, scene.overrides).planner.rate_hz
        cpu = {name: np.array([step.cpu_us for step in steps]) for name, steps in times.items()}
        note = f"{label}; {flights} {machine()}"
        paths |= dict.fromkeys(draw_step_times(cpu, period_s, out, f"planners_{number}", note))
    return planner_tables(rows, flights), list(paths)


def benchmark_scaling(
    studies: Mapping[str, Study],
    seed: int,
    budget_s: float,
    out: Path | None,
    tell: Callable[[str], None],
) -> tuple[list[Rows], list[Path]]:
    """Measure study by study, size by size; what is measured is kept at once.

    Returns
    -------
    tables : list of Rows
        One a study.
    paths : list of Path
        What was written: ``scaling.csv``, ``scaling.md`` and the figure.

    Raises
    ------
    NapfError
        If the seed is out of range or the folder cannot be written: before anything is flown.
    """
    check_campaign(["qp"], 1, seed)
    if out is not None:
        store.output_folder(out)
    flights = f"study_40s behind the filter, planner qp, seed {seed}; at most {budget_s:g} s a size."
    points: dict[str, list[Point]] = {}
    paths: dict[Path, None] = {}
    for label, study in studies.items():
        for point in grown(label, study, seed, budget_s, tell):
            points.setdefault(label, []).append(point)
            tell(f"{label}, {point.size:,}: {1e-3 * point.cost_us:.3g} ms")
            if out is not None:
                rows = [row for own in points.values() for row in own]
                paths |= dict.fromkeys(write(out, "scaling", rows, scaling_tables(points, studies, flights)))
        if out is not None:
            note = f"{flights} {machine()}"
            curves = {name: _curve(studies[name], own) for name, own in points.items()}
            paths |= dict.fromkeys(draw_growth(curves, out, "scaling", note))
    return scaling_tables(points, studies, flights), list(paths)


def _curve(study: Study, points: list[Point]) -> Curve:
    """What the figure shows of a study."""
    fit = growth(points)
    return Curve(
        study.grows, [point.size for point in points], [1e-3 * point.cost_us for point in points],
        [1e-3 * point.p99_us for point in points], fit.exponent, 1e-3 * fit.level_us,
    )  # fmt: skip
