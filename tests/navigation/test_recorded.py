"""Readers of measured logs: what they make of good files, and that bad ones end in a DataError."""

import contextlib
import gzip
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from napf_mpc.errors import DataError
from napf_mpc.navigation.recorded import (
    ErrorLog,
    coverage,
    errors_against_truth,
    read_error_log_csv,
    read_rtklib_pos,
)

CSV_HEAD = (
    "t_s,available,err_e_m,err_n_m,err_u_m,cov_ee_m2,cov_en_m2,cov_eu_m2,cov_nn_m2,cov_nu_m2,cov_uu_m2,nsat"
)
CSV_ROWS = [
    "0.0,1,1.0,-2.0,3.0,4.0,0.5,-0.25,9.0,1.5,16.0,12",
    "1.0,0,,,,,,,,,,",
    "2.0,1,-4.0,5.0,-6.0,1.0,0.0,0.0,1.0,0.0,1.0,9",
    "3.0,1,0.5,0.5,0.5,1.0,0.1,0.0,1.0,0.0,1.0,9",
]
POS_HEAD = [
    "% program   : RTKLIB ver.2.4.3",
    "% pos mode  : Single",
    "%",
    "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)",
    "%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)"
    "  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio",
]


def pos_row(clock: str, lat: float, lon: float, up: float, sds: str, date: str = "2023/07/11") -> str:
    return f"{date} {clock}   {lat:.9f}  {lon:.9f}  {up:9.4f}   5  12   {sds}   0.00    0.0"


SDS = "3.0 2.0 5.0 1.0 -1.5 0.5"
NONE = "0.0000 0.0000 0.0000 0.0000 0.0000 0.0000"
LAT, LON = 35.0, 137.0


def write(folder: Path, name: str, lines: list[str]) -> Path:
    path = folder / name
    path.write_text("\n".join(lines) + "\n")
    return path


def csv_file(folder: Path, rows: list[str], head: str = CSV_HEAD) -> Path:
    return write(folder, "log.csv", [head, *rows])


def log(error: np.ndarray, sigma: float = 1.0) -> ErrorLog:
    n = len(error)
    return ErrorLog(
        "made up",
        np.arange(n, dtype=float),
        np.ones(n, dtype=bool),
        error,
        np.tile(sigma**2 * np.eye(3), (n, 1, 1)),
    )


# ------------------------------------------------------------------------------------------------ CSV


def test_csv_gives_errors_and_full_covariance(tmp_path: Path):
    read = read_error_log_csv(csv_file(tmp_path, CSV_ROWS))
    np.testing.assert_array_equal(read.time_s, [0.0, 1.0, 2.0, 3.0])
    np.testing.assert_array_equal(read.available, [True, False, True, True])
    np.testing.assert_array_equal(read.error[0], [1.0, -2.0, 3.0])
    np.testing.assert_array_equal(
        read.covariance[0], [[4.0, 0.5, -0.25], [0.5, 9.0, 1.5], [-0.25, 1.5, 16.0]]
    )
    np.testing.assert_array_equal(read.error[1], 0.0)
    np.testing.assert_array_equal(read.covariance[1], 0.0)


def test_csv_columns_may_stand_in_any_order_and_others_are_left_alone(tmp_path: Path):
    order = [11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0]
    shuffled = [",".join(line.split(",")[i] for i in order) for line in (CSV_HEAD, *CSV_ROWS)]
    windows = tmp_path / "windows.csv"
    windows.write_bytes(b"\xef\xbb\xbf" + "\r\n".join([*shuffled, "", ""]).encode())
    a, b = read_error_log_csv(windows), read_error_log_csv(csv_file(tmp_path, CSV_ROWS))
    np.testing.assert_array_equal(a.error, b.error)
    np.testing.assert_array_equal(a.covariance, b.covariance)


def test_csv_fields_may_stand_in_quotes(tmp_path: Path):
    """As R and many tables write them; a comma inside quotes is no separator."""
    head = ",".join(f'"{name}"' for name in [*CSV_HEAD.split(","), "where"])
    rows = [f'{row}, "Nagoya, ""main"" station"' for row in CSV_ROWS]
    path = tmp_path / "quoted.csv"
    path.write_text("\n".join([head, *rows]), encoding="utf-8")
    a, b = read_error_log_csv(path), read_error_log_csv(csv_file(tmp_path, CSV_ROWS))
    np.testing.assert_array_equal(a.error, b.error)
    np.testing.assert_array_equal(a.covariance, b.covariance)


