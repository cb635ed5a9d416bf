"""Readers of receivers' logs: written by the formats' own libraries, read back in metres."""

import datetime as dt
import gzip
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pymap3d
import pynmeagps
import pytest
import pyubx2

from napf_mpc.errors import DataError
from napf_mpc.navigation.readers.formats import READERS, SUFFIXES, format_of, read_track
from napf_mpc.navigation.readers.nmea import read_nmea
from napf_mpc.navigation.readers.smartloc import read_smartloc
from napf_mpc.navigation.readers.ubx import read_ubx
from napf_mpc.navigation.readers.ulog import read_ulog
from napf_mpc.navigation.recorded import coverage, errors_against_truth
from napf_mpc.navigation.replay import load_error_log
from napf_mpc.problem import Recorded

PLACE = (35.1654, 136.8814, 80.0)
GPS_DAY_S = (dt.date(2023, 7, 11) - dt.date(1980, 1, 6)).days * 86_400.0


def there(east: float, north: float, up: float) -> tuple[float, float, float]:
    lat, lon, height = pymap3d.enu2geodetic(east, north, up, *PLACE)
    return float(lat), float(lon), float(height)


# ------------------------------------------------------------------------------------------------ NMEA


def sentence(kind: str, **fields: object) -> str:
    return str(pynmeagps.NMEAMessage("GN", kind, pynmeagps.GET, **fields).serialize().decode()).strip()


def gga(time: str, place: tuple[float, float, float], quality: int = 1) -> str:
    lat, lon, height = place
    return sentence(
        "GGA", time=time, lat=abs(lat), NS="NS"[lat < 0], lon=abs(lon), EW="EW"[lon < 0],
        quality=quality, numSV=8, HDOP=1.0, alt=height - 37.5, altUnit="M", sep=37.5, sepUnit="M",
        diffAge="", diffStation="",
    )  # fmt: skip


def gst(time: str, major: float, minor: float, bearing: float, up: float) -> str:
    return sentence(
        "GST", time=time, rangeRms=2.0, stdMajor=major, stdMinor=minor, orient=bearing, stdLat=major,
        stdLong=minor, stdAlt=up,
    )  # fmt: skip


def zda(time: str, day: int) -> str:
    return sentence("ZDA", time=time, day=day, month=7, year=2023, ltzh="00", ltzn="00")


def written(tmp_path: Path, *lines: str, name: str = "log.nmea") -> Path:
    path = tmp_path / name
    path.write_text("\r\n".join(lines) + "\r\n", encoding="ascii")
    return path


def test_nmea_comes_back_in_metres(tmp_path: Path) -> None:
    lines = [zda("06:04:29", 11)]
    for second in (30, 31, 32):
        stamp = f"06:04:{second}"
        place = there(second - 30.0, 2.0 * (second - 30.0), 5.0)
        lines += [gga(stamp, place), gst(stamp, 5.0, 3.0, 90.0, 9.0), "$GNGSA,A,3,01,02*29"]
    track = read_nmea(written(tmp_path, *lines))
    assert track.time_system == "UTC"
    np.testing.assert_allclose(track.time_s, GPS_DAY_S + 6 * 3600 + 4 * 60 + np.array([30.0, 31.0, 32.0]))
    enu = np.stack(pymap3d.geodetic2enu(*track.geodetic.T, *PLACE), -1)
    # Five digits of a minute are 2 cm, the height has the tenth of a metre and better.
    np.testing.assert_allclose(enu, [[0, 0, 5], [1, 2, 5], [2, 4, 5]], atol=0.05)
    # The long axis lies 90 degrees from north: east.
    np.testing.assert_allclose(track.covariance[0], np.diag([25.0, 9.0, 81.0]), atol=1e-9)


