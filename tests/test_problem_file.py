"""Whatever a problem file holds: a valid problem, or every fault with key path, value and what is allowed."""

import copy
import json
import math
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from napf_mpc.errors import ProblemError
from napf_mpc.problem import City, FormationMission, GaussMarkov, ObstacleList, Planner, Problem, Recorded
from napf_mpc.problem_file import load_problem, problem_schema
from napf_mpc.shipped import shipped_problems

SCHEMA_FILE = Path(__file__).parents[1] / "docs" / "problem.schema.json"
SHIPPED = shipped_problems()
NAMES = {
    "potential_surface", "single_uav", "square_8", "square_40", "street_canyon", "nishi_shinjuku",
    "table1_8", "table1_40", "table1_8c", "table1_40c", "study_8s", "study_40s", "study_8c", "study_40c",
    "crossing_traffic", "street_canyon_gnss", "nishi_shinjuku_gnss", "nagoya_replay", "berlin_replay",
}  # fmt: skip
SMALL = """
[formation]
shape = "square"
[mission]
length_m = 50.0
[world]
kind = "list"
obstacles = [
    { shape = "sphere", centre_m = [10, 0, 0], radius_m = 1.0 },
    { shape = "cylinder", centre_m = [20, 0], radius_m = 1.0 },
]
"""


def faults_of(tmp_path: Path, text: str, *settings: str) -> list[str]:
    """Give the lines of the error that a file must raise."""
    file = tmp_path / "problem.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ProblemError) as caught:
        load_problem(file, settings)
    assert "pydantic" not in str(caught.value)
    assert "Value error" not in str(caught.value)
    assert "Input should" not in str(caught.value)
    return caught.value.problems


def load(tmp_path: Path, text: str, *settings: str) -> Problem:
    file = tmp_path / "problem.toml"
    file.write_text(text, encoding="utf-8")
    return load_problem(file, settings)


# ---------------------------------------------------------------------------------- shipped problems


def test_every_promised_problem_is_shipped_and_valid() -> None:
    assert set(SHIPPED) == NAMES
    for name, path in SHIPPED.items():
        problem = load_problem(name)
        assert problem == load_problem(path) == load_problem(f"{name}.toml")
        assert 10 < len(problem.title) <= 110
        assert problem.source


@pytest.mark.parametrize("name", sorted(n for n in NAMES if n.startswith("table1")))
def test_table1_problems_are_the_canonical_scenes(name: str) -> None:
    problem = load_problem(name)
    mission, world, navigation = problem.mission, problem.world, problem.navigation
    assert isinstance(mission, FormationMission)
    assert isinstance(navigation, GaussMarkov)
    assert (mission.length_m, mission.speed_mps, problem.simulation.time_limit_s) == (130.0, 2.0, 110.0)
    assert mission.initial_positions_m == ((0, -1, 0), (1, 1, 1), (2, -1, 0), (0, 2, 0))
    assert mission.initial_velocities_mps == ((0, 0, 0), (1, 1, 1), (2, 2, 0), (1, 0, 1))
    assert (problem.vehicle.radius_m, problem.planner.k, problem.planner.sigma) == (0.0, 1.7, "rms")
    assert (problem.planner.kind, problem.planner.inflation) == ("napf", "shift")
    assert (problem.planner.influence_m, problem.planner.repulsive_gain) == (3.0, 15.0)
    assert (navigation.sigma_min_m, navigation.sigma_max_m, navigation.filter) == (1.0, 5.0, "none")
    assert navigation.correlation_time_s == 10.0
    assert world.kind == ("scatter" if "40" in name else "lanes")
    assert world.count == (40 if "40" in name else 8)
    assert world.shape == ("cylinder" if name.endswith("c") else "sphere")
    assert world.along_range_m == ((20.0, 110.0) if "40" in name else (20.0, 100.0))


@pytest.mark.parametrize(("study", "table"), [("8s", "8"), ("40s", "40"), ("8c", "8c"), ("40c", "40c")])
def test_studies_are_the_same_scenes_with_a_size_and_the_default_margin(study: str, table: str) -> None:
    problem, reference = load_problem(f"study_{study}"), load_problem(f"table1_{table}")
    assert problem.world == reference.world
    assert problem.navigation == reference.navigation
    assert problem.formation == reference.formation
    assert isinstance(problem.mission, FormationMission)
    assert problem.mission.length_m == 150.0
    assert (problem.vehicle.radius_m, problem.planner.k, problem.planner.sigma) == (0.3, 3.0, "directional")


