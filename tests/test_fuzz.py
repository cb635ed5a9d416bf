"""Whatever a problem file holds: a clear refusal, or a flight. Never a traceback, a hang or all the memory.

What `validate` lets through also flies, at every limit of every number.
"""

import copy
import itertools
import json
import math
import random
import resource
import subprocess
import sys
import time
import tomllib
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import annotated_types
import pytest
from pydantic import BaseModel

from napf_mpc.block import simulate
from napf_mpc.cli import run_command
from napf_mpc.errors import NapfError, ProblemError
from napf_mpc.goal_walk import walk_to_goal
from napf_mpc.mission import check_mission
from napf_mpc.problem import FormationMission, Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.scenario_file import scenes_of
from napf_mpc.shipped import shipped_problems

Tables = dict[str, Any]
Path_ = tuple[str | int, ...]

MUTANTS = 500
THROUGH_THE_COMMAND = 30
FLOWN_S = 2.0
MOST_S = 30.0
"""Time that one case may take (a street of 2000 km takes a third of it)."""
MOST_GB = 2.0
"""Memory that one case may add."""


# ------------------------------------------------------------------------------------------------- TOML


def toml(tables: Tables) -> str:
    """Write tables as TOML; every section is an inline table, so that anything can be in any place."""
    return "".join(f"{_key(key)} = {_value(value)}\n" for key, value in tables.items())


def _key(key: str) -> str:
    return json.dumps(key)


def _value(value: Any) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case float() if not math.isfinite(value):
            return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"
        case int() | float():
            return repr(value)
        case str():
            return json.dumps(value)
        case dict():
            return "{" + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + "}"
        case list():
            return "[" + ", ".join(map(_value, value)) + "]"
    raise TypeError(type(value))


def shipped() -> dict[str, Tables]:
    return {name: tomllib.loads(path.read_text("utf-8")) for name, path in shipped_problems().items()}


# ---------------------------------------------------------------------------------------------- mutations


def leaves(value: Any, path: Path_ = ()) -> Iterator[Path_]:
    """Paths of everything that is no table; of a list the whole and its first two entries."""
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from leaves(entry, (*path, key))
        return
    yield path
    if isinstance(value, list):
        for i, entry in enumerate(value[:2]):
            yield from leaves(entry, (*path, i))


def at(tables: Tables, path: Path_) -> Any:
    here: Any = tables
    for step in path:
        here = here[step]
    return here


def mutants() -> Iterator[tuple[str, Tables]]:
    """Every leaf of every shipped problem, broken in every way: name of the case and its tables."""
    values: list[Any] = [
        math.nan,
        math.inf,
        -1,
        -1.5,
        0,
        1e308,
        10**400,
        "x",
        "",
        True,
        {},
        [],
        [[]],
        {"x": 1},
    ]
    for name, tables in shipped().items():
        for path in leaves(tables):
            for value in values:
                broken = copy.deepcopy(tables)
                at(broken, path[:-1])[path[-1]] = value
                yield f"{name}:{'.'.join(map(str, path))}={str(value)[:20]}", broken
            broken = copy.deepcopy(tables)
            lost = at(broken, path[:-1]).pop(path[-1])
            yield f"{name}:{'.'.join(map(str, path))} missing", broken
            if isinstance(path[-1], str):
                misspelt = copy.deepcopy(broken)
                at(misspelt, path[:-1])[path[-1][:-1]] = lost
                yield f"{name}:{'.'.join(map(str, path))} misspelt", misspelt


def sample() -> list[tuple[str, Tables]]:
    return random.Random(1).sample(list(mutants()), MUTANTS)


# ------------------------------------------------------------------------------------------------- flying


def flies(problem: Problem, seconds: float = FLOWN_S) -> None:
    """Fly as `run` does, but for a short time only; a point walks all its way."""
    if not isinstance(problem.mission, FormationMission):
        walk_to_goal(problem, scenes_of(problem))
        return
    simulation = problem.simulation.model_copy(
        update={"time_limit_s": min(seconds, problem.simulation.time_limit_s)}
    )
    score = simulate(
        problem.model_copy(update={"simulation": simulation}), problem.planner.kind, record_every=1
    ).score
    assert len(score.outcome) == 1
    assert score.outcome[0] != "failed"


class Meter:
    """Time and memory that a case takes."""

    def __enter__(self) -> "Meter":
        self.began, self.before = time.monotonic(), _peak_gb()
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds, self.gb = time.monotonic() - self.began, _peak_gb() - self.before