BAD_CSV = {
    "column twice": (
        "\n".join([f"{CSV_HEAD},err_e_m", *(f"{row},7.0" for row in CSV_ROWS)]),
        "line 1: column err_e_m is there 2 times; keep one",
    ),
    "other separator": (
        "\n".join([CSV_HEAD, *CSV_ROWS]).replace(",", ";"),
        "column t_s is missing .*with commas between",
    ),
    "quote that does not end": (
        "\n".join([CSV_HEAD, CSV_ROWS[0].replace("-2.0", '"-2.0'), *CSV_ROWS[1:]]),
        "line 2: 4 fields, the header has",
    ),
    "endless quote": (
        "\n".join([CSV_HEAD, '"' + "1," * 70_000, *CSV_ROWS]),
        "line 2: 0 fields, the header has",
    ),
    "empty": ("", "column t_s is missing"),
    "header only": (CSV_HEAD, "0 epochs with a fix"),
    "one fix": ("\n".join([CSV_HEAD, *CSV_ROWS[:2]]), "1 epochs with a fix"),
    "column missing": (
        "\n".join([CSV_HEAD.replace("cov_nu_m2", "cov_xx"), *CSV_ROWS]),
        "cov_nu_m2 is missing",
    ),
    "truncated": ("\n".join([CSV_HEAD, *CSV_ROWS])[:-30], "line 5: .* fields"),
    "nan": ("\n".join([CSV_HEAD, CSV_ROWS[0].replace("-2.0", "nan"), *CSV_ROWS[1:]]), "line 2: err_n_m"),
    "inf": ("\n".join([CSV_HEAD, CSV_ROWS[0].replace("9.0", "inf"), *CSV_ROWS[1:]]), "line 2: cov_nn_m2"),
    "text": (
        "\n".join([CSV_HEAD, *CSV_ROWS[:3], CSV_ROWS[3].replace("0.1", "abc")]),
        "line 5: cov_en_m2 is abc",
    ),
    "empty field": ("\n".join([CSV_HEAD, CSV_ROWS[0].replace("3.0", ""), *CSV_ROWS[1:]]), "err_u_m is empty"),
    "negative variance": (
        "\n".join([CSV_HEAD, CSV_ROWS[0].replace(",4.0", ",-4.0"), *CSV_ROWS[1:]]),
        "cov_ee_m2",
    ),
    "zero variance": ("\n".join([CSV_HEAD, CSV_ROWS[0].replace("16.0", "0.0"), *CSV_ROWS[1:]]), "unknown"),
    "no covariance": (
        "\n".join([CSV_HEAD, CSV_ROWS[0].replace(",0.5", ",50.0"), *CSV_ROWS[1:]]),
        "no covariance",
    ),
    "huge": ("\n".join([CSV_HEAD, CSV_ROWS[0].replace("-2.0", "1e300"), *CSV_ROWS[1:]]), "beyond"),
    "huge time": ("\n".join([CSV_HEAD, *CSV_ROWS, CSV_ROWS[3].replace("3.0", "1e300", 1)]), "times"),
    "crowded": ("\n".join([CSV_HEAD, *CSV_ROWS, CSV_ROWS[3].replace("3.0", "3.0001", 1)]), "times"),
    "not sorted": ("\n".join([CSV_HEAD, CSV_ROWS[2], CSV_ROWS[0]]), "line 3: time 0 s is not after"),
    "twice": ("\n".join([CSV_HEAD, CSV_ROWS[2], CSV_ROWS[2]]), "line 3: time 2 s is not after"),
    "availability": ("\n".join([CSV_HEAD, CSV_ROWS[0].replace(",1,", ",yes,")]), "available is yes"),
    "zero byte": ("\n".join([CSV_HEAD, "\0"]), "line 2: not a text file"),
}


@pytest.mark.parametrize("name", BAD_CSV)
def test_bad_csv_names_file_and_place(tmp_path: Path, name: str):
    text, message = BAD_CSV[name]
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        read_error_log_csv(path)
    assert "log.csv" in str(caught.value)


@pytest.mark.parametrize("read", [read_error_log_csv, read_rtklib_pos])
def test_what_is_no_text_file_is_refused(tmp_path: Path, read):
    binary = tmp_path / "log.bin"
    binary.write_bytes(bytes(range(256)) * 40)
    for path in (binary, tmp_path, tmp_path / "missing"):
        with pytest.raises(DataError, match=path.name):
            read(path)


