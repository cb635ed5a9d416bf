"""Figures of a run, of the paper by its numbers, of comparisons; animations. The one home of matplotlib.

Nothing here uses pyplot: no display, no global state, and every figure comes out as the same file twice.
"""

from napf_mpc.plot.animate import animation
from napf_mpc.plot.compare import compare_figures
from napf_mpc.plot.flight import run_figures
from napf_mpc.plot.growth import Curve, draw_growth
from napf_mpc.plot.overview import Mission, paths_overview, pick_missions
from napf_mpc.plot.paper import paper_figures
from napf_mpc.plot.solvers import draw_solvers, draw_step_times
from napf_mpc.plot.stanford import StanfordPanel, draw_stanford
from napf_mpc.plot.tails import TailPanel, draw_tails
from napf_mpc.plot.trade import draw_fronts

__all__ = [
    "Curve",
    "Mission",
    "StanfordPanel",
    "TailPanel",
    "animation",
    "compare_figures",
    "draw_fronts",
    "draw_growth",
    "draw_solvers",
    "draw_stanford",
    "draw_step_times",
    "draw_tails",
    "paper_figures",
    "paths_overview",
    "pick_missions",
    "run_figures",
]
