"""Tables of results for the terminal and as Markdown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from napf_mpc.evaluate import Outcome
from napf_mpc.problem import Reference
from napf_mpc.risk import wilson
from napf_mpc.words import shown_text

METRIC_LABELS = {
    "path_rms_m": "path RMS [m]",
    "shape_rms_m": "shape RMS [m]",
    "shape_floor_m": "  from navigation errors alone [m]",
    "path_length_ratio": "path length ratio",
    "control_effort": "control effort [N² s]",
    "reform_time_s": "time to re-form [s]",
    "finish_time_s": "finish time [s]",
    "waited_s": "time waited [s]",
    "min_clearance_m": "least clearance [m]",
    "min_separation_m": "least separation [m]",
    "within_k_sigma_east": "share of errors within k sigma: east",
    "within_k_sigma_north": "  north",
    "within_k_sigma_up": "  up",
    "nees": "filter's NEES (1 is consistent)",
    "nees_position": "  of the position alone",
    "gated_fixes": "fixes refused or outvoted",
    "missed_fixes": "fixes that did not come",
    "monitor_alarms": "alarms of the monitor of innovations",
    "monitor_scale": "  largest factor on a reported sigma",
}
_OF_FILTER = {"nees", "nees_position", "gated_fixes", "missed_fixes", "monitor_alarms", "monitor_scale"}


@dataclass(frozen=True)
class Rows:
    """A table as text: what a terminal and a Markdown file both show."""

    title: str
    """Heading."""
    header: tuple[str, ...]
    """Column names."""
    rows: tuple[tuple[str, ...], ...]
    """Cells."""
    notes: tuple[str, ...]
    """Lines below."""

    def markdown(self) -> str:
        """Return the table as Markdown."""
        rule = "|" + "|".join([" --- ", *[" ---: "] * (len(self.header) - 1)]) + "|"
        lines = [f"## {self.title}", "", _markdown_row(self.header), rule, *map(_markdown_row, self.rows)]
        return "\n".join([*lines, "", *(f"- {note}" for note in self.notes), ""])

    def print(self, console: Console) -> None:
        """Print the table on a terminal."""
        # Text, not str: rich would take the unit in "path RMS [m]" for markup and leave it out.
        table = Table(title=Text(self.title), title_justify="left")
        for i, name in enumerate(self.header):
            table.add_column(Text(name), justify="left" if i == 0 else "right")
        for row in self.rows:
            table.add_row(*(Text(cell) for cell in row))
        console.print(table)
        for note in self.notes:
            console.print(note, markup=False, highlight=False)


def _markdown_row(cells: tuple[str, ...]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def comparison(summary: dict[str, Any], reference: Reference | None = None) -> Rows:
    """Table 1 for any problem: planners side by side, every rate with k, n and interval."""
    planners: dict[str, dict[str, Any]] = summary["planners"]
    runs = next(iter(planners.values()))["runs"]
    each = planners.values()
    stopping = summary.get("stopping")
    rows = [("collision risk, any UAV and obstacle", *[_rate(p, "collision_risk") for p in each])]
    if stopping is not None:
        rows = [
            (rows[0][0] + ", sequential", *[_sequential(p) for p in each]),
            ("  Wilson, not valid here: N was not fixed", *rows[0][1:]),
        ]
    if reference is not None:
        published: dict[str, float] = dict(reference.collision_risk)  # type: ignore[arg-type]
        cells = []
        for name in planners:
            value = published.get(name)
            cells.append("" if value is None else f"{100 * value:.2f} % (n = {reference.runs})")
        rows.append((f"  {shown_text(reference.source, 100)}", *cells))
    rows.append(("  of one UAV", *[_rate(p, "uav_collision_risk", p["uavs"]) for p in each]))
    rows.append(("UAV-UAV contact", *[_rate(p, "uav_contact_risk") for p in each]))
    for outcome in Outcome:
        rows.append((f"{outcome}", *[f"{p[str(outcome)]} of {p['runs']}" for p in each]))
    for key, label in (("finished", "finished, contacts or not"), ("joint_success", "joint success")):
        rows.append((label, *[_fraction(p[key], p["runs"]) for p in each]))
    for key, label in METRIC_LABELS.items():
        # Without a navigation filter there is nothing to say of one.
        if key not in _OF_FILTER or any(p[key]["n"] for p in each):
            rows.append((label, *[_quantiles(p[key], p["runs"]) for p in each]))
    notes = [
        f"N = {runs} runs a planner, seed {summary['seed']}, the same scenes and errors for all.",
        "Rates: count / missions = rate [95 % interval] (Wilson; of one UAV: allowing for shared fates). "
        "Metrics: median [5 %, 95 %] of the missions for which they are defined.",
        "joint success: reached, no contact of either kind, re-formed after the last obstacle.",
    ]
    if stopping is not None:
        notes.insert(1, _stopped(stopping, runs))
    notes += [f"{name}: {note}" for name, p in planners.items() for note in _solver_notes(p)]
    notes += [_pair(pair) for pair in summary["paired"]]
    if reference is not None:
        notes += [_reference_note(reference)]
    return Rows(shown_text(summary["problem"], 200), ("", *planners), tuple(rows), tuple(notes))


def _solver_notes(planner: dict[str, Any]) -> list[str]:
    """What the solver did, and why runs did not finish."""
    notes, solver = [], planner["solver"]
    if solver["status"]:
        solves = sum(solver["status"].values())
        words = ", ".join(f"{count} {status}" for status, count in solver["status"].items())
        steps = ", ".join(f"{count} {name}" for name, count in solver["fall_back_steps"].items())
        notes.append(
            f"{solves} programs: {words}; {solver['refused']} answers refused; steps on a fall-back: {steps}."
        )
        if solver["margin_short"]:
            share = 100.0 * solver["margin_short"] / solves
            notes.append(
                f"in {share:.1f} % of UAV-steps the formation is too small for the margin between UAVs at "
                "this confidence; they are kept apart by what its slots allow."
            )
    notes += [f"{count} runs did not finish: {word}." for word, count in planner["reasons"].items()]
    return notes


def _rate(planner: dict[str, Any], key: str, uavs: int = 1) -> str:
    missions = planner["runs"] * uavs
    return _counted(planner[key], missions, planner[f"{key}_low"], planner[f"{key}_high"])


def _sequential(planner: dict[str, Any]) -> str:
    ends = (planner[f"collision_risk_sequential_{end}"] for end in ("low", "high"))
    return _counted(planner["collision_risk"], planner["runs"], *ends)


def _stopped(stopping: dict[str, Any], runs: int) -> str:
    most = stopping["most_runs"]
    how = f"met after {runs} of at most {most} runs" if stopping["met"] else f"not met in {most} runs"
    return (
        f"Stopping rule {stopping['rule']}: {how}. The sequential interval holds at whatever run a campaign "
        "stops; all other intervals here are of a fixed N and a little too narrow."
    )


def _fraction(value: float, runs: int) -> str:
    rate = wilson(round(value * runs), runs)
    return _counted(value, runs, rate.low, rate.high)


def _counted(value: float, missions: int, low: float, high: float) -> str:
    share = f"{100 * value:.2f} % [{100 * low:.2f}, {100 * high:.2f}]"
    return f"{round(value * missions)} / {missions} = {share}"


def _quantiles(q: dict[str, Any], runs: int) -> str:
    if not q["n"]:
        return "not defined"
    missions = "" if q["n"] == runs else f", n = {q['n']}"
    return f"{q['median']:.2f} [{q['p05']:.2f}, {q['p95']:.2f}]{missions}"


def _pair(pair: dict[str, Any]) -> str:
    a, b = pair["a"], pair["b"]
    return (
        f"{a} against {b}, same runs: both hit in {pair['both']}, only {a} in {pair['only_a']}, only {b} in "
        f"{pair['only_b']}, neither in {pair['neither']}; exact McNemar p {_p(pair['p_value'])}, "
        f"corrected for the number of pairs {_p(pair['p_value_corrected'])}."
    )


def _p(value: float) -> str:
    # Smaller ones are zero in floating point, which no p-value is.
    return f"= {value:.2g}" if value >= 1e-300 else "< 1e-300"


def _reference_note(reference: Reference) -> str:
    intervals = []
    for name, value in reference.collision_risk.items():
        rate = wilson(round(value * reference.runs), reference.runs)
        intervals.append(f"{name} {100 * rate.low:.1f}-{100 * rate.high:.1f} %")
    words = f"{reference.source}: its {reference.runs} runs alone allow {', '.join(intervals)} (95 % Wilson)."
    return shown_text(f"{words} {reference.note}".strip(), 2000)


def sweep_table(name: str, keys: Sequence[str], columns: Mapping[str, Any], seed: int) -> Rows:
    """Points of a sweep one under the other: risk with its interval, what finished, how far from the slots.

    Parameters
    ----------
    name : str
        What was flown.
    keys : sequence of str
        Keys that were varied.
    columns : mapping of str to array
        As :func:`napf_mpc.sweep.run_sweep` returns them.
    seed : int
        Campaign seed.
    """
    rows = []
    for i, planner in enumerate(columns["planner"]):
        value = {key: values[i].item() for key, values in columns.items()}
        rows.append(
            (
                *(shown_text(str(value[key]), 60) for key in keys),
                str(planner),
                _rate(value, "collision_risk"),
                f"{100 * value['finished']:.1f} %",
                f"{value['path_rms_m']:.2f}" if math.isfinite(value["path_rms_m"]) else "not defined",
            )
        )
    header = (*keys, "planner", "collision risk", "finished", "path RMS [m]")
    notes = (
        f"N = {columns['runs'][0]} runs a planner and point, all of seed {seed}: count / missions = rate "
        "[95 % Wilson interval]; path RMS: median of the runs for which it is defined.",
    )
    return Rows(f"{shown_text(name, 200)}, by {', '.join(keys)}", header, tuple(rows), notes)


def rare_table(summary: dict[str, Any]) -> Rows:
    """Estimate of a small collision risk, and the levels it is made of."""
    levels = summary["levels"]
    if summary["reached"]:
        ends = f"[{summary['collision_risk_low']:.2g}, {summary['collision_risk_high']:.2g}]"
        cells = [("collision risk, any UAV and obstacle", f"{summary['collision_risk']:.2e} {ends}")]
        cells.append(("  coefficient of variation, levels independent", f"{summary['cov']:.2f}"))
        cells.append(("  the same, all levels erring together", f"{summary['cov_bound']:.2f}"))
        risk, cov = summary["collision_risk"], summary["cov"]
        if cov:
            cells.append(("missions that counting would take for it", f"{(1 - risk) / (risk * cov**2):,.0f}"))
    else:
        cells = [("collision risk, any UAV and obstacle", f"not reached; below about {summary['below']:.0e}")]
    cells.append(("missions flown", f"{summary['calls']:,}"))
    cells.append(("  of them failed, counted as contacts", f"{summary['failed']:,}"))
    for number, level in enumerate(levels, 1):
        taken = "" if level["accepted"] is None else f", {100 * level['accepted']:.0f} % of steps taken"
        cells.append(
            (
                f"level {number}: clearance <= {level['threshold']:.3f} m",
                f"{100 * level['probability']:.1f} %{taken}",
            )
        )
    notes = (
        f"Subset simulation, {summary['samples']} missions a level, {summary['dimension']} random numbers a "
        f"mission, seed {summary['seed']}.",
        "Interval: 95 %, log-normal, as if all levels erred together. Missions can spread by more, and it "
        "does not know of a way to collide that no mission came near: compare several seeds.",
    )
    title = f"{shown_text(summary['problem'], 200)}, planner {summary['planner']}"
    return Rows(title, ("", "value"), tuple(cells), notes)


def mission_table(row: dict[str, Any], name: str) -> Rows:
    """Outcome and metrics of one mission."""
    cells = [("outcome", str(row["outcome"]))]
    cells.append(("obstacle contact", f"{int(row['uavs_hit'])} of {int(row['uavs'])} UAVs"))
    cells.append(("UAV-UAV contact", "yes" if row["uav_contact"] else "no"))
    cells.append(("joint success", "yes" if row["joint_success"] else "no"))
    for key, label in METRIC_LABELS.items():
        value = float(row[key])
        defined = math.isfinite(value)
        if defined or key not in _OF_FILTER:
            cells.append((label, f"{value:.2f}" if defined else "not defined"))
    return Rows(
        f"{shown_text(name, 200)}, planner {row['planner']}, run {row['run']} of seed {row['seed']}",
        ("", "value"),
        tuple(cells),
        (),
    )
