"""Tables: every rate with its count and interval, nothing lost between numbers and text."""

import io
import re
from typing import Any

import pytest
from rich.console import Console

from napf_mpc.block import score_rows
from napf_mpc.campaign import compare, simulate
from napf_mpc.evaluate import METRICS, Outcome
from napf_mpc.problem import Reference
from napf_mpc.problem_file import load_problem
from napf_mpc.report import METRIC_LABELS, Rows, comparison, mission_table
from napf_mpc.risk import wilson

BRIEF: dict[str, Any] = {
    "mission": {"length_m": 1.0, "initial_velocities_mps": [[2.0, 0.0, 0.0]] * 4},
    "world.count": 4,
    "world.along_range_m": [0.0, 12.0],
    "simulation.time_limit_s": 5.0,
}
PAPER = Reference(source="Table 1", runs=30, collision_risk={"apf": 22 / 30, "napf": 5 / 30}, note="A note.")


@pytest.fixture(scope="module")
def summary() -> dict[str, Any]:
    return compare(load_problem("table1_8", BRIEF), runs=30, seed=2)


def printed(rows: Rows, width: int = 140) -> str:
    console = Console(file=io.StringIO(), width=width, color_system=None)
    rows.print(console)
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    return text


def cells(rows: Rows) -> dict[str, tuple[str, ...]]:
    return {row[0].strip(): row[1:] for row in rows.rows}


def test_every_rate_has_its_count_its_total_and_its_interval(summary: dict[str, Any]) -> None:
    table = cells(comparison(summary))
    for column, planner in enumerate(summary["planners"].values()):
        rate = wilson(round(planner["collision_risk"] * 30), 30)
        assert table["collision risk, any UAV and obstacle"][column] == (
            f"{rate.count} / 30 = {100 * rate.value:.2f} % [{100 * rate.low:.2f}, {100 * rate.high:.2f}]"
        )
        hit = round(planner["uav_collision_risk"] * 120)
        assert table["of one UAV"][column].startswith(f"{hit} / 120 = ")
        for label in ("UAV-UAV contact", "finished, contacts or not", "joint success"):
            assert re.fullmatch(r"\d+ / 30 = \d+\.\d\d % \[\d+\.\d\d, \d+\.\d\d\]", table[label][column]), (
                label
            )
        counts = [int(table[str(outcome)][column].split(" of ")[0]) for outcome in Outcome]
        assert sum(counts) == 30


def test_metrics_that_are_not_defined_for_all_say_for_how_many(summary: dict[str, Any]) -> None:
    table = cells(comparison(summary))
    apf = summary["planners"]["apf"]["finish_time_s"]
    assert 0 < apf["n"] < 30
    assert table["finish time [s]"][0] == (
        f"{apf['median']:.2f} [{apf['p05']:.2f}, {apf['p95']:.2f}], n = {apf['n']}"
    )
    assert table["path RMS [m]"] == ("not defined", "not defined")  # counted from 12 s on


def test_published_figures_stand_beside_ours_with_their_own_interval(summary: dict[str, Any]) -> None:
    rows = comparison(summary, PAPER)
    assert cells(rows)["Table 1"] == ("73.33 % (n = 30)", "16.67 % (n = 30)")
    assert rows.notes[-1] == (
        "Table 1: its 30 runs alone allow apf 55.6-85.8 %, napf 7.3-33.6 % (95 % Wilson). A note."
    )


def test_a_planner_without_a_published_figure_has_an_empty_cell(summary: dict[str, Any]) -> None:
    paper = Reference(source="Table 1", runs=30, collision_risk={"apf": 0.5})
    assert cells(comparison(summary, paper))["Table 1"] == ("50.00 % (n = 30)", "")


def test_the_paired_test_is_told_in_words(summary: dict[str, Any]) -> None:
    pair = summary["paired"][0]
    note = next(note for note in comparison(summary).notes if "McNemar" in note)
    assert f"both hit in {pair['both']}, only apf in {pair['only_a']}" in note
    assert f"p = {pair['p_value']:.2g}" in note


def test_a_p_value_too_small_for_floating_point_is_not_said_to_be_zero(summary: dict[str, Any]) -> None:
    pair = {**summary["paired"][0], "p_value": 0.0, "p_value_corrected": 2e-250}
    note = next(note for note in comparison({**summary, "paired": [pair]}).notes if "McNemar" in note)
    assert "p < 1e-300, corrected for the number of pairs = 2e-250." in note


@pytest.mark.parametrize("width", [60, 80, 140])
def test_nothing_is_cut_off_in_a_narrow_terminal(width: int, summary: dict[str, Any]) -> None:
    text = printed(comparison(summary, PAPER), width)
    assert "…" not in text
    assert "[m]" in text  # not taken for markup
    assert all(len(line) <= width for line in text.splitlines())


def test_markdown_has_as_many_cells_in_every_row(summary: dict[str, Any]) -> None:
    lines = comparison(summary, PAPER).markdown().splitlines()
    table = [line for line in lines if line.startswith("|")]
    assert len(table) > 20
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in table} == {4}
    assert all(line.startswith("- ") for line in lines[lines.index("", 3) + 1 :] if line)


def test_text_of_a_problem_file_cannot_break_a_table(summary: dict[str, Any]) -> None:
    nasty = Reference(source="a|b\x1b[2J\nc[red]", runs=3, collision_risk={}, note="\x07")
    rows = comparison(summary | {"problem": "x\n## y[bold]"}, nasty)
    assert r"a\|b\x1b[2J\nc[red]" in rows.markdown()
    text = printed(rows)
    assert "\x1b" not in text
    assert "[red]" in text
    assert "\x07" not in text


def test_a_mission_is_told_with_every_metric() -> None:
    score = simulate(load_problem("table1_8", BRIEF), "apf", seed=2, runs=1).score
    row = {name: values[0] for name, values in score_rows("apf", 2, score).items()}
    rows = mission_table(row, "brief")
    table = cells(rows)
    assert rows.title == "brief, planner apf, run 0 of seed 2"
    assert table["outcome"] == (str(score.outcome[0]),)
    assert table["obstacle contact"] == (f"{int(score.obstacle_contact.sum())} of 4 UAVs",)
    assert table["least clearance [m]"] == (f"{score.metrics['min_clearance_m'][0]:.2f}",)
    assert table["path RMS [m]"] == ("not defined",)
    assert METRIC_LABELS["nees"] not in table  # there was no filter


def test_every_metric_has_a_label() -> None:
    assert set(METRIC_LABELS) == set(METRICS)
