"""Signals of a horizon and what moves them: the part of the kernel solver that depends on the model alone.

Rows see a plan through 13 signals a stage: position, velocity, attitude and input. With the feedback
``u_k = v_k - K_k x_k`` of the Riccati recursion on the program's own grid and weights, the cost is
``sum v_k' H_k v_k / 2`` with ``H_k = B_k' P_{k+1} B_k + R_k``, well conditioned for any horizon. A unit force
on signal j moves signal i by the entry (i, j) of the signal kernel ``S H^-1 S'``, S being the map from v to
the signals. It is computed once for a model; the unconstrained optimum is one sweep back and forth.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.sparse.csgraph import connected_components

from napf_mpc.jit import compiled
from napf_mpc.qp import INPUTS, SIGNALS, STATES, Array, HorizonModel, Index, QpError

KINDS = tuple(SIGNALS)
"""Kinds of signals in the order of their numbers."""
TARGETS = np.array(
    [place + (STATES if kind == "input" else 0) for kind in KINDS for place in SIGNALS[kind]], dtype=np.int64
)
"""(13,) place of each signal in the state, or 12 and its place in the input."""
FIRST = np.cumsum([0, *(len(SIGNALS[kind]) for kind in KINDS)])[:-1]
"""(4,) number of the first signal of each kind."""
LOOSE = 1e-13
"""Signals correlated less than this belong to different chains: it is the rounding of the kernel."""
FLAT = 1e-13
"""Least eigenvalue of a stage's scaled Hessian: below it the cost does not determine the inputs."""


class SignalMaps(NamedTuple):
    """A model as the compiled loops need it; ``_t`` marks a transpose, so that inner loops are contiguous."""

    a: Array
    """(N, 12, 12)."""
    a_t: Array
    """(N, 12, 12)."""
    b: Array
    """(N, 12, 4)."""
    b_t: Array
    """(N, 4, 12)."""
    q: Array
    """(N, 12, 12)."""
    r: Array
    """(N, 4, 4)."""
    closed: Array
    """(N, 12, 12) A - B K."""
    gain: Array
    """(N, 4, 12) K."""
    gain_t: Array
    """(N, 12, 4)."""
    pull_t: Array
    """(N, 12, 4) transpose of H^-1 B'."""
    inverse: Array
    """(N, 4, 4) H^-1."""
    to_go: Array
    """(N, 12, 12) weight of the state at the end of each stage in the optimal cost from there on."""
    kernel: Array
    """(13 N, 13 N) signal kernel; signals chain by chain, stages of one signal in a row."""
    begin: Index
    """(13 N,) first signal of each signal's chain; the kernel is zero outside the chain."""
    end: Index
    """(13 N,) one past the last."""
    place: Index
    """(13,) each signal's place in the chain order: its stage k stands at ``place * N + k``."""
    target: Index
    """(13 N,) place of each signal in state and input, see :data:`TARGETS`."""
    stage: Index
    """(13 N,) its stage."""


def signal_maps(model: HorizonModel) -> SignalMaps:
    """Riccati recursion and signal kernel of a checked model.

    Raises
    ------
    QpError
        If the cost leaves an input undetermined: the method starts from the unconstrained optimum.
    """
    n = model.stages
    closed, gain = np.empty((n, STATES, STATES)), np.empty((n, INPUTS, STATES))
    inverse, root = np.empty((n, INPUTS, INPUTS)), np.empty((n, INPUTS, INPUTS))
    to_go = np.empty((n, STATES, STATES))
    to_go[-1] = model.q[-1]
    for k in range(n - 1, -1, -1):
        a, b, weight = model.a[k], model.b[k], to_go[k]
        hessian = model.r[k] + b.T @ weight @ b
        hessian = 0.5 * (hessian + hessian.T)
        root[k] = _inverse_root(hessian, k)
        inverse[k] = root[k] @ root[k].T
        gain[k] = inverse[k] @ (b.T @ weight @ a)
        closed[k] = a - b @ gain[k]
        if k:
            # Joseph's form keeps the weight positive however long the horizon.
            before = closed[k].T @ weight @ closed[k] + gain[k].T @ model.r[k] @ gain[k]
            to_go[k - 1] = model.q[k - 1] + 0.5 * (before + before.T)
    moved = _responses(model.b, closed, gain, root)
    flat = moved.reshape(len(TARGETS) * n, INPUTS * n)
    kernel = flat @ flat.T
    order, chain = _chains(kernel, n)
    place = np.empty(len(TARGETS), dtype=np.int64)
    place[order] = np.arange(len(TARGETS))
    at = (order[:, None] * n + np.arange(n)).ravel()
    chain_of = np.repeat(chain[order], n)
    t = (0, 2, 1)
    return SignalMaps(
        *(np.ascontiguousarray(v, dtype=float) for v in (
            model.a, model.a.transpose(t), model.b, model.b.transpose(t), model.q, model.r,
            closed, gain, gain.transpose(t), (inverse @ model.b.transpose(t)).transpose(t), inverse,
            to_go, kernel[np.ix_(at, at)],
        )),
        np.searchsorted(chain_of, chain_of, side="left").astype(np.int64),
        np.searchsorted(chain_of, chain_of, side="right").astype(np.int64),
        place,
        np.repeat(TARGETS[order], n),
        np.tile(np.arange(n), len(TARGETS)),
    )  # fmt: skip