def test_nmea_turns_the_error_ellipse(tmp_path: Path) -> None:
    track = read_nmea(written(tmp_path, gga("00:00:01", PLACE), gst("00:00:01", 4.0, 2.0, 45.0, 1.0)))
    along = np.array([1.0, 1.0, 0.0]) / math.sqrt(2.0)  # north-east
    across = np.array([1.0, -1.0, 0.0]) / math.sqrt(2.0)
    assert along @ track.covariance[0] @ along == pytest.approx(16.0)
    assert across @ track.covariance[0] @ across == pytest.approx(4.0)


def test_nmea_goes_on_over_midnight_and_leaves_out_what_has_no_fix(tmp_path: Path) -> None:
    lines = [
        zda("23:59:58", 11),
        gga("23:59:59", PLACE),
        gga("00:00:00", PLACE, quality=0),
        gga("00:00:00.5", PLACE, quality=6),  # dead reckoning
        gga("00:00:00.8", PLACE, quality=7),  # typed in
        gga("00:00:01", PLACE),
        zda("00:00:02", 12),
        gga("00:00:03", PLACE),
    ]
    track = read_nmea(written(tmp_path, *lines))
    np.testing.assert_allclose(track.time_s - GPS_DAY_S, [86_399.0, 86_401.0, 86_403.0])


