"""Plans of many programs side by side: the sweep that makes them, and how well they balance.

A matrix of the model has few entries, and a sweep is a chain of sums that wait for each other. Programs are
therefore taken side by side, in *lanes*: each entry is read once and serves all of them. No sum runs over
lanes, so that a plan is the same to the last bit whatever stands beside it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from napf_mpc.jit import compiled_apart, compiled_bare
from napf_mpc.qp import INPUTS, STATES, Array, Index
from napf_mpc.solvers.kernel_signals import CLOSED, GAIN, INVERSE, PULL, TO_GO, A, B, Q, R, SignalMaps


class Lanes(NamedTuple):
    """Plans of some programs, and room for their sweeps; the lane is the last axis."""

    start: Array
    """(1, 12, lane) states now."""
    reference: Array
    """(N, 12, lane)."""
    linear: Array
    """(N, 12, lane) -Q ref."""
    loads: Array
    """(N, 16, lane) rows times their multipliers, by state and input."""
    feed: Array
    """(N, 4, lane)."""
    push: Array
    """(N, 4, lane) linear cost of the inputs."""
    cost: Array
    """(N, 12, lane) linear part of the optimal cost from the end of each stage on."""
    states: Array
    """(N, 12, lane)."""
    inputs: Array
    """(N, 4, lane)."""
    costates: Array
    """(N, 12, lane) multipliers of the dynamics."""
    weighed: Array
    """(N, 16, lane)."""
    carried: Array
    """(N, 16, lane)."""
    lost: Index
    """(lane,) numbers of the plan that are not finite."""
    balance: Array
    """(6, lane) residual and largest term of dynamics, gradient and complementarity."""

    @classmethod
    def empty(cls, stages: int, count: int) -> Lanes:
        """Room for so many programs."""
        state, push = (stages, STATES, count), (stages, INPUTS, count)
        both = (stages, STATES + INPUTS, count)
        return cls(
            np.zeros((1, STATES, count)), np.zeros(state), np.zeros(state), np.zeros(both), np.zeros(push),
            np.zeros(push), np.zeros(state), np.zeros(state), np.zeros(push), np.zeros(state), np.zeros(both),
            np.zeros(both), np.zeros(count, dtype=np.int64), np.zeros((6, count)),
        )  # fmt: skip


@compiled_bare
def add(
    maps: SignalMaps, which: int, k: int, sign: float, vector: Array, at: int, out: Array, to: int, first: int
) -> None:
    """Add ``sign matrix vector[at]`` of a matrix of stage k to ``out[to, first:]``.

    Arrays come whole with indices: views of them cost more than the sums.
    """
    for e in range(maps.begins[which, k], maps.begins[which, k + 1]):
        value, row, column = sign * maps.value[e], first + maps.row[e], maps.column[e]
        for lane in range(out.shape[2]):
            out[to, row, lane] += value * vector[at, column, lane]


@compiled_bare
def add_turned(
    maps: SignalMaps, which: int, k: int, sign: float, vector: Array, at: int, out: Array, to: int, first: int
) -> None:
    """The same of the matrix's transpose."""
    for e in range(maps.begins[which, k], maps.begins[which, k + 1]):
        value, row, column = sign * maps.value[e], first + maps.column[e], maps.row[e]
        for lane in range(out.shape[2]):
            out[to, row, lane] += value * vector[at, column, lane]


@compiled_bare
def clear(values: Array) -> None:
    """Zero an array of lanes."""
    for k in range(values.shape[0]):
        for i in range(values.shape[1]):
            for lane in range(values.shape[2]):
                values[k, i, lane] = 0.0


@compiled_bare
def take(maps: SignalMaps, lanes: Lanes, lane: int, starts: Array, references: Array, at: int) -> None:
    """Put a program's state now and its reference into a lane."""
    for i in range(STATES):
        lanes.start[0, i, lane] = starts[at, i]
        for k in range(references.shape[1]):
            lanes.reference[k, i, lane] = references[at, k, i]


@compiled_apart
def sweep(maps: SignalMaps, lanes: Lanes, loaded: bool) -> None:
    """Optimal states and inputs for the model's cost and the references, under the loads if there are any."""
    n = lanes.linear.shape[0]
    if not loaded:
        clear(lanes.linear)
        for k in range(n):
            add(maps, Q, k, -1.0, lanes.reference, k, lanes.linear, k, 0)
    clear(lanes.feed)
    clear(lanes.states)
    clear(lanes.inputs)
    for k in range(n):
        for i in range(STATES):
            for lane in range(lanes.cost.shape[2]):
                lanes.cost[k, i, lane] = lanes.linear[k, i, lane]
            if loaded:
                for lane in range(lanes.cost.shape[2]):
                    lanes.cost[k, i, lane] -= lanes.loads[k, i, lane]
        if loaded:
            for i in range(INPUTS):
                for lane in range(lanes.push.shape[2]):
                    lanes.push[k, i, lane] = -lanes.loads[k, STATES + i, lane]
    for k in range(n - 1, -1, -1):
        add(maps, PULL, k, -1.0, lanes.cost, k, lanes.feed, k, 0)
        if loaded:
            add(maps, INVERSE, k, -1.0, lanes.push, k, lanes.feed, k, 0)
        if k == 0:
            break
        add_turned(maps, CLOSED, k, 1.0, lanes.cost, k, lanes.cost, k - 1, 0)
        if loaded:
            add_turned(maps, GAIN, k, -1.0, lanes.push, k, lanes.cost, k - 1, 0)
    for k in range(n):
        for i in range(INPUTS):
            for lane in range(lanes.inputs.shape[2]):
                lanes.inputs[k, i, lane] = lanes.feed[k, i, lane]
        before, at = (lanes.states, k - 1) if k > 0 else (lanes.start, 0)
        add(maps, GAIN, k, -1.0, before, at, lanes.inputs, k, 0)
        add(maps, A, k, 1.0, before, at, lanes.states, k, 0)
        add(maps, B, k, 1.0, lanes.inputs, k, lanes.states, k, 0)
    for lane in range(len(lanes.lost)):
        lanes.lost[lane] = 0
    for k in range(n):
        for i in range(STATES):
            # NaN fails every comparison.
            for lane in range(len(lanes.lost)):
                lanes.lost[lane] += not abs(lanes.states[k, i, lane]) < np.inf
        for i in range(INPUTS):
            for lane in range(len(lanes.lost)):
                lanes.lost[lane] += not abs(lanes.inputs[k, i, lane]) < np.inf


