"""The command line: thin, every heavy import waits until its command runs."""

from __future__ import annotations

import functools
import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TypeVar

import typer

from napf_mpc.errors import NapfError

if TYPE_CHECKING:
    from napf_mpc.problem import Problem
    from napf_mpc.report import Rows

app = typer.Typer(
    name="napf-mpc",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Fly UAV formations among obstacles with uncertain navigation; report an honest collision risk.",
)

File = Annotated[str, typer.Argument(help="Problem file (TOML), or the name of a shipped problem.")]
Seed = Annotated[int, typer.Option(help="Campaign seed, 0 to 2**63 - 1.")]
Out = Annotated[
    Path | None, typer.Option(help="Folder for results; made if missing. Without it nothing is kept.")
]
OutNeeded = Annotated[Path, typer.Option(help="Folder for results; made if missing.")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override a problem key, e.g. planner.k=2. Repeatable."),
]
Data = Annotated[
    Path | None, typer.Option(help="Folder with data files (default: variable NAPF_MPC_DATA, else data/).")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print errors only.")]
Json = Annotated[bool, typer.Option("--json", help="Print the summary as JSON on standard output.")]
Runs = Annotated[int, typer.Option(help="Number of runs.")]
Workers = Annotated[int | None, typer.Option(help="Processes (default: one a core). Changes no result.")]
Planners = Annotated[str, typer.Option(help="Planners, with commas.")]


F = TypeVar("F", bound=Callable[..., None])

_UsageError: Any = typer.BadParameter.__base__  # click's, wherever this version of typer keeps it


def main() -> NoReturn:
    """Run the command line and leave with its exit code: 0, 1 (not reached), 2 (bad input), 130 or 143."""
    interrupts.handle_signals()
    sys.exit(run_command())


def run_command(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; errors are one clear line, never a traceback.

    Parameters
    ----------
    arguments : sequence of str, optional
        Instead of those that the process was started with.
    """
    try:
        return int(app(arguments, prog_name="napf-mpc", standalone_mode=False) or 0)
    except _UsageError as error:
        _complain(error.format_message())
    except NapfError as error:
        _complain(str(error))
    except MemoryError:
        _complain("out of memory; finished blocks are kept: take a smaller problem, or fewer --workers")
    return 2


def _complain(text: str) -> None:
    for line in text.splitlines():
        print(f"error: {line}", file=sys.stderr)


def _command(function: F) -> F:
    """Register a command that ends with the right words and exit code when it is told to stop."""

    @functools.wraps(function)
    def stoppable(*args: Any, **kwargs: Any) -> None:
        try:
            function(*args, **kwargs)
        except KeyboardInterrupt as stop:  # caught before typer, to which every stop is Ctrl-C
            interrupts.say_stopped()
            raise typer.Exit(getattr(stop, "exit_code", 130)) from None

    app.command()(stoppable)
    return function


def _problem(file: str, settings: list[str] | None) -> Problem:
    from napf_mpc.problem_file import load_problem

    return load_problem(file, settings or ())


def _name(file: str) -> str:
    return Path(file).stem


def _show(table: Rows, quiet: bool) -> None:
    if quiet:
        return
    from rich.console import Console

    table.print(Console())


def _say(text: str, quiet: bool) -> None:
    if not quiet:
        print(text)


def _workers(workers: int | None) -> int:
    if workers is not None:
        return workers
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@_command
def problems(
    schema: Annotated[bool, typer.Option("--schema", help="Print the JSON Schema of problem files.")] = False,
    as_json: Json = False,
) -> None:
    """List the shipped problems, one line each."""
    from napf_mpc.problem_file import load_problem, problem_schema
    from napf_mpc.shipped import shipped_problems

    if schema:
        print(json.dumps(problem_schema(), indent=2))
        return
    listed = [(name, load_problem(path).title) for name, path in shipped_problems().items()]
    if as_json:
        print(json.dumps([{"name": name, "title": title} for name, title in listed], indent=2))
        return
    width = max(len(name) for name, _ in listed)
    for name, title in listed:
        print(f"{name:<{width}}  {title}")


@_command
def validate(
    file: File, settings: Settings = None, data: Data = None, quiet: Quiet = False, as_json: Json = False
) -> None:
    """Check a problem file: every error with key, value and what is allowed."""
    problem = _problem(file, settings)
    from napf_mpc.campaign import check_flyable
    from napf_mpc.planners.registry import make_planner
    from napf_mpc.problem import FormationMission

    note = ""
    if isinstance(problem.mission, FormationMission):
        make_planner(problem.planner.kind, problem)
        try:
            check_flyable(problem, [problem.planner.kind], data_folder=data)
        except _missing_data() as error:
            note = f"not flown through: {error}"
    if as_json:
        print(json.dumps({"file": file, "valid": True, "problem_hash": problem.digest(), "note": note}))
        return
    _say(f"{file}: valid", quiet)
    if note:
        _say(note, quiet)


def _missing_data() -> type[NapfError]:
    from napf_mpc.errors import DataError

    return DataError


@_command
def run(
    file: File,
    planner: Annotated[str | None, typer.Option(help="apf or napf (default: the problem's own).")] = None,
    seed: Seed = 0,
    run_index: Annotated[int, typer.Option(help="Which run of the seed's campaign.")] = 0,
    out: Out = None,
    settings: Settings = None,
    data: Data = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fly one mission: metrics, and with --out trajectories and figures. Exit code 1 if it is not reached."""
    problem = _problem(file, settings)
    from napf_mpc import mission

    row = mission.fly_one(
        problem, _name(file), planner or problem.planner.kind, seed, run_index, out, data_folder=data
    )
    if as_json:
        print(json.dumps(row.summary, indent=2))
    elif not quiet:
        _show(row.table, quiet)
        _say_out(out, quiet)
    raise typer.Exit(0 if row.reached else 1)


def _say_out(out: Path | None, quiet: bool) -> None:
    if out is not None:
        _say(f"results and figures: {out}", quiet)


@_command
def compare(
    file: File,
    planners: Planners = "apf,napf",
    runs: Runs = 30,
    seed: Seed = 0,
    workers: Workers = None,
    out: Out = None,
    settings: Settings = None,
    data: Data = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fly planners on the same seeds and compare them: the paper's Table 1 for any problem."""
    problem = _problem(file, settings)
    names = [name.strip() for name in planners.split(",") if name.strip()]
    summary = _campaign(problem, file, names, runs, seed, workers, out, 0, data, quiet or as_json)
    _conclude(problem, summary, out, quiet, as_json)


@_command
def montecarlo(
    file: File,
    out: OutNeeded,
    planner: Annotated[str | None, typer.Option(help="apf or napf (default: the problem's own).")] = None,
    runs: Runs = 1000,
    seed: Seed = 0,
    workers: Workers = None,
    trajectories: Annotated[
        bool, typer.Option("--trajectories", help="Keep trajectories at the planner's rate.")
    ] = False,
    settings: Settings = None,
    data: Data = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fly many missions of one planner; repeat the command to go on where it stopped."""
    problem = _problem(file, settings)
    ratio = round(problem.simulation.controller_rate_hz / problem.planner.rate_hz)
    every = ratio if trajectories else 0
    names = [planner or problem.planner.kind]
    summary = _campaign(problem, file, names, runs, seed, workers, out, every, data, quiet or as_json)
    _conclude(problem, summary, out, quiet, as_json)


@_command
def figures(
    source: Annotated[str, typer.Argument(metavar="FILE_OR_DIR", help="Problem, or folder with results.")],
    out: OutNeeded,
    seed: Seed = 0,
    settings: Settings = None,
    data: Data = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Draw the paper's figures for a problem, or the figures of stored results."""
    from napf_mpc import mission

    if Path(source).is_dir():
        paths = mission.draw_stored(Path(source), out)
    else:
        paths = mission.draw_problem(_problem(source, settings), _name(source), seed, out, data)
    if as_json:
        print(json.dumps([str(path) for path in paths], indent=2))
        return
    for path in paths:
        _say(str(path), quiet)


def _campaign(
    problem: Problem,
    file: str,
    names: list[str],
    runs: int,
    seed: int,
    workers: int | None,
    out: Path | None,
    record_every: int,
    data: Path | None,
    silent: bool,
) -> dict[str, Any]:
    from contextlib import ExitStack
    from tempfile import TemporaryDirectory

    from rich.console import Console
    from rich.progress import Progress

    from napf_mpc.campaign import run_campaign

    console = Console(stderr=True)
    with ExitStack() as stack:
        folder = out if out is not None else Path(stack.enter_context(TemporaryDirectory(prefix="napf-mpc-")))
        bar = stack.enter_context(
            Progress(console=console, transient=True, disable=silent or not console.is_terminal)
        )
        task = bar.add_task("missions", total=runs)
        return run_campaign(
            problem, names, runs, seed, folder, name=_name(file), workers=_workers(workers), data_folder=data,
            record_every=record_every, progress=lambda done: bar.update(task, completed=done),
        )  # fmt: skip


def _conclude(
    problem: Problem, summary: dict[str, Any], out: Path | None, quiet: bool, as_json: bool
) -> None:
    from napf_mpc import report

    table = report.comparison(summary, problem.reference)
    if out is not None:
        from napf_mpc import mission, store

        store.write_bytes(out / "comparison.md", lambda file: file.write(table.markdown().encode()))
        mission.draw_comparison(summary, out, problem)
    if as_json:
        print(json.dumps(summary, indent=2))
        return
    _show(table, quiet)
    _say_out(out, quiet)
