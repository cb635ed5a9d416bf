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
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.sparse.csgraph import connected_components

from napf_mpc.constraints.constraint import SIGNALS
from napf_mpc.jit import compiled_bare
from napf_mpc.qp import INPUTS, STATES, Array, HorizonModel, Index, QpError

KINDS = tuple(SIGNALS)
"""Kinds of signals in the order of their numbers."""
TARGETS = np.array(
    [place + (STATES if kind == "input" else 0) for kind in KINDS for place in SIGNALS[kind]], dtype=np.int64
)
"""(13,) place of each signal in the state, or 12 and its place in the input."""
FIRST = np.cumsum([0, *(len(SIGNALS[kind]) for kind in KINDS)])[:-1]
"""(4,) number of the first signal of each kind."""
A, B, Q, R, CLOSED, GAIN, PULL, INVERSE, TO_GO = range(9)
"""Matrices of a stage: the model's; A - B K, K, H^-1 B' and H^-1; the optimal cost from its end on."""
A_TURNED, B_TURNED, CLOSED_TURNED, GAIN_TURNED = range(9, 13)
"""Transposes."""
QUAD = 4
"""Entries of a row come in fours, filled up with zeros: sums of four do not wait for each other."""
NOISE = 1e-14
"""Entries of a weight below this part of what its diagonal allows are rounding."""
LOOSE = 1e-13
"""Signals correlated less than this belong to different chains: it is the rounding of the kernel."""
FLAT = 1e-13
"""Least eigenvalue of a stage's scaled Hessian: below it the cost does not determine the inputs."""


Small = NDArray[np.uint32]
"""Places that are never negative: the compiled loops need not ask."""


class SignalMaps(NamedTuple):
    """A model as the compiled loops need it: matrices as lists of their entries, and the signal kernel."""

    rows: Index
    """(13,) rows of each matrix, see :data:`A` to :data:`GAIN_TURNED`."""
    begins: Index
    """(13, N, 13) where the entries of each matrix, stage and row begin, and where those of the last end."""
    column: Small
    """(entries,)."""
    value: Array
    """(entries,)."""
    kernel: Array
    """(13 N, 13 N) signal kernel; signals chain by chain, stages of one signal in a row."""
    begin: Index
    """(13 N,) first signal of each signal's chain; the kernel is zero outside the chain."""
    end: Index
    """(13 N,) one past the last."""
    place: Index
    """(13,) each signal's place in the chain order: its stage k stands at ``place * N + k``."""
    target: Small
    """(13 N,) place of each signal in state and input, see :data:`TARGETS`."""
    stage: Small
    """(13 N,) its stage."""
    softest: float
    """Largest diagonal entry of the kernel: no unit row is easier to move."""


def signal_maps(model: HorizonModel) -> SignalMaps:
    """Riccati recursion and signal kernel of a checked model.

    Raises
    ------
    QpError
        If the cost leaves an input undetermined: the method starts from the unconstrained optimum.
    """
    n = model.stages
    t = (0, 2, 1)
    closed, gain = np.empty((n, STATES, STATES)), np.empty((n, INPUTS, STATES))
    inverse, root = np.empty((n, INPUTS, INPUTS)), np.empty((n, INPUTS, INPUTS))
    to_go = np.empty((n, STATES, STATES))
    to_go[-1] = _cleaned(model.q[-1])
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
            to_go[k - 1] = _cleaned(model.q[k - 1] + 0.5 * (before + before.T))
    moved = _responses(model.b, closed, gain, root)
    flat = moved.reshape(len(TARGETS) * n, INPUTS * n)
    kernel = flat @ flat.T
    order, chain = _chains(kernel, n)
    place = np.empty(len(TARGETS), dtype=np.int64)
    place[order] = np.arange(len(TARGETS))
    at = (order[:, None] * n + np.arange(n)).ravel()
    chain_of = np.repeat(chain[order], n)
    pull = inverse @ model.b.transpose(t)
    turned = [m.transpose(t) for m in (model.a, model.b, closed, gain)]
    matrices = (model.a, model.b, model.q, model.r, closed, gain, pull, inverse, to_go, *turned)
    return SignalMaps(
        *_entries(matrices),
        np.ascontiguousarray(kernel[np.ix_(at, at)]),
        np.searchsorted(chain_of, chain_of, side="left").astype(np.int64),
        np.searchsorted(chain_of, chain_of, side="right").astype(np.int64),
        place,
        np.repeat(TARGETS[order], n).astype(np.uint32),
        np.tile(np.arange(n), len(TARGETS)).astype(np.uint32),
        float(np.diag(kernel).max()),
    )


