"""Where satellites are: broadcast orbits against another implementation, files, the nominal constellation."""

import datetime as dt
import gzip
from pathlib import Path

import numpy as np
import pytest

from napf_mpc.errors import DataError
from napf_mpc.navigation.almanac import nominal_constellation
from napf_mpc.navigation.ephemeris import EARTH_ROTATION_RADPS, LIGHT_MPS
from napf_mpc.navigation.rinex import gps_seconds, read_rinex_navigation
from napf_mpc.navigation.sky import azimuth_rad, directions, east_north_up, elevation_rad, ranges, turned

HEADER = (
    "     3.02           N: GNSS NAV DATA    M: Mixed            RINEX VERSION / TYPE\n"
    "                                                            END OF HEADER       \n"
)
DAY = gps_seconds(dt.datetime(2023, 7, 11))
SIDEREAL_DAY_S = 2.0 * np.pi / EARTH_ROTATION_RADPS


def field(value: float) -> str:
    return f"{value:19.12E}"


def record(name: str = "G01", **changes: float) -> str:
    """A circular orbit of the radius of GPS that lies in the equator's plane, over Greenwich at its time."""
    values = {
        "af0": 1e-4, "af1": 0.0, "af2": 0.0, "iode": 1.0, "crs": 0.0, "delta_n": 0.0, "m0": 0.0, "cuc": 0.0,
        "e": 0.0, "cus": 0.0, "sqrt_a": 5153.6, "toe": 172_800.0, "cic": 0.0,
        "omega0": EARTH_ROTATION_RADPS * 172_800.0, "cis": 0.0, "i0": 0.0, "crc": 0.0, "omega": 0.0,
        "omega_dot": 0.0, "idot": 0.0, "source": 517.0, "week": 2270.0, "spare": 0.0, "accuracy": 2.0,
        "health": 0.0, "tgd": 0.0, "iodc": 1.0, "sent": 172_000.0, "fit": 4.0, "a": 0.0, "b": 0.0,
    } | changes  # fmt: skip
    texts = [field(value) for value in values.values()]
    lines = [f"{name} 2023 07 11 00 00 00" + "".join(texts[:3])]
    lines += ["    " + "".join(texts[3 + 4 * n : 7 + 4 * n]) for n in range(7)]
    return "\n".join(lines) + "\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "some.nav"
    path.write_text(text)
    return path


def test_a_circular_orbit_goes_round_as_kepler_says(tmp_path: Path) -> None:
    orbit = read_rinex_navigation(written(tmp_path, HEADER + record()))
    rate = np.sqrt(3.986005e14) / 5153.6**3
    for seconds in (0.0, 600.0, -3600.0):
        place = orbit.positions(np.array([DAY + seconds]))[0, 0]
        angle = (rate - EARTH_ROTATION_RADPS) * seconds
        np.testing.assert_allclose(
            place, 5153.6**2 * np.array([np.cos(angle), np.sin(angle), 0.0]), atol=0.01
        )
    assert orbit.clock_s(np.array([DAY]))[0, 0] == pytest.approx(1e-4)


def test_galileo_has_its_own_gravity(tmp_path: Path) -> None:
    """After an hour the two constants of gravity put a satellite 0.4 m apart."""
    text = HEADER + record("G01") + record("E01")
    orbits = read_rinex_navigation(written(tmp_path, text)).positions(np.array([DAY + 3600.0]))[0]
    rates = [np.sqrt(mu) / 5153.6**3 for mu in (3.986005e14, 3.986004418e14)]
    apart = 5153.6**2 * 3600.0 * (rates[0] - rates[1])
    assert np.linalg.norm(orbits[0] - orbits[1]) == pytest.approx(apart, abs=1e-3)
    assert apart > 0.5


