"""The command line: exit codes, what is printed where, and what each command leaves behind."""

import hashlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import napf_mpc
from napf_mpc import interrupts, store
from napf_mpc.cli import run_command
from napf_mpc.problem_file import load_problem
from napf_mpc.scenario_file import read_scenes
from napf_mpc.solvers import solver

PROBLEM = """
title = "Five seconds among four balls"
[formation]
shape = "square"
[mission]
length_m = 1.0
initial_velocities_mps = [[2, 0, 0], [2, 0, 0], [2, 0, 0], [2, 0, 0]]
[world]
kind = "lanes"
count = 4
along_range_m = [0.0, 12.0]
[vehicle]
radius_m = 0.0
[simulation]
time_limit_s = 5.0
controller_rate_hz = 25.0
[planner]
rate_hz = 5.0
k = 1.7
[navigation]
rate_hz = 5.0
[reference]
source = "A paper"
runs = 30
collision_risk = { apf = 0.7333, napf = 0.1667 }
"""
COMMANDS = ["problems", "validate", "run", "compare", "montecarlo", "rare", "sweep", "figures"]


@pytest.fixture
def problem(tmp_path: Path) -> str:
    path = tmp_path / "brief.toml"
    path.write_text(PROBLEM)
    return str(path)


class Figures:
    """In place of the module that draws: notes what it is asked for."""

    def __init__(self) -> None:
        self.drawn: list[tuple[str, tuple[Any, ...]]] = []

    def __getattr__(self, name: str) -> Any:
        def draw(*given: Any) -> list[Path]:
            self.drawn.append((name, given))
            return [Path("figure.png"), Path("figure.svg")]

        return draw


@pytest.fixture(autouse=True)
def figures(monkeypatch: pytest.MonkeyPatch) -> Figures:
    """Nothing is drawn unless a test asks for it: pictures take longer than all the rest."""
    stub = Figures()
    monkeypatch.setitem(sys.modules, "napf_mpc.figures", stub)  # type: ignore[arg-type]
    return stub


def done(capsys: pytest.CaptureFixture[str], *words: str | Path) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a command in this process."""
    code = run_command([str(word) for word in words])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def process(*words: str | Path, **options: Any) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "napf_mpc", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def digest(out: Path) -> str:
    return hashlib.sha256((out / "runs.parquet").read_bytes()).hexdigest()


# ---------------------------------------------------------------------------------------------------- help

HELP = """
import contextlib, io, sys, time
from napf_mpc.cli import run_command
with contextlib.redirect_stdout(io.StringIO()) as text:
    code = run_command(sys.argv[1:])
