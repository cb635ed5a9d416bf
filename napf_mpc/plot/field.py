"""The potential field of one UAV in the plane: its surface (Fig. 3), the walk down it and where it fails (Fig. 4)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray

from napf_mpc.apf import (
    Walk,
    angle_step_walk,
    attractive_force,
    attractive_potential,
    repulsion,
    repulsive_potential,
)
from napf_mpc.errors import ProblemError
from napf_mpc.plot import scene
from napf_mpc.plot.style import BLACK, BLUE, GREEN, GREY, PAGE_IN, VERMILION, Page
from napf_mpc.problem import GoalMission, Problem
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Sphere

Array = NDArray[np.float64]

CUT = 300.0
"""Potential above which the surface is cut: it rises without bound at the obstacle."""
GRID = 141
"""Points along each side of the plane."""
NEAR_GOAL_M = 1.5
"""Distance from the goal to the obstacle's centre in the example that keeps the walk from its goal."""
LIMIT_RADIUS_M = 1.0
"""Radius of the obstacle in the two examples of limits, as in the paper's Fig. 4."""


def goal_mission(problem: Problem) -> GoalMission:
    """Return the problem's mission if it is one point's walk to a goal.

    Raises
    ------
    ProblemError
        If it is a formation's mission.
    """
    if not isinstance(problem.mission, GoalMission):
        raise ProblemError("mission.kind", ['is "formation"; this figure shows one point\'s walk to a goal'])
    return problem.mission


def walk_to_goal(problem: Problem, obstacles: ObstacleSet) -> Walk:
    """Walk of the angle-step potential field from start to goal among obstacles (Eq. 29-35).

    Parameters
    ----------
    problem : Problem
        Problem with a mission of kind goal.
    obstacles : ObstacleSet
        One scene; the plane z = 0 through it counts.
    """
    mission, settings = goal_mission(problem), problem.planner
    return angle_step_walk(
        np.array(mission.start_m),
        np.array(mission.goal_m),
        _surroundings(problem, obstacles),
        attractive_gain=mission.attractive_gain,
        repulsive_gain=settings.repulsive_gain,
        influence_m=settings.influence_m,
        floor_m=settings.min_distance_m,
        step_m=mission.step_m,
        arrival_m=mission.arrival_m,
        max_steps=mission.max_steps,
    )


def _surroundings(problem: Problem, obstacles: ObstacleSet) -> Callable[[Array], tuple[Array, Array]]:
    def nearest(place: Array) -> tuple[Array, Array]:
        near = obstacles.near(np.array([[[place[0], place[1], 0.0]]]), np.inf)
        return near.distance[0, 0] - problem.vehicle.radius_m, near.gradient[0, 0, :, :2]

    return nearest


def potential_on_grid(problem: Problem, obstacles: ObstacleSet, x: Array, y: Array) -> tuple[Array, Array]:
    """Potential (y, x) of goal and obstacles (Eq. 23, 25) and the force (y, x, 2) down it (Eq. 27, 28)."""
    mission, settings = goal_mission(problem), problem.planner
    plane = np.stack(np.meshgrid(x, y), axis=-1)
    points = np.concatenate([plane, np.zeros((*plane.shape[:2], 1))], axis=-1).reshape(1, -1, 3)
    near = obstacles.near(points, np.inf)
    rho = (near.distance[0] - problem.vehicle.radius_m).reshape(*plane.shape[:2], -1)
    gradient = near.gradient[0, :, :, :2].reshape(*rho.shape, 2)
    goal = np.array(mission.goal_m)
    potential = attractive_potential(plane, goal, mission.attractive_gain)
    force = attractive_force(plane, goal, mission.attractive_gain)
    for j in range(rho.shape[-1]):
        potential = potential + repulsive_potential(
            rho[..., j], settings.repulsive_gain, settings.influence_m, settings.min_distance_m
        )
        push = repulsion(rho[..., j], settings.repulsive_gain, settings.influence_m, settings.min_distance_m)
        force = force + push[..., None] * gradient[..., j, :]
    return potential, force


