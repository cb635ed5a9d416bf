"""Modules of one's own on the command line: what they register has a name, what is no module is told."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from napf_mpc.cli import run_command
from napf_mpc.errors import ProblemError
from napf_mpc.extensions import load_extension
from napf_mpc.planners import registry
from napf_mpc.solvers import solver

MINE = """
from napf_mpc import register_planner, register_solver
from napf_mpc.planners.potential_field import NapfPlanner
from napf_mpc.solvers.solver import backend_maker

register_planner("{name}", NapfPlanner)
register_solver("{name}_osqp", lambda **settings: backend_maker("osqp", **settings))
"""


@pytest.fixture(autouse=True)
def _nothing_is_left_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(registry, "_OWN", {})
    monkeypatch.setattr(solver, "_FACTORIES", dict(solver._FACTORIES))
    monkeypatch.setattr(solver, "_NAMES", set(solver._NAMES))


SHORT = ["--set", "simulation.time_limit_s=1", "--set", "planner.horizon=4"]


def test_own_planners_and_solvers_fly_from_the_command_line_in_all_workers(tmp_path: Path) -> None:
    """In a process of its own, as a user has it: nothing of the module is known to its workers beforehand."""
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "two_of_mine.py").write_text(MINE.format(name="bold"))
    command = [
        "compare", "study_8s", "--with", "parts/two_of_mine.py", "--planners", "napf,bold,qp", "--runs", "4",
        "--workers", "2", "--set", "planner.solver=bold_osqp", *SHORT, "--out", "out", "--json",
    ]  # fmt: skip
    flown = subprocess.run(
        [sys.executable, "-m", "napf_mpc", *command], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    planners = json.loads(flown.stdout)["planners"]
    assert planners["bold"]["control_effort"] == planners["napf"]["control_effort"]
    assert planners["qp"]["runs"] == 4
    origin = json.loads((tmp_path / "out" / "campaign.json").read_text())
    assert origin["own_planners"].keys() == {"bold"}
    assert origin["own_solver"].keys() == {"bold_osqp"}


def test_own_parts_are_measured_by_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "measured_parts.py").write_text(MINE.format(name="timid"))
    scene = ["--scenes", "no obstacles", "--missions", "1", "--with", "measured_parts"]
    assert (
        run_command(["benchmark", "solvers", *scene, "--every", "150", "--solvers", "osqp, warm;timid_osqp"])
        == 0
    )
    assert run_command(["benchmark", "planners", *scene, "--planners", "timid"]) == 0
    out = capsys.readouterr().out
    assert "timid_osqp" in out
    assert "timid " in out


@pytest.mark.parametrize(
    ("where", "text", "told"),
    [
        ("gone.py", None, "is not a file"),
        ("gone_module", None, "no such module is installed or in the working directory"),
        ("gone_package.inside", None, "no such module is installed or in the working directory"),
        ("two words", None, "is not the name of a module; names have letters, digits and _ only"),
        ("two-words.py", "", "is not the name of a module; names have letters, digits and _ only"),
        ("unclosed.py", "x = (\n", r"cannot be imported: SyntaxError: .*unclosed.py, line 1"),
        (
            "lacks.py",
            "\nimport what_is_not_there\n",
            r"cannot be imported: ModuleNotFoundError: .*lacks.py:2",
        ),
        ("leaves.py", "raise SystemExit(3)\n", r"cannot be imported: SystemExit: 3 \(leaves.py:1\)"),
        ("numpy.py", "x = 1\n", "another module is named numpy: rename the file"),
        (
            "taken.py",
            "from napf_mpc import register_planner\nregister_planner('qp', dict)\n",
            '"qp": a planner of this name exists already',
        ),
    ],
)
def test_what_cannot_be_imported_is_told_in_a_line(
    where: str,
    text: str | None,
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    if text is not None:
        (tmp_path / where).write_text(text)
    with pytest.raises(ProblemError, match=f"--with {where}: .*{told}"):
        load_extension(where)
    assert run_command(["run", "study_8s", "--with", where, "--quiet"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: --with {where}: ")
    assert error.count("\n") == 1


def test_a_file_stands_behind_libraries(tmp_path: Path) -> None:
    """What lies beside a planner must not be imported in place of a library."""
    searched = [*sys.path]
    (tmp_path / "alone.py").write_text("import json\n\nassert json.loads('1') == 1\n")
    (tmp_path / "json.py").write_text("raise RuntimeError\n")
    load_extension(str(tmp_path / "alone.py"))
    load_extension(str(tmp_path / "alone.py"))
    assert sys.path == [*searched, str(tmp_path)]