heavy = {"casadi", "joblib", "matplotlib", "numba", "numpy", "pyarrow", "scipy", "shapely"}
print(code, len(text.getvalue()), time.process_time(), sorted(heavy & set(sys.modules)))
"""


@pytest.mark.parametrize("command", [None, *COMMANDS])
def test_help_is_quick_and_loads_nothing_heavy(command: str | None) -> None:
    words = ["--help"] if command is None else [command, "--help"]
    shown = subprocess.run([sys.executable, "-c", HELP, *words], capture_output=True, text=True, check=True)
    code, length, seconds, heavy = shown.stdout.split(maxsplit=3)
    assert (code, heavy.strip()) == ("0", "[]")
    assert int(length) > 200
    assert float(seconds) < 0.5  # of processor time: this machine may be busy with other things


def test_without_a_word_it_helps(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = done(capsys)
    assert (code, err) == (0, "")
    assert all(command in out for command in COMMANDS)


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["--version"]) == 0
    assert capsys.readouterr().out == f"napf-mpc {napf_mpc.__version__}\n"


def test_the_module_is_the_command() -> None:
    shown = process("problems", "--json")
    assert (shown.returncode, shown.stderr) == (0, "")
    assert "table1_8" in {entry["name"] for entry in json.loads(shown.stdout)}


# ----------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("compare P --runs 0", "runs = 0: must be a whole number from 1 to 10000000"),
        ("compare P --runs -1", "runs = -1"),
        ("compare P --runs x", "Invalid value for '--runs'"),
        ("compare P --runs 1e12", "Invalid value for '--runs'"),
        ("compare P --runs 1e9", "'--runs': \"1e9\": must be a whole number in digits, such as 1000"),
        ("compare P --runs=", "'--runs': \"\": must be a whole number in digits"),
        ("compare P --workers 1.5", "'--workers': \"1.5\": must be a whole number in digits"),
        ("compare P --block-limit soon", "'--block-limit': \"soon\": must be a number"),
        ("benchmark scaling --budget nan", "'--budget': \"nan\": must be a number of at most 1000000"),
        ("benchmark scaling --budget 2e6", "'--budget': \"2e6\": must be a number of at most 1000000"),
        ("benchmark scaling --budget 0.01", "'--budget': \"0.01\": must be a number of at least 0.1"),
        ("benchmark solvers --every 0", "'--every': \"0\": must be a number of at least 1"),
        ("compare P --runs 1000000000000", "runs = 1000000000000"),
        ("compare P --seed -1", "seed = -1: must be a whole number from 0 to 2**63 - 1"),
        (f"compare P --seed {2**200}", "seed = an integer of more than 60 digits"),
        ("compare P --seed 2**200", "Invalid value for '--seed'"),
        (f"run P --seed {2**63}", f"seed = {2**63}"),
        ("run P --planner pq", '"pq" is not a planner; choose from apf, napf, napf_guided, qp, qp_unguided'),
        ("run P --planner nonsense", '"nonsense" is not a planner; choose from apf, napf'),
        (
            "run P --planner nap",
            '"nap" is not a planner; choose from apf, napf, napf_guided, qp, qp_unguided; did you mean napf?',
        ),
        ("run P --planner=", '"" is not a planner'),
        ("montecarlo P --planner no --out O", '"no" is not a planner'),
        ("compare P --planners apf,no", '"no" is not a planner'),
        ("compare P --planners=", "planners: give a list of at least one name"),
        ("compare P --planners ,", "planners: give a list of at least one name"),
        ("compare P --planners napf,apf,napf", "planners = napf,apf,napf: each may be named once"),
        ("compare P --workers 0", "workers = 0: must be a whole number from 1 to 1024"),
        ("compare P --workers 5000", "workers = 5000"),
        ("compare P --block-limit 0", "block-limit = 0"),
        ("montecarlo P --out O --block-limit nan", "block-limit = nan"),
        ("montecarlo P --out O --runs 0", "runs = 0: must be a whole number from 1 to 10000000"),
        ("montecarlo P --out O --runs 1e12", "Invalid value for '--runs'"),
        (f"montecarlo P --out O --seed {2**200}", "seed = an integer of more than 60 digits"),
        ("run P --run-index -1", "run-index = -1: must be a whole number from 0 to 9999999"),
        ("run P --run-index 99999999999", "run-index = 99999999999"),
        ("run nowhere.toml", "nowhere.toml: no such file and no shipped problem of this name"),
        ("run tabel1_8", "did you mean table1_8"),
        ("run table1_8 --set nonsense", 'setting "nonsense": must be key.path=value'),
        ("run table1_8 --set planner.kk=2", "planner.kk: unknown key; did you mean planner.k?"),
        ("run table1_8 --set planner.k=-1", "planner.k = -1: must be >= 0 and <= 20"),
        ("run single_uav --planner napf", '"napf" cannot walk to a goal; only "apf" can'),
        ("compare single_uav", "mission.kind"),
        ("validate nonsense", "no such file"),
        ("validate table1_8 --set world.count=-1", "world.count = -1"),
        ("figures nonsense --out O", "no such file"),
        ("figures . --out O --set planner.k=2", "is drawn as it was flown"),
        ("montecarlo P", "Missing option '--out'"),
        ("montecarlo P --out O --until-width 0", "until-width = 0: must be a rate above 0 and below 1"),
        ("montecarlo P --out O --until-upper 2", "until-upper = 2: must be a rate above 0 and below 1"),
        ("montecarlo P --out O --until-upper nan", "until-upper = nan: must be a rate"),
        ("montecarlo P --out O --until-upper x", "Invalid value for '--until-upper'"),
        ("rare P --out O --samples 15", "samples = 15: must be a multiple of 10 from 20 to 1000000"),
        ("rare P --out O --samples 0", "samples = 0"),
        ("rare P --out O --seed -1", "seed = -1"),
        ("rare P --out O --planner no", '"no" is not a planner'),
        ("rare P", "Missing option '--out'"),
        ("rare single_uav --out O", "mission.kind"),
        ("run", "Missing argument"),
        ("run P P", "unexpected extra argument"),
        ("sweep P --out O", "Missing option '--vary'"),
        ("sweep P --vary planner.k=1,2", "Missing option '--out'"),
        ("sweep P --vary planner.k --out O", "must be key.path=value,value,... for example planner.k=1,2,3"),
        ("sweep P --vary planner.kk=1 --out O", "planner.kk: unknown key; did you mean planner.k?"),
        ("sweep P --vary planner.k=2,99 --out O", "planner.k = 99: must be >= 0 and <= 20"),
        ("sweep P --vary planner.k=2 --planners no --out O", '"no" is not a planner'),
        ("sweep P --vary planner.k=2 --runs 0 --out O", "runs = 0"),
        ("swep P", "No such command 'swep'. Did you mean 'sweep'?"),
        ("comapre P", "No such command 'comapre'. Did you mean 'compare'?"),
        ("run nishi_shinjuku --data D", "--data"),
    ],
)
def test_bad_input_is_one_clear_line_and_exit_code_2(
    words: str, told: str, problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    places = {"P": problem, "O": str(tmp_path / "out"), "D": str(tmp_path / "nodata")}
    code, out, err = done(capsys, *(places.get(word, word) for word in words.split()))
    assert (code, out) == (2, "")
    assert told in err
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["compare", "montecarlo"])
def test_a_cluster_needs_a_package_and_the_way_to_it_is_named(
    command: str,
    problem: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)  # as if it were not installed
    words = [command, problem, "--out", tmp_path / "out", "--cluster", "tcp://127.0.0.1:8786"]
    code, out, err = done(capsys, *words)
    assert (code, out) == (2, "")
    assert err == (
        "error: --cluster tcp://127.0.0.1:8786: needs the package distributed: "
        "pip install 'napf-mpc[cluster]'\n"
    )
    assert not (tmp_path / "out").exists()


def test_every_fault_of_a_problem_has_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(PROBLEM.replace("k = 1.7", "k = nan\nspeed = 3").replace("count = 4", "count = -4"))
    code, _, err = done(capsys, "validate", path)
    assert code == 2
    assert err.count("\n") == 3
    assert all(key in err for key in ("planner.k", "planner.speed", "world.count"))


def test_running_out_of_memory_is_one_line(
    problem: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def too_much(*_: Any, **__: Any) -> None:
        raise MemoryError

    monkeypatch.setattr("napf_mpc.campaign.run_campaign", too_much)
    code, out, err = done(capsys, "compare", problem)
    assert (code, out) == (2, "")
    assert err.startswith("error: out of memory")


def test_a_file_that_the_system_refuses_is_one_line(
    problem: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: Any, **__: Any) -> None:
        raise PermissionError(13, "Permission denied", "somewhere/file")

    monkeypatch.setattr("napf_mpc.campaign.run_campaign", refused)
    code, out, err = done(capsys, "compare", problem)
    assert (code, out) == (2, "")
    assert err == "error: somewhere/file: Permission denied; finished blocks are kept\n"


# ------------------------------------------------------------------------------------- problems and validate


def test_problems_are_listed_one_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = done(capsys, "problems")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert {"potential_surface", "single_uav", "square_8", "table1_40c", "nishi_shinjuku"} <= {
        line.split()[0] for line in lines
    }
    assert all(len(line.split()) > 3 for line in lines)


def test_the_schema_is_json(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = done(capsys, "problems", "--schema")
    assert code == 0
    assert json.loads(out)["properties"].keys() >= {"formation", "mission", "world", "planner"}


@pytest.mark.parametrize("name", ["table1_8", "single_uav", "street_canyon"])
def test_shipped_problems_are_valid(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert done(capsys, "validate", name) == (0, f"{name}: valid\n", "")
    code, out, _ = done(capsys, "validate", name, "--json")
    assert code == 0
    assert json.loads(out) == {
        "file": name, "valid": True, "problem_hash": load_problem(name).digest(), "note": ""
    }  # fmt: skip


def test_valid_without_its_data_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NAPF_MPC_DATA", str(tmp_path))
    code, out, err = done(capsys, "validate", "nishi_shinjuku")
    assert (code, err) == (0, "")
    assert "nishi_shinjuku: valid" in out
    assert "buildings.geojson" in out


def test_data_that_are_there_but_of_no_use_are_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "log.csv").write_text("nothing of use")
    settings = ["--set", 'navigation.kind="recorded"', "--set", 'navigation.file="log.csv"']
    path = tmp_path / "brief.toml"
    path.write_text(PROBLEM)
    code, out, err = done(capsys, "validate", path, "--data", tmp_path, *settings)
    assert (code, out) == (2, "")
    assert "log.csv" in err


@pytest.mark.parametrize(
    "setting",
    [
        "world.radius_m=[20, 20]",  # no room
        "vehicle.mass_kg=0.01",  # the inner loop would be unstable
        'planner.solver="nosuch"',  # though the problem's own planner has none
    ],
)
def test_what_cannot_be_flown_is_not_valid(setting: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = done(capsys, "validate", "table1_40", "--set", setting)
    assert (code, out) == (2, "")
    assert err.startswith("error: ")


def test_a_solver_that_is_not_known_is_told_with_its_key(
    problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (("validate",), ("compare", "--planners", "apf,qp", "--runs", "1")):
        code, out, err = done(capsys, words[0], problem, *words[1:], "--set", 'planner.solver="nosuch"')
        assert (code, out) == (2, "")
        assert err.startswith("error: planner.solver: ")
        assert "'nosuch' is not known; choose from" in err


@pytest.mark.parametrize(
    "words",
    [
        "validate P",
        "validate single_uav",
        "run P --planner napf --out O",
        "run single_uav --planner apf --out O",
        "compare P --planners apf,napf --runs 1 --out O",
        "montecarlo P --planner napf --runs 1 --out O",
        "sweep P --vary planner.k=1,2 --planners napf --runs 1 --out O",
        "rare P --planner napf --samples 20 --out O",
    ],
)
def test_a_solver_that_is_not_known_is_refused_by_planners_without_one(
    words: str,
    problem: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is not valid does not fly, whoever would fly it; what somebody has registered does."""
    places = {"P": problem, "O": str(tmp_path / "out")}
    command = [places.get(word, word) for word in words.split()]
    code, out, err = done(capsys, *command, "--set", 'planner.solver="osqpp"')
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert "planner.solver: solver 'osqpp' is not known; choose from osqp, " in err
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()
    if command[0] in ("validate", "run"):
        monkeypatch.setitem(solver._FACTORIES, "osqpp", solver.register_solver)
        assert done(capsys, *command, "--set", 'planner.solver="osqpp"')[0] in (0, 1)


