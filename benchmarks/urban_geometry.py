"""Satellites in sight and dilution of precision by height among the buildings of Nishi-Shinjuku.

    python benchmarks/urban_geometry.py --data DIR [--points N] [--moment 2023-07-11T23:10]

Free points are drawn uniformly over 1 km x 1 km about the city hall, moments uniformly over 2023-07-11 (GPS
time) unless one is given; GPS, Galileo and QZSS above 10 degrees and in line of sight. One clock for GPS and
QZSS, one for Galileo. Solvable: satellites >= 3 + clocks and PDOP <= 100. The last column takes one clock for
all systems.
"""

import argparse
import datetime as dt
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napf_mpc.navigation.ephemeris import Ephemerides
from napf_mpc.navigation.gnss import CLOCK_OF_SYSTEM
from napf_mpc.navigation.pseudorange_solution import Check, SolverSettings, solve
from napf_mpc.navigation.rinex import gps_seconds, read_rinex_navigation
from napf_mpc.navigation.sky import directions, elevation_rad
from napf_mpc.problem import City
from napf_mpc.streams import Stream, generator
from napf_mpc.world.city import load_city
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.sight import line_of_sight

ORIGIN_DEG = (35.6895, 139.6917)
HALF_M = 500.0
_PLAIN = SolverSettings("plain", exclude=False, max_pdop=100.0)


def at_height(
    city: ObstacleSet, records: Ephemerides, height_m: float, count: int, seed: int, moment_s: float | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Satellites (point,), and HDOP, VDOP, PDOP (point, 3) with two clocks and with one."""
    stream = generator(seed, round(height_m), Stream.SCENE)
    seen: list[float] = []
    two: list[NDArray[np.float64]] = []
    one: list[NDArray[np.float64]] = []
    while len(seen) < count:
        place = np.array([[[*stream.uniform(-HALF_M, HALF_M, 2), height_m]]])
        drawn_s = gps_seconds(dt.datetime(2023, 7, 11)) + 86_400.0 * stream.uniform()
        time_s = drawn_s if moment_s is None else moment_s
        if city.signed_distance(place)[0, 0] <= 0.0:
            continue
        constellation = records.at(time_s)
        unit = directions(constellation, *ORIGIN_DEG, np.array([time_s]))
        free = line_of_sight(city, place, unit, elevation_rad(unit) >= np.radians(10.0))[0]
        clock = CLOCK_OF_SYSTEM[constellation.system]
        zero, unity = np.zeros(free.shape), np.ones(free.shape)
        for kept, clocks in ((two, clock), (one, np.zeros_like(clock))):
            found = solve(unit, clocks, zero, unity, free, _PLAIN)
            kept.append(np.full(3, np.nan) if found.check[0] == Check.NONE else found.dop[0])
        seen.append(float(free.sum()))
    return np.array(seen, dtype=np.float64), np.array(two), np.array(one)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="data folder")
    parser.add_argument("--points", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--moment", type=dt.datetime.fromisoformat, help="GPS time, the same for all points")
    options = parser.parse_args()
    latitude, longitude = ORIGIN_DEG
    world = City(
        kind="city",
        file="city_tokyo_nishi_shinjuku/buildings.geojson",
        origin_latitude_deg=latitude,
        origin_longitude_deg=longitude,
    )
    city = load_city(world, options.data)
    records = read_rinex_navigation(options.data / "gnss_nagoya_spp" / "broadcast.nav")
    moment_s = None if options.moment is None else gps_seconds(options.moment)
    print(f"N = {options.points} points a height, seed {options.seed}")
    print("| height m | satellites (min) | solvable | HDOP median / 95 % | VDOP median / 95 % | one clock |")
    print("| --- | --- | --- | --- | --- | --- |")
    for height in (5.0, 20.0, 60.0, 120.0, 240.0):
        seen, two, one = at_height(city, records, height, options.points, options.seed, moment_s)
        solved, alone = np.isfinite(two[:, 0]), np.isfinite(one[:, 0])
        h, v = two[solved, 0], two[solved, 1]
        print(
            f"| {height:g} | {seen.mean():.1f} ({seen.min():.0f}) | {100 * solved.mean():.0f} % "
            f"| {np.median(h):.2f} / {np.quantile(h, 0.95):.2f} "
            f"| {np.median(v):.2f} / {np.quantile(v, 0.95):.2f} "
            f"| {100 * alone.mean():.0f} %, {np.median(one[alone, 0]):.2f}, {np.median(one[alone, 1]):.2f} |"
        )


if __name__ == "__main__":
    main()
