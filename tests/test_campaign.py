"""Campaigns: the same bits whatever the order, nothing lost, nothing mixed."""

import hashlib
import json
import shutil
import sys
import threading
import types
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from napf_mpc import campaign, provenance, store
from napf_mpc.block import MAX_RUNS, MAX_SEED, Block, check_campaign, fly_block, simulate
from napf_mpc.campaign import block_size, check_flyable, chunks, compare, run_campaign
from napf_mpc.errors import DataError, NapfError, OutputError, ProblemError, SceneError
from napf_mpc.evaluate import METRICS, Outcome
from napf_mpc.mission import fly_mission
from napf_mpc.own_parts import source_digest
from napf_mpc.planners import registry
from napf_mpc.planners.potential_field import ApfPlanner, NapfPlanner
from napf_mpc.planners.registry import Factory, register_planner
from napf_mpc.prefix import Prefix, looks
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.quadratic_program import Sparsity, Values
from napf_mpc.solvers import batch, solver
from napf_mpc.solvers.batch import (
    BatchSolver,
    OwnSolver,
    make_batch_solver,
    own_solver,
    register_batch_solver,
)
from napf_mpc.solvers.solver import Answer, MakeBackend, SolverError, Warm, backend_maker, register_solver
from napf_mpc.sweep import Point, run_sweep

BRIEF: dict[str, Any] = {
    "mission": {"length_m": 1.0, "initial_velocities_mps": [[2.0, 0.0, 0.0]] * 4},
    "world.count": 4,
    "world.along_range_m": [0.0, 12.0],
    "simulation.time_limit_s": 5.0,
    "simulation.controller_rate_hz": 25.0,
    "planner.rate_hz": 5.0,
    "navigation.rate_hz": 5.0,
}
"""Settings that make table1_8 a flight of five seconds in 125 ticks, still with contacts and arrivals."""


def brief(**settings: Any) -> Problem:
    return load_problem("table1_8", BRIEF | settings)


def fly(out: Path, runs: int, seed: int = 7, problem: Problem | None = None, **options: Any) -> str:
    """Fly a campaign; give the digest of its table of runs."""
    planners = options.pop("planners", ["apf", "napf"])
    run_campaign(problem or brief(), planners, runs, seed, out, **options)
    return digest(out)