@pytest.mark.parametrize("count", [8, 40])
def test_fixed_scenes_are_like_the_random_ones(count: int) -> None:
    world = load_problem(f"square_{count}").world
    assert isinstance(world, ObstacleList)
    assert len(world.obstacles) == count
    centres = np.array([ball.centre_m for ball in world.obstacles])
    radii = np.array([ball.radius_m for ball in world.obstacles])
    assert np.all((radii >= 0.5) & (radii <= 2.0))
    if count == 8:
        lanes = np.array([3.0, -3.0, -6.403, 6.403])
        assert np.all(np.abs(centres[:, 1, None] - lanes).min(axis=1) <= 1.0)
        assert sorted((centres[:, 0] - 20.0) // 10.0) == list(range(8))
    apart = np.hypot(*(centres[:, None, :2] - centres[None, :, :2]).T) - radii - radii[:, None]
    assert apart[~np.eye(count, dtype=bool)].min() >= 2.0


def test_real_city_names_its_data_and_credits() -> None:
    problem = load_problem("nishi_shinjuku")
    assert isinstance(problem.world, City)
    assert isinstance(problem.navigation, Recorded)
    assert isinstance(problem.mission, FormationMission)
    assert problem.world.file == "city_tokyo_nishi_shinjuku/buildings.geojson"
    assert problem.navigation.file == "gnss_nagoya_spp/nav_error_enu_1Hz.csv"
    for words in ("PLATEAU", "indigo-lab/plateau-tokyo23ku-building-mvt-2020", "CC BY 4.0", "changed"):
        assert words in problem.world.credit
    for words in ("car at street level", "Suzuki", "MatRTKLIB", "MIT"):
        assert words in problem.navigation.credit
    assert 60.0 <= problem.mission.start_m[2] <= 120.0
    assert problem.navigation.vertical == "barometer"


# -------------------------------------------------------------------------------------------- schema


def test_schema_in_the_docs_is_current() -> None:
    # To renew it: print(json.dumps(problem_schema(), indent=2))
    assert json.loads(SCHEMA_FILE.read_text(encoding="utf-8")) == problem_schema()


@pytest.mark.parametrize("name", sorted(NAMES))
def test_shipped_problems_agree_with_the_schema(name: str) -> None:
    validator = jsonschema.Draft202012Validator(problem_schema())
    data = tomllib.loads(SHIPPED[name].read_text(encoding="utf-8"))
    assert [error.message for error in validator.iter_errors(data)] == []
    data["mission"]["sped_mps"] = 2.0
    assert not validator.is_valid(data)


# ------------------------------------------------------------------------------------------ defaults


def test_sections_without_a_kind_are_formation_and_gauss_markov(tmp_path: Path) -> None:
    problem = load(tmp_path, SMALL + "[navigation]\nsigma_max_m = 2\n")
    assert isinstance(problem.mission, FormationMission)
    assert isinstance(problem.navigation, GaussMarkov)
    assert problem.navigation.sigma_max_m == 2.0


def test_byte_order_mark_and_windows_line_ends_are_read(tmp_path: Path) -> None:
    file = tmp_path / "windows.toml"
    file.write_bytes(b"\xef\xbb\xbf" + SMALL.replace("\n", "\r\n").encode())
    assert load_problem(file) == load(tmp_path, SMALL)


# -------------------------------------------------------------------------------------------- faults


WORLDS = '"empty", "list", "lanes", "scatter", "forest", "street_canyon" or "city"'
SHAPES = '"sphere", "cylinder", "box" or "prism"'
REFERENCE = "{ source = 'a', runs = 3, collision_risk = "
PLANNERS = '"apf", "napf", "napf_guided", "qp" or "qp_unguided"'
ERRORS = '"gauss_markov", "constant", "recorded" or "gnss"'


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("world.obstacles[0].radius_m", "-1.0", " = -1.0: must be >= 0.01 and <= 100000"),
        ("world.obstacles[1].radius_m", "nan", " = nan: must be a finite number >= 0.01 and <= 100000"),
        ("mission.speed_mps", "fast", ' = "fast": must be a number >= 0.05 and <= 50'),
        ("mission.speed_mps", "true", " = true: must be a number >= 0.05 and <= 50"),
        ("mission.speed_mps", "2020-01-01", " = 2020-01-01: must be a number >= 0.05 and <= 50"),
        ("mission.sped_mps", "3", ": unknown key; did you mean mission.speed_mps?"),
        ("vehicle.mass", "1", ": unknown key; did you mean vehicle.mass_kg?"),
        ("formaton", "1", ": unknown key; did you mean formation?"),
        ("k", "3", ": unknown key; did you mean planner.k?"),
        ("world.kind", "lane", f' = "lane": must be {WORLDS}; did you mean lanes?'),
        ("world.obstacles[0].shape", "ball", f' = "ball": must be {SHAPES}'),
        ("world.obstacles[1]", "{}", f".shape: missing; must be {SHAPES}"),
        ("world.obstacles[1]", "4", f" = 4: must be a table with shape = {SHAPES}"),
        ("navigation.kind", "gns", f' = "gns": must be {ERRORS}; did you mean gnss?'),
        (
            "navigation",
            "{kind = 'gnss', start_gps_time = 'noon'}",
            '.start_gps_time = "noon": must be GPS time',
        ),
        ("navigation", "{kind = 'gnss', common_mode_share = 0.5}", ": common_mode_share must be left out"),
        ("navigation", "{kind = 'gnss', systems = ['QZSS']}", ": systems: QZSS is in files only"),
        (
            "navigation",
            "{kind = 'gnss', origin_latitude_deg = 1}",
            ": origin_latitude_deg and origin_longitude",
        ),
        ("planner.kind", "nafp", f' = "nafp": must be {PLANNERS}; did you mean napf?'),
        ("planner.confidence", "1.0", " = 1.0: must be > 0 and < 1"),
        (
            "vehicle.lqr_q_diagonal",
            "[1, 2]",
            ": must be a list of 12 entries, each a number >= 0 and <= 1000000",
        ),
        (
            "mission.start_m",
            "[0, 0, 0, 0]",
            " = [0, 0, 0, 0]: must be a list of 3 entries, each a number >= -1000000",
        ),
        (
            "formation",
            "{shape = 'square', first_lane_m = 8}",
            ": first_lane_m = 8 must be <= side_m / sqrt(2)",
        ),
        ("planner", "3", " = 3: must be a table with the keys kind, rate_hz"),
        (
            "reference",
            REFERENCE + "{ apff = 0.5 } }",
            f".collision_risk.apff: unknown key; must be {PLANNERS}",
        ),
        ("reference", REFERENCE + "{ apf = 5 } }", ".collision_risk.apf = 5: must be >= 0 and <= 1"),
        ("reference", REFERENCE + "5 }", f".collision_risk = 5: must be a table with keys out of {PLANNERS}"),
        ("planner.rate_hz", "7", " = 7 must divide 50 Hz a whole number of times"),
        ("planner.rate_hz", "100", "which is simulation.controller_rate_hz (take 50, or change both)"),
        (
            "mission.length_m",
            "0x" + "f" * 9000,
            " = an integer of more than 60 digits: must be >= 1 and <= 100000",
        ),
        ("world.kind", "0x" + "f" * 9000, f" = an integer of more than 60 digits: must be {WORLDS}"),
        ("mission.initial_positions_m", "[[0, 0, 0]]", " has 1 rows, the formation has 4 UAVs"),
    ],
)
def test_each_fault_names_key_value_and_what_is_allowed(
    tmp_path: Path, key: str, value: str, says: str
) -> None:
    faults = faults_of(tmp_path, SMALL, f"{key}={value}")
    assert len(faults) == 1
    assert faults[0].startswith(key)
    assert says in faults[0]