def test_the_record_nearest_in_time_counts_while_it_is_valid_and_healthy(tmp_path: Path) -> None:
    text = HEADER + record() + record(toe=180_000.0, sqrt_a=5154.0) + record("G02", health=1.0)
    orbits = read_rinex_navigation(written(tmp_path, text))
    assert orbits.at(DAY + 3000.0).records.sqrt_a.tolist() == [5153.6]
    assert orbits.at(DAY + 4000.0).records.sqrt_a.tolist() == [5154.0]
    assert orbits.at(DAY + 3000.0).names == ("G01",)
    assert orbits.at(DAY + 20_000.0).names == ()


def test_fnav_records_and_other_systems_are_passed_over(tmp_path: Path) -> None:
    other = "R01" + record()[3:]
    text = HEADER + other + record("E01", source=258.0) + record("E02") + record("J01") + record("J01")
    assert read_rinex_navigation(written(tmp_path, text)).name.tolist() == ["E02", "J01"]


@pytest.mark.parametrize("week", [2269.0, 2271.0, 2270.0 - 2 * 1024.0])
def test_a_week_that_is_not_that_of_its_time_follows_the_date(tmp_path: Path, week: float) -> None:
    right = read_rinex_navigation(written(tmp_path, HEADER + record()))
    other = read_rinex_navigation(written(tmp_path, HEADER + record(week=week)))
    np.testing.assert_array_equal(other.toe_s, right.toe_s)
    with pytest.raises(DataError, match="line 3: week = 2200 is 70 weeks off its date, 2023 07 11 00 00 00"):
        read_rinex_navigation(written(tmp_path, HEADER + record(week=2200.0)))


def as_version_2(text: str) -> str:
    """The same records of GPS with two digits for satellite and year, one column to the left."""
    lines = []
    for line in text.replace("E", "D").splitlines():
        if line.startswith(" "):
            lines.append(line[1:])
            continue
        clock = " ".join(f"{int(word):2d}" for word in line[9:20].split())
        lines.append(f"{int(line[1:3]):2d} {line[6:8]} {clock}{float(line[20:23]):5.1f}{line[23:]}")
    return HEADER.replace("3.02           N: GNSS", "2.11           N: GPS ") + "\n".join(lines) + "\n"


def test_versions_2_and_4_hold_the_same_records(tmp_path: Path) -> None:
    rows = [record("G01"), record("G09", e=0.01, m0=-1.5, toe=180_000.0), record("G32", sqrt_a=5154.25)]
    rows = [row.replace("2023 07 11 00 00 00", f"2023 07 11 {h:02d} 59 44") for h, row in enumerate(rows)]
    three = read_rinex_navigation(written(tmp_path, HEADER + "".join(rows)))
    strange = "> STO G01 LNAV\n    2023 07 11\n> EPH G01 CNAV\n" + record("G01", sqrt_a=5000.0)
    four = HEADER.replace("3.02", "4.01") + strange
    four += "".join(f"> EPH {row[:3]} LNAV\n{row}" for row in rows) + "> ION G01 LNAV\n    1.0\n"
    for text in (as_version_2("".join(rows)), four):
        other = read_rinex_navigation(written(tmp_path, text))
        assert other.name.tolist() == three.name.tolist()
        for key in ("toc_s", "toe_s", "af0", "sqrt_a", "e", "m0", "healthy", "accuracy_m"):
            np.testing.assert_array_equal(getattr(other, key), getattr(three, key))
        moment = np.array([DAY + 7200.0])
        np.testing.assert_array_equal(other.positions(moment), three.positions(moment))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "line 1"),
        ("not a file\n", "is not the head of a RINEX navigation file"),
        (HEADER.replace("3.02", "5.00") + record(), "RINEX version 5.00, must be 2, 3 or 4"),
        (HEADER.replace("3.02", "30.2") + record(), "RINEX version 30.2, must be 2, 3 or 4"),
        (HEADER.replace("3.02", "2.11") + record(), "line 3: G01 .* is not a satellite, date and time"),
        (
            HEADER.replace("N: GNSS NAV", "G: GLONASS N"),
            "line 1: .* not the head of a RINEX navigation file of GPS",
        ),
        (HEADER.splitlines()[0] + "\n" + record(), "END OF HEADER"),
        (HEADER, "holds no ephemeris"),
        (HEADER + "\n".join(record().splitlines()[:5]) + "\n", "line 3: a record of 5 lines, must have 8"),
        (HEADER + record(e=0.9), "line 3: e = 0.9, must be from 0 to 0.5"),
        (HEADER + record(m0=float("nan")), "m0 = nan, must be finite"),
        (HEADER + record().replace("2023 07", "2023 17"), "is not a date and time"),
        (HEADER + record().replace(field(5153.6), " " * 19), "sqrt_a is missing, not a number"),
        (HEADER + "    stray\n" + record(), "line 3: .*stray belongs to no record"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(DataError, match=words):
        read_rinex_navigation(written(tmp_path, text))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"gone\.nav: cannot be read"):
        read_rinex_navigation(tmp_path / "gone.nav")