def surface_figure(problem: Problem, obstacles: ObstacleSet) -> Figure:
    """Fig. 3: potential of goal and obstacle as a surface, and its contours with the force and the walk."""
    mission = goal_mission(problem)
    view = _plane(problem, obstacles)
    x, y = np.linspace(*view.x, GRID), np.linspace(*view.y, GRID)
    potential, _ = potential_on_grid(problem, obstacles, x, y)
    low = np.minimum(potential, CUT)
    page = Page.of_size(PAGE_IN, 3.1)
    # mplot3d has no type information.
    space = cast(Any, page.axes(0.0, 0.1, 3.3, 2.9, projection="3d"))
    space.plot_surface(
        *np.meshgrid(x, y), low, cmap="cividis", vmin=0.0, vmax=CUT, rcount=71, ccount=71, linewidth=0.0,
        antialiased=False, rasterized=True,
    )  # fmt: skip
    space.set(xlim=view.x, ylim=view.y, zlim=(0.0, CUT))
    space.view_init(elev=32.0, azim=-125.0)
    space.set_box_aspect((1.0, 1.0, 0.75), zoom=0.86)
    space.tick_params(pad=-2.0)
    space.set_xlabel("East x (m)", labelpad=-3.0)
    space.set_ylabel("North y (m)", labelpad=-3.0)
    space.set_zlabel("Potential U (m²/s)", labelpad=-2.0)
    space.locator_params(nbins=5)
    for pane in (space.xaxis, space.yaxis, space.zaxis):
        pane.set_pane_color((1.0, 1.0, 1.0, 0.0))
        pane._axinfo["grid"].update(color="#E4E4E4", linewidth=0.4)

    plane = page.axes(3.95, 0.42, 2.4, 2.4)
    shown = plane.contourf(x, y, low, levels=np.linspace(0.0, CUT, 13), cmap="cividis", zorder=0.5)
    shown.set_rasterized(True)
    plane.contour(x, y, low, levels=np.linspace(0.0, CUT, 13)[1:-1], colors="white", linewidths=0.3, zorder=0.6)
    coarse_x, coarse_y = np.linspace(*view.x, 17)[1:-1], np.linspace(*view.y, 17)[1:-1]
    coarse, force = potential_on_grid(problem, obstacles, coarse_x, coarse_y)
    size = np.hypot(force[..., 0], force[..., 1])
    outside = obstacles.signed_distance(
        np.stack([*np.meshgrid(coarse_x, coarse_y), np.zeros_like(coarse)], axis=-1).reshape(1, -1, 3)
    ).reshape(coarse.shape) > 0.0
    unit = force / np.where(size > 0.0, size, 1.0)[..., None]
    across, upward = np.meshgrid(coarse_x, coarse_y)
    plane.quiver(
        across[outside], upward[outside], unit[..., 0][outside], unit[..., 1][outside],
        color="white", pivot="mid", scale=26.0, width=0.006, headwidth=4.0, zorder=2,
    )  # fmt: skip
    scene.draw_plan(plane, obstacles, view)
    walk = walk_to_goal(problem, obstacles)
    plane.plot(*walk.positions.T, color=VERMILION, linewidth=1.4, zorder=3)
    _start_and_goal(plane, mission)
    plane.set(xlim=view.x, ylim=view.y, xlabel="East x (m)", ylabel="North y (m)")
    bar = page.figure.colorbar(shown, cax=page.axes(6.45, 0.42, 0.1, 2.4))
    bar.set_label("Potential U (m²/s)")
    bar.set_ticks(np.linspace(0.0, CUT, 7).tolist())
    bar.ax.tick_params(length=2.0)
    page.legend([*_walk_handles(), Line2D([], [], color=VERMILION, linewidth=1.4, label="walk")], 3.06, x=4.0)
    return page.figure


def _plane(problem: Problem, obstacles: ObstacleSet) -> scene.View:
    """Square around start, goal and obstacles."""
    mission = goal_mission(problem)
    points = np.array([[*mission.start_m, 0.0], [*mission.goal_m, 0.0]])
    return _square(points, obstacles)


def _square(points: Array, obstacles: ObstacleSet) -> scene.View:
    view = scene.view_of(points, obstacles, pad_m=1.0, reach_m=5.0)
    half = 0.5 * max(view.width, view.height)
    middle = (0.5 * (view.x[0] + view.x[1]), 0.5 * (view.y[0] + view.y[1]))
    return scene.View((middle[0] - half, middle[0] + half), (middle[1] - half, middle[1] + half))


