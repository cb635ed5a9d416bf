"""Sweeps: grids over problem keys, told what is wrong before anything flies, nothing flown twice."""

import csv
import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
import sensitivity
from matplotlib.backends.backend_agg import FigureCanvasAgg

from napf_mpc import store, sweep
from napf_mpc.campaign import run_campaign
from napf_mpc.cli import run_command
from napf_mpc.errors import OutputError, ProblemError
from napf_mpc.planners.registry import PLANNERS
from napf_mpc.plot.style import house_style
from napf_mpc.plot.sweep import sweep_figure
from napf_mpc.problem_file import load_problem
from napf_mpc.report import sweep_table
from napf_mpc.sweep import Point, grid_points, parse_vary, run_sweep

BRIEF = [
    "mission.length_m=1.0",
    "mission.initial_velocities_mps=[[2.0,0.0,0.0],[2.0,0.0,0.0],[2.0,0.0,0.0],[2.0,0.0,0.0]]",
    "world.count=4",
    "world.along_range_m=[0.0,12.0]",
    "simulation.time_limit_s=2.0",
    "simulation.controller_rate_hz=25.0",
    "planner.rate_hz=5.0",
    "navigation.rate_hz=5.0",
]
VARY = ["planner.k=1,3", "world.shape=sphere,cylinder"]


def points(vary: list[str] = VARY) -> list[Point]:
    keys = {line.partition("=")[0] for line in vary}
    return grid_points("table1_8", vary, [line for line in BRIEF if line.partition("=")[0] not in keys])


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, store.Columns]:
    """Folder and table of a sweep of four points; only to be read."""
    out = tmp_path_factory.mktemp("sweep") / "out"
    return out, run_sweep(points(), ["apf", "napf"], 5, 3, out, name="brief")


# ------------------------------------------------------------------------------------------------ the grid


def test_commas_in_brackets_and_quotes_belong_to_the_value() -> None:
    grid = parse_vary(
        ["world.radius_m=[1, 2],[2, 3]", "planner.k = 1, 2.5", 'a.b="x,y",z', "c={ d = [1, 2] },e"]
    )
    assert grid == {
        "world.radius_m": ["[1, 2]", "[2, 3]"],
        "planner.k": ["1", "2.5"],
        "a.b": ['"x,y"', "z"],
        "c": ["{ d = [1, 2] }", "e"],
    }


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        ([], "give at least one"),
        (["planner.k"], "must be key.path=value,value"),
        (["=1,2"], "must be key.path=value,value"),
        (["planner.k=1,,2"], "must be key.path=value,value"),
        (["planner.k="], "must be key.path=value,value"),
        (["planner.k=1,1"], "each value may be there once"),
        (["planner.k=1", "planner.k=2"], "planner.k: is varied twice"),
        (["planner.kind=apf,napf"], "choose planners by --planners"),
    ],
)
def test_lines_that_are_no_grid_are_refused(lines: list[str], told: str) -> None:
    with pytest.raises(ProblemError, match=told):
        parse_vary(lines)


def test_a_key_is_varied_or_set() -> None:
    with pytest.raises(ProblemError, match=r"--set planner\.k: is varied, too; leave one of the two out"):
        grid_points("table1_8", ["planner.k=1,2"], ["world.count=3", "planner.k=3"])


def test_every_combination_is_a_point_with_its_own_folder() -> None:
    found = points()
    assert [tuple(point.settings.values()) for point in found] == [
        ("1", "sphere"), ("1", "cylinder"), ("3", "sphere"), ("3", "cylinder")
    ]  # fmt: skip
    assert [(point.problem.planner.k, point.problem.world.shape) for point in found] == [  # type: ignore[union-attr]
        (1.0, "sphere"), (1.0, "cylinder"), (3.0, "sphere"), (3.0, "cylinder")
    ]  # fmt: skip
    folders = {point.folder for point in found}
    assert len(folders) == 4
    assert all(folder == Path(folder).name and len(folder) < 120 for folder in folders)
    (strange,) = points(['title="../a b/' + 150 * "x" + '"'])
    assert strange.folder == Path(strange.folder).name
    assert len(strange.folder) < 120


def test_faults_of_all_points_are_told_at_once_and_once() -> None:
    with pytest.raises(ProblemError) as caught:
        points(["planner.k=-1,2,99", "world.cuont=3,4"])
    text = str(caught.value)
    assert "planner.k = -1" in text
    assert "planner.k = 99" in text
    assert text.count("world.cuont: unknown key; did you mean world.count?") == 1


def test_too_many_points_are_refused() -> None:
    with pytest.raises(ProblemError, match="10000 points, at most 1000 are flown"):
        points([f"a{i}=" + ",".join(map(str, range(10))) for i in range(4)])