def test_what_is_no_text_file_is_told_apart(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read: is a folder; name a file in it"):
        read_rinex_navigation(tmp_path)
    packed = tmp_path / "nav.rnx.gz"
    packed.write_bytes(gzip.compress((HEADER + record()).encode()))
    with pytest.raises(DataError, match=r"nav\.rnx\.gz: is packed by gzip; unpack it first"):
        read_rinex_navigation(packed)


def test_a_byte_order_mark_is_no_part_of_the_header(tmp_path: Path) -> None:
    plain = written(tmp_path, HEADER + record())
    marked = tmp_path / "marked.nav"
    marked.write_bytes(b"\xef\xbb\xbf" + plain.read_bytes())
    assert read_rinex_navigation(str(marked)).name.tolist() == read_rinex_navigation(plain).name.tolist()


def carried_on(mean: float, eccentricity: float) -> tuple[float, float]:
    """Solve Kepler's equation by the other implementation's iteration, to the end.

    It stops after ten steps, which leaves 6 cm on E14 and E18 (eccentricity 0.16).
    """
    anomaly = mean
    for _ in range(100):
        anomaly = mean + eccentricity * np.sin(anomaly)
    return anomaly, np.sin(anomaly)


def test_orbits_are_those_of_another_implementation(
    data_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All records of all GPS, Galileo and QZSS satellites of a measured file of 27 h: within 1 cm."""
    gnss = pytest.importorskip("cssrlib.gnss", reason="cssrlib is not installed")
    from cssrlib import ephemeris
    from cssrlib.ephemeris import eph2pos
    from cssrlib.rinex import rnxdec

    path = data_folder / "gnss_nagoya_spp" / "broadcast.nav"
    nav = gnss.Nav()
    rnxdec().decode_nav(str(path), nav)
    monkeypatch.setattr(ephemeris, "eccentricAnomaly", carried_on)
    theirs = {}
    for one in nav.eph:
        if one.mode == 0:
            theirs.setdefault((gnss.sat2id(one.sat), one.toe.time + one.toe.sec), one)
    orbits = read_rinex_navigation(path)
    for n, name in enumerate(orbits.name):
        toe = gnss.gpst2time(int(orbits.toe_s[n] // 604_800), orbits.toe_s[n] % 604_800)
        record = theirs[str(name), toe.time + toe.sec]
        for late_s in (-7200.0, -1000.0, 0.0, 3600.0, 7200.0):
            time_s = orbits.toe_s[n] + late_s
            place, clock = eph2pos(gnss.gpst2time(int(time_s // 604_800), time_s % 604_800), record)
            mine = orbits.take([n])
            apart = float(np.linalg.norm(place - mine.positions(np.array([time_s]))[0, 0]))
            assert apart < 0.01, f"{name} at {time_s}: {apart} m"
            assert abs(clock - mine.clock_s(np.array([time_s]))[0, 0]) * LIGHT_MPS < 0.01
    satellites = set(orbits.name.tolist())
    assert [sum(name[0] == letter for name in satellites) for letter in "GEJ"] == [32, 24, 4]


def test_the_nominal_constellation_repeats_over_the_ground() -> None:
    """GPS after a sidereal day, Galileo after ten, to the rounding of times of 1e9 s (metres in 1e7)."""
    sky = nominal_constellation()
    here, day, ten = sky.positions(DAY + np.array([0.0, 1.0, 10.0]) * SIDEREAL_DAY_S)
    gps = sky.system == 0
    np.testing.assert_allclose(day[gps], here[gps], atol=1.0)
    np.testing.assert_allclose(ten, here, atol=1.0)
    assert np.linalg.norm((day - here)[~gps], axis=-1).min() > 1e6


def test_the_nominal_constellation_is_what_its_documents_say() -> None:
    sky = nominal_constellation()
    assert len(sky.names) == len(set(sky.names)) == 48
    epoch = gps_seconds(dt.datetime(1993, 7, 1))
    radius = np.linalg.norm(sky.positions(np.array([epoch]))[0], axis=-1)
    np.testing.assert_allclose(radius[sky.system == 0], 26_559_700.0)
    np.testing.assert_allclose(radius[sky.system == 1], 29_599_800.0)
    # Slot A3: node at 272.847 - 279.060 degrees, 11.676 degrees along an orbit of 55 degrees from there.
    x, y, z = sky.positions(np.array([epoch]))[0, sky.names.index("G-A3")] / 26_559_700.0
    assert np.degrees(np.arcsin(z)) == pytest.approx(9.543, abs=1e-3)
    assert np.degrees(np.arctan2(y, x)) == pytest.approx(272.847 - 279.060 + 6.760, abs=2e-3)
    # A Walker pattern: no two satellites of one plane nearer than 45 degrees.
    galileo = sky.positions(np.array([DAY]))[0, sky.system == 1] / 29_599_800.0
    cosines = galileo @ galileo.T - 2.0 * np.eye(24)
    assert np.degrees(np.arccos(cosines.max())) > 10.0


def test_enough_nominal_satellites_stand_everywhere() -> None:
    sky = nominal_constellation()
    for latitude in (-60.0, 0.0, 35.0, 50.0, 85.0):
        unit = directions(sky, latitude, 10.0, DAY + np.arange(0.0, 86_400.0, 1200.0))
        high = (elevation_rad(unit) > np.radians(10.0)).sum(-1)
        assert high.min() >= 8, latitude


def test_east_north_up_and_angles() -> None:
    axes = east_north_up(0.0, 90.0)
    np.testing.assert_allclose(axes @ [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], atol=1e-15)
    np.testing.assert_allclose(axes @ [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], atol=1e-15)
    unit = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [-0.5, 0.0, np.sqrt(0.75)]])
    np.testing.assert_allclose(np.degrees(azimuth_rad(unit)), [90.0, 180.0, 270.0])
    np.testing.assert_allclose(np.degrees(elevation_rad(unit)), [0.0, 0.0, 60.0], atol=1e-12)


def test_a_range_has_the_earths_turn_in_it() -> None:
    """On the equator a satellite in the west is up to 45 m nearer than if the earth stood still."""
    sky = nominal_constellation()
    place = np.array([6_378_137.0, 0.0, 0.0])
    distance, sent = ranges(sky, place, DAY)
    flight = distance / LIGHT_MPS
    still = np.linalg.norm(sent - place, axis=-1)
    sagnac = EARTH_ROTATION_RADPS * (sent[:, 0] * place[1] - sent[:, 1] * place[0]) / LIGHT_MPS
    np.testing.assert_allclose(distance - still, sagnac, atol=0.01)
    assert 20.0 < np.abs(sagnac).max() < 46.0
    np.testing.assert_allclose(turned(sent, flight), turned(sent, flight + 1e-9), atol=1e-4)
