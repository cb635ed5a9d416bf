"""Largest difference of orbits and clocks to cssrlib's, from the same broadcast records of more than a day.

    pip install cssrlib
    python benchmarks/orbits.py --data DIR

All records of GPS, Galileo (I/NAV) and QZSS in the file, every ten minutes within two hours of their time.

cssrlib 1.2.1 solves Kepler's equation by ten steps E <- M + e sin E. That is within 0.1 mm for e < 0.1, but
leaves 6 cm on the two Galileo satellites of eccentricity 0.16 (E14, E18). They are compared twice: as they
are, and with the iteration carried on to rounding.
"""

import argparse
import math
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from napf_mpc.navigation.ephemeris import LIGHT_MPS, SYSTEMS, Ephemerides
from napf_mpc.navigation.rinex import read_rinex_navigation

WEEK_S = 604_800
STEP_S = 600.0
VALID_S = 7200.0


def kepler(mean: float, eccentricity: float) -> tuple[float, float]:
    """Anomaly and its sine, by cssrlib's iteration carried on."""
    anomaly = mean
    for _ in range(100):
        anomaly = mean + eccentricity * math.sin(anomaly)
    return anomaly, math.sin(anomaly)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="data folder")
    path = parser.parse_args().data / "gnss_nagoya_spp" / "broadcast.nav"
    # A package without types, which only this benchmark and one test use.
    try:
        gnss: Any = import_module("cssrlib.gnss")
    except ImportError as error:
        raise SystemExit("the comparison needs the package cssrlib: pip install cssrlib") from error
    orbits: Any = import_module("cssrlib.ephemeris")
    rinex: Any = import_module("cssrlib.rinex")
    nav = gnss.Nav()
    rinex.rnxdec().decode_nav(str(path), nav)
    theirs: dict[Any, Any] = {}
    for one in nav.eph:
        if one.mode == 0:
            theirs.setdefault((gnss.sat2id(one.sat), one.toe.time + one.toe.sec), one)
    records = read_rinex_navigation(path)
    hours = np.ptp(records.toe_s) / 3600.0
    print(f"{len(records)} records over {hours:.1f} h, each every {STEP_S:g} s within {VALID_S:g} s")
    print("| system | satellites | orbit, largest difference [m] | clock [m] |")
    print("| --- | --- | --- | --- |")
    compare(records, theirs, gnss, orbits, "as it is")
    orbits.eccentricAnomaly = kepler
    compare(records, theirs, gnss, orbits, "carried on")


def compare(records: Ephemerides, theirs: dict[Any, Any], gnss: Any, orbits: Any, words: str) -> None:
    """Print a line a system."""
    largest = np.zeros((len(SYSTEMS), 2))
    names: list[set[str]] = [set() for _ in SYSTEMS]
    for n, name in enumerate(records.name):
        toe = gnss.gpst2time(int(records.toe_s[n] // WEEK_S), records.toe_s[n] % WEEK_S)
        record = theirs[str(name), toe.time + toe.sec]
        one_record = records.take([n])
        system = int(records.system[n])
        names[system].add(str(name))
        for time_s in records.toe_s[n] + np.arange(-VALID_S, VALID_S + 1.0, STEP_S):
            moment = np.array([time_s])
            place, clock = orbits.eph2pos(gnss.gpst2time(int(time_s // WEEK_S), time_s % WEEK_S), record)
            apart = [
                np.linalg.norm(place - one_record.positions(moment)[0, 0]),
                abs(clock - one_record.clock_s(moment)[0, 0]) * LIGHT_MPS,
            ]
            largest[system] = np.maximum(largest[system], apart)
    for system, word in enumerate(SYSTEMS):
        orbit, clock = largest[system]
        print(f"| {word}, {words} | {len(names[system])} | {orbit:.1e} | {clock:.1e} |")


if __name__ == "__main__":
    main()
