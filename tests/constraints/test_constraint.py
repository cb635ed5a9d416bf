"""Rows and horizons refuse what does not fit, and say what it is."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from napf_mpc.constraints.constraint import ConstraintError, Horizon, LinearRows
from napf_mpc.constraints.contract import sample_horizon
from napf_mpc.world.obstacles import ObstacleSet

SHAPE = (2, 3, 4)


def rows(**changes: Any) -> LinearRows:
    """Two soft rows on the velocity: |v_x| and v_y + v_z."""
    jac = np.broadcast_to(np.array([(1.0, 0.0, 0.0), (0.0, 1.0, 1.0)]), (*SHAPE, 2, 3)).copy()
    lower, upper = np.full((*SHAPE, 2), -1.0), np.full((*SHAPE, 2), 2.0)
    price = np.ones((*SHAPE, 2))
    return replace(LinearRows("velocity", jac, lower, upper, price, price), **changes)


def spoilt(values: np.ndarray, number: float) -> np.ndarray:
    values = values.copy()
    values.flat[1] = number
    return values


def test_good_rows_pass_soft_hard_shared_and_one_sided() -> None:
    one = np.ones((*SHAPE, 1))
    for good in (
        rows(),
        rows(w1=None, w2=None),
        rows(w1=one, w2=one, shared_slack=True),
        rows(lower=None),
        rows(upper=None),
        rows(lower=np.full((*SHAPE, 2), -np.inf), upper=np.full((*SHAPE, 2), np.inf)),
    ):
        good.check(SHAPE)
    assert rows().slack_count == 2
    assert rows(w1=one, w2=one, shared_slack=True).slack_count == 1
    assert rows(w1=None, w2=None).slack_count == 0


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"signal": "speed"}, "'speed' is not known; choose from position"),
        ({"signal": "input"}, "jac has shape"),
        ({"jac": np.zeros((2, 3, 4, 3))}, "jac has shape"),
        ({"lower": np.zeros(SHAPE)}, "lower has shape"),
        ({"w1": np.ones((*SHAPE, 1))}, "w1 has shape"),
        ({"w1": None}, "both of w1 and w2"),
        ({"w1": None, "w2": None, "shared_slack": True}, "share no slack"),
        ({"lower": None, "upper": None}, "lower, upper or both"),
        ({"jac": spoilt(rows().jac, np.inf)}, "jac has an entry"),
        ({"lower": spoilt(np.zeros((*SHAPE, 2)), np.nan)}, "lower has a NaN"),
        ({"lower": np.full((*SHAPE, 2), np.inf), "upper": None}, r"lower has \+inf"),
        ({"upper": np.full((*SHAPE, 2), -np.inf), "lower": None}, "upper has -inf"),
        ({"upper": np.full((*SHAPE, 2), -3.0)}, "lower > upper"),
        ({"w1": np.full((*SHAPE, 2), -1.0)}, "w1 has an entry"),
        ({"w2": np.full((*SHAPE, 2), np.inf)}, "w2 has an entry"),
        ({"w1": np.zeros((*SHAPE, 2)), "w2": np.zeros((*SHAPE, 2))}, "free of charge"),
        ({"signal": ["velocity"]}, "signal .'velocity'. is not known"),
        ({"jac": rows().jac.tolist()}, r"jac is a list, must be an array \(run, uav, N, m, dim\)"),
        ({"lower": -7.0}, r"lower is a float, must be an array \(run, uav, N, m\) = \(2, 3, 4, 2\)"),
        ({"upper": np.float64(7.0)}, "upper is a float64, must be an array"),
        ({"w1": 300.0, "w2": 300.0}, "w1 is a float, must be an array.*w2 is a float"),
        ({"jac": rows().jac.astype(object)}, "jac holds entries of type object, must hold real numbers"),
        ({"lower": 1j * np.ones((*SHAPE, 2))}, "lower holds entries of type complex128"),
    ],
)
def test_bad_rows_are_refused_by_name(changes: dict[str, Any], fault: str) -> None:
    with pytest.raises(ConstraintError, match=fault):
        rows(**changes).check(SHAPE)


def test_values_and_violation_are_in_the_unit_of_the_row() -> None:
    signal = np.broadcast_to([3.0, -4.0, 1.5], (*SHAPE, 3))
    assert rows().values(signal) == pytest.approx(np.broadcast_to([3.0, -2.5], (*SHAPE, 2)))
    assert rows().violation(signal) == pytest.approx(np.broadcast_to([1.0, 1.5], (*SHAPE, 2)))
    assert rows(lower=None, upper=np.full((*SHAPE, 2), np.inf)).violation(signal).max() == 0.0


def test_shifted_rows_say_the_same_of_a_signal_from_another_origin() -> None:
    rng = np.random.default_rng(0)
    signal, origin = rng.normal(size=(*SHAPE, 3)), rng.normal(size=(*SHAPE[:2], 3))
    moved = rows().shifted(origin)
    moved.check(SHAPE)
    assert moved.violation(signal - origin[:, :, None]) == pytest.approx(rows().violation(signal))


def horizon() -> Horizon:
    return sample_horizon(np.random.default_rng(0), ObstacleSet.empty(), runs=2, stages=4)


@pytest.mark.parametrize(
    ("name", "values", "fault"),
    [
        ("velocity", np.zeros((2, 4, 3, 3)), "velocity has shape"),
        ("covariance", np.zeros((2, 4, 4, 3)), "covariance has shape"),
        ("common_factor", np.zeros((2, 1, 3, 2)), "common_factor has shape"),
        ("position", np.full((2, 4, 4, 3), np.nan), "position has an entry"),
        ("step_s", np.zeros(4), "step_s must be > 0"),
        ("obstacles", ObstacleSet.empty(3), "2 runs do not fit 3 scenes"),
    ],
)
def test_a_horizon_that_does_not_fit_is_refused_by_name(name: str, values: Any, fault: str) -> None:
    horizon().check()
    with pytest.raises(ConstraintError, match=fault):
        replace(horizon(), **{name: values}).check()
