"""The same track in every form that RTKLIB writes: what is read must not depend on the form."""

import datetime as dt
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pymap3d
import pytest

from napf_mpc.errors import DataError
from napf_mpc.navigation.clocks import gps_time_s
from napf_mpc.navigation.recorded import errors_against_truth
from napf_mpc.navigation.rtklib import PosTrack, read_rtklib_pos

EPOCHS = 6
START = dt.datetime(2024, 2, 28, 23, 59, 57)  # over midnight into a leap day
GPS_EPOCH = dt.datetime(1980, 1, 6)
PLACES = {
    "Nagoya": (35.1654, 136.8814, 41.4),
    "Quito": (-0.2201, -78.5123, 2850.0),
    "Accra": (5.6, -0.19, 61.0),
}
FILE_COMMENT = "% inp file  : C:\\\u30c7\u30fc\u30bf\\rover.obs"  # RTKLIB writes it in Windows' own code


def axes_of(latitude: float, longitude: float) -> np.ndarray:
    """East, north, up in earth-fixed axes, by differences of the ellipsoid's own surface."""
    here = np.array(pymap3d.geodetic2ecef(latitude, longitude, 0.0))
    east = np.array(pymap3d.geodetic2ecef(latitude, longitude + 1e-5, 0.0)) - np.array(
        pymap3d.geodetic2ecef(latitude, longitude - 1e-5, 0.0)
    )
    up = np.array(pymap3d.geodetic2ecef(latitude, longitude, 1.0)) - here
    east /= np.linalg.norm(east)
    return np.array([east, np.cross(up, east), up])


class Made:
    """A track whose places and covariances are known."""

    def __init__(self, place: tuple[float, float, float]) -> None:
        rng = np.random.default_rng(5)
        step = rng.normal(size=(EPOCHS, 3)) * [1e-4, 1e-4, 3.0]
        self.geodetic = np.array(place) + step
        root = rng.normal(size=(EPOCHS, 3, 3))
        self.covariance = root @ root.transpose(0, 2, 1) + np.eye(3)
        self.base = np.array(place)

    def rows(self, kind: str) -> list[list[str]]:
        return [self._row(kind, place, p) for place, p in zip(self.geodetic, self.covariance, strict=True)]

    def _row(self, kind: str, place: np.ndarray, p: np.ndarray) -> list[str]:
        ecef = np.array(pymap3d.geodetic2ecef(*place))
        if kind == "deg":
            words = [f"{place[0]:14.9f}", f"{place[1]:14.9f}", f"{place[2]:10.4f}"]
        elif kind == "dms":
            words = [*dms(place[0]), *dms(place[1]), f"{place[2]:10.4f}"]
        elif kind == "ecef":
            axes = axes_of(*place[:2])
            p = axes.T @ p @ axes
            words = [f"{x:14.4f}" for x in ecef]
        else:
            axes, base_axes = axes_of(*place[:2]), axes_of(*self.base[:2])
            p = base_axes @ axes.T @ p @ axes @ base_axes.T
            words = [f"{x:14.4f}" for x in base_axes @ (ecef - np.array(pymap3d.geodetic2ecef(*self.base)))]
        order = [1, 0, 2] if kind in ("deg", "dms") else [0, 1, 2]
        p = p[np.ix_(order, order)]
        signed = [p[0, 0], p[1, 1], p[2, 2], p[0, 1], p[1, 2], p[2, 0]]
        sigmas = [f"{math.copysign(math.sqrt(abs(v)), v):8.6f}" for v in signed]
        return [*words, "  5", " 12", *sigmas, "  0.00", "   0.0"]


def dms(degrees: float) -> list[str]:
    """As RTKLIB's deg2dms: the sign stands before the degrees, also before a zero."""
    sign, size = math.copysign(1.0, degrees), abs(degrees)
    whole = math.floor(size)
    minutes = math.floor((size - whole) * 60.0)
    return [f"{sign * whole:4.0f}", f"{minutes:02.0f}", f"{((size - whole) * 60.0 - minutes) * 60.0:08.5f}"]


SD = {
    "deg": "sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m)",
    "dms": "sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdue(m)",  # RTKLIB's own slip in the last name
    "ecef": "sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m)",
    "enu": "sde(m) sdn(m) sdu(m) sden(m) sdnu(m) sdue(m)",
}
COLUMNS = {
    "deg": "latitude(deg) longitude(deg) height(m)",
    "dms": "latitude(d'\") longitude(d'\") height(m)",
    "ecef": "x-ecef(m) y-ecef(m) z-ecef(m)",
    "enu": "e-baseline(m) n-baseline(m) u-baseline(m)",
}


def clock_words(moment: dt.datetime, week: bool, separator: str) -> str:
    if not week:
        return f"{moment:%Y/%m/%d %H:%M:%S.%f}"[:-3]
    weeks, seconds = divmod((moment - GPS_EPOCH).total_seconds(), 604_800.0)
    return f"{weeks:4.0f}{separator}{seconds:10.3f}"