@compiled_bare
def read_signals(maps: SignalMaps, lanes: Lanes, lane: int, signals: Array) -> None:
    """Write the signals (13 N,) of a lane."""
    for i in range(len(signals)):
        k, target = maps.stage[i], maps.target[i]
        signals[i] = (
            lanes.states[k, target, lane] if target < STATES else lanes.inputs[k, target - STATES, lane]
        )


@compiled_bare
def widen_bound(bounds: Array, which: int, values: Array, k: int, i: int) -> None:
    """Let a bound of each lane grow to the size of a number."""
    for lane in range(values.shape[2]):
        size = abs(values[k, i, lane])
        bounds[which, lane] = size if size > bounds[which, lane] else bounds[which, lane]


@compiled_apart
def stationarity(maps: SignalMaps, lanes: Lanes) -> None:
    """Multipliers of the dynamics, and how well states and inputs balance model, cost and loads.

    The multipliers are minus the gradient of the optimal cost from each stage on; the balance is taken of the
    model's own matrices. It is the largest violation of the dynamics and its largest term, the largest entry
    of the Lagrangian's gradient and its largest term, the largest multiplier times violation of the dynamics
    and its largest term. A number that is not finite is lost; the sweep has counted those.
    """
    n = lanes.linear.shape[0]
    clear(lanes.weighed)
    clear(lanes.carried)
    for e in range(6):
        for lane in range(lanes.balance.shape[1]):
            lanes.balance[e, lane] = 0.0
    for k in range(n):
        for i in range(STATES):
            for lane in range(lanes.cost.shape[2]):
                lanes.costates[k, i, lane] = -lanes.cost[k, i, lane]
    for k in range(n - 1, -1, -1):
        add(maps, TO_GO, k, -1.0, lanes.states, k, lanes.costates, k, 0)
        add(maps, Q, k, 1.0, lanes.states, k, lanes.weighed, k, 0)
        if k + 1 < n:
            add_turned(maps, A, k + 1, 1.0, lanes.costates, k + 1, lanes.carried, k, 0)
        add(maps, R, k, 1.0, lanes.inputs, k, lanes.weighed, k, STATES)
        add_turned(maps, B, k, 1.0, lanes.costates, k, lanes.carried, k, STATES)
        for i in range(STATES + INPUTS):
            widen_bound(lanes.balance, 3, lanes.weighed, k, i)
            for lane in range(lanes.carried.shape[2]):
                lanes.carried[k, i, lane] += lanes.loads[k, i, lane] - lanes.weighed[k, i, lane]
            if i < STATES:
                widen_bound(lanes.balance, 3, lanes.linear, k, i)
                widen_bound(lanes.balance, 3, lanes.costates, k, i)
                for lane in range(lanes.carried.shape[2]):
                    lanes.carried[k, i, lane] -= lanes.linear[k, i, lane] + lanes.costates[k, i, lane]
            else:
                widen_bound(lanes.balance, 3, lanes.loads, k, i)
            widen_bound(lanes.balance, 2, lanes.carried, k, i)
    # The dynamics, the other way round than in the sweep, in place of what is no longer needed.
    clear(lanes.weighed)
    for k in range(n):
        add(maps, B, k, 1.0, lanes.inputs, k, lanes.weighed, k, 0)
        before, at = (lanes.states, k - 1) if k > 0 else (lanes.start, 0)
        add(maps, A, k, 1.0, before, at, lanes.weighed, k, 0)
        for i in range(STATES):
            for lane in range(lanes.weighed.shape[2]):
                lanes.weighed[k, i, lane] -= lanes.states[k, i, lane]
            widen_bound(lanes.balance, 0, lanes.weighed, k, i)
            widen_bound(lanes.balance, 1, lanes.states, k, i)
            for lane in range(lanes.weighed.shape[2]):
                lanes.weighed[k, i, lane] *= lanes.costates[k, i, lane]
                lanes.carried[k, i, lane] = lanes.states[k, i, lane] * lanes.costates[k, i, lane]
            widen_bound(lanes.balance, 4, lanes.weighed, k, i)
            widen_bound(lanes.balance, 5, lanes.carried, k, i)
