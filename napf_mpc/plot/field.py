"""The potential of one UAV in the plane: its surface (Fig. 3), the walk on it and its limits (Fig. 4)."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from napf_mpc.apf import Walk, attractive_force, attractive_potential, repulsion, repulsive_potential
from napf_mpc.goal_walk import goal_mission, walk_to_goal
from napf_mpc.plot import scene
from napf_mpc.plot.style import BLACK, BLUE, GREEN, GREY, PAGE_IN, VERMILION, Page, plain_panes
from napf_mpc.problem import GoalMission, Problem
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Cylinder, Sphere

Array = NDArray[np.float64]

GRID = 301
"""Points along each side of the plane."""
NEAR_GOAL_M = 1.5
"""Distance from the goal to the obstacle's centre in the example that keeps the walk from its goal."""
LIMIT_RADIUS_M = 1.0
"""Radius of the obstacle in the two examples of limits, as in the paper's Fig. 4."""


def potential_at(problem: Problem, obstacles: ObstacleSet, places: Array) -> tuple[Array, Array]:
    """Potential of goal and obstacles (Eq. 23, 25) and the force down it (Eq. 27, 28).

    Parameters
    ----------
    problem : Problem
        Problem with a mission of kind goal.
    obstacles : ObstacleSet
        One scene; the plane z = 0 through it counts.
    places : array, shape (..., 2)
        Where [m].

    Returns
    -------
    tuple of array, shape (...) and (..., 2)
        Potential and force.
    """
    mission, settings = goal_mission(problem), problem.planner
    leading = places.shape[:-1]
    near = obstacles.near(_in_space(places), np.inf)
    rho = near.distance[0].reshape(*leading, -1)
    gradient = near.gradient[0, :, :, :2].reshape(*rho.shape, 2)
    goal = np.array(mission.goal_m)
    potential = attractive_potential(places, goal, mission.attractive_gain)
    force = attractive_force(places, goal, mission.attractive_gain)
    gain, influence, floor = settings.repulsive_gain, settings.influence_m, settings.min_distance_m
    for j in range(rho.shape[-1]):
        potential = potential + repulsive_potential(rho[..., j], gain, influence, floor)
        push = repulsion(rho[..., j], gain, influence, floor)
        force = force + push[..., None] * gradient[..., j, :]
    return potential, force


def _in_space(places: Array) -> Array:
    return np.concatenate([places, np.zeros((*places.shape[:-1], 1))], axis=-1).reshape(1, -1, 3)


def surface_figure(problem: Problem, obstacles: ObstacleSet) -> Figure:
    """Fig. 3: potential of goal and obstacle as a surface, and its contours with the force and the walk.

    The surface is cut at 1.2 times the goal's potential at the start: at the obstacle it rises without
    bound.
    """
    mission = goal_mission(problem)
    start, goal = np.array(mission.start_m), np.array(mission.goal_m)
    cut = 1.2 * float(attractive_potential(start, goal, mission.attractive_gain)) or 1.0
    walk = walk_to_goal(problem, obstacles)
    view = _square(walk.positions, mission, obstacles)
    page = Page.of_size(PAGE_IN, 3.1)
    # mplot3d has no type information.
    space = cast(Any, page.axes(0.0, 0.1, 3.3, 2.9, projection="3d"))
    mesh = _mesh(view, obstacles)
    surface = np.minimum(potential_at(problem, obstacles, mesh)[0], cut)
    space.plot_surface(
        mesh[..., 0], mesh[..., 1], surface, cmap="cividis", vmin=0.0, vmax=cut,
        rcount=mesh.shape[0], ccount=mesh.shape[1], linewidth=0.0, antialiased=False, rasterized=True,
    )  # fmt: skip
    space.set(xlim=view.x, ylim=view.y, zlim=(0.0, cut))
    space.view_init(elev=32.0, azim=-125.0)
    space.set_box_aspect((1.0, 1.0, 0.75), zoom=0.86)
    space.tick_params(pad=-2.0)
    space.set_xlabel("East x (m)", labelpad=-3.0)
    space.set_ylabel("North y (m)", labelpad=-3.0)
    space.zaxis.set_rotate_label(False)
    space.set_zlabel(_POTENTIAL, labelpad=0.0, rotation=90.0)
    space.locator_params(nbins=5)
    plain_panes(space)

    plane = page.axes(3.95, 0.42, 2.4, 2.4)
    x, y = np.linspace(*view.x, GRID), np.linspace(*view.y, GRID)
    low = np.minimum(potential_at(problem, obstacles, np.stack(np.meshgrid(x, y), axis=-1))[0], cut)
    levels = np.linspace(0.0, cut, 13)
    shown = plane.contourf(x, y, low, levels=levels, cmap="cividis", zorder=0.5)
    shown.set_rasterized(True)
    plane.contour(x, y, low, levels=levels[1:-1], colors="white", linewidths=0.3, zorder=0.6)
    _draw_force(plane, problem, obstacles, view)
    scene.draw_plan(plane, obstacles, view)
    plane.plot(*walk.positions.T, color=VERMILION, linewidth=1.4, zorder=3)
    _start_and_goal(plane, mission)
    plane.set(xlim=view.x, ylim=view.y, xlabel="East x (m)", ylabel="North y (m)")
    bar = page.figure.colorbar(shown, cax=page.axes(6.45, 0.42, 0.1, 2.4))
    bar.set_label(_POTENTIAL)
    bar.set_ticks(levels[::2].tolist())
    bar.ax.tick_params(length=2.0)
    page.legend([*_walk_handles(), Line2D([], [], color=VERMILION, linewidth=1.4, label="walk")], 3.06, x=4.0)
    return page.figure


