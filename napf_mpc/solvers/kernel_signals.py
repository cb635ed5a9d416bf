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

from napf_mpc.constraints.constraint import SIGNALS
from napf_mpc.qp import INPUTS, STATES, Array, HorizonModel, Index, QpError
from napf_mpc.solvers.kernel_tape import Matrices, Small, Tape, tape_of

KINDS = tuple(SIGNALS)
"""Kinds of signals in the order of their numbers."""
TARGETS = np.array(
    [place + (STATES if kind == "input" else 0) for kind in KINDS for place in SIGNALS[kind]], dtype=np.int64
)
"""(13,) place of each signal in the state, or 12 and its place in the input."""
FIRST = np.cumsum([0, *(len(SIGNALS[kind]) for kind in KINDS)])[:-1]
"""(4,) number of the first signal of each kind."""
NOISE = 1e-14
"""Entries of a weight below this part of what its diagonal allows are rounding."""
LOOSE = 1e-13
"""Signals correlated less than this belong to different chains: it is the rounding of the kernel."""
FLAT = 1e-13
"""Least eigenvalue of a stage's scaled Hessian: below it the cost does not determine the inputs."""


class SignalMaps(NamedTuple):
    """A model as the compiled loops need it: its sweeps, and the signal kernel."""

    tape: Tape
    """See :mod:`~napf_mpc.solvers.kernel_tape`."""
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
    give: Array
    """(13, N) diagonal of the kernel, in its order: how easily each signal is moved."""
    softest: float
    """Its largest entry: no unit row is easier to move."""
    dynamics: Array
    """(N, 12, 16) what a stage makes of states and inputs, for programs that fail."""


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
    pull = inverse @ model.b.transpose(0, 2, 1)
    matrices = Matrices(model.a, model.b, model.q, model.r, closed, gain, pull, inverse, to_go)
    return SignalMaps(
        tape_of(matrices),
        np.ascontiguousarray(kernel[np.ix_(at, at)]),
        np.searchsorted(chain_of, chain_of, side="left").astype(np.int64),
        np.searchsorted(chain_of, chain_of, side="right").astype(np.int64),
        place,
        np.repeat(TARGETS[order], n).astype(np.uint32),
        np.tile(np.arange(n), len(TARGETS)).astype(np.uint32),
        np.ascontiguousarray(np.diag(kernel)[at]).reshape(len(TARGETS), n),
        float(np.diag(kernel).max()),
        np.concatenate([model.a, model.b], axis=2),
    )


def _cleaned(weight: Array) -> Array:
    """Weight without entries that are rounding, such as a Riccati solver leaves between the chains."""
    size = np.sqrt(np.maximum(np.diag(weight), 0.0))
    return np.where(np.abs(weight) <= NOISE * size[:, None] * size, 0.0, weight)


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
