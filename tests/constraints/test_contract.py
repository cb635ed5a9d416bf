"""The contract finds what is wrong with a constraint, and a user's own one passes it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from napf_mpc.constraints.constraint import ConstraintError, Horizon, LinearRows
from napf_mpc.constraints.contract import check_constraint, part_of, sample_horizon, sample_horizons
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Sphere


def ceiling(horizon: Horizon) -> LinearRows:
    """Stay under 50 m: what a user's constraint looks like."""
    shape = (*horizon.shape, 1)
    up = np.broadcast_to([0.0, 0.0, 1.0], (*shape, 3))
    return LinearRows("position", up, None, np.full(shape, 50.0), np.full(shape, 1e3), np.full(shape, 1e2))


@dataclass
class Own:
    """A constraint made of a function."""

    make: Callable[[Horizon], LinearRows]
    name: str = "own"

    def rows(self, horizon: Horizon) -> LinearRows:
        return self.make(horizon)


def test_a_users_constraint_in_four_lines_passes() -> None:
    check_constraint(Own(ceiling))


def not_finite(horizon: Horizon) -> LinearRows:
    rows = ceiling(horizon)
    return replace(rows, jac=np.full(rows.jac.shape, np.nan))


def big_number(horizon: Horizon) -> LinearRows:
    return replace(ceiling(horizon), upper=np.full((*horizon.shape, 1), 1e20))


def changing_count(horizon: Horizon) -> LinearRows:
    rows = ceiling(horizon)
    if len(horizon.obstacles) == 0:
        return rows
    two = {name: np.repeat(getattr(rows, name), 2, axis=3) for name in ("jac", "upper", "w1", "w2")}
    return replace(rows, **two)


def sometimes_hard(horizon: Horizon) -> LinearRows:
    return replace(ceiling(horizon), w1=None, w2=None) if len(horizon.obstacles) else ceiling(horizon)


def sees_the_other_runs(horizon: Horizon) -> LinearRows:
    rows = ceiling(horizon)
    assert rows.upper is not None
    return replace(rows, upper=rows.upper + horizon.position.mean())


def sees_the_other_uavs(horizon: Horizon) -> LinearRows:
    rows = ceiling(horizon)
    assert rows.upper is not None
    return replace(rows, upper=rows.upper + horizon.position[..., 2].mean(1)[:, None, :, None])


def meddles(horizon: Horizon) -> LinearRows:
    horizon.position[...] += 1.0
    return ceiling(horizon)


def remembers() -> Callable[[Horizon], LinearRows]:
    calls = [0.0]

    def rows(horizon: Horizon) -> LinearRows:
        calls[0] += 1.0
        return replace(ceiling(horizon), upper=np.full((*horizon.shape, 1), calls[0]))

    return rows


def steady_for_one(horizon: Horizon) -> LinearRows:
    rows = ceiling(horizon)
    assert rows.upper is not None
    rows.upper[:, -1] += 1.0
    return replace(rows, steady=True)


def steady_and_written() -> Callable[[Horizon], LinearRows]:
    kept = np.full((3, 4, 6, 1), 50.0)

    def rows(horizon: Horizon) -> LinearRows:
        run, uav, _ = horizon.shape
        kept[...] = 50.0 + horizon.time_s
        return replace(ceiling(horizon), upper=kept[:run, :uav], steady=True)

    return rows


@pytest.mark.parametrize(
    ("make", "fault"),
    [
        (not_finite, "jac has an entry"),
        (big_number, "infinite bound"),
        (changing_count, "must never change"),
        (sometimes_hard, "must never change"),
        (sees_the_other_runs, "run 0 alone"),
        (sees_the_other_uavs, "UAV 0 alone"),
        (meddles, "changed the horizon"),
        (remembers(), "must not remember"),
        (steady_for_one, "steady rows differ between runs or UAVs"),
        (steady_and_written(), "steady rows were written into"),
    ],
    ids=lambda part: getattr(part, "__name__", None),
)
def test_each_breach_is_found_and_named(make: Callable[[Horizon], LinearRows], fault: str) -> None:
    with pytest.raises(ConstraintError, match=fault):
        check_constraint(Own(make))


def test_rows_that_couple_uavs_pass_when_they_say_so() -> None:
    check_constraint(Own(sees_the_other_uavs), couples_uavs=True)


def test_a_constraint_has_a_name() -> None:
    with pytest.raises(ConstraintError, match="name"):
        check_constraint(Own(ceiling, name=""))


def scalar_bounds(horizon: Horizon) -> LinearRows:
    scalars: Any = -7.0, 7.0, 300.0, 300.0
    return LinearRows("position", ceiling(horizon).jac, *scalars)


def sometimes_nothing(horizon: Horizon) -> Any:
    return ceiling(horizon) if horizon.shape[0] > 1 else None


class Nameless:
    def rows(self, horizon: Horizon) -> LinearRows:
        return ceiling(horizon)


class Rowless:
    name = "rowless"


@pytest.mark.parametrize(
    ("constraint", "fault"),
    [
        (Own(scalar_bounds), r"own: horizon 0: lower is a float, must be an array \(run, uav, N, m\)"),
        (Own(lambda horizon: None), "own: horizon 0: rows.. returned a NoneType, must return LinearRows"),
        (Own(lambda horizon: [ceiling(horizon)]), "own: horizon 0: rows.. returned a list, must return"),
        (Own(sometimes_nothing), "own: horizon 0: run 0 alone gives other rows"),
        (Nameless(), "Nameless: name must be a text that is not empty"),
        (Own(ceiling, name=3), "Own: name must be a text"),
        (Rowless(), "Rowless: rows must be a method that takes a horizon"),
        (Own, r"Own: is a class, give an instance of it: Own\(...\)"),
        (ceiling, "function: name must be a text.*\n.*rows must be a method"),
    ],
)
def test_what_is_no_constraint_is_refused_in_words(constraint: Any, fault: str) -> None:
    with pytest.raises(ConstraintError, match=fault):
        check_constraint(constraint)


def test_samples_are_valid_repeatable_and_varied() -> None:
    first, again, other = sample_horizons(0), sample_horizons(0), sample_horizons(1)
    for a, b, c in zip(first, again, other, strict=True):
        a.check()
        assert np.array_equal(a.position, b.position)
        assert not np.array_equal(a.step_s, c.step_s)
    assert any(not horizon.covariance.any() for horizon in first)
    inside = [(h.obstacles.signed_distance(h.position.reshape(h.shape[0], -1, 3)) < 0.0).any() for h in first]
    assert any(inside)


def test_a_part_of_a_horizon_has_its_own_scene() -> None:
    worlds = ObstacleSet.stack([ObstacleSet.empty(), ObstacleSet.from_shapes([Sphere((0.0, 0.0, 0.0), 1.0)])])
    horizon = sample_horizon(np.random.default_rng(0), worlds, runs=2)
    part = part_of(horizon, 1, slice(2, 3))
    part.check()
    assert part.shape == (1, 1, 6)
    assert len(part.obstacles) == 1
    assert np.array_equal(part.position[0, 0], horizon.position[1, 2])
