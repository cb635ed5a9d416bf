r"""Sigma(p): how certain of its position a receiver will be at a place.

:func:`napf_mpc.navigation.gnss_sigma.sigma_map` makes such a map from buildings and satellites. Here is what
a planner gets of it: variances over a grid, slices of height around the way of a formation.

At the edge of a building's shadow the covariance jumps, and a UAV does not know to the metre where it is.
What a place gets is therefore never less than at any corner of the grid's cell around it in its slice: nodes
hold the largest variance of themselves and their neighbours on the level, and between nodes it is linear, so
that it is continuous, too. Between slices it is linear. A node in a building has no say; where a neighbour of
a node has no fix, the node has none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napf_mpc.formation import PathFrame
from napf_mpc.jit import compiled

__all__ = ["SigmaMap", "largest_around"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class SigmaMap:
    """Variances of the fix to be expected over a volume around the way of a formation, for a block of runs.

    It holds what a planner may know, and no scene: nothing that was drawn can be reached from here.
    """

    frame: PathFrame
    """The path, in whose coordinates the grid is."""
    low_m: Array
    """(3,) its lowest corner: along, left, up [m]."""
    cell_m: Array
    """(3,) distance of nodes [m]."""
    nodes: Array
    """(run, along, left, up, 6) variances on east, north and up [m^2] of the fix's own error and of what UAVs
    have in common, which lasts; infinite without a fix. See :func:`largest_around`."""

    @property
    def heights_m(self) -> Array:
        """(up,) heights of the slices above the path [m]."""
        return np.asarray(self.low_m[2] + self.cell_m[2] * np.arange(self.nodes.shape[3]))

    def variance(self, places: Array) -> tuple[Array, Array]:
        """Variances (run, ..., 3) at places (run, ..., 3): own and lasting [m^2]; infinite without a fix.

        A place outside the volume has those of the nearest one in it, one that is not finite has none.
        """
        cells = (self.frame.to_path(places).reshape(len(places), -1, 3) - self.low_m) / self.cell_m
        out = np.empty((*cells.shape[:2], 6))
        _look_up(self.nodes, cells, out)
        out = out.reshape(*places.shape[:-1], 6)
        return out[..., :3], out[..., 3:]

    def ahead(self, reported: Sequence[Array], has_fix: Mask, here: Array, places: Array) -> list[Array]:
        """Variances of fixes at places to come, of receivers that report something now.

        Who reports more than the map has here, as with a faulty satellite, goes on by that factor; less is no
        promise. Who has no fix where the map has one gets none any more; where the map has none either, fixes
        come back where the map says.

        Parameters
        ----------
        reported : one or two arrays, shape (run, uav, 3)
            Variances that the last fix reported: of the whole error, or of its own part and what lasts [m^2].
        has_fix : array of bool, shape (run, uav)
            Whether fixes are in use.
        here, places : array, shapes (run, uav, 3) and (run, uav, N, 3)
            Where the UAVs are, and will be [m].

        Returns
        -------
        list of array, shape (run, uav, N, 3)
            As many as are reported [m^2]; infinite without a fix.
        """
        now, then = self.variance(here), self.variance(places)
        pairs = (
            list(zip(now, then, strict=True)) if len(reported) > 1 else [(now[0] + now[1], then[0] + then[1])]
        )
        explained = np.isinf(now[0]).any(-1)
        expected = (has_fix | explained)[..., None, None]
        out = []
        for variance, (at_here, at_then) in zip(reported, pairs, strict=True):
            known = has_fix[..., None] & np.isfinite(at_here) & (at_here > 0.0)
            more = np.where(known, variance / np.where(known, at_here, 1.0), 1.0)
            out.append(np.where(expected, np.fmax(more, 1.0)[:, :, None] * at_then, np.inf))
        return out


def largest_around(values: Array) -> Array:
    """Largest of each node (run, along, left, up, channel) and its neighbours on the level.

    NaN, a place where nobody can be, has no say; where there is nothing else, the answer is infinite.
    """
    out = np.where(np.isnan(values), -np.inf, values)
    for axis in (1, 2):
        padded = np.pad(out, [(int(a == axis), int(a == axis)) for a in range(5)], constant_values=-np.inf)
        count = values.shape[axis]
        parts = [padded.take(range(shift, shift + count), axis=axis) for shift in range(3)]
        out = np.maximum(np.maximum(parts[0], parts[1]), parts[2])
    return np.where(np.isneginf(out), np.inf, out)


@compiled
def _look_up(nodes: Array, at: Array, out: Array) -> None:
    """Write values (run, place, channel) linear between nodes, at places (run, place, 3) in cells."""
    low, part = np.empty(3, dtype=np.int64), np.empty(3)
    for r in range(at.shape[0]):
        for n in range(at.shape[1]):
            known = True
            for a in range(3):
                known = known and np.isfinite(at[r, n, a])
                place = min(max(at[r, n, a] if known else 0.0, 0.0), nodes.shape[a + 1] - 1.0)
                low[a] = min(int(place), nodes.shape[a + 1] - 2)
                part[a] = place - low[a]
            for c in range(out.shape[2]):
                total = 0.0 if known else np.inf
                for corner in range(8):
                    x, y, z = corner & 1, corner >> 1 & 1, corner >> 2
                    share = part[0] if x else 1.0 - part[0]
                    share *= part[1] if y else 1.0 - part[1]
                    share *= part[2] if z else 1.0 - part[2]
                    # Nothing of an infinite corner is nothing, not NaN.
                    if share > 0.0:
                        total += share * nodes[r, low[0] + x, low[1] + y, low[2] + z, c]
                out[r, n, c] = total
