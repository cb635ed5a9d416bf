"""Baselines from outside beside the QP, on the study scenes and the same seeds: ORCA and a deterministic MPC.

Run ``python benchmarks/outside_baselines.py --runs 100 --out out/outside``; repeating the command goes on
where it stopped. Needs the package ``pyrvo`` (``pip install --no-deps pyrvo``); ``--planners`` without ORCA
does not. Table and tests are those of ``comparison.py``, each baseline against the QP with k = 3:

- ``ORCA``: obstacles as large as they are. ``ORCA, k = 3``: grown by three reported sigma, as for NAPF. See
  ``orca.py`` for how ORCA flies a formation.
- ``deterministic MPC``: the QP with k = 0, which takes the estimate for the truth.
"""

from __future__ import annotations

import argparse

from comparison import Flown, chosen, fly, options_of, print_tables
from orca import OrcaPlanner, package

from napf_mpc.planners.planner import Planner
from napf_mpc.planners.registry import PLANNERS as REGISTRY
from napf_mpc.problem import Problem
from napf_mpc.safety_distance import Inflation

OURS = "QP, k = 3"
PLANNERS: dict[str, tuple[str, list[str]]] = {
    "ORCA": ("orca", ["planner.k=0"]),
    "ORCA, k = 3": ("orca", ["planner.k=3"]),
    # Distances that do not look at sigma: the whole of contact_extra_m.
    "deterministic MPC": ("qp", ["planner.k=0", "planner.contact_extra_sigmas=1000"]),
    OURS: ("qp", ["planner.k=3"]),
}
"""Label -> planner and its overrides."""
CELLS = ("8S filter", "40S filter", "8C filter", "40C filter")


def orca(problem: Problem) -> Planner:
    """ORCA for a problem, with obstacles that grow as the problem says."""
    return OrcaPlanner(problem, Inflation.of_problem(problem), "orca")


def main() -> None:
    """Fly what is missing and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--planners", default=";".join(PLANNERS), help="labels, separated by semicolons")
    options = options_of(parser, CELLS, 100)
    planners = chosen(parser, "planners", options.planners, PLANNERS)
    if any(PLANNERS[label][0] == "orca" for label in planners):
        package()
    REGISTRY["orca"] = orca

    def fly_one(cell: str, planner: str) -> Flown:
        kind, settings = PLANNERS[planner]
        # Other processes do not know a planner that was registered in this one.
        workers = 1 if kind == "orca" else options.workers
        return fly(cell, kind, settings, planner, options, workers)

    print_tables(options.cells, planners, options, fly_one, lambda a, b: OURS in (a, b))


if __name__ == "__main__":
    main()