def _peak_gb() -> float:
    scale = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale / 1e9


def test_there_are_thousands_of_mutants_of_every_problem_to_choose_from() -> None:
    names = [name for name, _ in mutants()]
    assert len(names) == len(set(names)) > 5000
    assert {name.split(":")[0] for name, _ in sample()} == set(shipped())


@pytest.mark.slow
def test_mutated_problem_files_are_refused_clearly_or_fly(tmp_path: Path) -> None:
    path = tmp_path / "mutant.toml"
    refused = flown = 0
    for name, tables in sample():
        path.write_text(toml(tables), encoding="utf-8")
        with Meter() as meter:
            told, problem, flyable = "", None, False
            try:
                problem = load_problem(path)
                flyable = not check_mission(problem)
            except NapfError as error:
                told = str(error)
            if told:
                refused += 1
                assert all(line.isprintable() and len(line) < 1000 for line in told.splitlines()), name
            elif problem is not None and flyable:
                flown += 1
                flies(problem)
        assert meter.seconds < MOST_S, name
        assert meter.gb < MOST_GB, name
    assert refused > MUTANTS // 2
    assert flown > MUTANTS // 20


@pytest.mark.slow
def test_mutated_problem_files_through_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NAPF_MPC_DATA", "")
    path = tmp_path / "mutant.toml"
    codes = []
    for name, tables in sample()[:THROUGH_THE_COMMAND]:
        path.write_text(toml(tables), encoding="utf-8")
        codes.append(run_command(["validate", str(path)]))
        printed = capsys.readouterr()
        if codes[-1] == 0:
            assert printed.out.startswith(f"{path}: valid"), name
            assert printed.err == "", name
        else:
            assert codes[-1] == 2, name
            assert printed.out == "", name
            assert all(line.startswith("error: ") for line in printed.err.splitlines()), name
    assert set(codes) == {0, 2}
    last = subprocess.run(
        [sys.executable, "-m", "napf_mpc", "validate", str(path)], capture_output=True, text=True, timeout=120
    )
    assert (last.returncode, last.stdout, last.stderr) == (codes[-1], printed.out, printed.err)


# ------------------------------------------------------------------------------------------------- limits


def families() -> dict[str, Tables]:
    """One problem for every kind of section: shipped ones, and variants for what none of them has."""
    found = shipped()
    table1, walk = found["table1_8"], found["single_uav"]
    found = {
        name: found[name] for name in ("table1_8", "table1_40", "street_canyon", "square_8", "single_uav")
    }
    loose = copy.deepcopy(table1)
    for key in ("initial_positions_m", "initial_velocities_mps"):
        del loose["mission"][key]
    for shape in ("line", "v", "circle"):
        found[shape] = loose | {"formation": {"shape": shape}}
    found["list"] = loose | {"formation": {"shape": "list", "offsets_m": [[0.0, 0.0, 0.0], [1.0, 5.0, 2.0]]}}
    found["forest"] = table1 | {"world": {"kind": "forest"}}
    found["constant"] = table1 | {"navigation": {"kind": "constant"}}
    found["outages"] = table1 | {"navigation": {"kind": "gauss_markov", "outage_interval_s": 20.0}}
    for name in ("kalman", "point_mass"):
        found[name] = table1 | {"navigation": {"filter": name, "outage_interval_s": 5.0}}
    found["solids"] = table1 | {"world": {"kind": "list", "obstacles": SOLIDS}}
    found["walk in a random world"] = walk | {"world": {"kind": "scatter"}}
    # Errors are drawn for the whole time limit: a short one is quicker to draw.
    short = {"simulation": {"time_limit_s": FLOWN_S}}
    return {name: tables | short for name, tables in found.items()}


SOLIDS = [
    {"shape": "box", "centre_m": [20.0, 3.0, 0.0], "size_m": [2.0, 2.0, 2.0]},
    {"shape": "cylinder", "centre_m": [30.0, 3.0], "radius_m": 1.0, "base_m": -5.0, "top_m": 5.0},
    {"shape": "prism", "footprint_m": [[40.0, 0.0], [44.0, 0.0], [42.0, 4.0]], "base_m": -3.0, "top_m": 8.0},
]


