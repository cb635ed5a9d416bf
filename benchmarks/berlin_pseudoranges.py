"""Positions from the measured pseudoranges of a drive through Berlin, by ways to solve, against the truth.

    python benchmarks/berlin_pseudoranges.py --data DIR

Data: smartLoc, Berlin Potsdamer Platz (TU Chemnitz, CC BY-SA 4.0), 1372 epochs of GPS and GLONASS, sigmas as
the receiver gives them. One clock a system. Epochs are correlated (0.6-0.8 at 5 s): no independent trials.
"""

import argparse
from pathlib import Path

import numpy as np
import pymap3d
from numpy.typing import NDArray

from napf_mpc.navigation.ephemeris import LIGHT_MPS
from napf_mpc.navigation.gnss_levels import TRUSTED
from napf_mpc.navigation.integrity.levels import LevelSettings, protection_levels
from napf_mpc.navigation.pseudorange_solution import Check, SolverSettings, solve
from napf_mpc.navigation.pseudoranges import fix_from_pseudoranges
from napf_mpc.navigation.range_errors import (
    carrier_to_noise_dbhz,
    code_noise_sigma_m,
    multipath_sigma_m,
    obliquity,
    p_reflected,
    troposphere_mapping,
)
from napf_mpc.navigation.sky import east_north_up, turned
from napf_mpc.problem import Gnss

Array = NDArray[np.float64]
FOLDER = "gnss_berlin_smartloc"
GLONASS = 4.0
TIME, RANGE, VARIANCE, SATELLITE, SYSTEM, ELEVATION, STRENGTH = 0, 1, 2, slice(3, 6), 7, 8, 9
ALL, STRONG, STRONGER = (0.0, 0.0), (15.0, 30.0), (15.0, 35.0)


def read(folder: Path) -> tuple[Array, Array]:
    """Pseudoranges, and the truth (time, x, y, z)."""
    ranges = (folder / FOLDER / "Berlin_Potsdamer_Platz_Input.txt").read_text().splitlines()
    truth = (folder / FOLDER / "Berlin_Potsdamer_Platz_GT.txt").read_text().splitlines()
    return (
        np.array([line.split()[1:] for line in ranges if line.startswith("pseudorange3")], dtype=np.float64),
        np.array([line.split()[1:5] for line in truth if line.startswith("point3")], dtype=np.float64),
    )