def test_a_point_that_cannot_fly_stops_the_sweep_before_anything_flies(tmp_path: Path) -> None:
    grid = points(["world.kind=lanes", "planner.k=1,2"])
    bad = grid_points("table1_40", ["world.count=40,4000"], ["world.min_gap_m=5.0"])
    with pytest.raises(ProblemError, match=r"world.count = 4000: .* more area than there is"):
        run_sweep([*grid, *bad], ["apf"], 2, 1, tmp_path / "out")
    with pytest.raises(
        ProblemError, match=r"planner.k = 1.0: is the same problem as planner.k = 1; leave one"
    ):
        run_sweep(points(["planner.k=1,1.0"]), ["apf"], 2, 1, tmp_path / "out")
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------------------------------------- the flights


def test_each_row_is_the_campaign_of_its_point(flown: tuple[Path, store.Columns], tmp_path: Path) -> None:
    out, columns = flown
    assert list(zip(columns["planner.k"], columns["world.shape"], columns["planner"], strict=True))[2:4] == [
        ("1", "cylinder", "apf"), ("1", "cylinder", "napf")
    ]  # fmt: skip
    problem = load_problem("table1_8", [*BRIEF, "planner.k=1", "world.shape=cylinder"])
    alone = run_campaign(problem, ["apf", "napf"], 5, 3, tmp_path / "alone", name="brief")
    assert store.read_json(out / points()[1].folder / "summary.json") == alone
    for row, name in ((2, "apf"), (3, "napf")):
        part = alone["planners"][name]
        for key in (
            "collision_risk",
            "collision_risk_low",
            "uav_contact_risk_high",
            "finished",
            "joint_success",
        ):
            assert columns[key][row] == part[key]
        assert columns["path_rms_m"][row] == pytest.approx(part["path_rms_m"]["median"], nan_ok=True) or (
            np.isnan(columns["path_rms_m"][row]) and part["path_rms_m"]["median"] is None
        )