def digest(out: Path) -> str:
    return hashlib.sha256((out / "runs.parquet").read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def hundred(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of an undisturbed campaign of 100 runs, in one block; only to be read."""
    out = tmp_path_factory.mktemp("hundred") / "out"
    fly(out, 100, block_runs=100)
    return out


# ------------------------------------------------------------------------------------------ the same bits


@pytest.mark.parametrize(("workers", "block_runs"), [(1, 7), (1, 64), (2, 13), (2, 50)])
def test_neither_blocks_nor_workers_change_a_bit(
    workers: int, block_runs: int, hundred: Path, tmp_path: Path
) -> None:
    assert fly(tmp_path, 100, workers=workers, block_runs=block_runs) == digest(hundred)


def test_blocks_of_one_change_no_bit(tmp_path: Path) -> None:
    assert fly(tmp_path / "a", 9, block_runs=1) == fly(tmp_path / "b", 9, block_runs=9)


def test_events_come_by_run_then_time_whatever_the_blocks(tmp_path: Path) -> None:
    watched = {"filter": "kalman", "monitor": "innovations", "reported_sigma_scale": 0.2}
    problem = brief(**{f"navigation.{key}": value for key, value in watched.items()})
    for block_runs in (1, 4):
        fly(tmp_path / str(block_runs), 4, problem=problem, planners=["napf"], block_runs=block_runs)
    single, together = (store.read_table(tmp_path / name / "events.parquet") for name in ("1", "4"))
    assert len(set(together["run"])) == 4  # all have alarms, so that there is an order to speak of
    for name, values in single.items():
        np.testing.assert_array_equal(values, together[name], err_msg=name)
    assert (np.diff(together["run"] * 1e6 + together["t_s"]) >= 0.0).all()


def test_the_first_runs_are_those_of_a_shorter_campaign(hundred: Path, tmp_path: Path) -> None:
    fly(tmp_path, 50)
    short, long = store.read_table(tmp_path / "runs.parquet"), store.read_table(hundred / "runs.parquet")
    first = long["run"] < 50
    for name, values in short.items():
        np.testing.assert_array_equal(values, long[name][first], err_msg=name)


def test_sixty_of_a_hundred_and_twenty_are_a_campaign_of_sixty(tmp_path: Path) -> None:
    """Also as bytes: what is cut to 60 runs is the file of 60 runs."""
    fly(tmp_path / "a", 120, planners=["apf"], block_runs=64)
    sixty = fly(tmp_path / "b", 60, planners=["apf"], block_runs=7)
    assert digest(tmp_path / "a") != sixty
    assert fly(tmp_path / "a", 60, planners=["apf"]) == sixty


def test_another_seed_shares_no_run(hundred: Path, tmp_path: Path) -> None:
    fly(tmp_path, 100, seed=8)
    ours, theirs = store.read_table(hundred / "runs.parquet"), store.read_table(tmp_path / "runs.parquet")
    for name in ("path_length_ratio", "min_clearance_m", "control_effort"):
        defined = np.isfinite(ours[name])
        assert defined.all()
        assert not set(ours[name][defined]) & set(theirs[name])


def test_the_problem_is_hard_enough_to_tell(hundred: Path) -> None:
    """Some collide and some do not, and planners differ: equal digests above are not those of nothing."""
    rows = store.read_table(hundred / "runs.parquet")
    hits = rows["obstacle_contact"]
    assert 5 < hits[rows["planner"] == "apf"].sum() < 95
    assert (hits[rows["planner"] == "apf"] != hits[rows["planner"] == "napf"]).any()
    assert {"reached", "collided"} <= set(rows["outcome"])


# -------------------------------------------------------------------------------------------------- resume


def flown_by(monkeypatch: pytest.MonkeyPatch) -> list[range]:
    """Note every block that is flown from here on."""
    flown: list[range] = []

    def noted(problem: Problem, planners: Any, seed: int, runs: range, **options: Any) -> Block:
        flown.append(runs)
        return fly_block(problem, planners, seed, runs, **options)

    monkeypatch.setattr(campaign, "fly_block", noted)
    return flown


def test_more_runs_fly_only_the_missing_ones(
    hundred: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fly(tmp_path, 50, block_runs=20)
    flown = flown_by(monkeypatch)
    assert fly(tmp_path, 100, block_runs=20) == digest(hundred)
    assert [run for runs in flown for run in runs] == list(range(50, 100))


def test_fewer_runs_fly_nothing_and_are_those_of_a_shorter_campaign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fly(tmp_path / "a", 20, block_runs=8)
    flown = flown_by(monkeypatch)
    assert fly(tmp_path / "a", 10, block_runs=8) == fly(tmp_path / "b", 10)
    assert flown == [range(10)]  # of the second campaign


def test_a_hole_is_filled(hundred: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fly(tmp_path, 100, block_runs=25)
    (tmp_path / "blocks" / "rows_00000025_00000050.parquet").unlink()
    flown = flown_by(monkeypatch)
    # Other blocks than the first time: what is left of the lost one must not be counted twice.
    assert fly(tmp_path, 100, block_runs=10) == digest(hundred)
    assert flown == [range(25, 35), range(35, 45), range(45, 50)]
    timing = store.read_table(tmp_path / "timing.parquet")
    assert timing["runs"].sum() == 2 * 100


class Cut(BaseException):
    """Stands for whatever ends a process."""


@pytest.mark.parametrize("after", [0, 1, 3])
def test_what_is_finished_is_kept_when_flying_stops(
    after: int, hundred: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown: list[range] = []

    def cut_off(problem: Problem, planners: Any, seed: int, runs: range, **options: Any) -> Block:
        if len(flown) == after:
            raise Cut
        flown.append(runs)
        return fly_block(problem, planners, seed, runs, **options)

    with monkeypatch.context() as patch:
        patch.setattr(campaign, "fly_block", cut_off)
        with pytest.raises(Cut):
            fly(tmp_path, 100, block_runs=20)
    assert len(list((tmp_path / "blocks").glob("rows_*"))) == after
    assert fly(tmp_path, 100, block_runs=20) == digest(hundred)


@pytest.mark.parametrize("full_at", [5, 6, 11])
def test_a_full_disk_keeps_what_is_finished(
    full_at: int, hundred: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever file is the first that does not fit: the third block's two, or the table of all runs."""
    written = 0
    write_table = store.write_table

    def until_full(path: Path, *rest: Any) -> None:
        nonlocal written
        written += 1
        if written == full_at:
            raise OutputError(f"{path}: cannot be written: No space left on device")
        write_table(path, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(store, "write_table", until_full)
        with pytest.raises(OutputError, match="No space left on device"):
            fly(tmp_path, 100, block_runs=20)
    assert fly(tmp_path, 100, block_runs=20) == digest(hundred)


def test_leftovers_of_a_killed_process_do_no_harm(hundred: Path, tmp_path: Path) -> None:
    fly(tmp_path, 50)
    (tmp_path / "blocks" / ".rows_00000050_00000100.parquet.0badcafe.partial").write_bytes(b"half")
    (tmp_path / "blocks" / "timing_00000050_00000060.parquet").write_bytes(b"without its rows")
    (tmp_path / ".summary.json.0badcafe.partial").write_bytes(b"half")
    assert fly(tmp_path, 100) == digest(hundred)
    assert not list(tmp_path.rglob("*.partial"))


def test_progress_starts_with_what_is_there_and_ends_with_all(tmp_path: Path) -> None:
    fly(tmp_path, 8, block_runs=8)
    told: list[int] = []
    fly(tmp_path, 20, block_runs=5, progress=told.append)
    assert told == [8, 13, 18, 20]


# ------------------------------------------------------------------------------------- lost and flown again


def broken_at(monkeypatch: pytest.MonkeyPatch, run: int) -> None:
    """Let the block with a run raise what nobody expects."""

    def flown(problem: Problem, planners: Any, seed: int, runs: range, **options: Any) -> Block:
        if run in runs:
            raise ZeroDivisionError("a slip of ours")
        return fly_block(problem, planners, seed, runs, **options)

    monkeypatch.setattr(campaign, "fly_block", flown)


def test_a_block_that_is_lost_is_filed_with_its_seeds_and_flown_again(
    hundred: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    with monkeypatch.context() as patch:
        broken_at(patch, 47)
        fly(tmp_path, 100, block_runs=20, warn=told.append)
    (line,) = told
    assert line.startswith(
        "runs 40 to 59 were lost twice and are filed as failed: ZeroDivisionError: a slip of"
    )
    assert line.endswith("repeat the command to fly them again")
    rows, whole = (store.read_table(folder / "runs.parquet") for folder in (tmp_path, hundred))
    assert rows["run"].tolist() == whole["run"].tolist()
    lost = (rows["run"] >= 40) & (rows["run"] < 60)
    assert set(rows["outcome"][lost]) == {"failed"}
    assert set(rows["seed"][lost]) == {7}
    assert set(rows["uavs"][lost]) == {4}
    assert all(
        reason.startswith("ZeroDivisionError: a slip of ours (test_campaign")
        for reason in rows["reason"][lost]
    )
    for name, values in rows.items():
        assert values.dtype.kind == whole[name].dtype.kind, name
        np.testing.assert_array_equal(values[~lost], whole[name][~lost], err_msg=name)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["planners"]["apf"]["failed"] == 20
    assert list(summary["planners"]["apf"]["reasons"].values()) == [20]
    again = flown_by(monkeypatch)
    assert fly(tmp_path, 100, block_runs=20) == digest(hundred)
    assert again == [range(40, 60)]
    assert not list((tmp_path / "blocks").glob("lost_*"))


def test_a_campaign_that_is_lost_altogether_says_so_and_can_be_flown_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        broken_at(patch, 1)
        fly(tmp_path / "a", 4, record_every=5)
    rows = store.read_table(tmp_path / "a" / "runs.parquet")
    assert rows["outcome"].tolist() == ["failed"] * 8
    assert set(store.read_table(tmp_path / "a" / "events.parquet")) >= {"planner", "run", "cause"}
    assert fly(tmp_path / "a", 4, record_every=5) == fly(tmp_path / "b", 4, record_every=5)


def test_what_is_made_of_the_blocks_can_be_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = fly(tmp_path, 12, block_runs=5)
    summary = (tmp_path / "summary.json").read_bytes()
    for name in ("runs.parquet", "summary.json", "events.parquet", "timing.parquet", "scenario.json"):
        (tmp_path / name).unlink()
    flown = flown_by(monkeypatch)
    assert fly(tmp_path, 12, block_runs=5) == before
    assert flown == []
    assert (tmp_path / "summary.json").read_bytes() == summary


# --------------------------------------------------------------------------------------------- stopping rules


def test_looks_are_fixed_and_grow() -> None:
    assert looks(120) == [50, 100, 120]
    assert looks(20) == [20]
    far = looks(100_000)
    assert far[:21] == list(range(50, 1051, 50))
    assert far[-1] == 100_000
    assert len(far) < 150


def test_a_stopping_rule_does_not_take_lost_runs_for_safe_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Runs 40 to 59 are lost: nothing from there on is shown to the rule, and all runs are flown."""
    shown: list[int] = []

    def enough(rows: store.Columns) -> bool:
        shown.append(len(set(rows["run"].tolist())))
        return len(shown) == 2

    with monkeypatch.context() as patch:
        broken_at(patch, 57)
        fly(tmp_path, 120, block_runs=20, enough=enough)
    assert shown == []
    assert len(set(store.read_table(tmp_path / "runs.parquet")["run"].tolist())) == 120
    fly(tmp_path, 120, block_runs=20, enough=enough)
    assert shown == [50, 100]
    assert len(set(store.read_table(tmp_path / "runs.parquet")["run"].tolist())) == 100


@pytest.mark.parametrize(("workers", "block_runs"), [(1, 100), (1, 7), (2, 30)])
def test_a_stopping_rule_ends_a_campaign_at_the_same_run_whatever_the_blocks(
    workers: int, block_runs: int, tmp_path: Path
) -> None:
    asked: list[tuple[list[int], list[str]]] = []

    def enough(rows: store.Columns) -> bool:
        runs = rows["run"][rows["planner"] == "napf"]
        asked.append((runs.tolist(), list(dict.fromkeys(rows["planner"]))))
        return len(runs) >= 100

    ended = fly(tmp_path / "a", 300, workers=workers, block_runs=block_runs, enough=enough)
    assert asked == [(list(range(n)), ["apf", "napf"]) for n in (50, 100)]
    assert ended == fly(tmp_path / "b", 100)
    asked.clear()
    assert fly(tmp_path / "a", 300, enough=enough) == ended  # nothing more is flown
    assert len(asked) == 2


def test_a_stopping_rule_waits_for_the_runs_before() -> None:
    told: list[int] = []

    def enough(rows: store.Columns) -> bool:
        told.append(len(rows["run"]))
        return False

    prefix = Prefix(enough, ["apf"], 120)

    def rows(block: range) -> store.Columns:
        return {"planner": np.full(len(block), "apf"), "run": np.array(block)}

    for block in (range(60, 120), range(30, 60)):
        prefix.add(block, rows(block))
        assert told == []
    prefix.add(range(30), rows(range(30)))
    assert told == [50, 100, 120]
    assert prefix.answer is None


# ----------------------------------------------------------------------------------------- nothing is mixed


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"seed": 8}, "seed = 7, not 8"),
        ({"planners": ["apf"]}, "planners = apf,napf, not apf"),
        ({"record_every": 5}, "record_every = 0, not 5"),
        ({"problem": brief(**{"planner.k": 2.0})}, f"problem_hash = {brief().digest()}, not "),
    ],
)
def test_a_folder_with_another_campaign_is_refused_with_both(
    change: dict[str, Any], told: str, tmp_path: Path
) -> None:
    before = fly(tmp_path, 4)
    with pytest.raises(OutputError, match="holds results of another origin") as caught:
        fly(tmp_path, 4, **change)
    assert told in str(caught.value)
    assert "choose another --out" in str(caught.value)
    assert digest(tmp_path) == before


def test_another_version_of_the_code_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fly(tmp_path, 2)
    other = provenance.versions() | {"code": "0123456789abcdef"}
    monkeypatch.setattr(provenance, "versions", lambda: other)
    with pytest.raises(OutputError, match=r"versions\.code = [0-9a-f]{16}, not 0123456789abcdef"):
        fly(tmp_path, 2)


def test_another_name_for_the_same_problem_goes_on(tmp_path: Path) -> None:
    before = fly(tmp_path, 4, name="mine")
    assert fly(tmp_path, 4, name="yours") == before


def test_a_folder_that_is_not_ours_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(OutputError, match="is not empty and holds no results of ours"):
        fly(tmp_path, 2)
    assert [entry.name for entry in tmp_path.iterdir()] == ["thesis.tex"]


def test_two_campaigns_do_not_share_a_folder(tmp_path: Path) -> None:
    fly(tmp_path, 2)
    with (
        store.locked(tmp_path),
        pytest.raises(OutputError, match="is in use by another command"),
    ):
        fly(tmp_path, 4)


DAMAGE: dict[str, Callable[[Path], object]] = {
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:-100]),
    "empty": lambda path: path.write_bytes(b""),
    "garbage": lambda path: path.write_bytes(b"PAR1" + b"\0" * 500 + b"PAR1"),
    "one bit of a value": lambda path: path.write_bytes(one_bit_off(path)),
}


def one_bit_off(path: Path) -> bytes:
    values = store.read_table(path)
    value = values["control_effort" if "control_effort" in values else "wall_s"][0].tobytes()
    content = path.read_bytes()
    assert value in content
    return content.replace(value, bytes([value[0] ^ 1]) + value[1:])


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("kind", ["rows", "timing"])
def test_a_damaged_block_is_named_with_the_way_out(kind: str, damage: str, tmp_path: Path) -> None:
    before = fly(tmp_path, 12, block_runs=4)
    DAMAGE[damage](tmp_path / "blocks" / f"{kind}_00000004_00000008.parquet")
    with pytest.raises(DataError, match=f"{kind}_00000004_00000008.parquet") as caught:
        fly(tmp_path, 12, block_runs=4)
    assert "and repeat the command" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert digest(tmp_path) == before
    (tmp_path / "blocks" / "rows_00000004_00000008.parquet").unlink()
    assert fly(tmp_path, 12, block_runs=4) == before


def test_a_truncated_block_is_found_before_anything_is_flown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fly(tmp_path, 12, block_runs=4)
    DAMAGE["truncated"](tmp_path / "blocks" / "rows_00000004_00000008.parquet")
    flown = flown_by(monkeypatch)
    with pytest.raises(DataError, match="rows_00000004_00000008"):
        fly(tmp_path, 24, block_runs=4)
    assert flown == []


def test_a_block_of_another_campaign_is_noticed(tmp_path: Path) -> None:
    fly(tmp_path / "seven", 8, block_runs=4)
    fly(tmp_path / "eight", 8, block_runs=4, seed=8)
    name = "rows_00000004_00000008.parquet"
    shutil.copy(tmp_path / "eight" / "blocks" / name, tmp_path / "seven" / "blocks" / name)
    with pytest.raises(DataError, match=f"{name}: is not a block of this campaign"):
        fly(tmp_path / "seven", 8)


def test_a_renamed_block_is_noticed(tmp_path: Path) -> None:
    fly(tmp_path, 8, block_runs=4)
    blocks = tmp_path / "blocks"
    (blocks / "rows_00000004_00000008.parquet").rename(blocks / "rows_00000008_00000012.parquet")
    with pytest.raises(DataError, match=r"rows_00000008_00000012.parquet: is not a block of this campaign"):
        fly(tmp_path, 12)


def test_runs_that_are_there_twice_are_noticed(tmp_path: Path) -> None:
    fly(tmp_path / "a", 8, block_runs=4)
    fly(tmp_path / "b", 8, block_runs=8)
    whole = "rows_00000000_00000008.parquet"
    shutil.copy(tmp_path / "b" / "blocks" / whole, tmp_path / "a" / "blocks" / whole)
    with pytest.raises(DataError, match="holds runs that"):
        fly(tmp_path / "a", 8)


# ------------------------------------------------------------------------------------------- what is written


def test_the_summary_keeps_its_contract(hundred: Path) -> None:
    summary = json.loads((hundred / "summary.json").read_text())
    rows = store.read_table(hundred / "runs.parquet")
    assert list(summary) == [
        "problem", "problem_hash", "data", "seed", "versions", "planners", "paired"
    ]  # fmt: skip
    assert (summary["problem_hash"], summary["seed"], summary["data"]) == (brief().digest(), 7, {})
    assert {"python", "napf-mpc", "numpy", "numba", "code"} <= set(summary["versions"])
    assert list(summary["planners"]) == ["apf", "napf"]
    for name, planner in summary["planners"].items():
        mine = {key: values[rows["planner"] == name] for key, values in rows.items()}
        hits = int(mine["obstacle_contact"].sum())
        assert planner["runs"] == 100
        assert sum(planner[str(outcome)] for outcome in Outcome) == 100
        assert planner["collision_risk"] == hits / 100
        assert 0.0 <= planner["collision_risk_low"] < hits / 100 < planner["collision_risk_high"] <= 1.0
        assert planner["collision_risk_sequential_low"] < planner["collision_risk_low"]
        assert planner["collision_risk_high"] < planner["collision_risk_sequential_high"]
        assert planner["uav_collision_risk"] == mine["uavs_hit"].sum() / 400
        assert planner["uav_collision_risk_low"] < planner["uav_collision_risk_high"]
        assert planner["finished"] == mine["finished"].mean()
        assert planner["joint_success"] == mine["joint_success"].mean()
        assert planner["reasons"] == {}
        solver = planner["solver"]
        assert (solver["status"], solver["iterations"], solver["fall_backs"]) == ({}, None, 0)
        assert solver["fall_back_steps"] == {"tail": 0, "hover": 0, "descend": 0}
        assert (solver["refused"], solver["margin_short"], solver["largest_slack_m"]["n"]) == (0, 0, 0)
        for metric in METRICS:
            defined = mine[metric][np.isfinite(mine[metric])]
            assert list(planner[metric]) == ["median", "p05", "p95", "mean", "n"]
            assert planner[metric]["n"] == len(defined)
            if len(defined):
                assert planner[metric]["median"] == pytest.approx(np.median(defined), rel=1e-12)
            else:
                assert planner[metric]["median"] is None
    (pair,) = summary["paired"]
    assert list(pair) == ["a", "b", "both", "only_a", "only_b", "neither", "p_value", "p_value_corrected"]
    assert pair["both"] + pair["only_a"] + pair["only_b"] + pair["neither"] == 100


def test_the_tables_keep_their_contract(hundred: Path) -> None:
    rows = store.read_table(hundred / "runs.parquet")
    assert rows["planner"].tolist() == ["apf"] * 100 + ["napf"] * 100
    assert rows["run"].tolist() == [*range(100), *range(100)]
    assert set(rows["seed"]) == {7}
    assert {"outcome", "finished", "obstacle_contact", "uav_contact", "joint_success", *METRICS} <= set(rows)
    timing = store.read_table(hundred / "timing.parquet")
    assert timing["planner"].tolist() == ["apf", "napf"]
    assert timing["runs"].tolist() == [100, 100]
    assert (timing["wall_s"] > 0.0).all()
    assert not (hundred / "trajectories.parquet").exists()


def test_trajectories_come_by_planner_run_time_and_uav_whatever_the_blocks(tmp_path: Path) -> None:
    for name, block_runs in (("a", 2), ("b", 5)):
        fly(tmp_path / name, 5, record_every=5, block_runs=block_runs)
    a, b = (store.read_table(tmp_path / name / "trajectories.parquet") for name in "ab")
    for key in a:
        np.testing.assert_array_equal(a[key], b[key], err_msg=key)
    order = np.lexsort((a["uav"], a["t_s"], a["run"], a["planner"]))
    np.testing.assert_array_equal(order, np.arange(len(order)))
    assert set(a["planner"]) == {"apf", "napf"}
    assert set(a["run"]) == set(range(5))
    assert np.unique(a["t_s"])[1] == pytest.approx(0.2)


def test_compare_gives_the_summary_of_a_campaign(hundred: Path) -> None:
    stored = json.loads((hundred / "summary.json").read_text())
    summary = compare(brief(), runs=100, seed=7)
    assert summary["planners"] == stored["planners"]
    assert summary["paired"] == stored["paired"]


# --------------------------------------------------------------------------------------------- bad settings


@pytest.mark.parametrize(
    ("planners", "runs", "seed", "workers", "told"),
    [
        (["apf"], 0, 0, 1, "runs = 0: must be a whole number from 1 to"),
        (["apf"], -1, 0, 1, "runs = -1"),
        (["apf"], MAX_RUNS + 1, 0, 1, f"runs = {MAX_RUNS + 1}"),
        (["apf"], 2.5, 0, 1, "runs = 2.5"),
        (["apf"], True, 0, 1, "runs = true"),
        (["apf"], 1, -1, 1, "seed = -1: must be a whole number from 0 to 2**63 - 1"),
        (["apf"], 1, MAX_SEED + 1, 1, "seed = "),
        (["apf"], 1, 2**200, 1, "seed = "),
        (["apf"], 1, 0, 0, "workers = 0"),
        ([], 1, 0, 1, "planners: give a list of at least one name"),
        ("apf", 1, 0, 1, "planners: give a list of at least one name"),
        (["apf", "apf"], 1, 0, 1, "planners = apf,apf: each may be named once"),
    ],
)
def test_settings_that_cannot_be_meant_are_refused(
    planners: Any, runs: Any, seed: int, workers: int, told: str
) -> None:
    with pytest.raises(ProblemError) as caught:
        check_campaign(planners, runs, seed, workers)
    assert told in str(caught.value)


@pytest.mark.parametrize("every", [-1, 1.5, True, "1", None])
def test_ticks_that_are_none_are_refused_wherever_they_are_given(every: Any, tmp_path: Path) -> None:
    with pytest.raises(ProblemError, match=r"record_every = .*: must be a whole number from 0 to"):
        run_campaign(brief(), ["apf"], 1, 0, tmp_path / "out", record_every=every)
    assert not (tmp_path / "out").exists()
    with pytest.raises(ProblemError, match=r"record_every = .*: must be a whole number from 0 to"):
        simulate(brief(), "apf", record_every=every)


def test_folders_may_be_texts_and_numbers_those_of_numpy(tmp_path: Path) -> None:
    whole: Any = np.int64(2)
    run_campaign(
        brief(), ["apf"], whole, np.int64(7), str(tmp_path / "a"), record_every=whole, enough=lambda _: False
    )
    run_campaign(brief(), ["apf"], 2, 7, tmp_path / "b", record_every=2)
    assert digest(tmp_path / "a") == digest(tmp_path / "b")
    fly_mission(brief(), "brief", "apf", seed=np.int64(7), run=np.int64(1), out=str(tmp_path / "c"))
    points = [Point({"planner.k": "1"}, brief())]
    assert len(run_sweep(points, ["apf"], 1, 7, str(tmp_path / "d"))["runs"]) == 1


@pytest.mark.parametrize("out", [None, 5])
def test_what_is_no_folder_is_refused(out: Any) -> None:
    with pytest.raises(OutputError, match=f"out = {out}: is not the path of a folder"):
        run_campaign(brief(), ["apf"], 1, 0, out)


# ------------------------------------------------------------------------------------- planners of one's own


class Mine(ApfPlanner):
    """APF that a module defines: other processes import it by name."""


@pytest.fixture
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    class Inside(ApfPlanner):
        """APF that no other process can import: it travels whole."""

    monkeypatch.setattr(registry, "_OWN", {})
    register_planner("mine", Mine)
    register_planner("inside", Inside)


@pytest.mark.parametrize("planners", [["apf", Mine(brief())], [Mine], Mine(brief()), [["apf"]], [None]])
def test_a_planner_in_place_of_its_name_is_refused_with_the_way_out(planners: Any, tmp_path: Path) -> None:
    told = r"not a (list of )?name.*: register_planner\(name, factory\).*simulate"
    with pytest.raises(ProblemError, match=told):
        compare(brief(), planners, runs=2)
    with pytest.raises(ProblemError, match=told):
        run_campaign(brief(), planners, 2, 0, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("_registered")
@pytest.mark.parametrize(("workers", "block_runs"), [(1, None), (2, 3)])
def test_planners_of_ones_own_fly_by_their_names_in_any_process(
    workers: int, block_runs: int | None, tmp_path: Path
) -> None:
    names = ["apf", "mine", "inside"]
    fly(tmp_path, 6, planners=names, workers=workers, block_runs=block_runs, record_every=25)
    rows = store.read_table(tmp_path / "runs.parquet")
    tracks = store.read_table(tmp_path / "trajectories.parquet")
    for name in names:
        for table, column in ((rows, "control_effort"), (tracks, "x_m")):
            theirs = table[column][table["planner"] == "apf"]
            np.testing.assert_array_equal(table[column][table["planner"] == name], theirs)
            assert len(theirs) >= 6
    assert compare(brief(), names, runs=6, seed=7)["planners"]["mine"]["runs"] == 6


@pytest.mark.usefixtures("_registered")
def test_the_source_of_ones_own_planner_belongs_to_the_origin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fly(tmp_path, 1, planners=["mine"])
    held = store.read_json(tmp_path / "campaign.json")["own_planners"]
    assert held == {"mine": hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:16]}
    fly(tmp_path, 2, planners=["mine"])
    monkeypatch.setattr(registry, "_OWN", {"mine": ApfPlanner})
    with pytest.raises(OutputError, match=r"own_planners\.mine = "):
        fly(tmp_path, 2, planners=["mine"])
    typed = eval("lambda problem: None", {"__name__": "__main__"})
    assert source_digest(typed) == "unknown"
    fly(tmp_path / "shipped", 1, planners=["apf"])
    assert "own_planners" not in store.read_json(tmp_path / "shipped" / "campaign.json")


class Backwards:
    """OSQP, for whoever imports this module."""

    def __init__(self, sparsity: Sparsity) -> None:
        self._osqp = backend_maker("osqp")(sparsity)

    def solve(self, values: Values, warm: Warm | None) -> Answer:
        return self._osqp.solve(values, warm)


def of_horizons(**settings: Any) -> BatchSolver:
    return make_batch_solver("osqp", **settings)


def plain(**settings: Any) -> MakeBackend:
    return Backwards


@pytest.fixture
def _own_solvers(monkeypatch: pytest.MonkeyPatch) -> None:
    for module, name in ((solver, "_FACTORIES"), (batch, "_BATCH_FACTORIES")):
        monkeypatch.setattr(module, name, dict(getattr(module, name)))
    monkeypatch.setattr(solver, "_NAMES", set(solver._NAMES))
    register_solver("plain", plain)
    register_solver("inside", lambda **settings: lambda sparsity: Backwards(sparsity))
    register_batch_solver("of_horizons", of_horizons)


@pytest.mark.usefixtures("_own_solvers")
@pytest.mark.parametrize("name", ["plain", "inside", "of_horizons"])
def test_a_solver_of_ones_own_flies_in_any_process_and_belongs_to_the_origin(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def problem(name: str) -> Problem:
        return brief(**{"planner.solver": name, "planner.horizon": 4})

    here = fly(tmp_path / "here", 4, problem=problem("osqp"), planners=["qp"])
    out = tmp_path / "there"
    assert fly(out, 4, problem=problem(name), planners=["qp"], workers=2, block_runs=2) == here
    held = store.read_json(out / "campaign.json")
    own = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:16]
    assert held["own_solver"] == {name: own}
    assert "own_solver" not in store.read_json(tmp_path / "here" / "campaign.json")
    # The same name, another source: these results are not mixed with those.
    if name != "of_horizons":
        monkeypatch.setitem(solver._FACTORIES, name, partial(backend_maker, "osqp"))
        with pytest.raises(OutputError, match=rf"own_solver\.{name} = "):
            fly(out, 6, problem=problem(name), planners=["qp"])


@pytest.mark.usefixtures("_own_solvers")
def test_a_lent_solver_takes_the_place_of_one_of_its_name() -> None:
    """A worker of a cluster lives longer than a campaign: the next one may bring another kind."""
    OwnSolver("plain", of_horizons, of_horizons=True).lend()
    assert own_solver("plain") == OwnSolver("plain", of_horizons, of_horizons=True)
    OwnSolver("plain", plain, of_horizons=False).lend()
    assert own_solver("plain") == OwnSolver("plain", plain, of_horizons=False)
    with pytest.raises(SolverError, match="exists already"):
        register_solver("plain", plain)


def locked() -> Factory:
    lock = threading.Lock()
    return lambda problem: ApfPlanner(problem) if lock else NapfPlanner(problem)


def homeless(monkeypatch: pytest.MonkeyPatch) -> Factory:
    module: Any = types.ModuleType("nowhere_to_be_found")
    module.Mine = type("Mine", (ApfPlanner,), {"__module__": module.__name__})
    monkeypatch.setitem(sys.modules, module.__name__, module)
    made: Factory = module.Mine
    return made


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("locked", "cannot pickle '_thread.lock' object"),
        ("homeless", "No module named 'nowhere_to_be_found'"),
    ],
)
def test_a_planner_that_workers_cannot_have_is_an_error_and_no_lost_block(
    how: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(registry, "_OWN", {})
    register_planner("own", locked() if how == "locked" else homeless(monkeypatch))
    with pytest.raises(
        NapfError, match=f"a worker cannot be given its task: .*{reason}; define .*--workers 1"
    ):
        fly(tmp_path, 4, planners=["own"], workers=2, block_runs=2)
    assert not list((tmp_path / "blocks").glob("*"))
    fly(tmp_path, 4, planners=["own"], block_runs=2)


def test_a_seed_of_thousands_of_digits_is_refused_in_few_words() -> None:
    with pytest.raises(ProblemError, match="seed = an integer of more than 60 digits"):
        check_campaign(["apf"], 1, 10**5000)


def test_all_bad_settings_are_told_at_once() -> None:
    with pytest.raises(ProblemError) as caught:
        check_campaign([], 0, -1, 0)
    assert len(caught.value.problems) == 4


@pytest.mark.parametrize("runs", [range(0), range(0, 10, 2), range(-3, 2), 0, 1.5])
def test_simulate_refuses_runs_that_are_no_runs(runs: Any) -> None:
    with pytest.raises(ProblemError, match="runs = "):
        simulate(brief(), "apf", runs=runs)


def test_simulate_takes_the_runs_of_the_campaign(hundred: Path) -> None:
    rows = store.read_table(hundred / "runs.parquet")
    flown = simulate(brief(), "napf", seed=7, runs=range(40, 43))
    stored = (rows["planner"] == "napf") & (rows["run"] >= 40) & (rows["run"] < 43)
    np.testing.assert_array_equal(flown.score.metrics["min_clearance_m"], rows["min_clearance_m"][stored])
    assert flown.trajectories == {}


@pytest.mark.parametrize("planner", ["pq", "nonsense", ""])
def test_a_planner_that_is_not_there_is_refused_before_anything_is_written(
    planner: str, tmp_path: Path
) -> None:
    with pytest.raises(ProblemError, match="choose from apf, napf"):
        run_campaign(brief(), [planner], 1, 0, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_problem_that_cannot_be_flown_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    crowded = load_problem("table1_40", ["world.radius_m=[20, 20]"])
    with pytest.raises(SceneError):
        run_campaign(crowded, ["apf"], 1, 0, tmp_path / "out")
    walk = load_problem("single_uav")
    with pytest.raises(ProblemError, match="mission"):
        run_campaign(walk, ["apf"], 1, 0, tmp_path / "out")
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------------------------------------------- blocks


def test_chunks_have_no_gaps_and_no_more_than_their_size() -> None:
    assert chunks([0, 1, 2, 5, 6, 7, 8], 3) == [range(0, 3), range(5, 8), range(8, 9)]
    assert chunks([], 3) == []
    assert chunks(range(4), 10) == [range(4)]


@pytest.mark.parametrize(
    ("settings", "runs", "workers", "every", "size"),
    [
        ([], 10_000, 1, 0, 256),  # 1024 UAVs
        ([], 300, 2, 0, 150),  # each worker its share
        ([], 20, 2, 0, 32),  # not worth a second process
        (["simulation.time_limit_s=3600", "navigation.rate_hz=50"], 10_000, 1, 0, 5),  # memory for errors
        (["world.count=100000"], 10_000, 1, 0, 10),  # memory for obstacles
        ([], 10_000, 1, 5, 45),  # memory for trajectories
    ],
)
def test_blocks_pay_and_fit_into_memory(
    settings: list[str], runs: int, workers: int, every: int, size: int
) -> None:
    problem = load_problem("table1_8", settings)
    scenario = check_flyable(problem, ["apf"])
    assert block_size(problem, scenario, runs, workers, every) == size


def test_a_run_larger_than_a_block_is_still_flown() -> None:
    crowd = {"formation": {"shape": "line", "count": 2000}, "mission": {"length_m": 5.0}}
    problem = load_problem("table1_8", crowd)
    assert block_size(problem, check_flyable(problem, ["apf"]), 100) == 1


def test_errors_of_a_worker_come_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run 0 fits, but not every run does: the scene's own error, from another process."""
    problem = load_problem(
        "table1_40", ["world.count=26", "world.radius_m=[0.5, 9]", "world.along_range_m=[20, 60]"]
    )
    with pytest.raises(NapfError, match="found a place"):
        run_campaign(problem, ["apf"], 400, 3, tmp_path, workers=2, block_runs=40)