def errors(
    ranges: Array, truth: Array, mask: tuple[float, float], settings: SolverSettings, turns: bool = True
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Errors (epoch, 3) east, north, up, reported covariances, and what the residuals said."""
    kept = ranges[(ranges[:, ELEVATION] >= mask[0]) & (ranges[:, STRENGTH] >= mask[1])]
    found, reported, checks = [], [], []
    for time_s in np.unique(ranges[:, TIME]):
        rows = kept[kept[:, TIME] == time_s]
        clock = (rows[:, SYSTEM] == GLONASS).astype(np.int64)
        if len(rows) == 0:
            continue
        fix = fix_from_pseudoranges(
            rows[:, RANGE], rows[:, SATELLITE], clock, np.sqrt(rows[:, VARIANCE]), settings, earth_turns=turns
        )
        if fix.check == Check.NONE:
            continue
        true = truth[np.argmin(np.abs(truth[:, 0] - time_s)), 1:]
        latitude, longitude, _ = pymap3d.ecef2geodetic(*true)
        found.append(east_north_up(float(latitude), float(longitude)) @ (fix.place - true))
        reported.append(fix.solution.covariance[0])
        checks.append(int(fix.check))
    return np.array(found), np.array(reported), np.array(checks, dtype=np.int64)


def levels(ranges: Array, truth: Array, p_hmi: float, reported: bool) -> tuple[Array, Array, Array]:
    """Errors (epoch, 3), HPL and VPL (epoch, 2), and covariances; infinite levels where there are none.

    Signals are reflections with the probability that emulated receivers take from C/N0 and elevation, sigmas
    of the others those that this receiver reports, or those of emulated ones.
    """
    cfg = Gnss(kind="gnss")
    low, high = cfg.carrier_to_noise_dbhz
    found, level, covariances = [], [], []
    for time_s in np.unique(ranges[:, TIME]):
        rows = ranges[(ranges[:, TIME] == time_s) & (ranges[:, ELEVATION] >= cfg.elevation_mask_deg)]
        clock = (rows[:, SYSTEM] == GLONASS).astype(np.int64)
        plain = SolverSettings("plain", exclude=False, max_pdop=1e6)
        sigma = np.sqrt(rows[:, VARIANCE])
        start = fix_from_pseudoranges(rows[:, RANGE], rows[:, SATELLITE], clock, sigma, plain)
        if start.check == Check.NONE:
            continue
        latitude, longitude, _ = pymap3d.ecef2geodetic(*start.place)
        axes = east_north_up(float(latitude), float(longitude))
        flight = np.linalg.norm(rows[:, SATELLITE] - start.place, axis=-1) / LIGHT_MPS
        away = turned(rows[:, SATELLITE], flight) - start.place
        distance = np.linalg.norm(away, axis=-1)
        unit, left = ((away / distance[:, None]) @ axes.T)[None], (rows[:, RANGE] - distance)[None]
        elevation = np.radians(rows[:, ELEVATION])
        if not reported:
            parts = (
                np.full(len(rows), cfg.signal_in_space_m),
                cfg.ionosphere_m * obliquity(elevation),
                cfg.troposphere_m * troposphere_mapping(elevation),
                cfg.multipath_scale * multipath_sigma_m(elevation),
                code_noise_sigma_m(rows[:, STRENGTH], cfg.code_noise_m),
            )
            sigma = np.sqrt(sum(part**2 for part in parts))
        fault = p_reflected(
            rows[:, STRENGTH] - carrier_to_noise_dbhz(elevation, low, high), cfg.fading_db,
            cfg.reflected_loss_db, cfg.reflected_loss_sigma_db,
            cfg.prior_reflected * (1.0 - elevation / (0.5 * np.pi)),
        )  # fmt: skip
        usable = (fault <= TRUSTED)[None]
        answer = protection_levels(
            unit, clock, left, sigma[None], fault[None], usable, LevelSettings(p_hmi, cfg.false_alarm)
        )
        mine = solve(unit, clock, left, sigma[None], answer.used, plain)
        true = truth[np.argmin(np.abs(truth[:, 0] - time_s)), 1:]
        found.append(axes @ (start.place - true) + mine.offset[0])
        level.append(answer.level_m[0])
        covariances.append(mine.covariance[0])
    return np.array(found), np.array(level), np.array(covariances)


def level_row(words: str, found: tuple[Array, Array, Array]) -> str:
    """How often there is a level, and how often it is true, beside 3 sigma of the same position."""
    error, level, covariance = found
    known = np.asarray(np.isfinite(level).all(-1))
    if not known.any():
        return f"| {words} | 0 of {len(known)} | | | | | |"
    error, level, covariance = error[known], level[known], covariance[known]
    across, up = np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])
    drms = np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])
    return (
        f"| {words} | {known.sum()} of {len(known)} "
        f"| {np.median(across):.1f} / {np.quantile(across, 0.95):.1f} "
        f"| {np.median(level[:, 0]):.0f}, {np.median(level[:, 1]):.0f} "
        f"| {100 * np.mean(across < 3 * drms):.1f} %, "
        f"{100 * np.mean(up < 3 * np.sqrt(covariance[:, 2, 2])):.1f} % "
        f"| {100 * np.mean(across < level[:, 0]):.1f} %, {100 * np.mean(up < level[:, 1]):.1f} % |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="data folder")
    ranges, truth = read(parser.parse_args().data)
    epochs = len(np.unique(ranges[:, TIME]))
    plain = SolverSettings("plain", exclude=False, max_pdop=1e6)
    ways = [
        ("all satellites, plain, the earth's turn left out", ALL, plain, False),
        ("all satellites, plain", ALL, plain, True),
        ("all, Huber", ALL, SolverSettings("huber", exclude=False, max_pdop=1e6), True),
        ("all, Cauchy", ALL, SolverSettings("cauchy", exclude=False, max_pdop=1e6), True),
        ("all, exclusion", ALL, SolverSettings("plain", exclude=True, max_pdop=1e6), True),
        ("elevation >= 15, C/N0 >= 30, plain", STRONG, plain, True),
        ("elevation >= 15, C/N0 >= 35, plain", STRONGER, plain, True),
        ("elevation >= 15, C/N0 >= 35, exclusion", STRONGER, SolverSettings("plain", max_pdop=1e6), True),
        ("elevation >= 15, C/N0 >= 35, Huber", STRONGER, SolverSettings("huber", False, max_pdop=1e6), True),
        (
            "elevation >= 15, C/N0 >= 35, Cauchy",
            STRONGER,
            SolverSettings("cauchy", False, max_pdop=1e6),
            True,
        ),
        ("the same, exclusion and Cauchy", STRONGER, SolverSettings("cauchy", max_pdop=1e6), True),
    ]
    print(
        "| way | epochs solved | H error median / 95 % [m] | mean east, up [m] | H < 3 drms | U < 3 sigma "
        "| unchecked, faulty |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, mask, settings, turns in ways:
        error, covariance, check = errors(ranges, truth, mask, settings, turns)
        across = np.hypot(error[:, 0], error[:, 1])
        drms = np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])
        up = np.abs(error[:, 2]) < 3.0 * np.sqrt(covariance[:, 2, 2])
        print(
            f"| {name} | {len(error)}/{epochs} | {np.median(across):.1f} / {np.quantile(across, 0.95):.1f} "
            f"| {error[:, 0].mean():+.1f}, {error[:, 2].mean():+.1f} "
            f"| {100 * np.mean(across < 3 * drms):.1f} % "
            f"| {100 * np.mean(up):.1f} % "
            f"| {np.sum(check == Check.UNCHECKED)}, {np.sum(check == Check.FAULTY)} |"
        )

    print(
        "\n| sigmas, P_HMI | with a level | H error median / 95 % [m] | HPL, VPL, median [m] "
        "| H < 3 drms, U < 3 sigma | H < HPL, U < VPL |"
    )
    print("| --- " * 6 + "|")
    for words, reported in (("of this receiver", True), ("of emulated receivers", False)):
        for p_hmi in (1e-2, 1e-3):
            print(level_row(f"{words}, {p_hmi:g}", levels(ranges, truth, p_hmi, reported)))


if __name__ == "__main__":
    main()