def _inverse_root(hessian: Array, stage: int) -> Array:
    """Return W with ``W W' = H^-1``."""
    scale = np.sqrt(np.maximum(np.diag(hessian), 0.0))
    if not (np.isfinite(hessian).all() and (scale > 0.0).all()):
        raise QpError(_undetermined(stage))
    scaled = hessian / scale[:, None] / scale
    if np.linalg.eigvalsh(scaled).min() < FLAT:
        raise QpError(_undetermined(stage))
    lower = np.linalg.cholesky(scaled) * scale[:, None]
    return np.asarray(solve_triangular(lower, np.eye(len(lower)), lower=True).T)


def _undetermined(stage: int) -> str:
    return (
        f"the cost does not determine the inputs of stage {stage}: give every input a weight, "
        'or choose solver "osqp"'
    )


def _responses(b: Array, closed: Array, gain: Array, root: Array) -> Array:
    """Signals (13, N, N, 4) moved by whitened inputs (stage, input) under the feedback."""
    n = len(b)
    moved = np.zeros((len(TARGETS), n, n, INPUTS))
    for j in range(n):
        state, push = np.zeros((STATES, INPUTS)), root[j]
        for k in range(j, n):
            both = np.vstack([np.zeros_like(state), push])
            both[:STATES] = closed[k] @ state + (b[k] @ push if k == j else 0.0)
            state = both[:STATES]
            moved[:, k, j] = both[TARGETS]
            if k + 1 < n:
                push = -gain[k + 1] @ state
    return moved


def _chains(kernel: Array, stages: int) -> tuple[Index, Index]:
    """Order of the 13 signals chain by chain, and the chain of each signal."""
    size = np.sqrt(np.diag(kernel))
    size = np.where(size > 0.0, size, 1.0)
    near = np.abs(kernel) / size[:, None] / size > LOOSE
    count = len(TARGETS)
    linked = near.reshape(count, stages, count, stages).any(axis=(1, 3))
    _, chain = connected_components(linked, directed=False)
    return np.argsort(chain, kind="stable"), chain.astype(np.int64)


@compiled
def sweep(
    maps: SignalMaps, start: Array, pull: Array, push: Array, pushed: bool,
    feed: Array, cost: Array, states: Array, inputs: Array,
) -> None:  # fmt: skip
    """Optimal states and inputs for a linear cost ``pull . x + push . u`` beside the model's own.

    Parameters
    ----------
    maps : SignalMaps
        Model.
    start : array, shape (12,)
        State now.
    pull, push : array, shapes (N, 12) and (N, 4)
        Linear cost of the state at the end of each stage and of its input.
    pushed : bool
        Whether push is anything but zero.
    feed : array, shape (N, 4)
        Room to work in.
    cost : array, shape (N, 12)
        Where the linear part of the optimal cost from the end of each stage on goes.
    states, inputs : array, shapes (N, 12) and (N, 4)
        Where the answer goes.
    """
    n = len(feed)
    cost[n - 1] = pull[n - 1]
    for k in range(n - 1, -1, -1):
        feed[k] = 0.0
        for j in range(STATES):
            for m in range(INPUTS):
                feed[k, m] -= maps.pull_t[k, j, m] * cost[k, j]
        if pushed:
            for j in range(INPUTS):
                for m in range(INPUTS):
                    feed[k, m] -= maps.inverse[k, j, m] * push[k, j]
        if k == 0:
            break
        cost[k - 1] = pull[k - 1]
        for j in range(STATES):
            for i in range(STATES):
                cost[k - 1, i] += maps.closed[k, j, i] * cost[k, j]
        if pushed:
            for m in range(INPUTS):
                for i in range(STATES):
                    cost[k - 1, i] -= maps.gain[k, m, i] * push[k, m]
    for k in range(n):
        inputs[k], states[k] = feed[k], 0.0
        for j in range(STATES):
            x = start[j] if k == 0 else states[k - 1, j]
            for m in range(INPUTS):
                inputs[k, m] -= maps.gain_t[k, j, m] * x
            for i in range(STATES):
                states[k, i] += maps.a_t[k, j, i] * x
        for m in range(INPUTS):
            for i in range(STATES):
                states[k, i] += maps.b_t[k, m, i] * inputs[k, m]