# By Eq. 37 the potential's gradient is a velocity.
_POTENTIAL = "Potential U (m²/s)"


def _draw_force(axes: Axes, problem: Problem, obstacles: ObstacleSet, view: scene.View) -> None:
    """Arrows of one length along the force, outside obstacles."""
    x, y = np.linspace(*view.x, 17)[1:-1], np.linspace(*view.y, 17)[1:-1]
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    places = places[obstacles.signed_distance(_in_space(places))[0] > 0.0]
    _, force = potential_at(problem, obstacles, places)
    size = np.hypot(force[:, 0], force[:, 1])
    unit = force / np.where(size > 0.0, size, 1.0)[:, None]
    axes.quiver(
        *places.T, *unit.T, color="white", pivot="mid", scale=26.0, width=0.006, headwidth=4.0, zorder=2
    )


def _mesh(view: scene.View, obstacles: ObstacleSet) -> Array:
    """Points (n, m, 2) of a mesh over the view: rays from the first round obstacle, dense at its wall.

    A square grid would turn the wall into teeth. Without a round obstacle well inside the view it is a
    square grid.
    """
    shapes = obstacles.shapes() if len(obstacles) else []
    if shapes and isinstance(shapes[0], (Sphere, Cylinder)):
        centre, radius = np.array(shapes[0].centre_m[:2]), shapes[0].radius_m
        angle = np.linspace(0.0, 2.0 * np.pi, 241)
        ray = np.column_stack([np.cos(angle), np.sin(angle)])
        corner = np.where(ray > 0.0, [view.x[1], view.y[1]], [view.x[0], view.y[0]]) - centre
        with np.errstate(divide="ignore"):
            edge = np.where(np.abs(ray) > 1e-9, corner / ray, np.inf).min(-1)
        if edge.min() > 1.7 * radius:
            # A circle's share of the way at first, straight edges at last.
            near = np.concatenate([[0.0, 0.9], np.linspace(1.0, 1.6, 61)]) * radius
            far = near[-1] + np.linspace(0.0, 1.0, 61)[1:, None] * (edge - near[-1])
            reach = np.concatenate([np.broadcast_to(near[:, None], (len(near), len(angle))), far])
            return np.asarray(centre + reach[..., None] * ray)
    return np.stack(np.meshgrid(np.linspace(*view.x, GRID), np.linspace(*view.y, GRID)), axis=-1)


def _square(points: Array, mission: GoalMission, obstacles: ObstacleSet) -> scene.View:
    """Square around start, goal, obstacles and points (n, 2)."""
    flat = np.concatenate([points, [mission.start_m, mission.goal_m]])
    view = scene.view_of(_in_space(flat), obstacles, pad_m=1.0, reach_m=5.0)
    half = 0.5 * max(view.width, view.height)
    middle = (0.5 * (view.x[0] + view.x[1]), 0.5 * (view.y[0] + view.y[1]))
    return scene.View((middle[0] - half, middle[0] + half), (middle[1] - half, middle[1] + half))


