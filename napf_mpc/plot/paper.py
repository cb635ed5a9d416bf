"""The paper's figures by their numbers, flown anew."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from napf_mpc.block import fly_block
from napf_mpc.closed_loop import build_scenario
from napf_mpc.goal_walk import goal_scenes
from napf_mpc.plot.field import surface_figure, walk_figure
from napf_mpc.plot.flight import paths_figure, run_figures
from napf_mpc.plot.sky import gnss_figures
from napf_mpc.plot.states import angle_figure, axis_figure
from napf_mpc.plot.style import house_style, save
from napf_mpc.plot.tracks import Track, track
from napf_mpc.problem import GoalMission, Problem

EVERY = 5
"""Ticks of the inner loop between two drawn samples (0.1 s at 50 Hz)."""

FIRST_NUMBERS = {"square_8": (5, 16), "square_40": (12, 21)}
"""Problem -> number of its first figure without and with navigation errors."""


def paper_figures(
    problem: Problem, name: str, seed: int, out: Path, data_folder: Path | None = None
) -> list[Path]:
    """Make the figures of the paper that a problem stands for.

    ``potential_surface`` is Fig. 3 and ``single_uav`` Fig. 4 (any other problem with a mission of kind goal
    gets both); ``square_8`` is Fig. 5-11 (APF without navigation errors) and 16-20 (APF against NAPF with
    errors, same seed), ``square_40`` Fig. 12-15 and 21-25. Any other formation problem gets the figures of
    a run for APF and NAPF; one with emulated GNSS receivers also the sky and the map of its geometry.

    Parameters
    ----------
    problem : Problem
        The problem.
    name : str
        Its name, from which the numbers follow.
    seed : int
        Campaign seed; run 0 of it is flown.
    out : Path
        Output folder.
    data_folder : Path, optional
        Where data files lie.

    Returns
    -------
    list of Path
        PNG and SVG files.

    Raises
    ------
    NapfError
        If the problem cannot be flown or the folder not be written.
    """
    if isinstance(problem.mission, GoalMission):
        return _goal_figures(problem, name, seed, out, data_folder)
    if name not in FIRST_NUMBERS:
        planners = ("apf", "napf")
        flown = fly_block(problem, planners, seed, range(1), data_folder, EVERY)
        scenario = build_scenario(problem, seed, range(1), data_folder)
        return [
            *run_figures(
                problem, name, flown.trajectories, scenario.obstacles, planners, out, scenario.moving
            ),
            *gnss_figures(problem, name, seed, out, data_folder),
        ]

    obstacles = build_scenario(problem, seed, range(1), data_folder).obstacles
    calm_first, rough_first = FIRST_NUMBERS[name]
    calm_problem = without_errors(problem)
    (calm,) = _fly(calm_problem, ("apf",), seed, data_folder)
    apf, napf = _fly(problem, ("apf", "napf"), seed, data_folder)
    written = []
    with house_style():
        figures: list[tuple[int, str, Figure]] = [
            (calm_first, "trajectory", paths_figure(calm_problem, calm, obstacles)),
            *((calm_first + 1 + a, f"{'xyz'[a]}", axis_figure(problem, [calm], a)) for a in range(3)),
            (rough_first, "trajectory_apf", paths_figure(problem, apf, obstacles, [napf])),
            (rough_first + 1, "trajectory_napf", paths_figure(problem, napf, obstacles, [apf])),
            *((rough_first + 2 + a, f"{'xyz'[a]}", axis_figure(problem, [apf, napf], a)) for a in range(3)),
        ]
        if name == "square_8":
            angles = ("roll", "pitch", "yaw")
            figures += [(9 + a, angles[a], angle_figure(problem, [calm], a)) for a in range(3)]
        for number, words, figure in sorted(figures, key=lambda item: item[0]):
            written += save(figure, out, f"fig{number:02d}_{words}")
    return written


def without_errors(problem: Problem) -> Problem:
    """Return the same problem with navigation errors switched off."""
    return problem.model_copy(
        update={"navigation": problem.navigation.model_copy(update={"error_scale": 0.0})}
    )


def _fly(problem: Problem, planners: Sequence[str], seed: int, data_folder: Path | None) -> list[Track]:
    flown = fly_block(problem, planners, seed, range(1), data_folder, EVERY)
    return [track(flown.trajectories, planner, 0) for planner in planners]


def _goal_figures(problem: Problem, name: str, seed: int, out: Path, data_folder: Path | None) -> list[Path]:
    obstacles = goal_scenes(problem, seed, data_folder=data_folder).scene(0)
    written = []
    with house_style():
        if name != "single_uav":
            written += save(surface_figure(problem, obstacles), out, "fig03_potential")
        if name != "potential_surface":
            written += save(walk_figure(problem, obstacles), out, "fig04_single_uav")
    return written
