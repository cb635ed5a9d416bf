"""Passes of a control step: each is the array operations that it stands for, to the last bit."""

import numpy as np
import pytest

from napf_mpc.planners import passes
from napf_mpc.planners.fallback import Action
from napf_mpc.planners.planner import Reason

RUNS, UAVS, STAGES = 3, 4, 5


def random() -> np.random.Generator:
    return np.random.default_rng(11)


def masks() -> np.ndarray:
    """(3, 4) a run of which all are, one of which some, and one of which nobody is."""
    return np.array([[True] * 4, [True, False, True, False], [False] * 4])


def test_everybody_and_anybody_are_all_and_any() -> None:
    some = np.empty(RUNS, dtype=bool)
    passes.anybody(masks(), some)
    np.testing.assert_array_equal(some, masks().any(-1))
    assert not passes.everybody(masks())
    for run in range(RUNS):
        assert passes.everybody(masks()[run : run + 1]) == masks()[run].all()
    assert passes.everybody(np.empty((0, UAVS), dtype=bool))


def test_a_place_is_kept_until_there_is_another() -> None:
    anchor, position = random().normal(size=(2, RUNS, UAVS, 3))
    wanted = np.where(masks()[..., None], position, anchor)
    position[~masks()] = np.nan
    passes.keep_place(position, masks(), anchor)
    np.testing.assert_array_equal(anchor, wanted)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_moved_there_and_back(sign: float) -> None:
    states, by = random().normal(size=(RUNS, UAVS, STAGES, 12)), random().normal(size=(RUNS, UAVS, 3))
    out, wanted = np.empty(states.shape), states.copy()
    wanted[..., 0:6:2] += sign * by[:, :, None]
    passes.move(states, by, sign, out)
    np.testing.assert_array_equal(out, wanted)


@pytest.mark.parametrize("rank", [0, 1, 3])
def test_what_is_shared_shrinks_as_far_as_an_axis_ever_does(rank: int) -> None:
    """Variances that grow, shrink and are zero; who is not trusted shares nothing, whatever it reports."""
    factor, root = random().normal(size=(RUNS, UAVS, 3, rank)), random().normal(size=(RUNS, UAVS, 6, 6))
    now = root @ root.swapaxes(-1, -2)
    now[0, 1, 2, 2] = 0.0
    ahead = now[:, :, None, :3, :3] * random().uniform(0.2, 2.0, size=(RUNS, UAVS, STAGES, 1, 1))
    least = np.einsum("...ii->...i", ahead).min(axis=2)
    variance = np.einsum("...ii->...i", now)[..., :3]
    scale = np.sqrt(np.clip(least / np.where(variance > 0.0, variance, np.inf), 0.0, 1.0))
    assert ((scale > 0.0) & (scale < 1.0)).any()
    wanted = np.where(masks()[..., None, None], factor * scale[..., None], 0.0)
    now[~masks()], factor[~masks()] = np.nan, np.nan
    shared = np.empty(factor.shape)
    passes.share(factor, now, ahead, masks(), shared)
    np.testing.assert_array_equal(shared, wanted)


def test_who_holds_is_told_the_larger_of_its_own_reason_and_its_guides() -> None:
    action = np.array([[Action.PLAN, Action.TAIL, Action.HOVER, Action.HOVER]], dtype=np.int8)
    trusted = np.array([[True, True, True, False]])
    initial, anchor = random().normal(size=(1, UAVS, 12)), random().normal(size=(1, UAVS, 3))
    waiting = np.array([[Reason.NONE, Reason.WAITING, Reason.WAITING, Reason.NO_PASSAGE]], dtype=np.int8)
    vectors, (planned, holding) = np.empty((3, 1, UAVS, 3)), np.empty((2, 1, UAVS), dtype=bool)
    reason = np.empty((1, UAVS), dtype=np.int8)
    passes.command(action, trusted, initial, anchor, waiting, vectors, planned, holding, reason)
    np.testing.assert_array_equal(reason, [[Reason.NONE, Reason.WAITING, Reason.SOLVER, Reason.NO_PASSAGE]])
    np.testing.assert_array_equal(holding, [[False, True, True, True]])
    np.testing.assert_array_equal(planned, [[True, True, False, False]])
    np.testing.assert_array_equal(vectors[0, 0, :2], initial[0, :2, 0:6:2])
    np.testing.assert_array_equal(vectors[0, 0, 2:], anchor[0, 2:])
