"""Plans of many programs side by side: the sweep that makes them, and how well they balance.

The sums stand on a :mod:`tape <napf_mpc.solvers.kernel_tape>`; a program has a *lane* of the plane on which
it is played.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from napf_mpc.jit import compiled_apart, compiled_bare
from napf_mpc.qp import INPUTS, STATES, Array, Index
from napf_mpc.solvers.kernel_signals import SignalMaps
from napf_mpc.solvers.kernel_tape import (
    BALANCE,
    BOTH,
    FREE,
    GRADIENT,
    LARGEST,
    LINEAR,
    LOADED,
    LOADS,
    MOVED,
    PLAN,
    PULLED,
    PUSH,
    REFERENCE,
    START,
    TERMS,
    WEIGHED,
    first_places,
    play,
)


class Lanes(NamedTuple):
    """Plans of some programs; the lane is the last axis. All but the last two share the plane's memory."""

    plane: Array
    """(place, lane) see :mod:`~napf_mpc.solvers.kernel_tape`."""
    flat: Array
    """(place lane,)."""
    start: Array
    """(12, lane) states now."""
    reference: Array
    """(N, 12, lane)."""
    loads: Array
    """(N, 16, lane) rows times their multipliers, by state and input."""
    states: Array
    """(N, 12, lane)."""
    inputs: Array
    """(N, 4, lane)."""
    gradient: Array
    """(N, 12, lane) of the optimal cost from the end of each stage on: minus the dynamics' multipliers."""
    lost: Index
    """(lane,) numbers of the plan that are not finite."""
    balance: Array
    """(6, lane) residual and largest term of dynamics, gradient and complementarity."""

    @classmethod
    def empty(cls, stages: int, count: int) -> Lanes:
        """Room for so many programs."""
        first = first_places(stages)
        plane = np.zeros((first[-1], count))

        def block(which: int, each: int) -> Array:
            return plane[first[which] : first[which + 1]].reshape(-1, each, count)

        return cls(
            plane, plane.reshape(-1), block(START, STATES)[0], block(REFERENCE, STATES), block(LOADS, BOTH),
            block(PLAN, STATES), block(PUSH, INPUTS), block(GRADIENT, STATES),
            np.zeros(count, dtype=np.int64), np.zeros((TERMS, count)),
        )  # fmt: skip


@compiled_bare
def unload(lanes: Lanes) -> None:
    """Take all loads away."""
    for k in range(lanes.loads.shape[0]):
        for i in range(lanes.loads.shape[1]):
            for lane in range(lanes.loads.shape[2]):
                lanes.loads[k, i, lane] = 0.0


@compiled_bare
def take(lanes: Lanes, lane: int, starts: Array, references: Array, at: int) -> None:
    """Put a program's state now and its reference into a lane."""
    for i in range(STATES):
        lanes.start[i, lane] = starts[at, i]
        for k in range(references.shape[1]):
            lanes.reference[k, i, lane] = references[at, k, i]


@compiled_apart
def sweep(maps: SignalMaps, lanes: Lanes, loaded: bool) -> None:
    """Optimal states and inputs for the model's cost and the references, under the loads if there are any."""
    play(maps.tape, LOADED if loaded else FREE, lanes.plane)
    for lane in range(len(lanes.lost)):
        lanes.lost[lane] = 0
    for k in range(lanes.states.shape[0]):
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
def grow(flat: Array, largest: np.uint64, numbers: np.uint64, count: np.uint64) -> None:
    """Let numbers of the flat plane grow to the size of others, place by place."""
    for i in range(count):
        size, own = abs(flat[numbers + i]), flat[largest + i]
        flat[largest + i] = size if size > own else own


@compiled_apart
def stationarity(maps: SignalMaps, lanes: Lanes) -> None:
    """Gradient of the optimal cost, and how well states and inputs balance model, cost and loads.

    The balance is taken of the model's own matrices. It is the largest violation of the dynamics and its
    largest term, the largest entry of the Lagrangian's gradient and its largest term, the largest multiplier
    times violation of the dynamics and its largest term. A number that is not finite is lost; the sweep has
    counted those.
    """
    flat, first, count = lanes.flat, maps.tape.first, lanes.plane.shape[1]
    # Unsigned, so that the compiler need not think of indices from the end, and vectorises.
    state, both = np.uint64(STATES * count), np.uint64(BOTH * count)
    weighed, pulled = np.uint64(first[WEIGHED] * count), np.uint64(first[PULLED] * count)
    moved, largest = np.uint64(first[MOVED] * count), np.uint64(first[LARGEST] * count)
    for i in range(np.uint64(TERMS) * both):
        flat[largest + i] = 0.0
    for k in range(lanes.states.shape[0] - 1, -1, -1):
        play(maps.tape, BALANCE + k, lanes.plane)
        loads = np.uint64((first[LOADS] + BOTH * k) * count)
        linear = np.uint64((first[LINEAR] + STATES * k) * count)
        states = np.uint64((first[PLAN] + STATES * k) * count)
        gradient = np.uint64((first[GRADIENT] + STATES * k) * count)
        for i in range(both):
            flat[pulled + i] = (flat[loads + i] - flat[weighed + i]) - flat[pulled + i]
        for i in range(state):
            flat[pulled + i] -= flat[linear + i] - flat[gradient + i]
        at = largest + np.uint64(2) * both
        grow(flat, at, pulled, both)
        at += both
        grow(flat, at, weighed, both)
        grow(flat, at, linear, state)
        grow(flat, at, gradient, state)
        grow(flat, at + state, loads + state, both - state)
        for i in range(state):
            flat[moved + i] -= flat[states + i]
        grow(flat, largest, moved, state)
        grow(flat, largest + both, states, state)
        # Products with the multipliers, in place of what is no longer needed.
        for i in range(state):
            flat[moved + i] *= flat[gradient + i]
        for i in range(state):
            flat[weighed + i] = flat[states + i] * flat[gradient + i]
        at += both
        grow(flat, at, moved, state)
        grow(flat, at + both, weighed, state)
    for e in range(TERMS):
        for lane in range(count):
            lanes.balance[e, lane] = 0.0
        for i in range(BOTH):
            row = first[LARGEST] + BOTH * e + i
            for lane in range(count):
                size = lanes.plane[row, lane]
                lanes.balance[e, lane] = size if size > lanes.balance[e, lane] else lanes.balance[e, lane]