def test_nmea_without_a_date_says_so(tmp_path: Path) -> None:
    track = read_nmea(written(tmp_path, gga("12:00:00", PLACE)))
    assert (track.time_system, track.time_s.tolist()) == ("UTC, no date", [43_200.0])
    assert not track.covariance.any()  # without GST nothing is reported


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty file"),
        ("\n", "no epochs with a 3-D fix"),
        ("position 1 2 3\n", "line 1: position 1 2 3 is no NMEA sentence"),
        ("$GNGGA,060430,3509.9", "line 1: sentence is cut off"),
        ("$GNGGA,060430,3509.92400,N,13652.88400,E,1,8,1.0,40.0,M,37.5,M,,*57", "line 1: broken sentence"),
        ("$GNGSA,A,3,01,02*29\n", "no epochs with a 3-D fix"),
    ],
)
def test_nmea_that_is_none(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "log.nmea"
    path.write_text(text, encoding="ascii")
    with pytest.raises(DataError) as caught:
        read_nmea(path)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_nmea_time_that_goes_back(tmp_path: Path) -> None:
    path = written(tmp_path, gga("12:00:05", PLACE), gga("12:00:04", PLACE))
    with pytest.raises(DataError, match=r"epoch 2: time goes back by 1 s"):
        read_nmea(path)


# ------------------------------------------------------------------------------------------------- UBX

SECOND_OF_WEEK = 2 * 86_400 + 6 * 3600 + 4 * 60 + 30  # a Tuesday, GPS time


def pvt(second: int, place: tuple[float, float, float], **changes: object) -> bytes:
    # UTC is 18 s behind GPS time in 2023; the week must come out right all the same.
    fields = {
        "iTOW": (SECOND_OF_WEEK + second) * 1000, "year": 2023, "month": 7, "day": 11, "hour": 6, "min": 4,
        "second": 12 + second, "validDate": 1, "validTime": 1, "fixType": 3, "gnssFixOk": 1, "numSV": 9,
        "lat": place[0], "lon": place[1], "height": round(1000 * place[2]), "hAcc": 5000, "vAcc": 9000,
    }  # fmt: skip
    return bytes(pyubx2.UBXMessage("NAV", "NAV-PVT", pyubx2.GET, **(fields | changes)).serialize())


def cov(second: int, **changes: float) -> bytes:
    fields = {
        "posCovNN": 9.0, "posCovNE": 1.0, "posCovND": -2.0, "posCovEE": 16.0, "posCovED": 0.5,
        "posCovDD": 25.0,
    } | changes  # fmt: skip
    message = pyubx2.UBXMessage(
        "NAV", "NAV-COV", pyubx2.GET, iTOW=(SECOND_OF_WEEK + second) * 1000, posCovValid=1, **fields
    )
    return bytes(message.serialize())


def test_ubx_comes_back_in_metres(tmp_path: Path) -> None:
    path = tmp_path / "log.ubx"
    noise = gga("06:04:12", PLACE).encode() + b"\r\n"  # receivers send both on one line
    path.write_bytes(
        pvt(0, there(0, 0, 1)) + cov(0) + noise + pvt(1, there(3, 4, 2)) + pvt(2, PLACE, fixType=0)
    )
    track = read_ubx(path)
    assert track.time_system == "GPST"
    np.testing.assert_allclose(track.time_s, GPS_DAY_S + 6 * 3600 + 4 * 60 + np.array([30.0, 31.0]))
    enu = np.stack(pymap3d.geodetic2enu(*track.geodetic.T, *PLACE), -1)
    np.testing.assert_allclose(enu, [[0, 0, 1], [3, 4, 2]], atol=0.02)  # 1e-7 degree is 1.1 cm
    # north, east, down -> east, north, up: terms with down change their sign
    np.testing.assert_allclose(track.covariance[0], [[16, 1, -0.5], [1, 9, 2], [-0.5, 2, 25]])
    # Without NAV-COV: 5 m horizontally is 25 m^2 for both axes together.
    np.testing.assert_allclose(track.covariance[1], np.diag([12.5, 12.5, 81.0]))


def test_ubx_of_two_weeks_keeps_the_covariances_of_each(tmp_path: Path) -> None:
    """Drives at the same time of the week in one file: a covariance belongs to the epoch it stands in."""
    path = tmp_path / "log.ubx"
    first = b"".join(pvt(s, PLACE) + cov(s, posCovDD=4.0) for s in range(2))
    week = b"".join(cov(s, posCovDD=100.0) + pvt(s, PLACE, day=18) for s in range(2))
    path.write_bytes(first + week + pvt(2, PLACE, day=18))
    track = read_ubx(path)
    np.testing.assert_allclose(track.time_s - track.time_s[0], [0.0, 1.0, 604_800.0, 604_801.0, 604_802.0])
    np.testing.assert_allclose(track.covariance[:, 2, 2], [4.0, 4.0, 100.0, 100.0, 81.0])


def test_ubx_that_is_none(tmp_path: Path) -> None:
    path = tmp_path / "log.ubx"
    whole = pvt(0, PLACE) + pvt(1, PLACE)
    spoilt = bytearray(whole)
    spoilt[20] ^= 0xFF
    cases = [
        (b"", "empty file"),
        (b"not a log at all", "no UBX-NAV-PVT messages"),
        (cov(0), "no UBX-NAV-PVT messages"),
        (whole[:-10], "cut"),
        (whole + pvt(2, PLACE)[:4], "cut"),
        (bytes(spoilt), "broken"),
        (pvt(0, PLACE, fixType=2), "no epochs with a 3-D fix"),
        (pvt(1, PLACE) + pvt(0, PLACE), "time goes back by 1 s"),
    ]
    for content, words in cases:
        path.write_bytes(content)
        with pytest.raises(DataError) as caught:
            read_ubx(path)
        assert words in str(caught.value)
        assert "\n" not in str(caught.value)


# ------------------------------------------------------------------------------------------------ ULog


def test_ulog_of_a_real_flight(data_folder: Path) -> None:
    track = read_ulog(data_folder / "px4_ulog_sample" / "flight_log_small.ulg")
    assert (len(track.time_s), track.time_system) == (32, "UTC")
    day = dt.datetime(1980, 1, 6) + dt.timedelta(seconds=float(track.time_s[0]))
    assert day.date() == dt.date(2021, 4, 21)
    assert track.geodetic[0] == pytest.approx([63.4170622, 10.4082151, 106.766])
    drms = np.sqrt(track.covariance[:, 0, 0] + track.covariance[:, 1, 1])
    assert drms.min() == pytest.approx(2.5, abs=0.1)
    assert drms.max() == pytest.approx(3.3, abs=0.1)
    sigma_up = np.sqrt(track.covariance[:, 2, 2])
    assert 5.1 < sigma_up.min() <= sigma_up.max() < 7.1


def test_ulog_cut_off_or_foreign(data_folder: Path, tmp_path: Path) -> None:
    whole = (data_folder / "px4_ulog_sample" / "flight_log_small.ulg").read_bytes()
    path = tmp_path / "log.ulg"
    for content in (whole[:40], whole[:3000], b"", b"no log", b"ULog\x01\x12\x35\x01" + bytes(200)):
        path.write_bytes(content)
        with pytest.raises(DataError) as caught:
            read_ulog(path)
        assert "\n" not in str(caught.value)


# -------------------------------------------------------------------------------------------- smartLoc


def test_smartloc_is_as_far_off_as_its_readme_says(data_folder: Path) -> None:
    """Elevation >= 15 deg, C/N0 >= 30 dBHz: 1367 of 1372 epochs, horizontal median 21.7 m, 95 % 56.9 m."""
    folder = data_folder / "gnss_berlin_smartloc"
    solution = read_smartloc(folder / "Berlin_Potsdamer_Platz_Input.txt")
    truth = read_smartloc(folder / "Berlin_Potsdamer_Platz_GT.txt")
    log = errors_against_truth(solution, truth)
    error = log.error[log.available]
    assert (len(solution.time_s), len(truth.time_s), len(error)) == (1367, 1372, 1367)
    horizontal = np.hypot(error[:, 0], error[:, 1])
    assert np.quantile(horizontal, [0.5, 0.95]) == pytest.approx([21.7, 56.9], abs=0.1)
    assert error[:, 2].mean() == pytest.approx(49.6, abs=0.1)
    assert coverage(log, 3.0).share[2] == pytest.approx(0.234, abs=0.001)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("odom3 0 1 2 3\n", "needs point3 records or pseudorange3 records"),
        ("point3 0 1 2\n", "line 1: 3 numbers, at least 4"),
        ("point3 0 1 2 x\n", "line 1: 0 1 2 x are not numbers"),
        ("point3 0 1 2 nan\n", "line 1: a number is not finite"),
        ("hello 1 2\n", "line 1: hello is no record"),
        ("pseudorange3 0 2e7 4 2e7 0 0 5 1 40 45\n", "no epochs with a 3-D fix"),
        ("pseudorange3 0 2e7 4 0 0 0 5 1 40 45\n", "line 1: the satellite's distance from the earth's"),
        ("pseudorange3 0 1e300 4 2e7 0 0 5 1 40 45\n", "line 1: the range is 1e+300, must be from 1e+06"),
        ("pseudorange3 0 2e7 -4 2e7 0 0 5 1 40 45\n", "line 1: the variance is -4, must be from 0"),
        ("pseudorange3 0 2e7 0 2e7 0 0 5 1 40 45\n", "none of its 1 pseudoranges has an elevation of 15 deg"),
        (2 * "pseudorange3 0 2e7 4 2e7 0 0 5 1 40 45\n", "satellite 5 of system 1 at 0 s is there twice"),
    ],
)
def test_smartloc_that_is_none(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "log.txt"
    path.write_text(text, encoding="ascii")
    with pytest.raises(DataError) as caught:
        read_smartloc(path)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


# ------------------------------------------------------------------------------------------- in problems


def ubx_log(path: Path, east: float) -> None:
    path.write_bytes(b"".join(pvt(s, there(east, 0, 0)) + cov(s) for s in range(4)))


def test_a_problem_replays_the_errors_between_two_logs(tmp_path: Path) -> None:
    ubx_log(tmp_path / "rover.ubx", 3.0)
    ubx_log(tmp_path / "truth.bin", 0.0)
    config = Recorded(kind="recorded", file="rover.ubx", truth_file="truth.bin", truth_format="ubx")
    log = load_error_log(config, tmp_path)
    np.testing.assert_allclose(log.error, [[3.0, 0.0, 0.0]] * 4, atol=0.03)
    np.testing.assert_allclose(log.covariance[0, 0, 0], 16.0)


def test_a_log_is_not_its_own_truth(tmp_path: Path) -> None:
    """The same positions under both names would fly without any error."""
    ubx_log(tmp_path / "rover.ubx", 3.0)
    ubx_log(tmp_path / "copy.ubx", 3.0)
    for truth in ("rover.ubx", "copy.ubx"):
        config = Recorded(kind="recorded", file="rover.ubx", truth_file=truth)
        with pytest.raises(DataError, match=rf"truth_file: {truth} has the positions of rover\.ubx"):
            load_error_log(config, tmp_path)


def test_nmea_after_a_gap_of_days_is_dated_by_its_date(tmp_path: Path) -> None:
    lines = [zda("10:00:00", 11), gga("10:00:00", PLACE), gga("10:00:01", PLACE)]
    lines += [zda("11:00:00", 13), gga("11:00:00", PLACE)]  # two days and an hour later
    track = read_nmea(written(tmp_path, *lines))
    np.testing.assert_allclose(track.time_s - GPS_DAY_S, [36_000.0, 36_001.0, 2 * 86_400.0 + 39_600.0])
    back = [*lines, zda("12:00:00", 12), gga("12:00:00", PLACE)]
    with pytest.raises(DataError, match="time goes back by 82800 s"):
        read_nmea(written(tmp_path, *back))


def test_nmea_the_same_second_of_another_day_leaves_the_first_where_it_was(tmp_path: Path) -> None:
    lines = [gga("10:00:00", PLACE), zda("10:00:00", 11), zda("10:00:00", 13), gga("10:00:00", PLACE)]
    track = read_nmea(written(tmp_path, *lines))
    np.testing.assert_allclose(track.time_s - GPS_DAY_S, [36_000.0, 2 * 86_400.0 + 36_000.0])


@pytest.mark.parametrize("clock", ["09:00:00", "10:30:00"])
def test_nmea_whose_date_comes_last_is_dated_by_it(tmp_path: Path, clock: str) -> None:
    """Positions first, date last: the first position after a gap of days belongs to the day told after it."""
    lines = [gga("10:00:00", PLACE), gst("10:00:00", 2.0, 1.0, 0.0, 3.0), zda("10:00:00", 11)]
    lines += [gga(clock, PLACE), gst(clock, 5.0, 4.0, 0.0, 6.0), zda(clock, 13)]
    track = read_nmea(written(tmp_path, *lines))
    hours = int(clock[:2]) + int(clock[3:5]) / 60.0
    np.testing.assert_allclose(track.time_s - GPS_DAY_S, [36_000.0, 2 * 86_400.0 + 3600.0 * hours])
    np.testing.assert_allclose(np.sqrt(track.covariance[:, 2, 2]), [3.0, 6.0])


def test_nmea_without_the_geoids_separation_has_heights_above_the_sea(tmp_path: Path) -> None:
    def without(line: str) -> str:
        body = line[1:].split("*")[0].split(",")
        text = ",".join([*body[:11], "", *body[12:]])
        checksum = 0
        for byte in text.encode():
            checksum ^= byte
        return f"${text}*{checksum:02X}"

    bare = [zda("06:04:12", 11), *(without(gga(f"06:04:{s}", PLACE)) for s in range(12, 16))]
    track = read_nmea(written(tmp_path, *bare))
    assert track.heights == "geodetic"
    np.testing.assert_allclose(track.geodetic[:, 2], PLACE[2] - 37.5, atol=0.01)
    ubx_log(tmp_path / "rover.ubx", 3.0)
    with pytest.raises(DataError, match="ellipsoidal and geodetic heights"):
        errors_against_truth(read_ubx(tmp_path / "rover.ubx"), track)
    with pytest.raises(DataError, match=r"line 6: some GGA give the geoid's separation"):
        read_nmea(written(tmp_path, *bare, gga("06:04:16", PLACE)))


def test_nmea_in_utc_is_the_truth_of_ubx_in_gps_time(tmp_path: Path) -> None:
    """18 s apart since 2017; a truth that cannot be brought to GPS time is refused."""
    ubx_log(tmp_path / "rover.ubx", 3.0)
    lines = [zda("06:04:12", 11), *(gga(f"06:04:{s}", PLACE) for s in range(12, 16))]
    written(tmp_path, *lines, name="truth.nmea")
    log = load_error_log(Recorded(kind="recorded", file="rover.ubx", truth_file="truth.nmea"), tmp_path)
    np.testing.assert_allclose(log.error, [[3.0, 0.0, 0.0]] * 4, atol=0.03)
    written(tmp_path, *lines[1:], name="dateless.nmea")
    config = Recorded(kind="recorded", file="rover.ubx", truth_file="dateless.nmea")
    with pytest.raises(DataError, match="times in GPST and in UTC, no date, which cannot be compared"):
        load_error_log(config, tmp_path)


def test_nmea_without_reported_sigmas_cannot_be_replayed(tmp_path: Path) -> None:
    lines = [gga(f"12:00:0{s}", PLACE) for s in range(4)]
    written(tmp_path, *lines)
    config = Recorded(kind="recorded", file="log.nmea", truth_file="log.nmea")
    with pytest.raises(DataError, match=r"a variance that is not positive \(zero means unknown\)"):
        load_error_log(config, tmp_path)


def test_every_suffix_has_a_reader() -> None:
    assert set(SUFFIXES.values()) <= set(READERS)
    assert format_of("a/b.UBX", "auto", "navigation.file") == "ubx"
    assert format_of("a/b.bin", "ubx", "navigation.file") == "ubx"
    with pytest.raises(DataError, match=r"navigation.truth_file = b.bin: .* navigation.truth_format"):
        format_of("b.bin", "auto", "navigation.truth_file")


@pytest.mark.parametrize("kind", sorted(READERS))
def test_whatever_is_not_there_or_no_file(tmp_path: Path, kind: str) -> None:
    for path, words in ((tmp_path / "nothing", "no such file"), (tmp_path, "is a folder; name a file in it")):
        with pytest.raises(DataError, match=f"{path.name}: cannot be read: {words}"):
            read_track(path, kind)


@pytest.mark.parametrize("kind", sorted(READERS))
def test_a_packed_log_is_to_be_unpacked(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "log.gz"
    path.write_bytes(gzip.compress(b"point3 0 1 2 3\n"))
    with pytest.raises(DataError, match=r"log\.gz: is packed by gzip; unpack it first"):
        read_track(path, kind)


def test_names_of_files_do_as_well_as_paths(tmp_path: Path, data_folder: Path) -> None:
    nmea = written(tmp_path, gga("12:00:00", PLACE))
    ubx_log(tmp_path / "log.ubx", 3.0)
    smartloc = data_folder / "gnss_berlin_smartloc" / "Berlin_Potsdamer_Platz_GT.txt"
    ulog = data_folder / "px4_ulog_sample" / "flight_log_small.ulg"
    for read, path in (
        (read_nmea, nmea), (read_ubx, tmp_path / "log.ubx"), (read_smartloc, smartloc), (read_ulog, ulog)
    ):  # fmt: skip
        named = read(str(path))
        np.testing.assert_array_equal(named.geodetic, read(path).geodetic)
        assert named.source == str(path)


@pytest.mark.parametrize("kind", sorted(READERS))
def test_bytes_of_any_kind_give_one_line(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "log"
    heads: list[Callable[[bytes], bytes]] = [
        lambda noise: noise,
        lambda noise: b"ULog\x01\x12\x35\x01" + noise,
        lambda noise: b"\xb5\x62\x01\x07" + noise,
        lambda noise: b"$GNGGA," + noise,
        lambda noise: b"pseudorange3 " + noise,
    ]
    noise = np.arange(4000, dtype=np.uint32) * 2_654_435_761 >> 13
    for head in heads:
        path.write_bytes(head(noise.astype(np.uint8).tobytes()))
        with pytest.raises(DataError) as caught:
            read_track(path, kind)
        assert "\n" not in str(caught.value)
