"""Trajectories of a flight: truth, estimate, reported sigma, command and reference, tick by tick."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from napf_mpc.closed_loop import ATTITUDE, POSITION, RATES, VELOCITY, Mask
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.planner import Command

Array = NDArray[np.float64]

_VECTORS = (
    ("", "m", "xyz"),
    ("v", "mps", "xyz"),
    ("est_", "m", "xyz"),
    ("sigma_", "m", "xyz"),
)
_ANGLES = ("roll", "pitch", "yaw")


class TrajectoryRecorder:
    """Observer that keeps every n-th tick of the inner loop as columns of a table.

    Parameters
    ----------
    planner : str
        Name in the ``planner`` column.
    runs : range
        Indices of the block's runs in their campaign.
    every : int
        Keep one tick of this many.
    """

    def __init__(self, planner: str, runs: range, every: int = 1) -> None:
        self._planner = planner
        self._runs = np.arange(runs.start, runs.stop)
        self._every = every
        self._tick = 0
        self._parts: list[dict[str, NDArray[Any]]] = []

    def moved(self, time_s: float, before: Array, after: Array, active: Mask) -> None:
        """Nothing to keep between ticks."""

    def ticked(
        self, time_s: float, state: Array, nav: NavSolution, command: Command, inputs: Array, active: Mask
    ) -> None:
        """Keep one row a UAV that still flies."""
        self._tick += 1
        if (self._tick - 1) % self._every:
            return
        uavs = state.shape[1]
        rows: dict[str, NDArray[Any]] = {
            "run": np.repeat(self._runs[active], uavs),
            "t_s": np.full(int(active.sum()) * uavs, time_s),
            "uav": np.tile(np.arange(uavs), int(active.sum())),
        }
        sigma = np.sqrt(np.einsum("...ii->...i", nav.position_covariance))
        values = (state[..., POSITION], state[..., VELOCITY], nav.position, sigma)
        for (prefix, unit, axes), vectors in zip(_VECTORS, values, strict=True):
            for a, axis in enumerate(axes):
                rows[f"{prefix}{axis}_{unit}"] = vectors[active][..., a].ravel()
        for a, angle in enumerate(_ANGLES):
            rows[f"{angle}_rad"] = state[..., ATTITUDE][active][..., a].ravel()
            rows[f"{angle}_rate_radps"] = state[..., RATES][active][..., a].ravel()
        for a, axis in enumerate("xyz"):
            rows[f"ref_{axis}_m"] = command.position[active][..., a].ravel()
            rows[f"ref_v{axis}_mps"] = command.velocity[active][..., a].ravel()
        for a, name in enumerate(("thrust_n", "roll_torque_nm", "pitch_torque_nm", "yaw_torque_nm")):
            rows[name] = inputs[active][..., a].ravel()
        rows["holding"] = command.holding[active].ravel()
        rows["available"] = nav.available[active].ravel()
        nothing = np.full(state.shape[:2], np.nan)
        slack = nothing if command.slack_m is None else command.slack_m
        rows["slack_m"] = slack[active].ravel()
        words = np.full(state.shape[:2], None, dtype=object)
        if command.solver_status is not None:
            words[:] = command.solver_status
        rows["solver_status"] = words[active].ravel()
        self._parts.append(rows)

    def columns(self) -> dict[str, NDArray[Any]]:
        """All rows so far by run, time and UAV; ``slack_m`` is null for planners without a QP."""
        if not self._parts:
            return {}
        table = {name: np.concatenate([part[name] for part in self._parts]) for name in self._parts[0]}
        order = np.lexsort((table["uav"], table["t_s"], table["run"]))
        table = {name: values[order] for name, values in table.items()}
        return {"run": table.pop("run"), "planner": np.full(len(order), self._planner), **table}
