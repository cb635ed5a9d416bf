"""Data files are found under the data folder and nowhere else."""

from pathlib import Path

import pytest

from napf_mpc.data_folder import find_data_file
from napf_mpc.errors import DataError

LOG = "gnss_nagoya_spp/nav_error_enu_1Hz.csv"
CITY = "city_tokyo_nishi_shinjuku/buildings.geojson"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give a data folder with one log, in a current folder without any."""
    monkeypatch.delenv("NAPF_MPC_DATA", raising=False)
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.chdir(home)
    file = tmp_path / "data" / LOG
    file.parent.mkdir(parents=True)
    file.write_text("t_s\n")
    return tmp_path / "data"


def test_given_folder_goes_before_variable_and_current_folder(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for other in ("variable", "home/data"):
        (tmp_path / other / "gnss_nagoya_spp").mkdir(parents=True)
        (tmp_path / other / LOG).write_text(other)
    assert find_data_file(LOG, None) == (tmp_path / "home/data" / LOG).resolve()
    monkeypatch.setenv("NAPF_MPC_DATA", str(tmp_path / "variable"))
    assert find_data_file(LOG, None) == (tmp_path / "variable" / LOG).resolve()
    assert find_data_file(LOG, folder) == (folder / LOG).resolve()


@pytest.mark.parametrize(
    ("name", "home"),
    [
        (CITY, "indigo-lab/plateau-tokyo23ku-building-mvt-2020"),
        ("gnss_nagoya_spp/rover_1Hz_spp.pos", "taroz/MatRTKLIB"),
        ("city_delft_cityjson/delft.city.json", "cityjson/cjio"),
    ],
)
def test_missing_file_names_place_way_out_and_public_home(folder: Path, name: str, home: str) -> None:
    with pytest.raises(DataError) as caught:
        find_data_file(name, folder)
    message = str(caught.value)
    for part in (name, str(folder), "--data DIR", "NAPF_MPC_DATA", home):
        assert part in message
    with pytest.raises(DataError, match=r"looked for in data .*no such folder"):
        find_data_file(name, None)


def test_a_data_folder_that_is_none_is_an_error(folder: Path) -> None:
    for wrong in (folder / "nowhere", folder / LOG):
        with pytest.raises(DataError, match="is not a folder"):
            find_data_file(LOG, wrong)


@pytest.mark.parametrize(
    "name",
    [
        "/etc/passwd",
        "../data/" + LOG,
        "gnss_nagoya_spp/../../secret",
        "gnss_nagoya_spp/..",
        "..",
        "..\\secret",
        "\\secret",
        "C:/secret",
        "c:secret",
        "~/secret",
        "",
        "  ",
        "a\0b",
        "x" * 5000,
        "gnss_nagoya_spp",
        ".",
        "\x1b[31m",
    ],
)
def test_names_that_are_no_path_inside_are_refused(folder: Path, name: str) -> None:
    (folder.parent / "secret").write_text("secret")
    with pytest.raises(DataError) as caught:
        find_data_file(name, folder)
    assert "\x1b" not in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_a_link_out_of_the_folder_is_refused_and_one_inside_is_followed(folder: Path) -> None:
    (folder.parent / "secret").write_text("secret")
    (folder / "out").symlink_to(folder.parent / "secret")
    (folder / "inside").symlink_to(folder / LOG)
    (folder / "loop").symlink_to(folder / "loop")
    with pytest.raises(DataError, match=r'^data file "out" leads out of the data folder .*; copy it there$'):
        find_data_file("out", folder)
    assert find_data_file("inside", folder) == (folder / LOG).resolve()
    with pytest.raises(DataError):
        find_data_file("loop", folder)


def test_real_data_is_found(data_folder: Path) -> None:
    for name in (LOG, CITY, "city_delft_cityjson/delft.city.json"):
        assert find_data_file(name, data_folder).is_file()
