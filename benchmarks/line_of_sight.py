"""Line of sight from ten thousand points to all satellites among the buildings of Nishi-Shinjuku: its time.

    python benchmarks/line_of_sight.py --data DIR

Points are uniform over 1.2 km x 1.2 km and from 5 to 240 m high (free or not), satellites those of the
broadcast ephemerides on 2023-07-11 at noon, GPS time, above 10 degrees. Subsets of the buildings are drawn at
random.
"""

import argparse
import datetime as dt
import time
from pathlib import Path

import numpy as np

from napf_mpc.navigation.rinex import gps_seconds, read_rinex_navigation
from napf_mpc.navigation.sky import directions, elevation_rad
from napf_mpc.problem import City
from napf_mpc.provenance import processor
from napf_mpc.streams import Stream, generator
from napf_mpc.world.city import load_city
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.sight import line_of_sight

ORIGIN_DEG = (35.6895, 139.6917)
POINTS = 10_000
REPEATS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="data folder")
    folder = parser.parse_args().data
    latitude, longitude = ORIGIN_DEG
    city = load_city(
        City(
            kind="city",
            file="city_tokyo_nishi_shinjuku/buildings.geojson",
            origin_latitude_deg=latitude,
            origin_longitude_deg=longitude,
        ),
        folder,
    )
    noon = gps_seconds(dt.datetime(2023, 7, 11, 12))
    constellation = read_rinex_navigation(folder / "gnss_nagoya_spp" / "broadcast.nav").at(noon)
    unit = directions(constellation, latitude, longitude, np.array([noon]))
    unit = unit[:, elevation_rad(unit[0]) >= np.radians(10.0)]
    stream = generator(0, 0, Stream.SCENE)
    points = np.stack(
        [
            stream.uniform(-600.0, 600.0, POINTS),
            stream.uniform(-600.0, 600.0, POINTS),
            stream.uniform(5.0, 240.0, POINTS),
        ],
        axis=-1,
    )[None]
    print(f"{processor()}; {POINTS} points x {unit.shape[1]} satellites; best of {REPEATS}")
    print("| buildings | time [s] | rays a second | free |")
    print("| --- | --- | --- | --- |")
    order = stream.permutation(len(city))
    shapes = city.shapes()
    for count in (100, 300, 1000, len(shapes)):
        some = ObstacleSet.from_shapes([shapes[i] for i in order[:count]])
        line_of_sight(some, points[:, :10], unit)  # compiles, plants the tree
        best = np.inf
        for _ in range(REPEATS):
            began = time.perf_counter()
            free = line_of_sight(some, points, unit)
            best = min(best, time.perf_counter() - began)
        print(f"| {count} | {best:.3f} | {free.size / best:.3g} | {100 * free.mean():.1f} % |")


if __name__ == "__main__":
    main()