def numbers(model: BaseModel, path: Path_ = ()) -> Iterator[tuple[Path_, type, tuple[float, float]]]:
    """Every number of a problem: where it is, its type and its limits."""
    for name, info in type(model).model_fields.items():
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            yield from numbers(value, (*path, name))
        else:
            yield from _numbers(value, info.annotation, list(info.metadata), (*path, name))


def _numbers(
    value: Any, kind: Any, limits: list[Any], path: Path_
) -> Iterator[tuple[Path_, type, tuple[float, float]]]:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        yield from _numbers(value, arguments[0], [*limits, *arguments[1:]], path)
    elif origin in (typing.Union, types.UnionType):
        for argument in arguments:
            yield from _numbers(value, argument, limits, path)
    elif origin is tuple and value is not None:
        entries = itertools.repeat(arguments[0]) if arguments[-1] is Ellipsis else arguments
        for i, (entry, entry_kind) in enumerate(zip(value[:2], entries, strict=False)):
            if isinstance(entry, BaseModel):
                yield from numbers(entry, (*path, i))
            else:
                yield from _numbers(entry, entry_kind, [], (*path, i))
    elif kind in (int, float):
        yield path, kind, _limits(limits, path)


def _limits(found: list[Any], path: Path_) -> tuple[float, float]:
    flat = [part for item in found for part in getattr(item, "metadata", [item])]
    low = [getattr(part, "ge", getattr(part, "gt", None)) for part in flat if isinstance(part, LOW)]
    high = [getattr(part, "le", getattr(part, "lt", None)) for part in flat if isinstance(part, HIGH)]
    assert low, f"{path} has no lower limit"
    assert high, f"{path} has no upper limit"
    return max(low), min(high)


LOW = (annotated_types.Ge, annotated_types.Gt)
HIGH = (annotated_types.Le, annotated_types.Lt)


def cases_at_limits(path: Path) -> Iterator[tuple[str, Tables]]:
    """Every number at its lower and at its upper limit, one at a time; each place once."""
    seen = set()
    for name, tables in families().items():
        path.write_text(toml(tables), encoding="utf-8")
        problem = load_problem(path)
        for place, kind, limits in numbers(problem):
            # What decides the meaning of a key: the kind of its section.
            section = getattr(problem, str(place[0]))
            known = (place, *(getattr(section, key, None) for key in ("kind", "shape", "filter")))
            if known in seen:
                continue
            seen.add(known)
            for limit in limits:
                changed = copy.deepcopy(tables)
                here: Any = changed
                for step in place[:-1]:
                    here = here.setdefault(step, {}) if isinstance(here, dict) else here[step]
                if isinstance(here, dict | list):
                    here[place[-1]] = kind(limit)
                    yield f"{name}: {'.'.join(map(str, place))} = {limit}", changed


@pytest.mark.slow
def test_every_number_at_its_limits_flies_or_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "limit.toml"
    refused, flown = [], 0
    for name, tables in cases_at_limits(tmp_path / "family.toml"):
        path.write_text(toml(tables), encoding="utf-8")
        with Meter() as meter:
            try:
                problem = load_problem(path)
                check_mission(problem)
            except NapfError:
                refused.append(name)
                continue
            flies(problem, 1.0)
            flown += 1
        assert meter.seconds < MOST_S, name
        assert meter.gb < MOST_GB, name
    assert flown > 200
    assert len(refused) < flown


def test_more_errors_than_memory_holds_are_refused_with_the_way_out() -> None:
    crowd = {"formation": {"shape": "line", "count": 4096}, "mission": {"length_m": 10.0}}
    with pytest.raises(ProblemError, match=r"make 1\.47e\+08 position fixes .* lower one of the three"):
        load_problem("table1_8", crowd | {"simulation.time_limit_s": 3600.0})


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {"formation": {"shape": "line", "count": 4096}, "simulation.time_limit_s": 450.0},
        {"simulation.time_limit_s": 3600.0, "navigation.rate_hz": 50.0},
        {"formation": {"shape": "line", "count": 4096}, "world.count": 1000},
        {"simulation.step_s": 0.001, "simulation.controller_rate_hz": 1000.0, "planner.rate_hz": 100.0},
    ],
)
def test_large_numbers_together_fly_or_are_refused(settings: dict[str, Any]) -> None:
    with Meter() as meter:
        try:
            problem = load_problem("table1_8", {"mission": {"length_m": 10.0}} | settings)
            check_mission(problem)
        except NapfError:
            return
        flies(problem)
    assert meter.gb < MOST_GB
    assert meter.seconds < MOST_S
