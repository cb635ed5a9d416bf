"""The ladder: new plan, tail, hover, descent; in this order, for each UAV alone, and every use an event."""

import numpy as np

from napf_mpc.planners.fallback import MOST_EVENTS, TAIL_S, Action, Ladder


def decide(
    ladder: Ladder,
    time_s: float,
    accepted: bool,
    age_s: float,
    clear: bool,
    cause: str = "status",
    down: bool = False,
) -> int:
    one = np.array([[True]])
    action = ladder.decide(
        time_s, one & accepted, np.full((1, 1), age_s), one & clear, np.full((1, 1), cause),
        lambda hover: hover & down,
    )  # fmt: skip
    return int(action[0, 0])


def test_an_accepted_plan_flies_whatever_the_old_one_is() -> None:
    assert decide(Ladder(1, 1), 0.0, True, np.inf, False) == Action.PLAN


def test_a_tail_flies_only_while_it_is_young_and_clear() -> None:
    assert decide(Ladder(1, 1), 5.0, False, TAIL_S, True) == Action.TAIL
    assert decide(Ladder(1, 1), 5.0, False, TAIL_S + 0.01, True) == Action.HOVER
    assert decide(Ladder(1, 1), 5.0, False, 0.1, False) == Action.HOVER
    assert decide(Ladder(1, 1), 5.0, False, np.inf, True) == Action.HOVER
    assert decide(Ladder(1, 1), 5.0, False, np.nan, True) == Action.HOVER


def test_a_hover_ends_in_a_descent_and_any_plan_ends_both() -> None:
    ladder = Ladder(1, 1)
    assert decide(ladder, 10.0, False, np.inf, True) == Action.HOVER
    assert decide(ladder, 40.0, False, np.inf, True, down=True) == Action.DESCEND
    assert decide(ladder, 41.0, True, 0.0, True, down=True) == Action.PLAN
    assert decide(ladder, 41.5, False, 0.5, True, down=True) == Action.TAIL
    assert decide(ladder, 43.0, False, np.inf, True) == Action.HOVER
    assert [event.action for event in ladder.events] == ["hover", "descend", "tail", "hover"]
    assert [event.time_s for event in ladder.events] == [10.0, 40.0, 41.5, 43.0]


def test_every_uav_has_a_ladder_of_its_own_and_its_events_name_it() -> None:
    ladder = Ladder(2, 2)
    accepted = np.array([[True, False], [False, True]])
    causes = np.array([["", "dual"], ["navigation", ""]])
    action = ladder.decide(
        3.0, accepted, np.full((2, 2), 0.2), np.array([[True, True], [False, True]]), causes
    )
    np.testing.assert_array_equal(action, [[Action.PLAN, Action.TAIL], [Action.HOVER, Action.PLAN]])
    assert [(e.run, e.uav, e.cause, e.action) for e in ladder.events] == [
        (0, 1, "dual", "tail"),
        (1, 0, "navigation", "hover"),
    ]


def test_a_uav_that_does_not_fly_is_no_event() -> None:
    ladder = Ladder(1, 1)
    assert decide(ladder, 3.0, False, np.inf, False, cause="") == Action.HOVER
    assert ladder.events == []


def test_events_do_not_fill_the_memory() -> None:
    ladder = Ladder(1, 1)
    for tick in range(2 * MOST_EVENTS + 2):
        decide(ladder, tick * 0.1, tick % 2 == 0, 0.0, True)
    assert len(ladder.events) == MOST_EVENTS


def test_a_run_with_many_events_takes_none_from_another() -> None:
    ladder = Ladder(2, 1)
    age, clear, cause = np.zeros((2, 1)), np.ones((2, 1), dtype=bool), np.full((2, 1), "dual", dtype=object)
    for tick in range(2 * MOST_EVENTS + 2):
        late = tick > 2 * MOST_EVENTS and tick % 2 == 1
        ladder.decide(tick * 0.1, np.array([[tick % 2 == 0], [not late]]), age, clear, cause)
    assert [event.run for event in ladder.events].count(1) == 1
