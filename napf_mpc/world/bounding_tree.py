"""Tree of bounding boxes over the solids of each scene, so that a query looks at few of many solids.

A box tree rather than a grid of cells: sizes from a pole to a city block, endless heights and queries far
from everything need no special case. The signed distance to a box is a lower bound of the signed distance to
everything within it, also inside, so the pruned search returns exactly what testing every solid would.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.world.distance import length3

STACK = 128
"""Entries of a search stack; a median-split tree over 2^60 solids is not deeper."""


class BoxTree(NamedTuple):
    """Boxes of one tree a scene, nodes in depth-first order (a left child follows its parent)."""

    root: NDArray[np.int64]  # (scene,) root node, -1 for an empty scene
    box: NDArray[np.float64]  # (node, 6) lower x, y, z, upper x, y, z [m]
    right: NDArray[np.int64]  # (node,) right child, -1 for a leaf
    first: NDArray[np.int64]  # (node,) first entry of `order`
    size: NDArray[np.int64]  # (node,) entries of `order`
    order: NDArray[np.int64]  # (solid,) solids, those of a leaf side by side


def plant(
    lower: NDArray[np.float64], upper: NDArray[np.float64], scene_start: NDArray[np.int64], leaf: int
) -> BoxTree:
    """Build the trees of all scenes from the solids' boxes, at most `leaf` solids to a leaf."""
    # Rounding of the distance itself must not let a box rule out the solid within it.
    pad = 1e-9 * (1.0 + np.maximum(_finite_size(lower), _finite_size(upper)))
    return BoxTree(*_plant(lower - pad, upper + pad, np.asarray(scene_start), leaf))


def _finite_size(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.isfinite(corners), np.abs(corners), 0.0)


@compiled_bare
def _middle(lower: float, upper: float) -> float:
    """Middle of an interval; of an endless one, its finite end or zero: only used to sort."""
    if lower == -np.inf:
        return 0.0 if upper == np.inf else upper
    return lower if upper == np.inf else 0.5 * (lower + upper)


@compiled
def _plant(
    lower: NDArray[np.float64], upper: NDArray[np.float64], scene_start: NDArray[np.int64], leaf: int
) -> tuple[
    NDArray[np.int64],
    NDArray[np.float64],
    NDArray[np.int64],
    NDArray[np.int64],
    NDArray[np.int64],
    NDArray[np.int64],
]:
    n = len(lower)
    scenes = len(scene_start) - 1
    centre = np.empty((n, 3))
    for i in range(n):
        for axis in range(3):
            centre[i, axis] = _middle(lower[i, axis], upper[i, axis])
    order = np.arange(n)
    # Halving more than `leaf` solids leaves at least (leaf + 1) // 2 on either side.
    most = 0
    for scene in range(scenes):
        most += 2 * ((scene_start[scene + 1] - scene_start[scene]) // ((leaf + 1) // 2)) + 1
    root = np.full(scenes, -1, dtype=np.int64)
    box = np.empty((most, 6))
    right = np.full(most, -1, dtype=np.int64)
    first = np.empty(most, dtype=np.int64)
    size = np.empty(most, dtype=np.int64)
    stack = np.empty((STACK, 3), dtype=np.int64)
    nodes = 0
    for scene in range(scenes):
        if scene_start[scene] == scene_start[scene + 1]:
            continue
        root[scene] = nodes
        stack[0] = scene_start[scene], scene_start[scene + 1], -1
        depth = 1
        while depth > 0:
            depth -= 1
            start, stop, parent = stack[depth]
            node = nodes
            nodes += 1
            if parent >= 0:
                right[parent] = node
            first[node] = start
            size[node] = stop - start
            widest = 0
            spread = -1.0
            for axis in range(3):
                low = near = np.inf
                high = far = -np.inf
                for entry in range(start, stop):
                    i = order[entry]
                    low = min(low, lower[i, axis])
                    high = max(high, upper[i, axis])
                    near = min(near, centre[i, axis])
                    far = max(far, centre[i, axis])
                box[node, axis] = low
                box[node, axis + 3] = high
                if far - near > spread:
                    spread = far - near
                    widest = axis
            if stop - start > leaf:
                half = (start + stop) // 2
                _split(order, centre[:, widest], start, stop, half)
                stack[depth] = half, stop, node
                stack[depth + 1] = start, half, -1
                depth += 2
    return root, box[:nodes], right[:nodes], first[:nodes], size[:nodes], order


@compiled_bare
def _split(order: NDArray[np.int64], key: NDArray[np.float64], start: int, stop: int, half: int) -> None:
    """Partly sort order[start:stop] so that the keys before `half` are not above those from it on."""
    low = start
    high = stop - 1
    while low < high:
        pivot = key[order[(low + high) // 2]]
        i = low
        j = high
        while i <= j:
            while key[order[i]] < pivot:
                i += 1
            while key[order[j]] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if half <= j:
            high = j
        elif half >= i:
            low = i
        else:
            return


@compiled_bare
def box_distance(box: NDArray[np.float64], node: int, px: float, py: float, pz: float) -> float:
    """Signed distance [m] to the box of a node: at most that of anything within the box."""
    x: float = max(box[node, 0] - px, px - box[node, 3])
    y: float = max(box[node, 1] - py, py - box[node, 4])
    z: float = max(box[node, 2] - pz, pz - box[node, 5])
    largest = max(x, max(y, z))
    if largest <= 0.0:
        return largest
    # Shortened by more than its own rounding, for points very far away.
    return (1.0 - 1e-15) * length3(max(x, 0.0), max(y, 0.0), max(z, 0.0))
