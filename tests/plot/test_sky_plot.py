"""Figures of emulated receivers: every satellite is on the sky, buildings and lanes are on the map."""

from pathlib import Path

import numpy as np

from napf_mpc.closed_loop import build_scenario
from napf_mpc.navigation.gnss_fixes import GnssErrors
from napf_mpc.navigation.sky import elevation_rad
from napf_mpc.plot.sky import dop_map_figure, gnss_figures, sigma_map_figure, sky_figure
from napf_mpc.problem_file import load_problem


def test_the_sky_shows_each_satellite_where_it_stands() -> None:
    problem = load_problem("street_canyon_gnss")
    errors = build_scenario(problem, 3, range(1)).errors
    assert isinstance(errors, GnssErrors)
    figure = sky_figure(problem, errors.scene, [np.array([60.0, 34.6, 20.0])], ["here"])
    (axes,) = figure.axes
    height = np.degrees(elevation_rad(errors.scene.directions(0.0)[0]))
    shown = sorted(90.0 - float(line.get_ydata()[0]) for line in axes.lines if len(line.get_ydata()) == 1)  # type: ignore[arg-type, index]
    np.testing.assert_allclose(shown, np.sort(height[height >= 10.0]))
    colours = {line.get_color() for line in axes.lines if len(line.get_ydata()) == 1}  # type: ignore[arg-type]
    assert len(colours) >= 2  # some in sight, some not


def test_the_map_shows_what_reaches_above_its_height() -> None:
    problem = load_problem("street_canyon_gnss")
    errors = build_scenario(problem, 3, range(1)).errors
    assert isinstance(errors, GnssErrors)
    tall = int((errors.scene.obstacles.boxes[1][:, 2] > 40.0).sum())
    figure = dop_map_figure(problem, errors.scene, 40.0, cells=24)
    left = figure.axes[0]
    assert len(left.patches) == tall > 0
    assert len(left.lines) == problem.uav_count
    assert "2023-07-1" in figure.texts[-1].get_text()


def test_the_sigma_map_has_a_panel_a_slice_with_the_houses_that_reach_above_it() -> None:
    problem = load_problem("street_canyon_gnss")
    errors = build_scenario(problem, 3, range(1)).errors
    assert isinstance(errors, GnssErrors)
    figure = sigma_map_figure(problem, errors.scene)
    *panels, bar = figure.axes
    tops = errors.scene.obstacles.boxes[1][:, 2]
    assert [panel.get_title() for panel in panels] == [f"{h} m above ground" for h in (10, 20, 30, 40)]
    assert [len(panel.patches) for panel in panels] == [int((tops > h).sum()) for h in (10, 20, 30, 40)]
    # The houses stand beside the street: in the path's own frame none covers the middle.
    for patch in panels[1].patches:
        if len(patch.get_path().vertices) > 5:
            continue  # a mast
        corners = patch.get_path().transformed(patch.get_patch_transform() + patch.get_data_transform())
        inside = panels[1].transData.inverted().transform(corners.vertices)
        assert (np.abs(inside[:, 1]) > 13.0).all()
    assert "sigma" in bar.get_ylabel()


def test_files_are_written_and_other_problems_get_none(tmp_path: Path) -> None:
    written = gnss_figures(load_problem("street_canyon_gnss"), "street", 1, tmp_path)
    assert {path.name for path in written} == {
        "street_sky.png",
        "street_sky.svg",
        "street_dop.png",
        "street_dop.svg",
    }
    assert all(path.stat().st_size > 10_000 for path in written)
    assert gnss_figures(load_problem("table1_8"), "table", 1, tmp_path) == []
