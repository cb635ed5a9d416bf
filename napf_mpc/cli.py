"""The command line: thin, every heavy import waits until its command runs."""

from __future__ import annotations

import errno
import io
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from napf_mpc import __version__, interrupts
from napf_mpc.errors import NapfError, ProblemError
from napf_mpc.words import shown_value

if TYPE_CHECKING:
    from napf_mpc.problem import Problem
    from napf_mpc.report import Rows
    from napf_mpc.stopping import StoppingRule

T = TypeVar("T")

app = typer.Typer(
    name="napf-mpc",
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
With = Annotated[
    list[str] | None,
    typer.Option(
        "--with",
        metavar="MODULE",
        help="Python file or module that registers planners or solvers of your own. Repeatable.",
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print errors only.")]
Json = Annotated[bool, typer.Option("--json", help="Print the summary as JSON on standard output.")]
Runs = Annotated[int, typer.Option(help="Number of runs.")]
Workers = Annotated[int | None, typer.Option(help="Processes (default: one a core). Changes no result.")]
Cluster = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Fly on the workers of this dask scheduler (tcp://host:8786), whatever --workers is. "
        "Changes no result.",
    ),
]
BlockLimit = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="When a worker counts as hung with its block (default: after 20 times the slowest block, "
        "at least half an hour).",
    ),
]
Planner = Annotated[
    str | None, typer.Option(help="apf, napf, napf_guided, qp or qp_unguided (default: the problem's own).")
]
Animation = Annotated[bool, typer.Option("--animation", help="Draw an animation too: some ten seconds.")]


_UsageError: Any = typer.BadParameter.__base__  # click's, wherever this version of typer keeps it


_OUTPUT_ERRORS = (errno.ENOSPC, errno.EIO, errno.EPIPE, errno.EBADF)
"""What writing to a stream ends with: full, broken, nobody reads it, closed."""


def run_command(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; errors are one clear line, never a traceback.

    Parameters
    ----------
    arguments : sequence of str, optional
        Instead of those that the process was started with; none at all asks for help.
    """
    given = sys.argv[1:] if arguments is None else list(arguments)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a sign that a terminal does not have is no reason to fail
    try:
        code = int(app(given or ["--help"], prog_name="napf-mpc", standalone_mode=False) or 0)
        if sys.stdout is not None:  # it may have been closed by whoever started this
            sys.stdout.flush()
        return code
    except _UsageError as error:
        _complain(_usage(error))
    except NapfError as error:
        _complain(str(error))
    except MemoryError:
        _complain("out of memory; finished blocks are kept: take a smaller problem, or fewer --workers")
    except OSError as error:
        if error.filename is not None:
            _complain(f"{error.filename}: {error.strerror}; finished blocks are kept")
        elif error.errno in _OUTPUT_ERRORS:
            _complain(f"standard output: {error.strerror}; what was written under --out is kept")
            _drop_output()
        else:
            raise
    return 2


_WANTED = {
    "int": "must be a whole number in digits, such as 1000",
    "float": "must be a number",
    "greater_than_equal": "must be a number of at least {ge:.10g}",
    "less_than_equal": "must be a number of at most {le:.10g}",
}
"""What is allowed, by the beginning of pydantic's name of a fault."""


def _usage(error: Any) -> str:
    """What the parser complains of, with the value and what is allowed instead in plain words."""
    text: str = error.format_message()
    cause = error.__cause__
    if not hasattr(cause, "errors"):  # a version of typer that does without pydantic names the value
        return text
    (fault, *_) = cause.errors()
    wanted = next((words for kind, words in _WANTED.items() if fault["type"].startswith(kind)), None)
    allowed = fault["msg"] if wanted is None else wanted.format(**fault.get("ctx", {}))
    return f"{text.removesuffix(error.message)}{shown_value(fault['input'])}: {allowed}"


def _drop_output() -> None:
    """Let what is still to be printed go nowhere: the interpreter would try again when it ends."""
    if sys.__stdout__ is not None and sys.stdout is sys.__stdout__:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.__stdout__.fileno())


def _complain(text: str) -> None:
    for line in text.splitlines():
        print(f"error: {line}", file=sys.stderr)