def test_a_backend_of_matplotlib_that_is_not_there_is_no_matter(problem: str, tmp_path: Path) -> None:
    """Some set it for windows of their own; commands draw into files."""
    out = tmp_path / "out"
    shown = process(
        "run", problem, "--planner", "apf", "--out", out, env={**os.environ, "MPLBACKEND": "nope"}
    )
    assert shown.stderr == ""
    assert shown.returncode in (0, 1)
    assert (out / "brief_apf_paths.png").stat().st_size > 0


@pytest.mark.parametrize("encoding", ["ascii", "cp932"])
def test_a_sign_that_the_output_does_not_have_is_no_reason_to_fail(problem: str, encoding: str) -> None:
    """Redirected on a Japanese Windows, for one, standard output has no superscript two."""
    shown = process("run", problem, env={**os.environ, "PYTHONIOENCODING": encoding}, errors="replace")
    assert shown.returncode in (0, 1)
    assert "N? s" in shown.stdout
    assert shown.stderr == ""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no full device here")
def test_a_full_disk_under_the_output_is_one_line() -> None:
    with open("/dev/full", "w") as full:
        shown = subprocess.run(
            [sys.executable, "-m", "napf_mpc", "problems", "--schema"],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert shown.returncode == 2
    assert (
        shown.stderr
        == "error: standard output: No space left on device; what was written under --out is kept\n"
    )


def test_quiet_prints_nothing(problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert done(capsys, "validate", problem, "--quiet") == (0, "", "")
    assert done(capsys, "compare", problem, "--runs", "3", "--quiet") == (0, "", "")
    code, out, err = done(capsys, "run", problem, "--quiet", "--out", tmp_path / "out")
    assert code in (0, 1)
    assert (out, err) == ("", "")


# ------------------------------------------------------------------------------------------------------ run


def test_run_ends_with_0_if_reached_and_1_if_not(problem: str, capsys: pytest.CaptureFixture[str]) -> None:
    codes = {}
    for run in range(6):
        code, out, _ = done(capsys, "run", problem, "--planner", "apf", "--run-index", str(run), "--json")
        codes[json.loads(out)["outcome"]] = code
    assert codes.pop("reached") == 0
    assert set(codes.values()) == {1}


def test_run_flies_a_row_of_a_campaign_again_bit_by_bit(
    problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["compare", problem, "--runs", "12", "--seed", "5", "--workers", "1", "--quiet"]
    assert done(capsys, *words, "--out", tmp_path / "all")[0] == 0
    everything = store.read_table(tmp_path / "all" / "runs.parquet")
    for planner, run in (("apf", 0), ("napf", 7), ("napf", 11)):
        out = tmp_path / f"{planner}{run}"
        done(
            capsys, "run", problem, "--seed", "5", "--run-index", str(run), "--planner", planner, "--quiet",
            "--out", out,
        )  # fmt: skip
        row = (everything["planner"] == planner) & (everything["run"] == run)
        for name, values in store.read_table(out / "runs.parquet").items():
            np.testing.assert_array_equal(values, everything[name][row], err_msg=name)


def test_run_leaves_all_that_is_needed_to_judge_it_again(
    problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], figures: Figures
) -> None:
    out = tmp_path / "out"
    code, text, err = done(capsys, "run", problem, "--run-index", "3", "--out", out)
    assert code in (0, 1)
    assert err == ""
    assert "brief, planner napf, run 3 of seed 0" in text
    assert f"results and figures: {out}" in text
    assert sorted(path.name for path in out.iterdir() if not path.name.startswith(".")) == [
        "campaign.json", "events.parquet", "runs.parquet", "scenario.json", "summary.json", "timing.parquet",
        "trajectories.parquet",
    ]  # fmt: skip
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["run"], summary["planners"]["napf"]["runs"]) == (3, 1)
    track = store.read_table(out / "trajectories.parquet")
    contract = (
        "run planner t_s uav x_m y_m z_m est_x_m est_y_m est_z_m sigma_x_m roll_rad roll_rate_radps thrust_n "
        "ref_x_m slack_m solver_status"
    )
    assert set(contract.split()) <= set(track)
    assert set(track["uav"]) == {0, 1, 2, 3}
    # The verdict again, from the stored files alone: samples are coarser than the sweep, so never closer.
    (shapes,) = read_scenes(out / "scenario.json").values()
    centres = np.array([shape.centre_m for shape in shapes])  # type: ignore[union-attr]
    radii = np.array([shape.radius_m for shape in shapes])  # type: ignore[union-attr]
    points = np.stack([track["x_m"], track["y_m"], track["z_m"]], axis=-1)
    sampled = (np.linalg.norm(points[:, None] - centres, axis=-1) - radii).min()
    swept = store.read_table(out / "runs.parquet")["min_clearance_m"][0]
    assert swept <= sampled + 1e-7
    assert sampled - swept < 0.05
    ((name, given),) = figures.drawn
    assert name == "draw_mission"
    assert given[1] == "brief"


def test_run_again_into_its_folder_is_the_same_and_another_run_is_refused(
    problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", problem, "--out", tmp_path / "out", "--quiet"]
    first = done(capsys, *words)
    before = digest(tmp_path / "out")
    assert done(capsys, *words) == first
    assert digest(tmp_path / "out") == before
    code, _, err = done(capsys, *words, "--run-index", "1")
    assert code == 2
    assert "run = 0, not 1" in err
    assert digest(tmp_path / "out") == before


@pytest.mark.parametrize("name", ["single_uav", "potential_surface"])
def test_a_walk_to_a_goal_runs_and_is_stored(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = done(capsys, "run", name, "--json", "--out", tmp_path / "out")
    assert (code, err) == (0, "")
    summary = json.loads(out)
    assert summary["outcome"] == "reached"
    assert summary["planners"]["apf"]["path_length_ratio"]["median"] > 1.0
    assert summary == json.loads((tmp_path / "out" / "summary.json").read_text())
    track = store.read_table(tmp_path / "out" / "trajectories.parquet")
    assert np.hypot(track["x_m"][-1] - 10.0, track["y_m"][-1] - 10.0) <= 0.1
    assert np.isnan(track["t_s"]).all()  # a walk has steps, no clock
    assert track["step"].tolist() == list(range(len(track["step"])))


# ------------------------------------------------------------------------------------ compare and montecarlo


def test_compare_prints_rates_with_count_and_interval_beside_the_published(
    problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = done(capsys, "compare", problem, "--runs", "20", "--workers", "1")
    assert (code, err) == (0, "")
    assert re.search(r"collision risk.*\d+ / 20 = \d+\.\d\d % \[\d+\.\d\d, \d+\.\d\d\]", out)
    assert re.search(r"A paper.*73\.33 % \(n = 30\).*16\.67 % \(n = 30\)", out)
    assert "path RMS [m]" in out  # rich would take [m] for markup
    assert "exact McNemar p =" in out


def test_json_is_all_there_is_on_standard_output(
    problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = done(
        capsys, "compare", problem, "--runs", "6", "--workers", "1", "--json", "--out", tmp_path / "out"
    )
    assert (code, err) == (0, "")
    assert json.loads(out) == json.loads((tmp_path / "out" / "summary.json").read_text())


def test_compare_leaves_its_tables_and_a_note(
    problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], figures: Figures
) -> None:
    out = tmp_path / "out"
    assert done(capsys, "compare", problem, "--runs", "6", "--workers", "1", "--out", out)[0] == 0
    names = {path.name for path in out.iterdir()}
    assert {"runs.parquet", "timing.parquet", "summary.json", "scenario.json", "comparison.md"} <= names
    assert "| collision risk, any UAV and obstacle |" in (out / "comparison.md").read_text()
    assert sorted(read_scenes(out / "scenario.json"), key=str) == list(range(6))
    assert [name for name, _ in figures.drawn] == ["draw_comparison"]


def test_montecarlo_goes_on_where_it_stopped(
    problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["montecarlo", problem, "--planner", "apf", "--seed", "2", "--workers", "1", "--quiet"]
    assert done(capsys, *words, "--runs", "5", "--out", tmp_path / "a") == (0, "", "")
    first = sorted((tmp_path / "a" / "blocks").iterdir())
    assert done(capsys, *words, "--runs", "11", "--out", tmp_path / "a") == (0, "", "")
    assert done(capsys, *words, "--runs", "11", "--out", tmp_path / "b") == (0, "", "")
    assert digest(tmp_path / "a") == digest(tmp_path / "b")
    assert set(first) < set((tmp_path / "a" / "blocks").iterdir())


def test_montecarlo_stops_when_enough_is_known(
    problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = ["montecarlo", problem, "--planner", "apf", "--seed", "2", "--workers", "1", "--out", out]
    code, text, err = done(capsys, *words, "--runs", "200", "--until-width", "0.6", "--until-upper", "0.001")
    assert (code, err) == (0, "")
    assert "Stopping rule until-width 0.6 or until-upper 0.001: met after" in text
    runs = len(store.read_table(out / "runs.parquet")["run"])
    assert runs == 50
    assert f"met after {runs} of at most 200 runs" in (out / "comparison.md").read_text()
    # The same folder serves a rule that asks for more, and a fixed number of runs.
    assert done(capsys, *words, "--runs", "200", "--until-width", "0.3", "--quiet")[0] == 0
    assert runs < len(store.read_table(out / "runs.parquet")["run"]) < 200
    assert done(capsys, *words, "--runs", "200", "--quiet")[0] == 0
    assert "stopping" not in json.loads((out / "summary.json").read_text())


def test_rare_estimates_and_goes_on(problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    words = ["rare", problem, "--planner", "apf", "--samples", "40", "--seed", "3", "--out", out]
    code, text, err = done(capsys, *words)
    assert (code, err) == (0, "")
    assert "collision risk, any UAV and obstacle" in text
    summary = json.loads((out / "summary.json").read_text())
    assert summary["method"] == "subset simulation"
    assert len(store.read_table(out / "calls.parquet")["clearance_m"]) == summary["calls"]
    assert "| level 1: clearance <= " in (out / "rare.md").read_text()
    assert json.loads(done(capsys, *words, "--json")[1]) == summary
    code, _, err = done(capsys, *[word if word != "3" else "4" for word in words])
    assert (code, err.count("\n")) == (2, 1)
    assert "seed = 3, not 4" in err


def test_montecarlo_flies_the_problems_own_planner_and_keeps_trajectories(
    problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = ["montecarlo", problem, "--runs", "3", "--workers", "1", "--trajectories", "--json", "--out", out]
    code, text, _ = done(capsys, *words)
    assert code == 0
    assert list(json.loads(text)["planners"]) == ["napf"]
    track = store.read_table(out / "trajectories.parquet")
    assert set(track["run"]) == {0, 1, 2}
    assert np.unique(track["t_s"])[:3] == pytest.approx([0.0, 0.2, 0.4])  # the planner's rate


def test_settings_change_the_problem_and_are_part_of_it(
    problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["compare", problem, "--runs", "4", "--workers", "1", "--quiet", "--out", tmp_path / "out"]
    assert done(capsys, *words, "--set", "planner.k=0")[0] == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["problem_hash"] == load_problem(problem, ["planner.k=0"]).digest()
    # k = 0 is the fixed safety distance: NAPF is then APF.
    apf, napf = (summary["planners"][name] | {"solver": None} for name in ("apf", "napf"))
    assert apf == napf
    code, _, err = done(capsys, *words)
    assert code == 2
    assert "problem_hash = " in err


@pytest.mark.parametrize("what", ["file", "somebody's", "another", "read-only"])
def test_an_output_folder_that_cannot_be_used_is_one_line(
    what: str,
    problem: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "out"
    words = ["compare", problem, "--runs", "2", "--workers", "1", "--quiet", "--out", out]
    if what == "file":
        out.write_text("mine")
    elif what == "somebody's":
        out.mkdir()
        (out / "thesis.tex").write_text("mine")
    elif what == "another":
        assert done(capsys, "run", problem, "--quiet", "--out", out)[0] in (0, 1)
    else:
        out.mkdir()
        monkeypatch.setattr(os, "access", lambda path, mode: not mode & os.W_OK)
    before = sorted(tmp_path.rglob("*"))
    code, text, err = done(capsys, *words)
    assert (code, text) == (2, "")
    assert err.startswith(f"error: {out}: ")
    assert "choose another --out" in err
    assert err.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_changed_data_are_another_campaign(
    problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    data.mkdir()
    corners = [[0.0, 0.0], [1e-4, 0.0], [1e-4, 1e-4], [0.0, 1e-4], [0.0, 0.0]]
    building = {
        "type": "Feature",
        "properties": {"height_m": 30.0},
        "geometry": {"type": "Polygon", "coordinates": [corners]},
    }
    city = json.dumps({"type": "FeatureCollection", "features": [building]})
    (data / "city.geojson").write_text(city)
    text = PROBLEM.replace(
        'kind = "lanes"\ncount = 4\nalong_range_m = [0.0, 12.0]', 'kind = "city"\nfile = "city.geojson"'
    )
    Path(problem).write_text(text)
    words = ["compare", problem, "--runs", "2", "--workers", "1", "--data", data, "--out", tmp_path / "out"]
    assert done(capsys, *words)[0] == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    content = (data / "city.geojson").read_bytes()
    assert summary["data"] == {"city.geojson": hashlib.sha256(content).hexdigest()}
    (data / "city.geojson").write_text(city.replace("30.0", "31.0"))
    code, _, err = done(capsys, *words)
    assert code == 2
    assert "data.city.geojson = " in err


# -------------------------------------------------------------------------------------------------- figures


def test_figures_of_a_problem_and_of_a_folder(
    problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], figures: Figures
) -> None:
    code, out, _ = done(capsys, "figures", problem, "--out", tmp_path / "out")
    assert (code, out) == (0, "figure.png\nfigure.svg\n")
    code, out, _ = done(capsys, "figures", tmp_path, "--out", tmp_path / "out", "--json")
    assert json.loads(out) == ["figure.png", "figure.svg"]
    assert [name for name, _ in figures.drawn] == ["draw_problem", "draw_stored"]


# ------------------------------------------------------------------------------------------------- terminal


class Terminal(io.StringIO):
    """Standard error that says whether it is a terminal."""

    def __init__(self, is_terminal: bool) -> None:
        super().__init__()
        self.is_terminal = is_terminal

    def isatty(self) -> bool:
        return self.is_terminal


@pytest.mark.parametrize(
    ("terminal", "option", "shown"),
    [(True, None, True), (False, None, False), (True, "--quiet", False), (True, "--json", False)],
)
def test_a_progress_bar_is_for_terminals_only(
    terminal: bool, option: str | None, shown: bool, problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    error = Terminal(terminal)
    monkeypatch.setattr(sys, "stderr", error)
    # Rich would otherwise believe these more than the stream.
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    words = ["compare", problem, "--runs", "2", "--workers", "1", *([option] if option else [])]
    assert run_command(words) == 0
    assert ("missions" in error.getvalue()) == shown
    assert shown or error.getvalue() == ""


def test_words_for_a_stop_can_be_changed(capsys: pytest.CaptureFixture[str]) -> None:
    interrupts.when_stopped("stopped: 3 of 4")
    interrupts.say_stopped()
    assert capsys.readouterr().err == "stopped: 3 of 4\n"
    interrupts.when_stopped("stopped")


def test_results_can_be_moved_and_drawn_elsewhere(
    problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing in a folder of results holds a path."""
    out = tmp_path / "out"
    assert done(capsys, "compare", problem, "--runs", "2", "--workers", "1", "--quiet", "--out", out)[0] == 0
    for path in out.rglob("*"):
        if path.is_file():
            assert str(tmp_path).encode() not in path.read_bytes(), path
    shutil.move(out, tmp_path / "moved")
    words = ["compare", problem, "--runs", "3", "--workers", "1", "--quiet", "--out", tmp_path / "moved"]
    assert done(capsys, *words)[0] == 0