@pytest.mark.parametrize("read", [read_error_log_csv, read_rtklib_pos])
def test_a_folder_and_a_packed_log_are_told_apart(tmp_path: Path, read):
    packed = tmp_path / "log.csv.gz"
    packed.write_bytes(gzip.compress(CSV_HEAD.encode()))
    for path, words in (
        (packed, r"log\.csv\.gz: is packed by gzip; unpack it first"),
        (tmp_path, "cannot be read: is a folder; name a file in it"),
        (tmp_path / "missing", "missing: cannot be read: no such file"),
    ):
        with pytest.raises(DataError, match=words):
            read(path)


def test_a_name_as_text_is_read(tmp_path: Path):
    csv = csv_file(tmp_path, CSV_ROWS)
    assert read_error_log_csv(str(csv)).source == read_error_log_csv(csv).source
    pos = write(tmp_path, "log.pos", [*POS_HEAD, pos_row("06:00:00.000", LAT, LON, 10.0, SDS)])
    assert read_rtklib_pos(str(pos)).source == str(pos)


def test_no_covariance_by_rounding_only_is_repaired(tmp_path: Path):
    """Fully correlated axes, printed to four digits: the smallest eigenvalue may come out just below zero."""
    row = "{t},1,1,1,1,1.0000,1.0001,0,1.0000,0,1.0000,9"
    read = read_error_log_csv(csv_file(tmp_path, [row.format(t=0), row.format(t=1)]))
    assert np.linalg.eigvalsh(read.covariance).min() >= -1e-12
    np.testing.assert_allclose(read.covariance[0, 0, 1], 1.0, atol=1e-3)


@given(data=st.binary(max_size=400), cut=st.integers(0, 400))
def test_garbage_ends_in_a_data_error_or_a_log(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, cut: int
):
    folder = tmp_path_factory.mktemp("garbage")
    good_csv = "\n".join([CSV_HEAD, *CSV_ROWS]).encode()
    good_pos = "\n".join([*POS_HEAD, pos_row("00:00:00.000", LAT, LON, 1.0, SDS)]).encode()
    for read, good in ((read_error_log_csv, good_csv), (read_rtklib_pos, good_pos)):
        for content in (data, good[:cut] + data, good[:-cut] + data + good[-cut:]):
            path = folder / "log"
            path.write_bytes(content)
            with contextlib.suppress(DataError):
                read(path)


# ------------------------------------------------------------------------------------------- RTKLIB


def test_pos_cross_terms_are_signed_square_roots(tmp_path: Path):
    track = read_rtklib_pos(
        write(tmp_path, "a.pos", [*POS_HEAD, pos_row("06:04:30.000", LAT, LON, 39.5, SDS)])
    )
    np.testing.assert_array_equal(track.geodetic, [[LAT, LON, 39.5]])
    # sdn 3, sde 2, sdu 5, sdne 1, sdeu -1.5, sdun 0.5 in east, north, up
    np.testing.assert_allclose(
        track.covariance[0], [[4.0, 1.0, -2.25], [1.0, 9.0, 0.25], [-2.25, 0.25, 25.0]], atol=1e-12
    )


def test_date_and_week_are_the_same_time(tmp_path: Path):
    """2023-07-11 06:04:30 is second 194670 of GPS week 2270 (the same moment in the log's own truth file)."""
    row = pos_row("06:04:30.250", LAT, LON, 1.0, SDS)
    by_date = read_rtklib_pos(write(tmp_path, "a.pos", [*POS_HEAD, row]))
    week = row.replace("2023/07/11 06:04:30.250", "2270 194670.250")
    by_week = read_rtklib_pos(write(tmp_path, "b.pos", [*POS_HEAD, week]))
    assert by_date.time_s[0] == by_week.time_s[0] == 2270 * 604_800 + 194_670.25
    assert by_date.time_system == "GPST"


def enu_offsets(east: float, north: float) -> tuple[float, float]:
    """Degrees of a small step on the WGS-84 ellipsoid, from its radii of curvature at LAT."""
    a, e2 = 6_378_137.0, 6.694_379_990_141e-3
    w = 1.0 - e2 * math.sin(math.radians(LAT)) ** 2
    meridian, normal = a * (1.0 - e2) / w**1.5, a / math.sqrt(w)
    return math.degrees(north / meridian), math.degrees(east / (normal * math.cos(math.radians(LAT))))