@compiled
def read_signals(maps: SignalMaps, states: Array, inputs: Array, signals: Array) -> None:
    """Write the signals (13 N,) of states (N, 12) and inputs (N, 4)."""
    for i in range(len(signals)):
        k, target = maps.stage[i], maps.target[i]
        signals[i] = states[k, target] if target < STATES else inputs[k, target - STATES]


@compiled
def stationarity(
    maps: SignalMaps, start: Array, states: Array, inputs: Array, cost: Array, linear: Array, force: Array,
    costates: Array, work: Array, out: Array,
) -> None:  # fmt: skip
    """Multipliers of the dynamics, and how well states and inputs balance model, cost and forces.

    The multipliers are minus the gradient of the optimal cost from each stage on; the balance is taken of the
    model's own matrices.

    Parameters
    ----------
    maps : SignalMaps
        Model.
    start, states, inputs : array, shapes (12,), (N, 12) and (N, 4)
        The plan.
    cost : array, shape (N, 12)
        From the sweep that made the plan.
    linear : array, shape (N, 12)
        -Q ref.
    force : array, shape (13 N,)
        Sum of the rows times their multipliers, by signal.
    costates : array, shape (N, 12)
        Where the multipliers of the dynamics go.
    work : array, shape (3, N, 16)
        Room to work in.
    out : array, shape (6,)
        Largest violation of the dynamics and its largest term, largest entry of the Lagrangian's gradient and
        its largest term, largest multiplier times violation of the dynamics and its largest term.
    """
    n = len(states)
    loads, weighed, carried = work[0], work[1], work[2]
    loads[:] = 0.0
    for i in range(len(force)):
        loads[maps.stage[i], maps.target[i]] += force[i]
    for e in range(6):
        out[e] = 0.0
    for k in range(n - 1, -1, -1):
        weighed[k], carried[k] = 0.0, 0.0
        for i in range(STATES):
            costates[k, i] = -cost[k, i]
        for j in range(STATES):
            x = states[k, j]
            for i in range(STATES):
                costates[k, i] -= maps.to_go[k, j, i] * x
                weighed[k, i] += maps.q[k, j, i] * x
        if k + 1 < n:
            for j in range(STATES):
                for i in range(STATES):
                    carried[k, i] += maps.a[k + 1, j, i] * costates[k + 1, j]
        for i in range(STATES):
            left = weighed[k, i] + linear[k, i] + costates[k, i] - carried[k, i] - loads[k, i]
            out[2] = max(out[2], abs(left))
            out[3] = max(
                out[3], abs(weighed[k, i]), abs(linear[k, i]), abs(costates[k, i]), abs(carried[k, i])
            )
        for j in range(INPUTS):
            for m in range(INPUTS):
                weighed[k, STATES + m] += maps.r[k, j, m] * inputs[k, j]
        for j in range(STATES):
            for m in range(INPUTS):
                carried[k, STATES + m] += maps.b[k, j, m] * costates[k, j]
        for m in range(STATES, STATES + INPUTS):
            out[2] = max(out[2], abs(weighed[k, m] - carried[k, m] - loads[k, m]))
            out[3] = max(out[3], abs(weighed[k, m]), abs(carried[k, m]), abs(loads[k, m]))
    for k in range(n):
        # The other way round than in the sweep, and in place of what is no longer needed.
        loads[k] = 0.0
        for m in range(INPUTS):
            for i in range(STATES):
                loads[k, i] += maps.b_t[k, m, i] * inputs[k, m]
        for j in range(STATES):
            x = start[j] if k == 0 else states[k - 1, j]
            for i in range(STATES):
                loads[k, i] += maps.a_t[k, j, i] * x
        for i in range(STATES):
            gap = abs(states[k, i] - loads[k, i])
            out[0] = max(out[0], gap)
            out[1] = max(out[1], abs(states[k, i]))
            out[4] = max(out[4], gap * abs(costates[k, i]))
            out[5] = max(out[5], abs(costates[k, i] * states[k, i]))