def test_the_tables_on_disk_hold_the_same(flown: tuple[Path, store.Columns]) -> None:
    out, columns = flown
    stored = store.read_table(out / "sweep.parquet")
    assert list(stored) == list(columns)
    with (out / "sweep.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8
    for key in ("collision_risk", "collision_risk_low", "joint_success"):
        np.testing.assert_array_equal(stored[key], columns[key])
        assert [float(row[key]) for row in rows] == columns[key].tolist()
    assert [row["world.shape"] for row in rows] == columns["world.shape"].tolist()


def test_keys_that_are_numbers_are_numbers_to_a_program(flown: tuple[Path, store.Columns]) -> None:
    stored = store.read_table(flown[0] / "sweep.parquet")
    assert stored["planner.k"].dtype.kind in "if"
    assert set(stored["planner.k"].tolist()) == {1, 3}
    assert set(stored["world.shape"].tolist()) == {"sphere", "cylinder"}


@pytest.mark.parametrize(
    ("texts", "kind"),
    [(["4", "-8"], "i"), (["0.5", "1e6"], "f"), (["1", "2.5"], "f"), (["1", "a"], "U"), (["1", "nan"], "U"),
     (["true", "false"], "U"), (["[1, 2]", "[3, 4]"], "U"), (["99999999999999999999", "1"], "f")],
)  # fmt: skip
def test_values_are_numbers_if_all_are(texts: list[str], kind: str) -> None:
    assert sweep._numbers(np.array(texts)).dtype.kind == kind


def test_it_goes_on_where_it_stopped_and_takes_a_larger_grid(
    flown: tuple[Path, store.Columns], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    told: list[int] = []
    fly = sweep.run_campaign

    def twice(problem: Any, *given: Any, **options: Any) -> Any:
        if len(list(out.glob("*/summary.json"))) == 2:
            raise KeyboardInterrupt
        return fly(problem, *given, **options)

    monkeypatch.setattr(sweep, "run_campaign", twice)
    with pytest.raises(KeyboardInterrupt):
        run_sweep(points(), ["apf", "napf"], 5, 3, out, name="brief")
    monkeypatch.setattr(sweep, "run_campaign", fly)
    blocks = {path: path.stat().st_mtime_ns for path in out.glob("*/blocks/rows*")}
    assert len(blocks) == 2
    columns = run_sweep(points(), ["apf", "napf"], 5, 3, out, name="brief", progress=told.append)
    assert told == sorted(told)
    assert told[-1] == 20
    for key, values in columns.items():
        np.testing.assert_array_equal(values, flown[1][key])
    larger = run_sweep(points(["planner.k=1,2,3", VARY[1]]), ["apf", "napf"], 5, 3, out, name="brief")
    assert len(larger["planner"]) == 12
    assert blocks.items() <= {path: path.stat().st_mtime_ns for path in out.glob("*/blocks/rows*")}.items()
    with pytest.raises(OutputError, match="seed = 3, not 4"):
        run_sweep(points(), ["apf", "napf"], 5, 4, out, name="brief")


# ------------------------------------------------------------------------------------------ what is shown


def test_the_table_shows_counts_and_intervals(flown: tuple[Path, store.Columns]) -> None:
    table = sweep_table("brief", list(points()[0].settings), flown[1], 3)
    assert table.header[:4] == ("planner.k", "world.shape", "planner", "collision risk")
    hits = round(5 * float(flown[1]["collision_risk"][0]))
    assert table.rows[0][:3] == ("1", "sphere", "apf")
    assert table.rows[0][3].startswith(f"{hits} / 5 = {20 * hits:.2f} % [")


@pytest.mark.parametrize(
    ("vary", "panels", "labels", "scale"),
    [
        (["planner.k=1,1.5,3"], 1, ["1", "1.5", "3"], "linear"),
        (["navigation.correlation_time_s=2,10,1e6"], 1, ["2", "10", "1e6"], "log"),
        (["navigation.correlation_time_s=0,2,50,1e6"], 1, ["0", "2", "50", "1e6"], "linear"),
        (VARY, 2, ["sphere", "cylinder"], "linear"),
        (["world.count=1,2,3,4,5", "planner.k=1,3"], 5, ["1", "3"], "linear"),
    ],
)
def test_the_figure_has_a_panel_for_each_combination(
    vary: list[str], panels: int, labels: list[str], scale: str
) -> None:
    grid = points(vary)
    keys, count = list(grid[0].settings), len(grid)
    risk = np.linspace(0.02, 0.4, 2 * count)
    columns = {key: np.repeat([point.settings[key] for point in grid], 2) for key in keys} | {
        "planner": np.tile(["apf", "napf"], count), "runs": np.full(2 * count, 100),
        "collision_risk": risk, "collision_risk_low": 0.8 * risk, "collision_risk_high": 1.2 * risk,
    }  # fmt: skip
    with house_style():
        figure = sweep_figure(columns, keys)
        figure.canvas.draw()
    assert len(figure.axes) == panels
    for axes in figure.axes:
        assert [label.get_text() for label in axes.get_xticklabels()] == labels
        assert axes.get_xscale() == scale
        for bar in axes.containers:
            assert len(bar[0].get_xdata()) == len(labels)
        low, high = axes.get_ylim()
        assert low < 0.0
        assert high >= 0.48
    plt.close(figure)


@pytest.mark.parametrize("vary", [["planner.k=0,1,2,3"], ["world.count=4,8", "planner.k=0,1"]])
@pytest.mark.parametrize("planners", [["apf"], ["apf", "napf", "napf_guided"], list(PLANNERS)])
def test_legend_and_note_of_the_figure_keep_clear_of_each_other(vary: list[str], planners: list[str]) -> None:
    grid = points(vary)
    keys, each = list(grid[0].settings), len(planners)
    risk = np.linspace(0.02, 0.4, each * len(grid))
    columns = {key: np.repeat([point.settings[key] for point in grid], each) for key in keys} | {
        "planner": np.tile(planners, len(grid)), "runs": np.full(len(risk), 10_000_000),
        "collision_risk": risk, "collision_risk_low": 0.8 * risk, "collision_risk_high": 1.2 * risk,
    }  # fmt: skip
    with house_style():
        figure = sweep_figure(columns, keys)
        renderer: Any = FigureCanvasAgg(figure).get_renderer()
        figure.draw(renderer)
        (legend,), (note,) = figure.legends, figure.texts
        boxes = [legend.get_window_extent(renderer), note.get_window_extent(renderer)]
    frames = [axes.get_tightbbox(renderer) for axes in figure.axes]
    assert not boxes[0].overlaps(boxes[1])
    assert not any(box.overlaps(frame) for box in boxes for frame in frames)
    for box in boxes:
        assert box.x0 >= 0.0
        assert box.x1 <= figure.bbox.x1
        assert box.y1 <= figure.bbox.y1


def test_the_sensitivity_table_of_the_documents_is_a_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sensitivity, "SCENES", {"balls": ("table1_8", BRIEF)})
    monkeypatch.setattr(
        sensitivity,
        "PLANNERS",
        {"APF": ("apf", []), "k = 1": ("napf", ["planner.k=1"]), "k = 3": ("napf", [])},
    )
    lines = sensitivity.table(4, 3, tmp_path, 1).splitlines()
    assert lines[0] == "| scene and errors | APF | k = 1 | k = 3 |"
    cells = lines[2].strip("|").split("|")
    assert cells[0].strip() == "balls"
    alone = run_campaign(
        load_problem("table1_8", [*BRIEF, "planner.k=1"]), ["napf"], 4, 3, tmp_path / "alone"
    )
    part = alone["planners"]["napf"]
    assert cells[2].split()[0] == f"{100 * part['collision_risk']:.1f}"


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    words = ["sweep", "table1_8", "--vary", "planner.k=1,3", "--planners", "apf,napf", "--runs", "3"]
    words += ["--workers", "1", "--out", str(out)]
    for line in BRIEF:
        words += ["--set", line]
    assert run_command(words) == 0
    assert "planner.k" in capsys.readouterr().out
    assert {"sweep.md", "sweep.csv", "sweep.parquet", "sweep.png", "sweep.svg"} <= {
        p.name for p in out.iterdir()
    }
    assert run_command([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [row["planner.k"] for row in found["points"]] == ["1", "1", "3", "3"]
