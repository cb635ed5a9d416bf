"""Asked risk against achieved risk at one obstacle that stays at its margin for 15 s.

Run ``python benchmarks/calibration.py`` (about three minutes on one core); it prints Markdown. Tables 1 to 3
hold the *estimate* of a point exactly at the margin, so that they test the margins alone: the errors are the
library's own, sigma swings from 1 to 5 m. Table 4 puts a planner in the place of the point: one UAV along a
wall that its lane is too close to, in the closed loop.

Seeds 300 to 399 are for development, 7000 to 7999 for reports; nobody tunes on the latter.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from napf_mpc.block import simulate
from napf_mpc.constraints.probability import BALL, DISC, HALF_SPACE, exact_margins
from napf_mpc.navigation.error_models import position_errors
from napf_mpc.problem import GaussMarkov, Problem
from napf_mpc.risk import Rate, clustered_rate, wilson
from napf_mpc.risk_budget import RiskBudget, RiskLedger, error_correlation_time

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BLOCKS = {"development": range(300, 400), "report": range(7000, 8000)}
ASKED = (0.10, 0.05, 0.01)
TIMES = (2.0, 10.0, 50.0)
RADII = (0.5, 1.0, 2.0, 4.0)
ACTIVE_S, PERIOD_S, UAV_RADIUS_M = 15.0, 0.1, 0.3
STEPS = round(ACTIVE_S / PERIOD_S)
SHAPES = {"wall": HALF_SPACE, "sphere": BALL, "cylinder": DISC}
WALL_Y_M, BEGIN_S = 1.0, 25.0


@dataclass(frozen=True)
class Draws:
    """Errors of many missions of one UAV."""

    error: Array
    """(run, step, 3) [m]."""
    sigma: Array
    """(run, step, 3) [m]."""


def drawn(seeds: Sequence[int], runs: int, correlation_time_s: float) -> Draws:
    """Errors of so many runs of every seed."""
    navigation = GaussMarkov(correlation_time_s=correlation_time_s)
    error = np.empty((len(seeds), runs, STEPS, 3))
    sigma = np.empty_like(error)
    for i, seed in enumerate(seeds):
        errors = position_errors(navigation, seed, range(runs), 1, ACTIVE_S, None)
        for step in range(STEPS):
            fix = errors.fix(step)
            error[i, :, step] = fix.error[:, 0]
            sigma[i, :, step] = np.sqrt(np.einsum("raa->ra", fix.covariance[:, 0]))
    return Draws(error.reshape(-1, STEPS, 3), sigma.reshape(-1, STEPS, 3))


def direction(bearing_deg: float) -> Array:
    """Unit vector from the obstacle to the point."""
    bearing = np.deg2rad(bearing_deg)
    return np.array([np.cos(bearing), np.sin(bearing), 0.0])


def margins(
    draws: Draws, shape: str, radius_m: float, k: float, bearing_deg: float, mission: RiskBudget | None = None
) -> Array:
    """Margins (run, step) between the UAV's surface and the obstacle's, as the library sets them [m]."""
    points, m = draws.error.shape[0] * STEPS, mission
    covariance = np.zeros((points, 3, 3))
    covariance[:, range(3), range(3)] = draws.sigma.reshape(-1, 3) ** 2
    margin = np.empty((points, 1))
    exact_margins(
        np.full((points, 1), SHAPES[shape]),
        np.full((points, 1), radius_m + UAV_RADIUS_M),
        np.tile(direction(bearing_deg), (points, 1, 1)),
        covariance,
        k,
        margin,
        *(() if m is None else (m.risk_per_uav, m.active_s, m.correlation_time_s, m.period_s)),
    )
    return margin.reshape(-1, STEPS)


def held_point(
    draws: Draws, shape: str, radius_m: float, k: float, bearing_deg: float, mission: RiskBudget | None = None
) -> Mask:
    """Whether (run, step) the true point touches an obstacle at whose margin its estimate is held."""
    normal, reach = direction(bearing_deg), radius_m + UAV_RADIUS_M
    away = margins(draws, shape, radius_m, k, bearing_deg, mission)[..., None] * normal - draws.error
    if shape == "wall":
        return np.asarray(away @ normal <= 0.0)
    true = away + reach * normal
    return np.asarray(np.linalg.norm(true if shape == "sphere" else true[..., :2], axis=-1) <= reach)


def step_k(asked: float) -> float:
    """Sigmas of a one-sided chance at one moment."""
    return -float(special.ndtri(asked))


def budget(asked: float, correlation_time_s: float) -> RiskBudget:
    """Budget as a problem with these errors would have it."""
    time = error_correlation_time(GaussMarkov(correlation_time_s=correlation_time_s))
    return RiskBudget(asked, 1, ACTIVE_S, time, PERIOD_S)


def per_step(contact: Mask) -> Rate:
    """Chance of a step, with an interval that allows for steps of one mission going together."""
    return clustered_rate(contact.sum(-1), contact.shape[1])


def per_mission(contact: Mask) -> Rate:
    return wilson(int(contact.any(-1).sum()), len(contact))


def percent(rate: Rate) -> str:
    return f"{100 * rate.value:.2f} [{100 * rate.low:.2f}-{100 * rate.high:.2f}]"


def ratio(rate: Rate, asked: float) -> str:
    return f"{rate.value / asked:.2f} [{rate.low / asked:.2f}-{rate.high / asked:.2f}]"


def on_surface(draws: Draws, shape: str, radius_m: float, k: float) -> bool:
    """Whether an obstacle is so small that mostly less than what is asked is reached without a margin."""
    return bool(np.median(margins(draws, shape, radius_m, k, 30.0)) == 0.0)


def verdict(rate: Rate, asked: float, low: float, high: float) -> str:
    """Whether the interval of achieved / asked reaches into a range."""
    return "yes" if rate.high >= low * asked and rate.low <= high * asked else "NO"


def table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    print(f"\n{title}\n")
    print("| " + " | ".join(head) + " |")
    print("|" + " --- |" * len(head))
    for row in rows:
        print("| " + " | ".join(row) + " |")


def wall_rows(draws: dict[float, Draws], levels: Sequence[float]) -> None:
    rows = []
    for bearing in (0.0, 30.0):
        for asked in levels:
            contact = held_point(draws[10.0], "wall", 0.0, step_k(asked), bearing)
            step = per_step(contact)
            row = [f"{bearing:.0f}°", f"{100 * asked:g}", percent(step), ratio(step, asked)]
            rows.append([*row, verdict(step, asked, 0.7, 1.1), percent(per_mission(contact))])
    head = ("wall's bearing", "asked, %", "achieved, %", "achieved / asked", "0.7-1.1", "mission, %")
    table(f"1. Wall, asked per step, tau 10 s, {len(contact)} missions a row", head, rows)

    rows = []
    for bearing in (0.0, 30.0):
        for tau in TIMES:
            for asked in levels:
                k = budget(asked, tau).k
                mission = per_mission(held_point(draws[tau], "wall", 0.0, k, bearing))
                row = [f"{bearing:.0f}°", f"{tau:g}", f"{100 * asked:g}", f"{k:.3f}", percent(mission)]
                rows.append([*row, ratio(mission, asked), verdict(mission, asked, 1 / 3, 1.0)])
    names = ("wall's bearing", "tau, s", "asked, %", "k", "achieved, %", "achieved / asked", "1/3-1")
    table(f"2. Wall, asked per mission of 15 s, {len(contact)} missions a row", names, rows)


def solid_rows(draws: dict[float, Draws], levels: Sequence[float]) -> None:
    runs = len(draws[10.0].error)
    rows = []
    for shape in ("sphere", "cylinder"):
        for radius in RADII:
            row = [shape, f"{radius:g}"]
            for asked in levels:
                step = per_step(held_point(draws[10.0], shape, radius, step_k(asked), 30.0))
                small = on_surface(draws[10.0], shape, radius, step_k(asked))
                row += [ratio(step, asked), "no margin" if small else verdict(step, asked, 0.3, 1.0)]
            rows.append(row)
    head = [
        "shape",
        "radius, m",
        *(cell for p in levels for cell in (f"achieved / asked {100 * p:g} %", "0.3-1")),
    ]
    table(f"3a. Exact margin, asked per step, tau 10 s, {runs} missions a row", head, rows)

    for tau in TIMES:
        rows = []
        for shape in ("sphere", "cylinder"):
            for radius in RADII:
                row = [shape, f"{radius:g}"]
                for asked in levels:
                    whole = budget(asked, tau)
                    mission = per_mission(held_point(draws[tau], shape, radius, whole.k, 30.0, whole))
                    row += [ratio(mission, asked), verdict(mission, asked, 0.3, 1.0)]
                rows.append(row)
        table(f"3b. Exact margin, asked per mission, tau {tau:g} s, {runs} missions a row", head, rows)


# ---------------------------------------------------------------------------------------- closed loop


def wall_problem(**planner: object) -> Problem:
    """One UAV whose lane runs 1 m beside a wall without end: its margin is active all the time.

    It starts 16 m off the wall and comes nearer as far as its margin lets it.
    """
    wall = {"shape": "box", "centre_m": (150.0, WALL_Y_M + 25.0, 0.0), "size_m": (400.0, 50.0, 400.0)}
    start = {"initial_positions_m": ((0.0, -15.0, 0.0),), "initial_velocities_mps": ((2.0, 0.0, 0.0),)}
    return Problem.model_validate(
        {
            "title": "One UAV along a wall",
            "vehicle": {"radius_m": UAV_RADIUS_M},
            "formation": {"shape": "line", "count": 1},
            "mission": {"kind": "formation", "length_m": 1000.0, **start},
            "world": {"kind": "list", "obstacles": (wall,)},
            "navigation": {"kind": "gauss_markov"},
            "planner": planner,
            "simulation": {"time_limit_s": BEGIN_S + ACTIVE_S},
        }
    )


@dataclass(frozen=True)
class Flown:
    """What came of missions along the wall, from 25 s on."""

    contact: Mask
    """(run, step)."""
    bound: Array
    """(run,) what the ledger says of them."""
    clearance_m: float
    """Mean true distance between the surfaces."""


def fly(problem: Problem, planner: str, seeds: Sequence[int], runs: int) -> Flown:
    """Fly a planner along the wall; contact is judged on the truth, the ledger sees estimates only."""
    contact, bound, clearance = [], [], []
    asked = RiskBudget.of_problem(problem)
    for seed in seeds:
        track = simulate(problem, planner, seed=seed, runs=runs, record_every=5).trajectories
        late = track["t_s"] > BEGIN_S - 1e-6
        columns = {name: track[name][late] for name in ("run", "t_s", "y_m", "est_y_m", "sigma_y_m")}
        order = np.lexsort((columns["t_s"], columns["run"]))
        true, seen, sigma = (
            columns[name][order].reshape(runs, -1) for name in ("y_m", "est_y_m", "sigma_y_m")
        )
        gap = WALL_Y_M - true - UAV_RADIUS_M
        ledger = RiskLedger(asked, runs, 1, 1)
        for step in range(gap.shape[1]):
            ledger.spend(
                (WALL_Y_M - seen[:, step] - UAV_RADIUS_M)[:, None, None],
                sigma[:, step][:, None, None],
                np.zeros((runs, 1, 1), dtype=np.int64),
                PERIOD_S,
                np.ones(runs, dtype=np.bool_),
            )
        contact.append(gap <= 0.0)
        bound.append(ledger.certificate().bound)
        clearance.append(gap.mean())
    return Flown(np.concatenate(contact), np.concatenate(bound), float(np.mean(clearance)))


def closed_loop_rows(
    planners: Sequence[str], levels: Sequence[float], seeds: Sequence[int], runs: int
) -> None:
    rows = []
    for planner in planners:
        for asked in levels:
            flown = fly(wall_problem(risk_per_mission=asked), planner, seeds, runs)
            mission = per_mission(flown.contact)
            unannounced = int((flown.contact.any(-1) & (flown.bound <= asked)).sum())
            rows.append(
                [
                    planner,
                    f"{100 * asked:g}",
                    percent(mission),
                    ratio(mission, asked),
                    f"{100 * np.median(flown.bound):.2g} ({100 * flown.bound.mean():.2g})",
                    f"{100 * (flown.bound > asked).mean():.0f}",
                    str(unannounced),
                    f"{flown.clearance_m:.1f}",
                ]
            )
    head = (
        "planner", "asked, %", "achieved, %", "achieved / asked", "certificate, %: median (mean)",
        "announced, %", "contacts within budget", "clearance, m",
    )  # fmt: skip
    total = len(seeds) * runs
    table(f"4. Closed loop along a wall, 15 s, tau 10 s, {total} missions a row", head, rows)


def chance(word: str) -> float:
    """A risk that may be asked for."""
    asked = float(word)
    if not 0.0 < asked < 0.5:
        raise argparse.ArgumentTypeError(f"{word} is not between 0 and 0.5")
    return asked


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", choices=BLOCKS, default="development")
    parser.add_argument("--asked", type=chance, nargs="+", default=ASKED, help="risks asked for, 0 to 0.5")
    parser.add_argument("--missions", type=int, default=20_000, help="of the held point, tables 1 and 2")
    parser.add_argument("--solids", type=int, default=2000, help="of the held point, table 3")
    parser.add_argument("--flights", type=int, default=1000, help="in the closed loop; 0 for none")
    parser.add_argument("--planners", default="napf", help="of table 4, with commas")
    arguments = parser.parse_args()
    seeds = BLOCKS[arguments.seeds]
    if min(arguments.missions, arguments.solids) < len(seeds):
        parser.error(f"missions and solids must be {len(seeds)} or more, one for each seed")
    print(f"Seeds {seeds.start}-{seeds.stop - 1} ({arguments.seeds}); brackets: 95 % intervals")
    runs = arguments.missions // len(seeds)
    draws = {tau: drawn(seeds, runs, tau) for tau in TIMES}
    wall_rows(draws, arguments.asked)
    few = len(seeds) * (arguments.solids // len(seeds))
    some = {tau: Draws(all_.error[:few], all_.sigma[:few]) for tau, all_ in draws.items()}
    solid_rows(some, arguments.asked)
    if arguments.flights:
        blocks = min(len(seeds), 10)
        flown = seeds[:blocks], arguments.flights // blocks
        closed_loop_rows(arguments.planners.split(","), arguments.asked, *flown)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
