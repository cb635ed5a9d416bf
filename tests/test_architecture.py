"""The shape of the house: imports go down, no cycles, one home for each library, a light front door."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent / "napf_mpc"

# Whoever stands higher may import what stands lower, never the other way round and never sideways. A package
# is one place; its modules may import each other as long as that makes no cycle.
FLOORS: list[set[str]] = [
    {"__main__"},
    {"cli"},
    {"mission", "figures", "benchmark", "rare_events", "sweep"},
    {"report", "plot"},
    {"campaign"},
    {"prefix"},
    {"campaign_folder", "scenario_file", "cluster"},
    {"workers"},
    {"goal_walk"},
    {"block"},
    {"summary", "record", "provenance"},
    {"own_parts"},
    {"evaluate", "lanes"},
    {"closed_loop"},
    {"planners"},
    {"solvers"},
    {"qp"},
    {"quadratic_program", "constraints"},
    {"apf"},
    {"safety_distance"},
    {"risk_budget"},
    {"navigation"},
    {"world"},
    {"vehicle"},
    {"formation"},
    {"problem_file"},
    {"problem_faults"},
    {"problem"},
    {"store", "data_folder", "data_file", "overrides", "stopping", "extensions"},
    {"risk", "first_passage", "shipped", "interrupts", "streams", "jit", "errors", "words"},
]

HOMES = {
    "distributed": {"cluster.py"},
    "fcl": {"world/audit.py"},
    "osqp": {"solvers/osqp_.py"},
    "cvxpy": {"solvers/cvxpy_.py"},
    "qpsolvers": {"solvers/qpsolvers_.py"},
    "piqp": {"solvers/piqp_.py"},
    "highspy": {"solvers/qpsolvers_.py"},
    "numba": {"jit.py"},
    "casadi": {"vehicle/quadrotor.py", "vehicle/codegen.py", "solvers/casadi_.py", "benchmark/nmpc.py"},
    "pymap3d": {
        "navigation/recorded.py",
        "navigation/readers/smartloc.py",
        "navigation/rtklib_layout.py",
        "navigation/sky.py",
        "navigation/pseudoranges.py",
        "world/city.py",
    },
    "pynmeagps": {"navigation/readers/nmea.py"},
    "pyubx2": {"navigation/readers/ubx.py"},
    "pyulog": {"navigation/readers/ulog.py"},
    "pyarrow": {"store.py"},
    "matplotlib": {"plot/"},
    "PIL": {"plot/"},
    "typer": {"cli.py"},
    "tomllib": {"problem_file.py", "overrides.py"},
}

FILES = sorted(ROOT.rglob("*.py"))
NAMES = [path.relative_to(ROOT).as_posix() for path in FILES]


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def modules() -> dict[str, Path]:
    """Dotted name below the package -> file; the package itself is the empty name."""
    return {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix("__init__").rstrip("."): path
        for path in FILES
    }


def imports(path: Path) -> Iterator[str]:
    """Full names of all that a file imports, wherever in it, as far down as they are modules of ours."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            for alias in node.names:
                inner = f"{node.module}.{alias.name}".removeprefix("napf_mpc.")
                yield f"napf_mpc.{inner}" if inner in modules() else str(node.module)


@cache
def graph() -> dict[str, set[str]]:
    """Module -> modules of ours that it imports, late imports included; not the package's list of names."""
    edges = {}
    for name, path in modules().items():
        ours = {target for target in imports(path) if target.split(".")[0] == "napf_mpc"}
        edges[name] = {target.partition(".")[2] for target in ours} - {""}
    return {name: targets for name, targets in edges.items() if name}


def floor(module: str) -> int:
    return next(i for i, level in enumerate(FLOORS) if module.split(".")[0] in level)


def test_every_module_has_its_place() -> None:
    placed = set().union(*FLOORS)
    present = {name.split(".")[0] for name in graph()}
    assert present <= placed, f"give these a floor: {sorted(present - placed)}"
    assert placed <= present, f"these are gone: {sorted(placed - present)}"
    assert sum(map(len, FLOORS)) == len(placed)


@pytest.mark.parametrize("module", sorted(graph()))
def test_imports_go_down(module: str) -> None:
    for target in sorted(graph()[module]):
        same_package = target.split(".")[0] == module.split(".")[0]
        assert same_package or floor(target) > floor(module), f"{module} may not import {target}"