def test_a_table_with_many_keys_lists_some_and_says_where_the_others_stand(tmp_path: Path) -> None:
    (fault,) = faults_of(tmp_path, SMALL, "planner=3")
    listed, _, rest = fault.partition("with the keys ")[2].partition(" and ")
    keys = list(Planner.model_fields)
    assert listed.split(", ") == keys[:12]
    assert rest == f"{len(keys) - 12} others (napf-mpc problems --schema)"


def test_missing_keys_say_what_they_must_be(tmp_path: Path) -> None:
    assert faults_of(tmp_path, "[mission]\n") == [
        'formation: missing; must be a table with shape = "square", "line", "v", "circle" or "list"',
        "mission.length_m: missing; must be a number >= 1 and <= 100000",
        'world: missing; must be a table with kind = "empty", "list", "lanes", "scatter", "forest", '
        '"street_canyon" or "city"',
    ]


def test_all_faults_are_told_at_once(tmp_path: Path) -> None:
    settings = ["vehicle.mass_kg=0", "mission.length_m=x", "world.obstacles[1].radius_m=inf", "planer.k=1",
                "navigation.sigma_max_m=-1", "simulation.step_s=1"]  # fmt: skip
    faults = faults_of(tmp_path, SMALL, *settings)
    assert len(faults) == len(settings)
    for setting in settings:
        assert any(line.startswith(setting.partition("=")[0].partition(".")[0]) for line in faults)


