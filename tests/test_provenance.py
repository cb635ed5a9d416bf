"""What decides a result is part of its identity, and nothing else is."""

import hashlib
from pathlib import Path

import pytest

from napf_mpc import provenance
from napf_mpc.errors import DataError
from napf_mpc.problem_file import load_problem


def test_versions_name_what_decides_a_result() -> None:
    versions = provenance.versions()
    assert {"python", "napf-mpc", "numpy", "scipy", "numba", "casadi", "pyarrow", "code"} == set(versions)
    assert all(versions.values())
    assert versions["code"] == provenance._code_digest()[:16]


def test_the_code_counts_but_not_what_only_shows_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "plot").mkdir()
    for name in ("provenance.py", "apf.py", "cli.py", "plot/style.py"):
        (tmp_path / name).write_text("x = 1\n")
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "provenance.py"))
    before = provenance._code_digest()
    for name in ("cli.py", "plot/style.py", "plot/new.py"):
        (tmp_path / name).write_text("x = 2\n")
    assert provenance._code_digest() == before
    (tmp_path / "apf.py").write_text("x = 2\n")
    assert provenance._code_digest() != before


def test_every_module_that_shows_is_there_under_its_name() -> None:
    package = Path(provenance.__file__).parent
    assert all((package / name).exists() for name in provenance._SHOWING)


def test_data_files_are_those_that_the_problem_names() -> None:
    assert provenance.data_files(load_problem("table1_8")) == []
    assert provenance.data_files(load_problem("nishi_shinjuku")) == [
        "city_tokyo_nishi_shinjuku/buildings.geojson",
        "gnss_nagoya_spp/nav_error_enu_1Hz.csv",
    ]
    assert provenance.data_files(load_problem("nishi_shinjuku_gnss"))[1:] == ["gnss_nagoya_spp/broadcast.nav"]
    assert provenance.data_files(load_problem("street_canyon_gnss")) == []
    against_truth = {"navigation": {"kind": "recorded", "file": "a.pos", "truth_file": "b.pos"}}
    assert provenance.data_files(load_problem("table1_8", against_truth)) == ["a.pos", "b.pos"]


def test_data_count_by_their_content(tmp_path: Path) -> None:
    problem = load_problem("table1_8", {"navigation": {"kind": "recorded", "file": "log.csv"}})
    (tmp_path / "log.csv").write_bytes(b"anything")
    expected = hashlib.sha256(b"anything").hexdigest()
    assert provenance.data_digests(problem, tmp_path) == {"log.csv": expected}
    (tmp_path / "log.csv").unlink()
    with pytest.raises(DataError, match=r"log\.csv"):
        provenance.data_digests(problem, tmp_path)


def test_identity_does_not_depend_on_words() -> None:
    a = provenance.identity(load_problem("table1_8"), "a", ["apf"], 3)
    b = provenance.identity(load_problem("table1_8", ["title=another"]), "b", ("apf",), 3)
    assert provenance.differences(a, b) == []
    c = provenance.identity(load_problem("table1_8", ["mission.speed_mps=2.1"]), "a", ["apf"], 3)
    (line,) = provenance.differences(a, c)
    assert line == f"problem_hash = {a['problem_hash']}, not {c['problem_hash']}"


def test_differences_name_each_entry_with_both_values() -> None:
    held = {"seed": 7, "planners": ["apf", "napf"], "versions": {"code": "aa", "numpy": "2"}, "run": 3}
    ours = {"seed": 8, "planners": ["apf"], "versions": {"code": "bb", "numpy": "2"}, "data": {"f": "x"}}
    assert provenance.differences(held, ours) == [
        "seed = 7, not 8",
        "planners = apf,napf, not apf",
        "versions.code = aa, not bb",
        "data = none, not {'f': 'x'}",
        "run = 3, not none",
    ]