def _start_and_goal(axes: Axes, mission: GoalMission) -> None:
    axes.plot(*mission.start_m, "o", markersize=5, mfc="white", mec=BLACK, mew=0.8, zorder=5)
    axes.plot(*mission.goal_m, "^", markersize=6, mfc=GREEN, mec="white", mew=0.6, zorder=5)


def _walk_handles() -> list[Line2D]:
    return [
        Line2D([], [], linestyle="", marker="o", markersize=5, mfc="white", mec=BLACK, mew=0.8, label="start"),
        Line2D([], [], linestyle="", marker="^", markersize=6, mfc=GREEN, mec="white", mew=0.6, label="goal"),
    ]


def limit_cases(problem: Problem) -> list[tuple[str, ObstacleSet]]:
    """Two scenes in which the traditional potential field fails: an obstacle on the line, and one at the goal."""
    mission = goal_mission(problem)
    start, goal = np.array(mission.start_m), np.array(mission.goal_m)
    back = (start - goal) / float(np.hypot(*(start - goal)))

    def ball(centre: Array) -> ObstacleSet:
        place = (float(centre[0]), float(centre[1]), 0.0)
        return ObstacleSet.from_shapes([Sphere(place, LIMIT_RADIUS_M)])

    return [
        ("obstacle on the line: stuck", ball(0.5 * (start + goal))),
        (f"obstacle {NEAR_GOAL_M:g} m from the goal", ball(goal + NEAR_GOAL_M * back)),
    ]


def walk_figure(problem: Problem, obstacles: ObstacleSet) -> Figure:
    """Fig. 4: the walk past the problem's obstacles, and the two limits of the method beside it."""
    mission = goal_mission(problem)
    cases = [("", obstacles), *limit_cases(problem)]
    view = _plane(problem, ObstacleSet.stack([obstacles]) if len(obstacles) else obstacles)
    left, gap, bottom, title = 0.45, 0.12, 0.4, 0.44
    side = (PAGE_IN - left - 0.06 - gap * 2) / 3
    height = bottom + side + title
    page = Page.of_size(PAGE_IN, height)
    for place, (words, blocks) in enumerate(cases):
        axes = page.axes(left + place * (side + gap), bottom, side, side)
        axes.set(xlim=view.x, ylim=view.y, xlabel="East x (m)", ylabel="North y (m)" if place == 0 else "")
        axes.tick_params(labelleft=place == 0)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MultipleLocator(_round_step(view.width)))
        scene.draw_plan(axes, blocks, view)
        walk = walk_to_goal(problem, blocks)
        axes.plot([mission.start_m[0], mission.goal_m[0]], [mission.start_m[1], mission.goal_m[1]],
                  color=GREY, linewidth=0.5, linestyle=(0, (2, 2)), zorder=0.5)  # fmt: skip
        axes.plot(*walk.positions.T, color=BLUE if walk.arrived else VERMILION, linewidth=1.4, zorder=3)
        _start_and_goal(axes, mission)
        if not walk.arrived:
            axes.plot(*walk.positions[-1], "X", markersize=6, mfc=VERMILION, mec="white", mew=0.5, zorder=6)
        axes.set_title(f"({'abc'[place]}) {words or walk_words(walk, mission)}")
    page.legend(
        [
            *_walk_handles(),
            Line2D([], [], color=BLUE, linewidth=1.4, label="arrives"),
            Line2D([], [], color=VERMILION, linewidth=1.4, label="does not arrive"),
            Line2D([], [], linestyle="", marker="X", markersize=6, mfc=VERMILION, mec="white", mew=0.5, label="given up"),
        ],
        height - 0.02,
    )
    return page.figure


def walk_words(walk: Walk, mission: GoalMission) -> str:
    """How a walk ended, in a few words."""
    length = mission.step_m * (len(walk.positions) - 1)
    if walk.arrived:
        return f"arrives after {length:.1f} m"
    return "stuck" if walk.stuck else f"not there after {length:.0f} m"


def _round_step(width: float) -> float:
    power = 10.0 ** np.floor(np.log10(width / 4.0))
    return float(min((m * power for m in (1.0, 2.0, 5.0, 10.0) if width / (m * power) <= 8.0), default=10 * power))
