"""Risk against formation error as k grows: NAPF, guided NAPF and the QP at k = 1, 1.7, 2 and 3.

Run ``python benchmarks/fronts.py --runs 200 --out out/fronts``: prints the table of ``comparison.py`` for
every planner and k, compares planners of the same k on the same runs, and writes ``fronts.png`` and
``fronts.svg`` into the folder. Repeating the command goes on where it stopped; rows that
``comparison.py`` has flown into the same folder are taken from there.
"""

from __future__ import annotations

import argparse
from typing import Any

from comparison import BLOCKS, PLANNERS, Flown, chosen, fly, options_of, print_tables

from napf_mpc.plot import draw_fronts

LEVELS = ("1", "1.7", "2", "3")
KINDS = {"NAPF": "napf", "NAPF guided": "napf_guided", "QP": "qp", "QP unguided": "qp_unguided"}
"""Label before the k -> planner."""
CELLS = ("8S filter", "40S filter", "8C filter", "40C filter")


def main() -> None:
    """Fly what is missing, print the tables and draw the fronts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--planners", default="NAPF;NAPF guided;QP", help="without k, with semicolons")
    parser.add_argument("--stem", default="fronts", help="name of the figure's files")
    options = options_of(parser, CELLS, 200)
    kinds = chosen(parser, "planners", options.planners, KINDS)

    def fly_one(cell: str, planner: str) -> Flown:
        kind, settings = PLANNERS[planner]
        return fly(cell, kind, settings, planner, options, options.workers)

    labels = {f"{label}, k = {k}": (KINDS[label], float(k)) for label in kinds for k in LEVELS}
    rows = print_tables(options.cells, list(labels), options, fly_one)
    fronts: dict[str, dict[str, dict[float, dict[str, Any]]]] = {}
    for row in rows:
        planner, k = labels[row.planner]
        fronts.setdefault(row.cell, {}).setdefault(planner, {})[k] = row.result
    note = f"N = {options.runs} runs a point, seeds of campaign {BLOCKS[options.block]}."
    for path in draw_fronts(fronts, options.out, options.stem, note=note):
        print(path)


if __name__ == "__main__":
    main()
