"""What the navigation filters make of emulated receivers: errors, and what is claimed of them.

    python benchmarks/navigation_filters.py [--problem nishi_shinjuku_gnss --data DIR] [--runs N] [--seed S]

UAVs stay in their slots at the reference speed, no planner; runs have their own times of the day, all filters
have the same fixes. ``--set`` changes the problem, as ``navigation.reported_sigma_scale=0.5``. Errors and
shares are of a moment a second, from the first on; those of a run are correlated, so only the share of runs
has an interval.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from napf_mpc.lanes import LaneNavigation, navigate
from napf_mpc.plot.style import BLUE, VERMILION, house_style
from napf_mpc.problem_file import load_problem
from napf_mpc.risk import wilson

Array = NDArray[np.float64]

FILTERS = {
    "kalman": {"navigation.filter": "kalman"},
    "kalman, watched": {"navigation.filter": "kalman", "navigation.monitor": "innovations"},
    "point_mass": {"navigation.filter": "point_mass"},
    "point_mass, watched": {"navigation.filter": "point_mass", "navigation.monitor": "innovations"},
}


def row(label: str, told: LaneNavigation) -> str:
    """One line of the table."""
    e, c = told.error, told.covariance
    across, up = np.hypot(e[..., 0], e[..., 1]), np.abs(e[..., 2])
    sigma = np.sqrt(np.einsum("...aa->...a", c))
    nees = np.einsum("...a,...ab,...b->...", e, np.linalg.inv(c), e) / 3.0
    drms = np.hypot(sigma[..., 0], sigma[..., 1])
    # Three sigma of a circle as wide as the ellipse is on average.
    beyond = across - 3.0 * drms / np.sqrt(2.0)
    runs = e.shape[1]
    lost = wilson(int((beyond > 2.0).any(axis=(0, 2)).sum()), runs)
    quantiles = " / ".join(f"{q:.1f}" for q in np.quantile(across, [0.5, 0.95, 0.999]))
    return (
        f"| {label} | {quantiles} | {np.quantile(up, 0.95):.1f} / {np.quantile(up, 0.999):.1f} "
        f"| {np.median(drms):.1f} | {nees.mean():.2f} | {100 * (np.abs(e) < 3.0 * sigma).mean():.2f} % "
        f"| {100 * lost.value:.0f} [{100 * lost.low:.0f}, {100 * lost.high:.0f}] % "
        f"| {told.gated_fixes.mean():.0f} |"
    )


def since(told: LaneNavigation, first_s: float) -> LaneNavigation:
    """Return what was told from a time on."""
    late = told.time_s >= first_s
    return replace(told, time_s=told.time_s[late], error=told.error[late], covariance=told.covariance[late])


def figure(tolds: dict[str, LaneNavigation], path: Path) -> None:
    """Save the error of the UAV that the Kalman filter lost farthest, and the tails of all."""
    far = np.abs(tolds["kalman"].error[..., 0])
    lost = np.unravel_index(far.max(axis=0).argmax(), far.shape[1:])
    with house_style():
        drawn, (left, right) = plt.subplots(1, 2, figsize=(7.2, 2.6), layout="constrained")
        for name, label, colour in (("kalman", "Kalman", VERMILION), ("point_mass", "point-mass", BLUE)):
            told = tolds[name]
            error, band = told.error[:, *lost, 0], 3.0 * np.sqrt(told.covariance[:, *lost, 0, 0])
            left.plot(told.time_s, error, color=colour, label=label)
            left.fill_between(told.time_s, -band, band, color=colour, alpha=0.15, linewidth=0.0)
            across = np.sort(np.hypot(told.error[..., 0], told.error[..., 1]).ravel())
            beyond = 1.0 - np.arange(len(across)) / len(across)
            right.semilogy(across, beyond, color=colour, label=label)
        left.set(xlabel="time (s)", ylabel="error east (m)", xlim=(0.0, told.time_s[-1]))
        left.set_title("one UAV, and 3 sigma as reported by either")
        right.set(xlabel="horizontal error (m)", ylabel="share beyond", xlim=(0.0, None), ylim=(1e-4, 1.0))
        right.set_title("all UAVs")
        left.legend()
        right.legend()
        drawn.savefig(path, dpi=200)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--problem", default="street_canyon_gnss")
    parser.add_argument("--data", type=Path)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=7200)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--stand", type=float, metavar="METRES", help="stand this far along for a minute")
    parser.add_argument(
        "--outage",
        type=float,
        nargs=2,
        metavar=("FROM", "TO"),
        help="no fix for so long [s]; told of it alone",
    )
    parser.add_argument("--figure", type=Path, metavar="FILE", help="save errors over time and their tails")
    options = parser.parse_args()
    print(f"{options.problem}, N = {options.runs} runs, seed {options.seed} {' '.join(options.set)}")
    print(
        "| filter | H error, median / 95 % / 99.9 % [m] | U, 95 % / 99.9 % [m] | drms, median [m] | NEES "
        "| within 3 sigma, axes | runs with a UAV 2 m beyond 3 sigma | fixes a run refused or outvoted |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    tolds: dict[str, LaneNavigation] = {}
    for label, settings in FILTERS.items():
        overrides = [f"{key}={value}" for key, value in settings.items()]
        problem = load_problem(options.problem, [*options.set, *overrides])
        tolds[label] = navigate(
            problem, options.seed, range(options.runs), stand_m=options.stand, data_folder=options.data,
            outage_s=options.outage, seconds=options.outage[1] if options.outage else None,
        )  # fmt: skip
        if options.outage:
            tolds[label] = since(tolds[label], options.outage[0])
        print(row(label, tolds[label]), flush=True)
    if options.figure:
        figure(tolds, options.figure)


if __name__ == "__main__":
    main()