def test_key_of_another_kind_is_unknown_and_says_so(tmp_path: Path) -> None:
    faults = faults_of(tmp_path, SMALL, "world.kind=lanes")
    assert len(faults) == 1
    assert faults[0].startswith('world.obstacles: unknown key of kind = "lanes" (another kind has it); ')


def test_thousands_of_faults_are_cut_and_counted(tmp_path: Path) -> None:
    balls = ", ".join(['{ shape = "sphere", centre_m = [0, 0, 0], radius_m = -1 }'] * 1000)
    faults = faults_of(tmp_path, SMALL, f"world.obstacles=[{balls}]")
    assert len(faults) == 201
    assert faults[-1] == "... and 800 more faults"


def test_terminal_control_characters_are_not_passed_on(tmp_path: Path) -> None:
    faults = faults_of(tmp_path, SMALL, r'planner.kind="\u001b[31m\u202e"', r'planner."\u001bx"=1')
    assert not any(char in "\n".join(faults) for char in "\x1b\u202e")
    text = SMALL + '["\\u001b[2J"]\n'
    assert "\x1b" not in "\n".join(faults_of(tmp_path, text))


# ------------------------------------------------------------------------------------ unreadable files


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\xff\xfe\x00", "not UTF-8 text (line 1)"),
        (b"a = 1\nb = \xe9\n", "not UTF-8 text (line 2)"),
        (b"a = ", "not TOML"),
        (b"a = 1\na = 2", "not TOML"),
        (b"a = " + b"9" * 5000, "not TOML"),
        (b"a = " + b"[" * 100_000, "nested too deeply"),
        (b"a" + b".a" * 30 + b" = 1", "nested deeper than 20 levels"),
        (b"a" + b".a" * 1_000_000 + b" = 1", "a key of more than 50 parts"),
        (b'["#="' + b'."#="' * 1_000_000 + b"]", "a key of more than 50 parts"),
        (b"# " + b"x" * 10_000_000, "larger than 10 MB"),
        (b"", "formation: missing"),
    ],
)
def test_files_that_are_no_problem(tmp_path: Path, content: bytes, words: str) -> None:
    file = tmp_path / "odd.toml"
    file.write_bytes(content)
    with pytest.raises(ProblemError) as caught:
        load_problem(file)
    assert words in str(caught.value)
    assert str(file) in str(caught.value)


def test_folders_and_missing_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ProblemError, match="is a folder"):
        load_problem(tmp_path)
    with pytest.raises(ProblemError, match=r"no such file.*did you mean table1_8"):
        load_problem("tabel1_8")
    with pytest.raises(
        ProblemError,
        match=r"no such file.*shipped problems: berlin_replay, crossing_traffic, nagoya_replay, nishi_",
    ):
        load_problem("zzz")
    for odd in ("", "a\0b", "x" * 5000, "\x1b[2J"):
        with pytest.raises(ProblemError) as caught:
            load_problem(odd)
        assert "\x1b" not in str(caught.value)
    # A folder of results named like a problem does not hide the problem; a file does.
    monkeypatch.chdir(tmp_path)
    (tmp_path / "table1_8").mkdir()
    assert load_problem("table1_8") == load_problem(SHIPPED["table1_8"])
    (tmp_path / "table1_40.toml").write_text(SMALL)
    assert load_problem("table1_40.toml").uav_count == 4
    assert load_problem("table1_40.toml") != load_problem("table1_40")


# ------------------------------------------------------------------------------------------ mutations