def written(
    path: Path,
    made: Made,
    kind: str = "deg",
    *,
    separator: str = " ",
    week: bool = False,
    system: str = "GPST",
    ahead_s: float = 0.0,
    head: str | None = None,
) -> Path:
    names = [*COLUMNS[kind].split(), "Q", "ns", *SD[kind].split(), "age(s)", "ratio"]
    base = " ".join(f"{x:14.9f}" for x in made.base)
    lines = [FILE_COMMENT, f"% ref pos   :{base}", "%", head or "% (x)"]
    lines.append(f"%  {system:<24}{separator}{separator.join(f'{name:>14}' for name in names)}")
    for i, row in enumerate(made.rows(kind)):
        moment = START + dt.timedelta(seconds=i + ahead_s)
        lines.append(separator.join([clock_words(moment, week, separator), *row]))
    path.write_bytes("\r\n".join([*lines, ""]).encode("cp932"))
    return path


@pytest.fixture(params=PLACES)
def made(request: pytest.FixtureRequest) -> Made:
    return Made(PLACES[request.param])


def off_m(track: PosTrack, made: Made) -> np.ndarray:
    one = np.stack(pymap3d.geodetic2ecef(*track.geodetic.T), -1)
    return np.asarray(np.linalg.norm(one - np.stack(pymap3d.geodetic2ecef(*made.geodetic.T), -1), axis=-1))


@pytest.mark.parametrize("week", [False, True])
@pytest.mark.parametrize("separator", [" ", ",", "\t", ";", " , "])
@pytest.mark.parametrize("kind", COLUMNS)
def test_every_form_is_the_same_track(
    tmp_path: Path, made: Made, kind: str, separator: str, week: bool
) -> None:
    track = read_rtklib_pos(written(tmp_path / "a.pos", made, kind, separator=separator, week=week))
    assert off_m(track, made).max() < 5e-4  # a tenth of a millimetre an axis, and 1e-5 arc seconds
    np.testing.assert_allclose(track.covariance, made.covariance, atol=2e-5)
    start = (START - GPS_EPOCH).total_seconds()
    np.testing.assert_allclose(track.time_s, start + np.arange(EPOCHS), atol=1e-6)


@pytest.mark.parametrize(("system", "ahead_s"), [("UTC", -18.0), ("JST", 9 * 3600.0 - 18.0)])
def test_logs_on_different_clocks_are_compared_at_the_same_moments(
    tmp_path: Path, system: str, ahead_s: float
) -> None:
    made = Made(PLACES["Nagoya"])
    gps = read_rtklib_pos(written(tmp_path / "gps.pos", made))
    other = read_rtklib_pos(written(tmp_path / "other.pos", made, system=system, ahead_s=ahead_s))
    for solution, truth in ((gps, other), (other, gps)):
        log = errors_against_truth(solution, truth)
        assert log.available.sum() == EPOCHS
        np.testing.assert_allclose(log.error, 0.0, atol=1e-6)


def test_leap_seconds_count_from_their_own_midnight() -> None:
    """GPS - UTC was 0 in 1980, 13 s from 1999 on, 17 s to the end of 2016, 18 s after (IERS Bulletin C)."""
    for moment, ahead in (
        (dt.datetime(1980, 6, 1), 0),
        (dt.datetime(1999, 1, 1), 13),
        (dt.datetime(2008, 12, 31, 23, 59, 59), 14),
        (dt.datetime(2016, 12, 31, 23, 59, 59), 17),
        (dt.datetime(2017, 1, 1), 18),
        (dt.datetime(2024, 2, 29), 18),
    ):
        utc = np.array([(moment - GPS_EPOCH).total_seconds()])
        assert gps_time_s(utc, "UTC")[0] - utc[0] == ahead
        assert gps_time_s(utc + 9 * 3600.0, "JST")[0] - utc[0] == ahead


def test_heights_above_the_sea_and_above_the_ellipsoid_are_not_compared(tmp_path: Path) -> None:
    made = Made(PLACES["Nagoya"])
    head = "% (lat/lon/height=WGS84/{},Q=1:fix,ns=# of satellites)"
    sea = read_rtklib_pos(written(tmp_path / "sea.pos", made, head=head.format("geodetic")))
    ellipsoid = read_rtklib_pos(written(tmp_path / "e.pos", made, head=head.format("ellipsoidal")))
    assert errors_against_truth(sea, sea).available.all()
    with pytest.raises(DataError, match=r"sea\.pos against .*e\.pos: geodetic and ellipsoidal heights"):
        errors_against_truth(sea, ellipsoid)
    with pytest.raises(DataError, match=r"line 4: positions in datum Tokyo"):
        read_rtklib_pos(
            written(tmp_path / "t.pos", made, head=head.format("geodetic").replace("WGS84", "Tokyo"))
        )


def changed(path: Path, change: Callable[[list[str]], list[str]]) -> Path:
    lines = path.read_bytes().decode("cp932").split("\r\n")
    path.write_bytes("\r\n".join(change(lines)).encode("cp932"))
    return path


