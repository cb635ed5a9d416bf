"""What reported sigmas of a real urban log are worth: coverage, overbounds, and misleading epochs.

Run ``python benchmarks/integrity_nagoya.py --data DIR [--out DIR]`` (seconds); it prints Markdown and writes
two figures. Every bound is fitted to one half of the log and judged on the other. Nothing is drawn at random.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napf_mpc.data_folder import find_data_file
from napf_mpc.navigation.integrity.overbound import Overbound, fit_overbound
from napf_mpc.navigation.integrity.stanford import Integrity, classify, count_classes
from napf_mpc.navigation.integrity.tails import confidence_factor, fit_student
from napf_mpc.navigation.recorded import ErrorLog, errors_against_truth, halves
from napf_mpc.navigation.rtklib import read_rtklib_pos
from napf_mpc.plot import StanfordPanel, TailPanel, draw_stanford, draw_tails

Array = NDArray[np.float64]

LOG, TRUTH = "gnss_nagoya_spp/rover_1Hz_spp.pos", "gnss_nagoya_spp/reference_1Hz.pos"
CREDIT = "GNSS log of a car in Nagoya: T. Suzuki, MatRTKLIB, MIT"
AXES = ("east", "north", "up")
K = 3.0
CONFIDENCE = 0.9973
ALERT_LIMITS_M = {"horizontal": 40.0, "vertical": 50.0}
"""Of the approach APV-I (ICAO Annex 10, volume I, table 3.7.2.4-1), for want of one for UAVs."""


@dataclass(frozen=True)
class Half:
    """One half of the log, and the bound of the other."""

    name: str
    """Which."""
    error: Array
    """(n, 3) at epochs with a fix [m]."""
    covariance: Array
    """(n, 3, 3) as reported [m^2]."""
    bound: Overbound
    """Fitted to the other half."""
    student: tuple[float, float, float]
    """Reported sigmas of the fitted t law at the confidence of 3 sigma, from the other half."""

    @property
    def normalised(self) -> Array:
        """(n, 3) errors over reported sigmas."""
        return np.asarray(self.error / np.sqrt(np.einsum("nii->ni", self.covariance)))


def read(data: Path | None) -> tuple[Half, Half]:
    """Both halves of the log."""
    solution = read_rtklib_pos(find_data_file(LOG, data))
    log = errors_against_truth(solution, read_rtklib_pos(find_data_file(TRUTH, data)))
    first, second = halves(log)
    return _half("first", first, second), _half("second", second, first)


def _half(name: str, flown: ErrorLog, other: ErrorLog) -> Half:
    fixes = other.available
    z = other.error[fixes] / np.sqrt(np.einsum("nii->ni", other.covariance[fixes]))
    east, north, up = (fit_student(column).factor(CONFIDENCE) for column in z.T)
    return Half(
        name, flown.error[flown.available], flown.covariance[flown.available], fit_overbound(other),
        (east, north, up),
    )  # fmt: skip


def levels(covariance: Array, factors: Array) -> dict[str, Array]:
    """Protection levels of a bare covariance (n, 3, 3) whose axes grow by factors (3,) [m].

    Horizontal: the two-dimensional 99.73 % ellipse's long axis. Vertical: 3 sigma.
    """
    grown = covariance * factors[:, None] * factors
    long_axis = np.sqrt(np.linalg.eigvalsh(grown[:, :2, :2])[:, -1])
    return {
        "horizontal": confidence_factor(CONFIDENCE, 2) * long_axis,
        "vertical": K * np.sqrt(grown[:, 2, 2]),
    }


def errors(half: Half) -> dict[str, Array]:
    """Sizes of the errors that they are to bound [m]."""
    return {
        "horizontal": np.hypot(half.error[:, 0], half.error[:, 1]),
        "vertical": np.abs(half.error[:, 2]),
    }


def coverage_table(parts: tuple[Half, Half]) -> list[str]:
    """Markdown: fits, and shares of errors within 3 sigma before and after."""
    lines = [
        "| axis | fitted to | fixes | worth | told up to k | b | s | factor at k = 3 | judged on | fixes | "
        "within 3 sigma | within the overbound | within Student's t |",
        "| --- " * 13 + "|",
    ]
    for a, axis in enumerate(AXES):
        for half in parts:
            bound, z = half.bound.axes[a], np.abs(half.normalised[:, a])
            other = "second" if half.name == "first" else "first"
            inside = [(z <= limit).mean() for limit in (K, K * bound.factor(K), half.student[a])]
            lines.append(
                f"| {axis} | {other} half | {bound.n} | {bound.effective_n:.0f} | {bound.supported_k:.1f} | "
                f"{bound.bias:.2f} | {bound.sigma:.2f} | {bound.factor(K):.2f} | {half.name} | {len(z)} | "
                + " | ".join(f"{100 * share:.1f} %" for share in inside)
                + " |"
            )
    return lines


def stanford_panels(parts: tuple[Half, Half]) -> list[StanfordPanel]:
    """Reported and overbounded, horizontally and vertically, both halves together."""
    panels = []
    for direction, limit in ALERT_LIMITS_M.items():
        for words, bounded in (("reported sigma", False), ("overbound of the other half", True)):
            level = [
                levels(half.covariance, half.bound.factors(K) if bounded else np.ones(3))[direction]
                for half in parts
            ]
            error = [errors(half)[direction] for half in parts]
            title = f"{direction.capitalize()}, {words}"
            panels.append(StanfordPanel(title, np.concatenate(error), np.concatenate(level), limit))
    return panels


def stanford_table(panels: list[StanfordPanel]) -> list[str]:
    """Markdown: epochs of each class."""
    lines = [
        "| level | AL [m] | PL, median [m] | fixes | nominal | misleading | hazardously misleading | "
        "not available | not available and misleading |",
        "| --- " * 9 + "|",
    ]
    for panel in panels:
        count = count_classes(classify(panel.error_m, panel.level_m, panel.alert_limit_m))
        cells = [count.by_class[kind] for kind in Integrity if kind is not Integrity.NONE]
        lines.append(
            f"| {panel.title} | {panel.alert_limit_m:g} | {np.median(panel.level_m):.1f} | {count.total} | "
            + " | ".join(map(str, cells))
            + " |"
        )
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=None)
    parser.add_argument("--out", type=Path, default=None)
    chosen = parser.parse_args()
    parts = read(chosen.data)
    panels = stanford_panels(parts)
    print("\n".join([*coverage_table(parts), "", *stanford_table(panels)]))
    if chosen.out is not None:
        draw_stanford(panels, chosen.out, "nagoya_stanford", CREDIT)
        tails = [
            TailPanel(f"{axis.capitalize()}, {half.name} half", half.normalised[:, a], half.bound.axes[a])
            for half in parts[1:]
            for a, axis in enumerate(AXES)
        ]
        draw_tails(tails, chosen.out, "nagoya_tails", CREDIT)


if __name__ == "__main__":
    main()
