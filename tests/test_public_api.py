"""What `import napf_mpc` offers: typed, lazy, silent, and without a display."""

import importlib
import inspect
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import napf_mpc

IMPORT = """
import sys, time
before = set(sys.modules)
began = time.process_time()
import napf_mpc
took = time.process_time() - began
heavy = {"numpy", "numba", "casadi", "scipy", "matplotlib", "pyarrow", "shapely", "pydantic", "typer", "rich"}
print(took, sorted(heavy & (set(sys.modules) - before)))
"""


def test_importing_is_quick_silent_and_loads_nothing_heavy() -> None:
    done = subprocess.run([sys.executable, "-c", IMPORT], capture_output=True, text=True, check=True)
    took, heavy = done.stdout.split(maxsplit=1)
    assert heavy.strip() == "[]"
    assert float(took) < 0.05
    assert done.stderr == ""


def test_every_name_is_there_and_comes_from_its_home() -> None:
    assert napf_mpc.__all__ == sorted(napf_mpc.__all__)
    for name in napf_mpc.__all__:
        value = getattr(napf_mpc, name)
        home = importlib.import_module(f"napf_mpc.{napf_mpc._HOMES[name]}")
        assert value is getattr(home, name)
        assert inspect.isclass(value) or inspect.isfunction(value)
        assert inspect.getdoc(value)
    assert set(napf_mpc.__all__) == set(napf_mpc._HOMES)


def test_type_checkers_see_the_same_names() -> None:
    text = Path(napf_mpc.__file__).read_text(encoding="utf-8")
    seen = text[text.index("if TYPE_CHECKING:") : text.index("__version__")]
    imported = {
        (line.split()[1], name.strip())
        for line in seen.splitlines()[1:]
        if line.strip()
        for name in line.split(" import ")[1].split(",")
    }
    assert imported == {(f"napf_mpc.{home}", name) for name, home in napf_mpc._HOMES.items()}
    assert (Path(napf_mpc.__file__).parent / "py.typed").exists()


def test_no_name_is_hidden_by_a_module() -> None:
    """`import napf_mpc.x` sets the attribute x of the package: a function of that name would be gone."""
    modules = {module.name for module in pkgutil.iter_modules(napf_mpc.__path__)}
    assert not modules & set(napf_mpc.__all__)


def test_names_stay_what_they_are_once_everything_is_loaded() -> None:
    code = (
        "import pkgutil, importlib, napf_mpc\n"
        "for m in pkgutil.walk_packages(napf_mpc.__path__, 'napf_mpc.'):\n"
        "    if not m.name.endswith('__main__'): importlib.import_module(m.name)\n"
        "print([n for n in napf_mpc.__all__ if not callable(getattr(napf_mpc, n))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout.strip(), done.stderr) == ("[]", "")


def test_dir_lists_what_there_is_and_a_wrong_name_is_an_attribute_error() -> None:
    assert set(napf_mpc.__all__) < set(dir(napf_mpc))
    with pytest.raises(AttributeError, match="has no attribute 'simulat'"):
        napf_mpc.simulat  # noqa: B018


def test_the_contract_of_the_library_so_far() -> None:
    names = "load_problem simulate compare ApfPlanner NapfPlanner NavSolution clearance_margin linearize lqr"
    assert set(names.split()) <= set(napf_mpc.__all__)


def test_errors_have_built_in_parents() -> None:
    assert issubclass(napf_mpc.ProblemError, napf_mpc.NapfError)
    assert issubclass(napf_mpc.ProblemError, ValueError)
    assert issubclass(napf_mpc.OutputError, OSError)


def test_a_mission_in_three_lines() -> None:
    problem = napf_mpc.load_problem("table1_8", ["simulation.time_limit_s=1"])
    missions = napf_mpc.simulate(problem, "napf", seed=1, runs=2)
    assert missions.score.metrics["control_effort"].shape == (2,)


def test_a_planner_of_ones_own_flies_in_the_same_loop() -> None:
    class Mine(napf_mpc.ApfPlanner):
        @property
        def name(self) -> str:
            return "mine"

    problem = napf_mpc.load_problem("table1_8", ["simulation.time_limit_s=2"])
    mine = napf_mpc.simulate(problem, Mine(problem), seed=1, record_every=10)
    theirs = napf_mpc.simulate(problem, "apf", seed=1)
    assert set(mine.trajectories["planner"]) == {"mine"}
    assert mine.score.metrics["control_effort"] == theirs.score.metrics["control_effort"]
