"""Obstacles of one or many scenes in flat arrays, and the distance queries that planners and judges ask.

Run r of a query looks at scene r, or at the only scene when there is just one. Every query is one compiled
call over (run, point), and each answer depends on its own point and scene alone, to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napf_mpc.world.bounding_tree import BoxTree, plant
from napf_mpc.world.distance import BASE, CYLINDER, SPHERE, TOP, A, Solids, X, Y, solid_bounds
from napf_mpc.world.queries import all_finite, largest_count, near_all, nearest_all
from napf_mpc.world.shapes import Shape, pack, unpack

LEAF = 4
"""Obstacles in a leaf of the search tree, at most (measured: benchmarks/obstacle_queries.py)."""


@dataclass(frozen=True, eq=False)
class Near:
    """Obstacles nearer than a reach, for each query point, nearest first; rows are padded at the end."""

    distance: NDArray[np.float64]  # (run, point, m) signed distance [m], padding +inf
    gradient: NDArray[np.float64]  # (run, point, m, 3) unit, away from the obstacle, padding 0
    index: NDArray[np.int64]  # (run, point, m) obstacle within its scene, padding -1


@dataclass(frozen=True, eq=False)
class ObstacleSet:
    """Obstacles of one or many scenes.

    Make one with `from_shapes`, `from_spheres`, `from_cylinders`, `stack` or `empty`.

    Parameters
    ----------
    solids : Solids
        All obstacles, scene after scene.
    scene_start : array, shape (scene + 1,)
        First obstacle of each scene, and the total at the end.
    """

    solids: Solids
    scene_start: NDArray[np.int64]

    @classmethod
    def from_shapes(cls, shapes: Sequence[Shape]) -> ObstacleSet:
        """One scene with the given shapes, in this order."""
        return cls(pack(shapes), np.array([0, len(shapes)], dtype=np.int64))

    @classmethod
    def from_spheres(cls, centres: ArrayLike, radii: ArrayLike) -> ObstacleSet:
        """Many scenes with the same number of spheres.

        Parameters
        ----------
        centres : array, shape (scene, n, 3)
            Centres [m].
        radii : array, broadcast to shape (scene, n)
            Radii, > 0 [m].

        Raises
        ------
        ValueError
            If a shape does not fit, a number is not finite or a radius is not positive.
        """
        points = _finite("centres", centres, 3)
        kind, parameters = _round(SPHERE, points, radii)
        parameters[:, BASE] = parameters[:, TOP] = points[..., 2].ravel()
        return cls._even(kind, parameters, points.shape[0])

    @classmethod
    def from_cylinders(
        cls, centres: ArrayLike, radii: ArrayLike, base: ArrayLike = -math.inf, top: ArrayLike = math.inf
    ) -> ObstacleSet:
        """Many scenes with the same number of vertical cylinders.

        Parameters
        ----------
        centres : array, shape (scene, n, 2)
            Positions of the axes [m].
        radii : array, broadcast to shape (scene, n)
            Radii, > 0 [m].
        base, top : array, broadcast to shape (scene, n)
            Heights of floor and roof, top above base; may be -inf and +inf [m].

        Raises
        ------
        ValueError
            If a shape does not fit or a number is not usable.
        """
        points = _finite("centres", centres, 2)
        kind, parameters = _round(CYLINDER, points, radii)
        low = _spread("base", base, points.shape[:2])
        high = _spread("top", top, points.shape[:2])
        usable = (low < high) & (low < math.inf) & (high > -math.inf)
        if not usable.all():
            s, i = np.argwhere(~usable)[0]
            raise ValueError(
                f"base[{s}, {i}] = {low[s, i]} and top[{s}, {i}] = {high[s, i]}, top must be above base"
            )
        parameters[:, BASE] = low.ravel()
        parameters[:, TOP] = high.ravel()
        return cls._even(kind, parameters, points.shape[0])

    @classmethod
    def empty(cls, n_scenes: int = 1) -> ObstacleSet:
        """Scenes without obstacles: every distance is +inf."""
        return cls(pack(()), np.zeros(n_scenes + 1, dtype=np.int64))

    @classmethod
    def stack(cls, sets: Sequence[ObstacleSet]) -> ObstacleSet:
        """All scenes of several sets, one after the other."""
        if not sets:
            raise ValueError(
                "stack() needs at least one ObstacleSet; for a world without obstacles use empty()"
            )
        parts = [obstacles.solids for obstacles in sets]
        rings = np.cumsum([0] + [len(part.ring_start) - 1 for part in parts])
        vertices = np.cumsum([0] + [len(part.vertices) for part in parts])
        totals = np.cumsum([0] + [len(part.kind) for part in parts])
        starts = [part.ring_start[:-1] + shift for part, shift in zip(parts, vertices[:-1], strict=True)]
        solids = Solids(
            np.concatenate([part.kind for part in parts]),
            np.concatenate([part.parameters for part in parts]),
            np.concatenate([part.rings + shift for part, shift in zip(parts, rings[:-1], strict=True)]),
            np.concatenate([*starts, vertices[-1:]]),
            np.concatenate([part.vertices for part in parts]),
        )
        scenes = [each.scene_start[:-1] + shift for each, shift in zip(sets, totals[:-1], strict=True)]
        return cls(solids, np.concatenate([*scenes, totals[-1:]]))

    @classmethod
    def _even(cls, kind: NDArray[np.int64], parameters: NDArray[np.float64], scenes: int) -> ObstacleSet:
        n = len(kind)
        none = pack(())
        solids = Solids(kind, parameters, np.zeros((n, 2), np.int64), none.ring_start, none.vertices)
        return cls(solids, np.arange(scenes + 1, dtype=np.int64) * (n // scenes if scenes else 0))

    def __len__(self) -> int:
        """Number of obstacles in all scenes together."""
        return len(self.solids.kind)

    @property
    def n_scenes(self) -> int:
        """Number of scenes."""
        return len(self.scene_start) - 1

    def counts(self) -> NDArray[np.int64]:
        """Number of obstacles in each scene, shape (scene,)."""
        return np.diff(self.scene_start)

    def scene(self, i: int) -> ObstacleSet:
        """Scene i as a set of its own."""
        rows = self._rows(i)
        part = self.solids
        prisms = part.rings[rows][part.rings[rows][:, 1] > 0]
        ring_lo, ring_hi = (int(prisms[:, 0].min()), int(prisms[:, 1].max())) if len(prisms) else (0, 0)
        ring_start = part.ring_start[ring_lo : ring_hi + 1]
        rings = np.where(part.rings[rows] > 0, part.rings[rows] - ring_lo, 0)
        vertices = part.vertices[ring_start[0] : ring_start[-1]]
        solids = Solids(part.kind[rows], part.parameters[rows], rings, ring_start - ring_start[0], vertices)
        return ObstacleSet(solids, self.scene_start[i : i + 2] - self.scene_start[i])

    def shapes(self, scene: int = 0) -> list[Shape]:
        """Obstacles of one scene as shapes, in order."""
        rows = self._rows(scene)
        return [unpack(self.solids, i) for i in range(rows.start, rows.stop)]

    def _rows(self, scene: int) -> slice:
        if not 0 <= scene < self.n_scenes:
            raise IndexError(f"scene {scene} does not exist: this set has {self.n_scenes}")
        return slice(int(self.scene_start[scene]), int(self.scene_start[scene + 1]))

    @cached_property
    def boxes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Axis-aligned box of each obstacle: lower and upper corners, shape (obstacle, 3) [m]."""
        return solid_bounds(self.solids)

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corner of the box around all obstacles, shape (3,) [m]; +inf, -inf when empty."""
        lower, upper = self.boxes
        return lower.min(axis=0, initial=np.inf), upper.max(axis=0, initial=-np.inf)

    @cached_property
    def tree(self) -> BoxTree:
        """Search tree, built at the first query."""
        return plant(*self.boxes, self.scene_start, LEAF)

    def signed_distance(self, points: ArrayLike) -> NDArray[np.float64]:
        """Signed distance to the nearest obstacle.

        Parameters
        ----------
        points : array, shape (run, point, 3)
            East, north, up [m].

        Returns
        -------
        array, shape (run, point)
            Distance, negative inside an obstacle, +inf without any [m].

        Raises
        ------
        ValueError
            If a point is not finite, or the runs do not fit the scenes.
        """
        return self.nearest(points)[0]

    def nearest(
        self, points: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """Nearest obstacle: signed distance, its gradient and the obstacle's index within its scene.

        Parameters
        ----------
        points : array, shape (run, point, 3)
            East, north, up [m].

        Returns
        -------
        distance : array, shape (run, point)
            Signed distance, +inf in an empty scene [m].
        gradient : array, shape (run, point, 3)
            Unit vector away from the obstacle, 0 in an empty scene.
        index : array, shape (run, point)
            The lowest index among equally near ones, -1 in an empty scene.

        Raises
        ------
        ValueError
            If a point is not finite, or the runs do not fit the scenes.
        """
        array = self.check_points("points", points)
        distance = np.empty(array.shape[:2])
        gradient = np.empty(array.shape)
        index = np.empty(array.shape[:2], dtype=np.int64)
        nearest_all(self.solids, self.tree, self.scene_start, array, distance, gradient, index)
        return distance, gradient, index

    def near(self, points: ArrayLike, reach: ArrayLike, limit: int | None = None, together: int = 1) -> Near:
        """Obstacles whose signed distance is below a reach, sorted by (distance, index).

        Parameters
        ----------
        points : array, shape (run, point, 3)
            East, north, up [m].
        reach : float or array, broadcast to shape (run, point)
            Reach, may be +inf [m].
        limit : int, optional
            Keep this many of the nearest and make the arrays this wide; without it the arrays are as wide as
            the largest number found, possibly 0.
        together : int
            Points in a row that lie near each other, such as those of one plan: they are searched faster as
            one, with the same answers.

        Returns
        -------
        Near
            Distances, gradients and indices, padded with +inf, 0 and -1.

        Raises
        ------
        ValueError
            If a point is not finite, a reach is NaN, the limit is negative, together is below 1 or the runs
            do not fit the scenes.
        """
        array = self.check_points("points", points)
        reaches = _spread("reach", reach, array.shape[:2])
        if limit is not None and limit < 0:
            raise ValueError(f"limit = {limit}, must be >= 0")
        if together < 1:
            raise ValueError(f"together = {together}, must be >= 1")
        if limit is None:
            width = largest_count(self.solids, self.tree, self.scene_start, array, reaches)
        else:
            width = limit
        distance = np.empty((*array.shape[:2], width))
        gradient = np.empty((*array.shape[:2], width, 3))
        index = np.empty((*array.shape[:2], width), dtype=np.int64)
        if width > 0:
            near_all(
                self.solids, self.tree, self.scene_start, array, reaches, together, distance, gradient, index
            )
        return Near(distance, gradient, index)

    def check_points(self, name: str, points: ArrayLike) -> NDArray[np.float64]:
        """Return points of shape (run, point, 3) as a contiguous array, or raise ValueError naming them."""
        array = _finite(name, points, 3)
        self.check_runs(array.shape[0])
        return array

    def check_runs(self, runs: int) -> None:
        """Raise ValueError unless each run has a scene."""
        if self.n_scenes not in (1, runs):
            raise ValueError(f"{runs} runs do not fit {self.n_scenes} scenes: need one each, or one for all")


def _finite(name: str, values: ArrayLike, columns: int) -> NDArray[np.float64]:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim != 3 or array.shape[2] != columns:
        raise ValueError(
            f"{name} has shape {array.shape}, must have three axes, the last of length {columns}"
        )
    if not all_finite(array):
        r, k, _ = np.argwhere(~np.isfinite(array))[0]
        raise ValueError(f"{name}[{r}, {k}] = {array[r, k].tolist()}, must be finite")
    return array


def _spread(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    if isinstance(values, np.ndarray) and values.shape == shape and values.dtype == np.float64:
        spread = np.ascontiguousarray(values)
        if not np.isnan(spread).any():
            return spread
    try:
        array = np.ascontiguousarray(np.broadcast_to(np.asarray(values, dtype=np.float64), shape))
    except ValueError:
        raise ValueError(f"{name} has shape {np.shape(values)}, must broadcast to {shape}") from None
    if np.isnan(array).any():
        raise ValueError(f"{name} holds NaN")
    return array


def _round(
    kind: int, centres: NDArray[np.float64], radii: ArrayLike
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Kinds and parameters of solids with a centre and a radius, scene after scene."""
    size = _spread("radii", radii, centres.shape[:2])
    usable = np.isfinite(size) & (size > 0.0)
    if not usable.all():
        s, i = np.argwhere(~usable)[0]
        raise ValueError(f"radii[{s}, {i}] = {size[s, i]}, must be finite and > 0")
    n = centres.shape[0] * centres.shape[1]
    parameters = np.zeros((n, 8))
    parameters[:, X] = centres[..., 0].ravel()
    parameters[:, Y] = centres[..., 1].ravel()
    parameters[:, A] = size.ravel()
    return np.full(n, kind, dtype=np.int64), parameters
