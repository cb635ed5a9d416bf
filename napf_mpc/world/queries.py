"""Compiled searches over (run, point): the nearest obstacle, and those within a reach."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.world.bounding_tree import STACK, BoxTree, box_distance
from napf_mpc.world.distance import BASE, SPHERE, A, Solids, X, Y, ball_distance, length3, signed_distance


@compiled_bare
def all_finite(points: NDArray[np.float64]) -> bool:
    """Whether all coordinates of points (run, point, 3) are finite."""
    for r in range(points.shape[0]):
        for k in range(points.shape[1]):
            for axis in range(points.shape[2]):
                if not np.isfinite(points[r, k, axis]):
                    return False
    return True


@compiled_bare
def nearest_obstacle(
    solids: Solids,
    tree: BoxTree,
    scene: int,
    px: float,
    py: float,
    pz: float,
    nodes: NDArray[np.int64],
    bounds: NDArray[np.float64],
) -> tuple[float, float, float, float, int]:
    """Nearest obstacle of a scene (d, gx, gy, gz, index among all solids), or (inf, 0, 0, 0, -1).

    `nodes` and `bounds` are scratch arrays of length STACK.
    """
    best = np.inf
    gx = gy = gz = 0.0
    index = -1
    depth = 0
    if tree.root[scene] >= 0:
        nodes[0] = tree.root[scene]
        bounds[0] = -np.inf
        depth = 1
    while depth > 0:
        depth -= 1
        # Equal bounds are searched too: the lowest index wins a tie.
        if bounds[depth] > best:
            continue
        node = nodes[depth]
        while tree.right[node] >= 0:
            left = box_distance(tree.box, node + 1, px, py, pz)
            right = box_distance(tree.box, tree.right[node], px, py, pz)
            if left <= right:
                nodes[depth] = tree.right[node]
                bounds[depth] = right
                node = node + 1
                nearer = left
            else:
                nodes[depth] = node + 1
                bounds[depth] = left
                node = tree.right[node]
                nearer = right
            depth += 1
            if nearer > best:
                break
        else:
            for entry in range(tree.first[node], tree.first[node] + tree.size[node]):
                i = tree.order[entry]
                d, dx, dy, dz = signed_distance(solids, i, px, py, pz)
                if d < best or (d == best and i < index):
                    best = d
                    gx = dx
                    gy = dy
                    gz = dz
                    index = i
    return best, gx, gy, gz, index


@compiled_bare
def two_nearest(
    solids: Solids,
    tree: BoxTree,
    scene: int,
    px: float,
    py: float,
    pz: float,
    nodes: NDArray[np.int64],
) -> tuple[float, float, int]:
    """Distances to the nearest and second nearest obstacle (inf for none), and which is nearest (or -1).

    `nodes` is a scratch array of length STACK.
    """
    best = second = np.inf
    index = -1
    depth = 0
    if tree.root[scene] >= 0:
        nodes[0] = tree.root[scene]
        depth = 1
    while depth > 0:
        depth -= 1
        node = nodes[depth]
        # Equal bounds are searched too: the lowest index wins a tie.
        if box_distance(tree.box, node, px, py, pz) > second:
            continue
        if tree.right[node] >= 0:
            near = node + 1
            far = tree.right[node]
            if box_distance(tree.box, far, px, py, pz) < box_distance(tree.box, near, px, py, pz):
                near, far = far, near
            nodes[depth] = far
            nodes[depth + 1] = near
            depth += 2
            continue
        for entry in range(tree.first[node], tree.first[node] + tree.size[node]):
            i = tree.order[entry]
            d = signed_distance(solids, i, px, py, pz)[0]
            if d < best or (d == best and i < index):
                second = best
                best = d
                index = i
            elif d < second:
                second = d
    return best, second, index


@compiled
def nearest_all(
    solids: Solids,
    tree: BoxTree,
    scene_start: NDArray[np.int64],
    points: NDArray[np.float64],
    distance: NDArray[np.float64],
    gradient: NDArray[np.float64],
    index: NDArray[np.int64],
) -> None:
    """Answer `ObstacleSet.nearest` in place."""
    nodes = np.empty(STACK, dtype=np.int64)
    bounds = np.empty(STACK)
    shared = len(scene_start) == 2
    for r in range(points.shape[0]):
        scene = 0 if shared else r
        for k in range(points.shape[1]):
            d, gx, gy, gz, i = nearest_obstacle(
                solids, tree, scene, points[r, k, 0], points[r, k, 1], points[r, k, 2], nodes, bounds
            )
            distance[r, k] = d
            gradient[r, k, 0] = gx
            gradient[r, k, 1] = gy
            gradient[r, k, 2] = gz
            index[r, k] = i - scene_start[scene] if i >= 0 else -1


@compiled
def largest_count(
    solids: Solids,
    tree: BoxTree,
    scene_start: NDArray[np.int64],
    points: NDArray[np.float64],
    reaches: NDArray[np.float64],
) -> int:
    """Largest number of obstacles below the reach of any point."""
    nodes = np.empty(STACK, dtype=np.int64)
    shared = len(scene_start) == 2
    largest = 0
    for r in range(points.shape[0]):
        scene = 0 if shared else r
        for k in range(points.shape[1]):
            px, py, pz = points[r, k]
            count = 0
            depth = 0
            if tree.root[scene] >= 0:
                nodes[0] = tree.root[scene]
                depth = 1
            while depth > 0:
                depth -= 1
                node = nodes[depth]
                if box_distance(tree.box, node, px, py, pz) >= reaches[r, k]:
                    continue
                if tree.right[node] >= 0:
                    nodes[depth] = tree.right[node]
                    nodes[depth + 1] = node + 1
                    depth += 2
                    continue
                for entry in range(tree.first[node], tree.first[node] + tree.size[node]):
                    if signed_distance(solids, tree.order[entry], px, py, pz)[0] < reaches[r, k]:
                        count += 1
            largest = max(largest, count)
    return largest


@compiled
def near_all(
    solids: Solids,
    tree: BoxTree,
    scene_start: NDArray[np.int64],
    points: NDArray[np.float64],
    reaches: NDArray[np.float64],
    together: int,
    distance: NDArray[np.float64],
    gradient: NDArray[np.float64],
    index: NDArray[np.int64],
) -> None:
    """Answer `ObstacleSet.near` in place, padding included; the arrays are at least one wide.

    So many points in a row as `together` says share a search, see :func:`_candidates`; it changes no answer.
    """
    nodes = np.empty(STACK, dtype=np.int64)
    solid = np.empty(CANDIDATES, dtype=np.int64)
    from_centre = np.empty(CANDIDATES)
    centre = np.empty(3)
    found = np.empty((CANDIDATES, 4))
    order = np.empty(CANDIDATES, dtype=np.int64)
    row = solids.parameters
    shared = len(scene_start) == 2
    width = distance.shape[2]
    for r in range(points.shape[0]):
        scene = 0 if shared else r
        for start in range(0, points.shape[1], together):
            stop = min(start + together, points.shape[1])
            count = -1
            if together > 1:
                ours, theirs = points[r, start:stop], reaches[r, start:stop]
                count = _candidates(solids, tree, scene, ours, theirs, nodes, centre, solid, from_centre)
            for k in range(start, stop):
                for n in range(width):
                    distance[r, k, n], index[r, k, n] = np.inf, -1
                    for axis in range(3):
                        gradient[r, k, n, axis] = 0.0
            for k in range(start, stop if count >= 0 else start):
                px, py, pz = points[r, k, 0], points[r, k, 1], points[r, k, 2]
                reach = reaches[r, k]
                away = length3(px - centre[0], py - centre[1], pz - centre[2]) + BOUND_M
                held = 0
                for c in range(count):
                    if from_centre[c] - away >= reach:
                        continue
                    i = solid[c]
                    if solids.kind[i] == SPHERE:
                        d, gx, gy, gz = ball_distance(
                            px - row[i, X], py - row[i, Y], pz - row[i, BASE], row[i, A]
                        )
                    else:
                        d, gx, gy, gz = signed_distance(solids, i, px, py, pz)
                    if d >= reach:
                        continue
                    found[c, 0], found[c, 1], found[c, 2], found[c, 3] = d, gx, gy, gz
                    at = held
                    while at > 0 and (
                        found[order[at - 1], 0] > d
                        or (found[order[at - 1], 0] == d and solid[order[at - 1]] > i)
                    ):
                        at -= 1
                    if at == width:
                        continue
                    held = min(held + 1, width)
                    for later in range(held - 1, at, -1):
                        order[later] = order[later - 1]
                    order[at] = c
                for n in range(held):
                    c = order[n]
                    distance[r, k, n] = found[c, 0]
                    index[r, k, n] = solid[c] - scene_start[scene]
                    for axis in range(3):
                        gradient[r, k, n, axis] = found[c, 1 + axis]
            for k in range(start if count < 0 else stop, stop):
                px, py, pz = points[r, k]
                keys = distance[r, k]
                names = index[r, k]
                vectors = gradient[r, k]
                held = 0
                reach = reaches[r, k]
                depth = 0
                if tree.root[scene] >= 0:
                    nodes[0] = tree.root[scene]
                    depth = 1
                while depth > 0:
                    depth -= 1
                    node = nodes[depth]
                    bound = box_distance(tree.box, node, px, py, pz)
                    if bound >= reach or (held == width and bound > keys[0]):
                        continue
                    if tree.right[node] >= 0:
                        nodes[depth] = tree.right[node]
                        nodes[depth + 1] = node + 1
                        depth += 2
                        continue
                    for entry in range(tree.first[node], tree.first[node] + tree.size[node]):
                        i = tree.order[entry]
                        d, gx, gy, gz = signed_distance(solids, i, px, py, pz)
                        if d >= reach:
                            continue
                        name = i - scene_start[scene]
                        if held < width:
                            keys[held] = d
                            names[held] = name
                            _set(vectors, held, gx, gy, gz)
                            held += 1
                            _rise(keys, names, vectors, held - 1)
                        elif d < keys[0] or (d == keys[0] and name < names[0]):
                            keys[0] = d
                            names[0] = name
                            _set(vectors, 0, gx, gy, gz)
                            _sink(keys, names, vectors, 0, held)
                for last in range(held - 1, 0, -1):
                    _swap(keys, names, vectors, 0, last)
                    _sink(keys, names, vectors, 0, last)


CANDIDATES = 64
"""Obstacles near a row of points, at most, that are tested one by one at each of them."""
BOUND_M = 1e-6
"""What the bound on a distance is loosened by, so that rounding drops no obstacle [m]."""


@compiled
def _candidates(
    solids: Solids,
    tree: BoxTree,
    scene: int,
    points: NDArray[np.float64],
    reaches: NDArray[np.float64],
    nodes: NDArray[np.int64],
    centre: NDArray[np.float64],
    solid: NDArray[np.int64],
    bound: NDArray[np.float64],
) -> int:
    """Obstacles that may be within reach of any of some points, or -1 if that are too many to be of use.

    A signed distance changes by no more than the way gone, so that from the middle of the points one look
    settles which obstacles can matter at all; `bound`, the distance there, says which of them can at a point.
    """
    lower, upper = np.inf * np.ones(3), -np.inf * np.ones(3)
    reach = -np.inf
    for k in range(points.shape[0]):
        reach = max(reach, reaches[k])
        for axis in range(3):
            lower[axis] = min(lower[axis], points[k, axis])
            upper[axis] = max(upper[axis], points[k, axis])
    for axis in range(3):
        centre[axis] = 0.5 * lower[axis] + 0.5 * upper[axis]
    cx, cy, cz = centre[0], centre[1], centre[2]
    widest = length3(upper[0] - cx, upper[1] - cy, upper[2] - cz)
    # Very far out the coordinates themselves are coarser than the bound.
    if not (abs(cx) + abs(cy) + abs(cz) + widest < 1e7):
        return -1
    reach += widest + BOUND_M
    count = 0
    depth = 0
    if tree.root[scene] >= 0:
        nodes[0] = tree.root[scene]
        depth = 1
    while depth > 0:
        depth -= 1
        node = nodes[depth]
        if box_distance(tree.box, node, cx, cy, cz) >= reach:
            continue
        if tree.right[node] >= 0:
            nodes[depth] = tree.right[node]
            nodes[depth + 1] = node + 1
            depth += 2
            continue
        for entry in range(tree.first[node], tree.first[node] + tree.size[node]):
            i = tree.order[entry]
            d = signed_distance(solids, i, cx, cy, cz)[0]
            if d < reach:
                if count == len(solid):
                    return -1
                solid[count] = i
                bound[count] = d
                count += 1
    return count


# A heap with the farthest (distance, index) at its top keeps the nearest few and ends as a sorted row, in
# place: a reach may hold ten thousand obstacles.


@compiled_bare
def _set(vectors: NDArray[np.float64], i: int, gx: float, gy: float, gz: float) -> None:
    vectors[i, 0] = gx
    vectors[i, 1] = gy
    vectors[i, 2] = gz


@compiled_bare
def _swap(
    keys: NDArray[np.float64], names: NDArray[np.int64], vectors: NDArray[np.float64], i: int, j: int
) -> None:
    keys[i], keys[j] = keys[j], keys[i]
    names[i], names[j] = names[j], names[i]
    for axis in range(3):
        vectors[i, axis], vectors[j, axis] = vectors[j, axis], vectors[i, axis]


@compiled_bare
def _farther(keys: NDArray[np.float64], names: NDArray[np.int64], i: int, j: int) -> bool:
    return bool(keys[i] > keys[j] or (keys[i] == keys[j] and names[i] > names[j]))


@compiled_bare
def _rise(keys: NDArray[np.float64], names: NDArray[np.int64], vectors: NDArray[np.float64], i: int) -> None:
    while i > 0 and _farther(keys, names, i, (i - 1) // 2):
        _swap(keys, names, vectors, i, (i - 1) // 2)
        i = (i - 1) // 2


@compiled_bare
def _sink(
    keys: NDArray[np.float64], names: NDArray[np.int64], vectors: NDArray[np.float64], i: int, count: int
) -> None:
    while True:
        top = i
        for child in range(2 * i + 1, min(2 * i + 3, count)):
            if _farther(keys, names, child, top):
                top = child
        if top == i:
            return
        _swap(keys, names, vectors, i, top)
        i = top