def solution_and_truth(folder: Path, gap: bool = True) -> tuple[Path, Path]:
    """Truth at 1 Hz for 6 s; solution with a known error, no epoch at 2 s, one outside the truth's time."""
    truth = [pos_row(f"00:00:0{s}.000", LAT, LON, 10.0, NONE) for s in range(6)]
    lat, lon = enu_offsets(3.0, -4.0)
    seconds = [0, 1, 3, 4, 5, 7] if gap else range(6)
    solution = [pos_row(f"00:00:0{s}.000", LAT + lat, LON + lon, 12.5, SDS) for s in seconds]
    return write(folder, "rover.pos", [*POS_HEAD, *solution]), write(folder, "truth.pos", [*POS_HEAD, *truth])


def test_solution_minus_truth_in_east_north_up(tmp_path: Path):
    rover, truth = map(read_rtklib_pos, solution_and_truth(tmp_path))
    read = errors_against_truth(rover, truth)
    np.testing.assert_allclose(read.time_s, np.arange(6.0), atol=1e-6)
    np.testing.assert_array_equal(read.available, [True, True, False, True, True, True])
    # nine decimals of a degree are 0.1 mm
    np.testing.assert_allclose(read.error[read.available], np.tile([3.0, -4.0, 2.5], (5, 1)), atol=5e-4)
    np.testing.assert_allclose(np.sqrt(np.diag(read.covariance[0])), [2.0, 3.0, 5.0])


def test_a_denser_truth_adds_no_gaps(tmp_path: Path):
    rover, _ = solution_and_truth(tmp_path, gap=False)
    dense = [pos_row(f"00:00:0{s / 5:.3f}", LAT, LON, 10.0, NONE) for s in range(26)]
    truth = write(tmp_path, "dense.pos", [*POS_HEAD, *dense])
    read = errors_against_truth(read_rtklib_pos(rover), read_rtklib_pos(truth))
    assert read.available.all()
    np.testing.assert_allclose(read.time_s, np.arange(6.0), atol=1e-6)


def test_truth_of_another_day_or_time_system_is_refused(tmp_path: Path):
    rover, truth = solution_and_truth(tmp_path)
    other = write(tmp_path, "other.pos", [truth.read_text().replace("2023/07/11", "2023/07/12")])
    utc = write(tmp_path, "utc.pos", [truth.read_text().replace("%  GPST", "%  UTC ")])
    with pytest.raises(DataError, match="0 epochs in common"):
        errors_against_truth(read_rtklib_pos(rover), read_rtklib_pos(other))
    with pytest.raises(DataError, match="0 epochs in common"):  # 18 s later
        errors_against_truth(read_rtklib_pos(rover), read_rtklib_pos(utc))
    unknown = replace(read_rtklib_pos(truth), time_system="time of the log")
    with pytest.raises(DataError, match="GPST and in time of the log, which cannot be compared"):
        errors_against_truth(read_rtklib_pos(rover), unknown)


def test_a_truth_of_another_place_is_refused(tmp_path: Path):
    rover, truth = solution_and_truth(tmp_path)
    lines = truth.read_text().replace(f"{LAT:.9f}", f"{LAT + 0.01:.9f}").splitlines()
    elsewhere = write(tmp_path, "elsewhere.pos", lines)
    with pytest.raises(DataError, match=r"elsewhere\.pos: positions are 11\d\d m apart \(median\)"):
        errors_against_truth(read_rtklib_pos(rover), read_rtklib_pos(elsewhere))


def test_a_solution_that_reports_no_sigma_is_refused(tmp_path: Path):
    _, truth = solution_and_truth(tmp_path)
    track = read_rtklib_pos(truth)
    with pytest.raises(DataError, match="not positive"):
        errors_against_truth(track, track)