_START: dict[str, Any] = {"marker": "o", "markersize": 5, "mfc": "white", "mec": BLACK, "mew": 0.8}
_GOAL: dict[str, Any] = {"marker": "^", "markersize": 6, "mfc": GREEN, "mec": "white", "mew": 0.6}


def _start_and_goal(axes: Axes, mission: GoalMission) -> None:
    axes.plot(*mission.start_m, zorder=5, **_START)
    axes.plot(*mission.goal_m, zorder=5, **_GOAL)


def _walk_handles() -> list[Line2D]:
    return [
        Line2D([], [], linestyle="", label="start", **_START),
        Line2D([], [], linestyle="", label="goal", **_GOAL),
    ]


def limit_cases(problem: Problem) -> list[tuple[str, ObstacleSet]]:
    """Two scenes, with names, in which the traditional potential field does not get to its goal."""
    mission = goal_mission(problem)
    start, goal = np.array(mission.start_m), np.array(mission.goal_m)
    apart = float(np.hypot(*(start - goal)))
    back = (start - goal) / apart if apart > 0.0 else np.array([-1.0, 0.0])
    # Beside the line, so that only the nearness to the goal matters.
    side = np.array([-back[1], back[0]])
    at_goal = goal + NEAR_GOAL_M * (np.cos(0.35) * back + np.sin(0.35) * side)

    def ball(centre: Array) -> ObstacleSet:
        place = (float(centre[0]), float(centre[1]), 0.0)
        return ObstacleSet.from_shapes([Sphere(place, LIMIT_RADIUS_M)])

    return [
        ("obstacle on the line", ball(0.5 * (start + goal))),
        (f"obstacle {NEAR_GOAL_M:g} m from goal", ball(at_goal)),
    ]


def walk_figure(problem: Problem, obstacles: ObstacleSet) -> Figure:
    """Fig. 4: the walk past the problem's obstacles, and two limits of the method beside it."""
    mission = goal_mission(problem)
    cases = [
        (words, blocks, walk_to_goal(problem, blocks))
        for words, blocks in [("", obstacles), *limit_cases(problem)]
    ]
    every_place = np.concatenate([walk.positions for _, _, walk in cases])
    view = _square(every_place, mission, obstacles)
    left, gap, bottom, title = 0.48, 0.14, 0.4, 0.44
    side = (PAGE_IN - left - 0.06 - gap * 2) / 3
    height = bottom + side + title
    page = Page.of_size(PAGE_IN, height)
    for place, (words, blocks, walk) in enumerate(cases):
        axes = page.axes(left + place * (side + gap), bottom, side, side)
        axes.set(xlim=view.x, ylim=view.y, xlabel="East x (m)", ylabel="North y (m)" if place == 0 else "")
        axes.tick_params(labelleft=place == 0)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(nbins=7, steps=[1, 2, 5, 10]))
        scene.draw_plan(axes, blocks, view)
        straight = np.array([mission.start_m, mission.goal_m])
        axes.plot(*straight.T, color=GREY, linewidth=0.5, linestyle=(0, (2, 2)), zorder=0.5)
        axes.plot(*walk.positions.T, color=BLUE if walk.arrived else VERMILION, linewidth=1.4, zorder=3)
        _start_and_goal(axes, mission)
        if not walk.arrived:
            axes.plot(*walk.positions[-1], zorder=6, **_GIVEN_UP)
        axes.set_title(f"({'abc'[place]}) {words}{': ' if words else ''}{walk_words(walk, mission)}")
    handles = [
        *_walk_handles(),
        Line2D([], [], color=BLUE, linewidth=1.4, label="arrives"),
        Line2D([], [], color=VERMILION, linewidth=1.4, label="does not arrive"),
        Line2D([], [], linestyle="", label="given up", **_GIVEN_UP),
    ]
    page.legend(handles, height - 0.02)
    return page.figure


_GIVEN_UP: dict[str, Any] = {"marker": "X", "markersize": 6, "mfc": VERMILION, "mec": "white", "mew": 0.5}


def walk_words(walk: Walk, mission: GoalMission) -> str:
    """How a walk ended, in a few words."""
    length = mission.step_m * (len(walk.positions) - 1)
    if walk.arrived:
        return f"arrives after {length:.1f} m"
    return "stuck" if walk.stuck else f"not there after {length:.0f} m"