def _cleaned(weight: Array) -> Array:
    """Weight without entries that are rounding, such as a Riccati solver leaves between the chains."""
    size = np.sqrt(np.maximum(np.diag(weight), 0.0))
    return np.where(np.abs(weight) <= NOISE * size[:, None] * size, 0.0, weight)


def _entries(matrices: tuple[Array, ...]) -> tuple[Index, Index, Small, Array]:
    """Rows of each matrix; where each matrix, stage and row begins; entries that are not zero, and padding."""
    stages = len(matrices[0])
    begins = np.empty((len(matrices), stages, STATES + 1), dtype=np.int64)
    columns, values, count = [], [], 0
    for which, matrix in enumerate(matrices):
        some = matrix != 0.0
        # A matrix of fewer rows has empty ones behind its own.
        wide = np.zeros((stages, STATES), dtype=np.int64)
        wide[:, : matrix.shape[1]] = -(-some.sum(axis=2) // QUAD) * QUAD
        ends = count + wide.cumsum().reshape(stages, STATES)
        begins[which, :, 1:], begins[which, :, 0] = ends, ends[:, 0] - wide[:, 0]
        size = int(wide.sum())
        column, value = np.zeros(size, dtype=np.uint32), np.zeros(size)
        stage, row, at = np.nonzero(some)
        mine = begins[which, stage, row]
        place = mine - count + np.arange(len(mine)) - np.searchsorted(mine, mine)
        column[place], value[place] = at, matrix[stage, row, at]
        columns.append(column)
        values.append(value)
        count += size
    rows = np.array([matrix.shape[1] for matrix in matrices], dtype=np.int64)
    return rows, begins, np.concatenate(columns), np.concatenate(values)


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
    near = np.asarray(np.abs(kernel) / size[:, None] / size > LOOSE)
    count = len(TARGETS)
    linked = np.asarray(near.reshape(count, stages, count, stages).any(axis=(1, 3)), dtype=float)
    _, chain = connected_components(linked, directed=False)
    return np.argsort(chain, kind="stable"), chain.astype(np.int64)


@compiled_bare
def add(
    maps: SignalMaps, which: int, k: int, sign: float, vector: Array, at: int, out: Array, to: int, first: int
) -> None:
    """Add ``sign matrix vector[at]`` of a matrix of stage k to ``out[to, first:]``.

    Arrays come whole with indices: views of them are counted, which costs more than the sums.
    """
    for r in range(maps.rows[which]):
        total = 0.0
        for e in range(max(maps.begins[which, k, r], 0), maps.begins[which, k, r + 1], QUAD):
            one = maps.value[e] * vector[at, maps.column[e]]
            two = maps.value[e + 1] * vector[at, maps.column[e + 1]]
            three = maps.value[e + 2] * vector[at, maps.column[e + 2]]
            four = maps.value[e + 3] * vector[at, maps.column[e + 3]]
            total += (one + two) + (three + four)
        out[to, first + r] += sign * total


@compiled_bare
def sweep(
    maps: SignalMaps, starts: Array, at: int, pull: Array, push: Array, pushed: bool,
    feed: Array, cost: Array, states: Array, inputs: Array,
) -> None:  # fmt: skip
    """Optimal states and inputs for a linear cost ``pull . x + push . u`` beside the model's own.

    Parameters
    ----------
    maps : SignalMaps
        Model.
    starts : array, shape (batch, 12)
        States now.
    at : int
        Which of them.
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
    for k in range(n):
        for i in range(STATES):
            cost[k, i], states[k, i] = pull[k, i], 0.0
        for m in range(INPUTS):
            feed[k, m], inputs[k, m] = 0.0, 0.0
    for k in range(n - 1, -1, -1):
        add(maps, PULL, k, -1.0, cost, k, feed, k, 0)
        if pushed:
            add(maps, INVERSE, k, -1.0, push, k, feed, k, 0)
        if k == 0:
            break
        add(maps, CLOSED_TURNED, k, 1.0, cost, k, cost, k - 1, 0)
        if pushed:
            add(maps, GAIN_TURNED, k, -1.0, push, k, cost, k - 1, 0)
    for k in range(n):
        for m in range(INPUTS):
            inputs[k, m] = feed[k, m]
        if k == 0:
            add(maps, GAIN, k, -1.0, starts, at, inputs, k, 0)
            add(maps, A, k, 1.0, starts, at, states, k, 0)
        else:
            add(maps, GAIN, k, -1.0, states, k - 1, inputs, k, 0)
            add(maps, A, k, 1.0, states, k - 1, states, k, 0)
        add(maps, B, k, 1.0, inputs, k, states, k, 0)


@compiled_bare
def read_signals(maps: SignalMaps, states: Array, inputs: Array, signals: Array) -> None:
    """Write the signals (13 N,) of states (N, 12) and inputs (N, 4)."""
    for i in range(len(signals)):
        k, target = maps.stage[i], maps.target[i]
        signals[i] = states[k, target] if target < STATES else inputs[k, target - STATES]


@compiled_bare
def stationarity(
    maps: SignalMaps, starts: Array, at: int, states: Array, inputs: Array, cost: Array, linear: Array,
    force: Array, costates: Array, loads: Array, weighed: Array, carried: Array, out: Array,
) -> None:  # fmt: skip
    """Multipliers of the dynamics, and how well states and inputs balance model, cost and forces.

    The multipliers are minus the gradient of the optimal cost from each stage on; the balance is taken of the
    model's own matrices.

    Parameters
    ----------
    maps : SignalMaps
        Model.
    starts : array, shape (batch, 12)
        States now.
    at : int
        Which of them.
    states, inputs : array, shapes (N, 12) and (N, 4)
        The plan.
    cost : array, shape (N, 12)
        From the sweep that made the plan.
    linear : array, shape (N, 12)
        -Q ref.
    force : array, shape (13 N,)
        Sum of the rows times their multipliers, by signal.
    costates : array, shape (N, 12)
        Where the multipliers of the dynamics go.
    loads, weighed, carried : array, shape (N, 16)
        Room to work in.
    out : array, shape (6,)
        Largest violation of the dynamics and its largest term, largest entry of the Lagrangian's gradient and
        its largest term, largest multiplier times violation of the dynamics and its largest term.
    """
    n = len(states)
    for k in range(n):
        for i in range(STATES + INPUTS):
            loads[k, i], weighed[k, i], carried[k, i] = 0.0, 0.0, 0.0
        for i in range(STATES):
            costates[k, i] = -cost[k, i]
    for i in range(len(force)):
        loads[maps.stage[i], maps.target[i]] += force[i]
    gradient, largest = 0.0, 0.0
    for k in range(n - 1, -1, -1):
        add(maps, TO_GO, k, -1.0, states, k, costates, k, 0)
        add(maps, Q, k, 1.0, states, k, weighed, k, 0)
        if k + 1 < n:
            add(maps, A_TURNED, k + 1, 1.0, costates, k + 1, carried, k, 0)
        add(maps, R, k, 1.0, inputs, k, weighed, k, STATES)
        add(maps, B_TURNED, k, 1.0, costates, k, carried, k, STATES)
    for k in range(n):
        for i in range(STATES):
            left = weighed[k, i] + linear[k, i] + costates[k, i] - carried[k, i] - loads[k, i]
            gradient = max(gradient, abs(left))
            largest = max(largest, max(abs(weighed[k, i]), max(abs(linear[k, i]), abs(costates[k, i]))))
        for m in range(STATES, STATES + INPUTS):
            gradient = max(gradient, abs(weighed[k, m] - carried[k, m] - loads[k, m]))
            largest = max(largest, max(abs(weighed[k, m]), abs(loads[k, m])))
    out[2], out[3] = gradient, largest
    off, size, product, most = 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        # The other way round than in the sweep, and in place of what is no longer needed.
        for i in range(STATES):
            loads[k, i] = 0.0
        add(maps, B, k, 1.0, inputs, k, loads, k, 0)
        if k == 0:
            add(maps, A, k, 1.0, starts, at, loads, k, 0)
        else:
            add(maps, A, k, 1.0, states, k - 1, loads, k, 0)
    for k in range(n):
        for i in range(STATES):
            gap = abs(states[k, i] - loads[k, i])
            off, size = max(off, gap), max(size, abs(states[k, i]))
            product = max(product, gap * abs(costates[k, i]))
            most = max(most, abs(costates[k, i] * states[k, i]))
    out[0], out[1], out[4], out[5] = off, size, product, most