GOOD = pos_row("00:00:01.000", LAT, LON, 1.0, SDS)
BAD_POS = {
    "empty": ([], "no epochs"),
    "header only": (POS_HEAD, "no epochs"),
    "no header": ([GOOD], "line 1: no header line"),
    "column missing": ([*POS_HEAD[:-1], POS_HEAD[-1].replace("sdeu(m)", "x"), GOOD], r"sdeu\(m\) is missing"),
    "ecef": ([*POS_HEAD[:-1], "%  GPST   x-ecef(m)  y-ecef(m)", GOOD], r"z-ecef\(m\) is missing"),
    "truncated": ([*POS_HEAD, GOOD[:60]], "line 6: 5 fields"),
    "nan": ([*POS_HEAD, GOOD.replace("1.0000", "nan")], r"line 6: height\(m\) is nan"),
    "text": ([*POS_HEAD, GOOD.replace(" 2.0", " abc")], r"line 6: sde\(m\) is abc"),
    "negative sigma": ([*POS_HEAD, GOOD.replace(" 2.0", " -2.0")], r"line 6: sde\(m\) = -2"),
    "latitude": ([*POS_HEAD, GOOD.replace("35.0", "95.0")], r"latitude\(deg\) = 95"),
    "no time": ([*POS_HEAD, GOOD.replace("00:00:01.000", "25:00:01.000")], "is no time"),
    "no date": ([*POS_HEAD, GOOD.replace("2023/07/11", "2023/13/11")], "is no time"),
    "no week": ([*POS_HEAD, GOOD.replace("2023/07/11 00:00:01.000", "2270 nan")], "is no time"),
    "not sorted": ([*POS_HEAD, GOOD, GOOD.replace("35.0", "35.1")], "line 7: time .* is not after"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_POS)
def test_bad_pos_names_file_and_place(tmp_path: Path, name: str):
    lines, message = BAD_POS[name]
    with pytest.raises(DataError, match=message) as caught:
        read_rtklib_pos(write(tmp_path, "log.pos", lines))
    assert "log.pos" in str(caught.value)


# ------------------------------------------------------------------------------------------ coverage


def test_coverage_counts_per_axis_and_only_fixes():
    error = np.array([[0.0, 0.0, 0.0], [1.0, 2.5, 3.5], [-3.0, -3.1, 1.0], [0.5, 0.5, 9.0]])
    found = coverage(log(error), 3.0)
    assert found.n == 4
    assert found.share == (1.0, 0.75, 0.5)
    assert coverage(log(error, sigma=2.0), 3.0).share == (1.0, 1.0, 0.75)


def test_coverage_of_a_normal_law():
    error = np.random.default_rng(0).standard_normal((40_000, 3))
    for k in (1.0, 2.0, 3.0):
        expected = math.erf(k / math.sqrt(2.0))
        bound = 5.0 * math.sqrt(expected * (1.0 - expected) / 40_000)
        np.testing.assert_allclose(coverage(log(error), k).share, expected, atol=bound)


@pytest.mark.parametrize("k", [-1.0, math.nan, math.inf])
def test_coverage_needs_a_number_of_sigmas(k: float):
    with pytest.raises(ValueError, match="k ="):
        coverage(log(np.zeros((2, 3))), k)


def test_arrays_of_a_log_must_fit_together():
    with pytest.raises(DataError, match=r"\(n, 3, 3\)"):
        ErrorLog("x", np.arange(3.0), np.ones(3, dtype=bool), np.zeros((3, 3)), np.zeros((3, 6, 6)))


# --------------------------------------------------------------------------------------- measured data


def test_nagoya_log_is_the_same_from_both_files_and_has_its_published_figures(data_folder: Path):
    folder = data_folder / "gnss_nagoya_spp"
    derived = read_error_log_csv(folder / "nav_error_enu_1Hz.csv")
    computed = errors_against_truth(
        read_rtklib_pos(folder / "rover_1Hz_spp.pos"), read_rtklib_pos(folder / "reference_1Hz.pos")
    )
    np.testing.assert_array_equal(derived.time_s, computed.time_s)
    np.testing.assert_array_equal(derived.available, computed.available)
    np.testing.assert_allclose(derived.error, computed.error, atol=0.6e-4)  # four decimals in the CSV
    np.testing.assert_allclose(derived.covariance, computed.covariance, atol=0.6e-4)
    for one in (derived, computed):
        assert len(one.time_s) == 1231
        found = coverage(one, 3.0)
        assert found.n == 550
        np.testing.assert_allclose(found.share, [0.964, 0.975, 0.933], atol=5e-4)
        horizontal = np.hypot(one.error[one.available, 0], one.error[one.available, 1])
        assert np.median(horizontal) == pytest.approx(2.86, abs=0.005)
        assert horizontal.max() == pytest.approx(96.4, abs=0.05)
        assert np.median(np.abs(one.error[one.available, 2])) == pytest.approx(3.21, abs=0.005)
        steps = np.diff(one.time_s[one.available])
        assert steps.max() == pytest.approx(69.0)
        assert np.count_nonzero(steps > 5.0) == 25