WRONG: list[Any] = [
    math.nan, math.inf, -math.inf, -1, -1.0, 0, 1e308, 10**400, "x", "", "é\x1b", True, None,
    {}, [], [[]], [1e308] * 3, {"shape": "sphere"}, {"kind": []}, {"kind": 1 << 20_000},
]  # fmt: skip


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every place in the tables, containers included."""
    if path:
        yield path
    entries = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    )
    for key, entry in entries:
        yield from leaves(entry, (*path, key))


def mutated(data: dict[str, Any], path: tuple[Any, ...], how: Any) -> dict[str, Any]:
    """Copy with one place made wrong: another value, taken out, or its key misspelt."""
    data = copy.deepcopy(data)
    here: Any = data
    for step in path[:-1]:
        here = here[step]
    if how == "missing":
        del here[path[-1]]
    elif how == "misspelt" and isinstance(here, dict):
        here[f"{path[-1]}_x"] = here.pop(path[-1])
    else:
        here[path[-1]] = copy.deepcopy(how)
    return data


def attempt(file: str | Path, settings: Any) -> tuple[Problem | None, list[str]]:
    """Load; the problem or its faults, and nothing else may come."""
    try:
        return load_problem(file, settings), []
    except ProblemError as error:
        return None, error.problems


def check_outcome(data: dict[str, Any]) -> bool:
    """Whether the tables validate; if not, each fault is one printable, short line."""
    problem, faults = attempt(EMPTY, data)
    assert (problem is None) == bool(faults)
    for line in faults:
        assert line.isprintable()
        assert len(line) < 600
        assert not any(jargon in line for jargon in ("pydantic", "Input should", "Value error"))
    if problem is not None:
        assert all(math.isfinite(x) for x in numbers(problem.model_dump()))
    return problem is not None


def numbers(value: Any) -> Iterator[float]:
    """Every number in a dump."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, (list, tuple)):
        for entry in value:
            yield from numbers(entry)
    elif isinstance(value, (int, float)):
        yield value


EMPTY = Path(__file__).parent / "no_problem.toml"


@pytest.fixture(autouse=True, scope="module")
def _empty_file(tmp_path_factory: pytest.TempPathFactory) -> None:
    global EMPTY
    EMPTY = tmp_path_factory.mktemp("empty") / "empty.toml"
    EMPTY.write_text("")


def every_mutation() -> list[tuple[str, tuple[Any, ...], Any]]:
    places = []
    for name in sorted(SHIPPED):
        data = tomllib.loads(SHIPPED[name].read_text(encoding="utf-8"))
        places += [(name, path, how) for path in leaves(data) for how in [*WRONG, "missing", "misspelt"]]
    return places


def test_mutated_problems_are_refused_in_words_or_valid() -> None:
    mutations = every_mutation()
    chosen = np.random.default_rng(0).choice(len(mutations), size=1500, replace=False)
    files = {name: tomllib.loads(path.read_text(encoding="utf-8")) for name, path in SHIPPED.items()}
    valid = sum(
        check_outcome(mutated(files[name], path, how))
        for name, path, how in map(mutations.__getitem__, chosen)
    )
    assert (
        0.05 < valid / 1500 < 0.5
    )  # most wrong values are refused; some, such as 0 for a coordinate, are right


words = st.text(max_size=8) | st.sampled_from(["square", "list", "lanes", "goal"])
keys = st.sampled_from(["kind", "shape", "count", "radius_m", "obstacles", "start_m", "k", "x"])
tables = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | words,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(keys, inner, max_size=5),
    max_leaves=12,
)


@given(
    st.dictionaries(
        st.sampled_from(
            ["title", "vehicle", "formation", "mission", "world", "navigation", "planner", "odd"]
        ),
        tables,
    )
)
def test_any_tables_at_all(data: dict[str, Any]) -> None:
    check_outcome(data)


@given(st.text(max_size=60), st.text(max_size=20))
def test_any_settings_at_all(key: str, value: str) -> None:
    for settings in ([f"{key}={value}"], [key], {key: value}, [f"planner.{key}={value}"]):
        _, faults = attempt("table1_8", settings)
        assert all(line.isprintable() for line in faults)


@given(st.binary(max_size=200))
def test_any_bytes_at_all(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    file = tmp_path_factory.getbasetemp() / "bytes.toml"
    file.write_bytes(content)
    with pytest.raises(ProblemError):
        load_problem(file)