def _problem(file: str, settings: list[str] | None, own: list[str] | None = None) -> Problem:
    from napf_mpc.problem_file import load_problem

    _load(own)
    return load_problem(file, settings or ())


def _load(own: list[str] | None) -> None:
    if own:
        from napf_mpc.extensions import load_extension

        for where in own:
            load_extension(where)


def _name(file: str) -> str:
    return Path(file).stem


def _names(planners: str) -> list[str]:
    return [name.strip() for name in planners.split(",") if name.strip()]


def _json_list(values: Any) -> list[Any]:
    """Values of a column; JSON has no NaN."""
    return [None if value != value else value for value in values.tolist()]


def _say(text: str, quiet: bool) -> None:
    if not quiet:
        print(text)


def _show(table: Rows, quiet: bool) -> None:
    if quiet:
        return
    from rich.console import Console

    console = Console()
    if not console.is_terminal:
        console = Console(width=120)  # a file has no width, and 80 columns would cut labels in two
    table.print(console)


def _print_json(value: Any) -> None:
    print(json.dumps(value, indent=2, allow_nan=False))


def _tell_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"napf-mpc {__version__}")
        raise typer.Exit


@app.callback()
def of_all(
    version: Annotated[
        bool,
        typer.Option("--version", is_eager=True, callback=_tell_version, help="Print the version and end."),
    ] = False,
) -> None:
    """What holds for every command."""


@app.command()
def problems(
    schema: Annotated[bool, typer.Option("--schema", help="Print the JSON Schema of problem files.")] = False,
    as_json: Json = False,
) -> None:
    """List the shipped problems, one line each."""
    from napf_mpc.problem_file import load_problem, problem_schema
    from napf_mpc.shipped import shipped_problems

    if schema:
        _print_json(problem_schema())
        return
    listed = [(name, load_problem(path).title) for name, path in shipped_problems().items()]
    if as_json:
        _print_json([{"name": name, "title": title} for name, title in listed])
        return
    width = max((len(name) for name, _ in listed), default=0)
    for name, title in listed:
        print(f"{name:<{width}}  {title}")