def test_no_module_imports_itself_by_a_detour() -> None:
    state: dict[str, int] = {}

    def visit(module: str, way: tuple[str, ...]) -> None:
        state[module] = 1
        for target in sorted(graph()[module]):
            assert state.get(target) != 1, " -> ".join((*way, module, target))
            if target not in state:
                visit(target, (*way, module))
        state[module] = 2

    for module in sorted(graph()):
        if module not in state:
            visit(module, ())


@pytest.mark.parametrize("library", sorted(HOMES))
def test_a_library_has_one_home(library: str) -> None:
    users = {
        name
        for name, path in zip(NAMES, FILES, strict=True)
        if any(target.split(".")[0] == library for target in imports(path))
    }
    astray = {
        user for user in users if not any(user == home or user.startswith(home) for home in HOMES[library])
    }
    assert not astray, f"{library} is imported by {sorted(astray)}, its home is {sorted(HOMES[library])}"
    assert users, f"{library} is used nowhere"


# ----------------------------------------------------------------------------------- what nobody may do

FORBIDDEN_MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "random"}
FORBIDDEN_CALLS = {"eval", "exec", "compile", "__import__"}
GLOBAL_RANDOM = {
    "seed",
    "rand",
    "randn",
    "random",
    "normal",
    "uniform",
    "choice",
    "shuffle",
    "default_rng",
    "RandomState",
}


@pytest.mark.parametrize("name", NAMES)
def test_no_code_from_data_and_no_hidden_randomness(name: str) -> None:
    """No pickle, no eval; random numbers only from the streams of a campaign's seed."""
    for node in ast.walk(tree(ROOT / name)):
        where = f"{name}:{getattr(node, 'lineno', 0)}"
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id not in FORBIDDEN_CALLS, where
        if isinstance(node, ast.Call):
            assert not any(key.arg == "allow_pickle" for key in node.keywords), where
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute):
            drawn = node.value.attr == "random" and node.attr in GLOBAL_RANDOM
            assert not drawn, f"{where}: draw from napf_mpc.streams"
    for target in imports(ROOT / name):
        assert target.split(".")[0] not in FORBIDDEN_MODULES, f"{name} imports {target}"
        assert not target.startswith("numpy.random"), f"{name} imports {target}"


@pytest.mark.parametrize("name", NAMES)
def test_no_leftovers(name: str) -> None:
    """No promises in the code, and no path of some machine."""
    text = (ROOT / name).read_text(encoding="utf-8")
    for word in ("TODO", "FIXME", "XXX", "NotImplementedError", "/home/", "/tmp/", "C:\\"):
        assert word not in text, f"{name}: {word}"


def test_no_module_is_a_drawer_for_everything() -> None:
    assert not {"utils", "helpers", "common", "misc"} & {part for name in graph() for part in name.split(".")}


# ---------------------------------------------------------------------------------------- the front door


def python(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
    )
    return done.stdout.strip()


def test_importing_the_package_loads_nothing_heavy() -> None:
    heavy = [
        "numpy", "scipy", "numba", "casadi", "matplotlib", "pyarrow", "pandas", "shapely", "fcl", "pydantic",
        "joblib", "distributed", "rich", "typer", "PIL", "pymap3d",
    ]  # fmt: skip
    loaded = python(f"import napf_mpc, sys; print(*sorted(set({heavy!r}) & set(sys.modules)))")
    assert loaded == ""


def test_the_command_line_is_there_before_anything_heavy() -> None:
    heavy = ["scipy.stats", "numba", "casadi", "matplotlib", "pyarrow", "shapely", "fcl", "joblib"]
    loaded = python(f"import napf_mpc.cli, sys; print(*sorted(set({heavy!r}) & set(sys.modules)))")
    assert loaded == ""


def test_public_names_are_what_they_say_whatever_was_imported_before() -> None:
    """`from napf_mpc import compare, simulate` must give two functions, also once all modules are loaded."""
    code = """
import importlib, pkgutil, napf_mpc
for module in pkgutil.walk_packages(napf_mpc.__path__, "napf_mpc."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
for name in napf_mpc.__all__:
    if getattr(getattr(napf_mpc, name), "__name__", "") != name:
        print(name, getattr(napf_mpc, name))
"""
    assert python(code) == ""