def test_epochs_without_a_fix_and_repeated_lines_are_left_out(tmp_path: Path) -> None:
    made = Made(PLACES["Nagoya"])

    def change(lines: list[str]) -> list[str]:
        lines[7] = lines[7].replace("   5  12", "   0  12")
        return [*lines[:10], lines[9], *lines[10:]]

    whole = read_rtklib_pos(written(tmp_path / "a.pos", made))
    track = read_rtklib_pos(changed(written(tmp_path / "b.pos", made), change))
    kept = [0, 1, 3, 4, 5]
    np.testing.assert_array_equal(track.time_s, whole.time_s[kept])
    np.testing.assert_array_equal(track.geodetic, whole.geodetic[kept])


def test_a_truth_needs_no_standard_deviations(tmp_path: Path) -> None:
    made = Made(PLACES["Nagoya"])

    def without(lines: list[str]) -> list[str]:
        return [
            *lines[:4],
            " ".join(lines[4].split()[:6]),
            *(" ".join(line.split()[:7]) for line in lines[5:]),
        ]

    whole = read_rtklib_pos(written(tmp_path / "a.pos", made))
    bare = read_rtklib_pos(changed(written(tmp_path / "b.pos", made), without))
    np.testing.assert_array_equal(bare.geodetic, whole.geodetic)
    np.testing.assert_array_equal(bare.covariance, 0.0)
    assert errors_against_truth(whole, bare).available.all()


def test_four_decimals_of_millimetres_are_a_covariance(tmp_path: Path) -> None:
    """As an RTK log has them: sigmas of 1 mm, axes that hang together, an eigenvalue below zero."""
    exact = np.array([[0.69, 0.88, 1.34], [0.88, 1.46, 2.11], [1.34, 2.11, 3.35]]) * 1e-6
    assert np.linalg.eigvalsh(exact)[0] > 0.0
    printed = np.round(np.sqrt(exact), 4) ** 2
    low, _, high = np.linalg.eigvalsh(printed)
    assert low < -1e-3 * high
    made = Made(PLACES["Nagoya"])
    made.covariance = np.tile(exact, (EPOCHS, 1, 1))

    def four_decimals(lines: list[str]) -> list[str]:
        rows = [line.split() for line in lines[5:-1]]
        cut = [[*row[:7], *(f"{float(word):.4f}" for word in row[7:13]), *row[13:]] for row in rows]
        return [*lines[:5], *(" ".join(row) for row in cut), ""]

    track = read_rtklib_pos(changed(written(tmp_path / "a.pos", made), four_decimals))
    assert errors_against_truth(track, track).available.all()
    np.testing.assert_allclose(track.covariance, made.covariance, atol=4e-7)
    path = changed(tmp_path / "a.pos", lambda lines: [line.replace("0.0015", "0.0040") for line in lines])
    wrong = read_rtklib_pos(path)
    with pytest.raises(DataError, match="a matrix that is no covariance"):
        errors_against_truth(wrong, wrong)


def moved(old: str, new: str, at: int = 6) -> Callable[[list[str]], list[str]]:
    def change(lines: list[str]) -> list[str]:
        assert old in lines[at]
        return [*lines[:at], lines[at].replace(old, new, 1), *lines[at + 1 :]]

    return change


def with_sigma(line: str, text: str) -> str:
    fields = line.split(",")
    return ",".join([*fields[:6], text, *fields[7:]])


BAD = {
    "an empty field": ("deg", ",", lambda lines: [*lines[:6], with_sigma(lines[6], ""), *lines[7:]],
                       r"line 7: sdn\(m\) is empty, not a number"),
    "not a text": ("deg", ",", lambda lines: [*lines[:6], with_sigma(lines[6], "\u30c7"), *lines[7:]],
                   r"line 7: sdn\(m\) is .*, not a number"),
    "a line cut before Q": ("deg", " ", lambda lines: [*lines[:4], " ".join(lines[4].split()[:6]),
                                                       *(" ".join(line.split()[:5]) for line in lines[5:])],
                            "line 6: 5 fields, the header promises at least 6"),
    "no base": ("enu", " ", lambda lines: lines[2:], r"a\.pos: positions count from a base"),
    "a base that is none": ("enu", " ", moved("pos   :", "pos   : 5", 1), "line 2: .* no reference"),
    "minutes": ("dms", " ", moved(" 09 ", " 69 "), r"line 7: latitude\(d'\"\) is 35 69 .*, not degrees"),
    "not on earth": ("ecef", " ", moved("-38", "-78"), r"line 7: x, y, z are .* m from the earth's centre"),
    "another form": (
        "deg", " ", lambda lines: [*lines[:8], lines[4].replace("GPST", "UTC "), *lines[8:]],
        "line 9: another header",
    ),
    "said differently": ("deg", " ", lambda lines: [*lines[:7], lines[6].replace("35.1", "35.2"), *lines[7:]],
                         "line 8: time .* keep one line an epoch"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_is_wrong_is_named_with_its_line(tmp_path: Path, name: str) -> None:
    kind, separator, change, message = BAD[name]
    path = changed(written(tmp_path / "a.pos", Made(PLACES["Nagoya"]), kind, separator=separator), change)
    with pytest.raises(DataError, match=message):
        read_rtklib_pos(path)