@app.command()
def validate(
    file: File,
    settings: Settings = None,
    own: With = None,
    data: Data = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Check a problem file: every error with key, value and what is allowed."""
    problem = _problem(file, settings, own)
    from napf_mpc.mission import check_mission

    missing = check_mission(problem, data)
    note = f"its data are not here, so it was checked without them: {missing}" if missing else ""
    if as_json:
        _print_json({"file": file, "valid": True, "problem_hash": problem.digest(), "note": note})
        return
    _say(f"{file}: valid", quiet)
    if note:
        _say(note, quiet)


@app.command()
def run(
    file: File,
    planner: Planner = None,
    seed: Seed = 0,
    run_index: Annotated[int, typer.Option(help="Which run of the seed's campaign.")] = 0,
    out: Out = None,
    animation: Animation = False,
    settings: Settings = None,
    own: With = None,
    data: Data = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fly one mission: metrics, and with --out trajectories and figures. Exit code 1 if it is not reached."""
    problem, name = _problem(file, settings, own), _name(file)
    kind = problem.planner.kind if planner is None else planner
    from napf_mpc.mission import fly_mission

    flown = fly_mission(problem, name, kind, seed=seed, run=run_index, out=out, data_folder=data)
    if not as_json:
        from napf_mpc.report import mission_table

        _show(mission_table(flown.row, name), quiet)
    if out is not None:
        from napf_mpc.figures import draw_mission

        draw_mission(problem, name, flown.trajectories, flown.obstacles, [kind], out, animation, flown.moving)
    _end(flown.summary, out, quiet, as_json)
    raise typer.Exit(0 if flown.reached else 1)


@app.command()
def compare(
    file: File,
    planners: Annotated[str, typer.Option(help="Planners, with commas.")] = "apf,napf",
    runs: Runs = 30,
    seed: Seed = 0,
    workers: Workers = None,
    cluster: Cluster = None,
    block_limit: BlockLimit = None,
    out: Out = None,
    settings: Settings = None,
    own: With = None,
    data: Data = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fly planners on the same seeds and compare them: the paper's Table 1 for any problem."""
    names = _names(planners)
    engine = _engine(workers, cluster, block_limit)
    _campaign(_problem(file, settings, own), file, names, runs, seed, engine, out, data, quiet, as_json)


@app.command()
def montecarlo(
    file: File,
    out: OutNeeded,
    planner: Planner = None,
    runs: Runs = 1000,
    seed: Seed = 0,
    workers: Workers = None,
    cluster: Cluster = None,
    block_limit: BlockLimit = None,
    until_width: Annotated[
        float | None,
        typer.Option(help="Stop once the interval of the risk is narrower than this; --runs is the most."),
    ] = None,
    until_upper: Annotated[
        float | None,
        typer.Option(help="Stop once the upper end of that interval is below this; --runs is the most."),
    ] = None,
    trajectories: Annotated[
        bool, typer.Option("--trajectories", help="Keep trajectories at the planner's rate.")
    ] = False,
    settings: Settings = None,
    own: With = None,
    data: Data = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fly many missions of one planner; repeat the command to go on where it stopped."""
    problem = _problem(file, settings, own)
    ticks = round(problem.simulation.controller_rate_hz / problem.planner.rate_hz) if trajectories else 0
    names = [problem.planner.kind if planner is None else planner]
    engine = _engine(workers, cluster, block_limit)
    rule = None
    if until_width is not None or until_upper is not None:
        from napf_mpc.stopping import StoppingRule

        rule = StoppingRule(until_width, until_upper)
    _campaign(problem, file, names, runs, seed, engine, out, data, quiet, as_json, ticks, rule)


@app.command()
def sweep(
    file: File,
    out: OutNeeded,
    vary: Annotated[
        list[str],
        typer.Option("--vary", metavar="KEY=V1,V2", help="Values of a problem key. Repeatable: a grid."),
    ],
    planners: Annotated[
        str | None, typer.Option(help="Planners, with commas (default: the problem's own).")
    ] = None,
    runs: Runs = 100,
    seed: Seed = 0,
    workers: Workers = None,
    settings: Settings = None,
    own: With = None,
    data: Data = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fly a grid over problem keys: one table, one figure; repeat the command to go on where it stopped."""
    from napf_mpc.sweep import grid_points, run_sweep

    _load(own)
    points = grid_points(file, vary, settings or ())
    names = _names(points[0].problem.planner.kind if planners is None else planners)
    total = len(points) * runs
    with _progress(total, out, quiet or as_json) as progress:
        columns = run_sweep(
            points, names, runs, seed, out, name=_name(file), workers=_processes(workers),
            data_folder=data, progress=progress,
        )  # fmt: skip
    from napf_mpc import store
    from napf_mpc.plot.style import credit_of
    from napf_mpc.plot.sweep import draw_sweep
    from napf_mpc.report import sweep_table

    keys = list(points[0].settings)
    table = sweep_table(_name(file), keys, columns, seed)
    store.write_bytes(out / "sweep.md", lambda file: file.write(table.markdown().encode()))
    draw_sweep(columns, keys, out, credit_of(points[0].problem))
    if as_json:
        rows = [
            dict(zip(columns, row, strict=True))
            for row in zip(*map(_json_list, columns.values()), strict=True)
        ]
        _print_json({"problem": _name(file), "seed": seed, "points": rows})
        return
    _show(table, quiet)
    _say(f"results and figure: {out}", quiet)


@app.command()
def rare(
    file: File,
    out: OutNeeded,
    planner: Planner = None,
    samples: Annotated[
        int, typer.Option(help="Missions a level; the more, the surer. Compare several seeds.")
    ] = 1000,
    seed: Seed = 0,
    settings: Settings = None,
    own: With = None,
    data: Data = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Estimate a collision risk too small to count, by subset simulation; repeat the command to go on."""
    problem = _problem(file, settings, own)
    from napf_mpc.rare_events.estimate import check_samples, estimate_collision_risk

    check_samples(samples)
    with _progress(None, out, quiet or as_json) as progress:
        summary = estimate_collision_risk(
            problem, problem.planner.kind if planner is None else planner, out, samples=samples, seed=seed,
            name=_name(file), data_folder=data, progress=progress,
        )  # fmt: skip
    from napf_mpc import store
    from napf_mpc.report import rare_table

    table = rare_table(summary)
    store.write_bytes(out / "rare.md", lambda file: file.write(table.markdown().encode()))
    if not as_json:
        _show(table, quiet)
    _end(summary, out, quiet, as_json)


@app.command()
def figures(
    source: Annotated[str, typer.Argument(metavar="FILE_OR_DIR", help="Problem, or folder with results.")],
    out: OutNeeded,
    seed: Seed = 0,
    animation: Animation = False,
    settings: Settings = None,
    own: With = None,
    data: Data = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Draw the paper's figures for a problem, or the figures of stored results."""
    if Path(source).is_dir():
        if settings:
            raise ProblemError(source, ["is drawn as it was flown: --set is for problems"])
        from napf_mpc.figures import draw_stored

        paths = draw_stored(Path(source), out, data, animation)
    else:
        problem = _problem(source, settings, own)
        from napf_mpc.figures import draw_problem

        paths = draw_problem(problem, _name(source), seed, out, data)
    if as_json:
        _print_json([str(path) for path in paths])
        return
    for path in paths:
        _say(str(path), quiet)


benchmark = typer.Typer(
    add_completion=False,
    invoke_without_command=True,
    rich_markup_mode=None,
)
app.add_typer(benchmark, name="benchmark")


@benchmark.callback()
def of_what(context: typer.Context) -> None:
    """Measure solvers, planners and growth on this machine."""
    if context.invoked_subcommand is None:
        raise ProblemError("benchmark", ["of what? choose from solvers, nonlinear, planners, scaling"])


Scenes = Annotated[str | None, typer.Option(help="Scenes, with semicolons (default: all).")]
Every = Annotated[int, typer.Option(min=1, help="Steps of a mission from one timed to the next.")]
Missions = Annotated[int, typer.Option(min=1, max=1000, help="Missions flown in each scene.")]


@benchmark.command("solvers")
def benchmark_solvers(
    out: Out = None,
    scenes: Scenes = None,
    contenders: Annotated[
        str | None, typer.Option("--solvers", help="Solvers, with semicolons (default: all).")
    ] = None,
    missions: Missions = 8,
    every: Every = 20,
    seed: Seed = 0,
    own: With = None,
    quiet: Quiet = False,
) -> None:
    """Time solvers on programs of missions, and check their claims."""
    from napf_mpc.benchmark import contenders as known
    from napf_mpc.benchmark import run

    _load(own)
    chosen_scenes = _chosen("scenes", scenes, known.SCENES)
    chosen = _chosen("solvers", contenders, known.contenders())
    say = partial(_say, quiet=quiet)
    _measured(run.benchmark_solvers(chosen_scenes, chosen, missions, every, seed, out, say), quiet)


@benchmark.command("nonlinear")
def benchmark_nonlinear(
    out: Out = None, scenes: Scenes = None, missions: Missions = 4, every: Every = 40, seed: Seed = 0,
    quiet: Quiet = False,
) -> None:  # fmt: skip
    """Compare the programs with those of the nonlinear quadrotor: times and first inputs."""
    from napf_mpc.benchmark import run
    from napf_mpc.benchmark.contenders import SCENES

    chosen, say = _chosen("scenes", scenes, SCENES), partial(_say, quiet=quiet)
    _measured(run.benchmark_nonlinear(chosen, missions, every, seed, out, say), quiet)


@benchmark.command("planners")
def benchmark_planners(
    out: Out = None,
    scenes: Scenes = None,
    pilots: Annotated[
        str | None, typer.Option("--planners", help="Planners, with semicolons (default: all).")
    ] = None,
    missions: Missions = 16,
    seed: Seed = 0,
    own: With = None,
    quiet: Quiet = False,
) -> None:
    """Time control steps and missions of planners."""
    from napf_mpc.benchmark import run
    from napf_mpc.benchmark.contenders import SCENES
    from napf_mpc.benchmark.planners import pilots as known_pilots

    _load(own)
    chosen_scenes, chosen = _chosen("scenes", scenes, SCENES), _chosen("planners", pilots, known_pilots())
    say = partial(_say, quiet=quiet)
    _measured(run.benchmark_planners(chosen_scenes, chosen, missions, seed, out, say), quiet)


@benchmark.command("scaling")
def benchmark_scaling(
    out: Out = None,
    studies: Annotated[str | None, typer.Option(help="Studies, with semicolons (default: all).")] = None,
    budget: Annotated[
        float,
        typer.Option(min=0.1, max=1e6, help="Seconds for a size; what would take longer is left out."),
    ] = 60.0,
    seed: Seed = 0,
    quiet: Quiet = False,
) -> None:
    """Time how the cost grows with UAVs, obstacles, ..."""
    from napf_mpc.benchmark import run
    from napf_mpc.benchmark.scaling import STUDIES

    chosen, say = _chosen("studies", studies, STUDIES), partial(_say, quiet=quiet)
    _measured(run.benchmark_scaling(chosen, seed, budget, out, say), quiet)


def _measured(found: tuple[list[Rows], list[Path]], quiet: bool) -> None:
    """Show tables and what was written."""
    tables, paths = found
    for table in tables:
        _show(table, quiet)
    for path in paths:
        _say(str(path), quiet)


def _chosen(option: str, given: str | None, known: Mapping[str, T]) -> dict[str, T]:
    """Entries by their labels, which may contain commas."""
    if given is None:
        return dict(known)
    labels = [label.strip() for label in given.split(";") if label.strip()]
    unknown = [label for label in labels if label not in known]
    if unknown or not labels:
        what = f"does not know {unknown[0]!r}" if unknown else "names nothing"
        raise ProblemError(f"--{option}", [f"{what}; choose from {'; '.join(known)}"])
    return {label: known[label] for label in labels}


def _campaign(
    problem: Problem,
    file: str,
    names: list[str],
    runs: int,
    seed: int,
    engine: dict[str, Any],
    out: Path | None,
    data: Path | None,
    quiet: bool,
    as_json: bool,
    record_every: int = 0,
    rule: StoppingRule | None = None,
) -> None:
    from contextlib import ExitStack
    from tempfile import TemporaryDirectory

    from napf_mpc.campaign import run_campaign

    with ExitStack() as stack:
        kept = out or Path(stack.enter_context(TemporaryDirectory(prefix="napf-mpc-")))
        progress = stack.enter_context(_progress(runs, out, quiet or as_json))
        summary = run_campaign(
            problem, names, runs, seed, kept, name=_name(file), data_folder=data,
            record_every=record_every, progress=progress, warn=_warn, enough=rule, **engine,
        )  # fmt: skip
    from napf_mpc.report import comparison

    table = comparison(summary, problem.reference)
    if not as_json:
        _show(table, quiet)
    if out is not None:
        from napf_mpc import store
        from napf_mpc.figures import draw_comparison

        store.write_bytes(out / "comparison.md", lambda file: file.write(table.markdown().encode()))
        draw_comparison(problem, summary, store.read_table(out / "runs.parquet"), out, data)
    _end(summary, out, quiet, as_json)


@contextmanager
def _progress(runs: int | None, out: Path | None, silent: bool) -> Iterator[Callable[[int], None]]:
    """What a campaign tells of the missions it has finished.

    A bar on a terminal, nothing anywhere else; without a number of runs it has no end. It stops where a
    signal asks for it, and settles what a stop says then.
    """
    of_all = "missions" if runs is None else f"of {runs} runs"

    def finished(done: int) -> None:
        interrupts.raise_if_asked()
        show(done)
        kept = f"{done} {of_all} are kept in {out}; repeat the command to go on"
        interrupts.when_stopped(f"stopped: {'nothing is kept without --out' if out is None else kept}")

    def show(done: int) -> None:
        if bar is not None:
            bar.update(task, completed=done)

    if silent or not sys.stderr.isatty():
        bar = None
        yield finished
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("missions", total=runs)
        yield finished


def _warn(line: str) -> None:
    print(f"warning: {line}", file=sys.stderr)


def _engine(workers: int | None, cluster: str | None, block_limit: float | None) -> dict[str, Any]:
    """Where a campaign is flown; changes none of its results."""
    return {"workers": _processes(workers), "cluster": cluster, "block_limit_s": block_limit}


def _processes(workers: int | None) -> int:
    if workers is not None:
        return workers
    from joblib import cpu_count  # knows the limits of containers

    return int(cpu_count())


def _end(summary: dict[str, Any], out: Path | None, quiet: bool, as_json: bool) -> None:
    if as_json:
        _print_json(summary)
    elif out is not None:
        _say(f"results and figures: {out}", quiet)
