# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Potential field against QP, on the same mission
#
# `apf` and `napf` turn the distance to an obstacle into a velocity, here and now. `qp` puts the same
# repulsion into one quadratic program a UAV and step, which looks 6.5 s ahead. All three fly the same
# scenes with the same navigation errors, and see them through the same Kalman filter.
#
# Every number and picture below is computed here. How many missions stand behind the table follows from
# the variable `NAPF_MPC_NOTEBOOK_RUNS` (300 unless set; a tenth of it is flown, since a QP mission takes
# seconds). The first solve of an installation compiles the solver and its guidance: a little over two
# minutes on one core.

# %%
import os
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Markdown, display

from napf_mpc import compare, load_problem, simulate
from napf_mpc.plot.flight import uncertainty_figure
from napf_mpc.plot.overview import Mission, overview_figure
from napf_mpc.plot.style import GREY, house_style, planner_colour, planner_name, uav_colour
from napf_mpc.plot.tracks import acting, clearances, track
from napf_mpc.report import comparison
from napf_mpc.safety_distance import Inflation
from napf_mpc.store import stack

# %matplotlib inline

RUNS = int(os.environ.get("NAPF_MPC_NOTEBOOK_RUNS", "300")) // 10
PLANNERS = ("apf", "napf", "qp")
SEED, RUN = 1, 5
FILTER = {"navigation.filter": "kalman"}

# %% [markdown]
# ## 1. What does one mission look like among 8 obstacles?
#
# Run 5 of seed 1: one mission, to look at. How often something happens is the question of the table at the
# end, not of a picture. Seen from above, a path that crosses a circle passes over or under the sphere; only
# a cross is a contact.

# %%
few = load_problem("study_8s", FILTER)
missions = {
    planner: simulate(few, planner, seed=SEED, runs=range(RUN, RUN + 1), record_every=5)
    for planner in PLANNERS
}
shown = [Mission(planner, RUN, str(flown.score.outcome[0])) for planner, flown in missions.items()]
obstacles = missions["qp"].scenario.obstacles
with house_style():
    tables = stack([flown.trajectories for flown in missions.values()])
    figure = overview_figure(few, tables, {RUN: obstacles}.__getitem__, shown)
figure

# %% [markdown]
# ## 2. And among 40?

# %%
many = load_problem("study_40s", FILTER)
missions = {
    planner: simulate(many, planner, seed=SEED, runs=range(RUN, RUN + 1), record_every=5)
    for planner in PLANNERS
}
shown = [Mission(planner, RUN, str(flown.score.outcome[0])) for planner, flown in missions.items()]
obstacles = missions["qp"].scenario.obstacles
with house_style():
    tables = stack([flown.trajectories for flown in missions.values()])
    figure = overview_figure(many, tables, {RUN: obstacles}.__getitem__, shown)
figure

# %%
for planner, flown in missions.items():
    print(
        f"{planner_name(planner):5}",
        *(
            f"{words} {flown.score.metrics[name][0]:.2f} m,"
            for words, name in (
                ("path RMS", "path_rms_m"),
                ("shape RMS", "shape_rms_m"),
                ("least clearance", "min_clearance_m"),
            )
        ),
        f"effort {flown.score.metrics['control_effort'][0]:.0f} N² s",
    )

# %% [markdown]
# ## 3. What inflates?
#
# The obstacles, by k times the reported sigma in the direction of each: `napf` and `qp` alike, `apf` not at
# all. So what navigation reports decides how much room there is. The same mission with the fixes as they
# are, and behind the filter:

# %%
rough = load_problem("study_40s")
raw = simulate(rough, "qp", seed=SEED, runs=range(RUN, RUN + 1), record_every=5)
k = Inflation.of_problem(many).k
flown = {
    "fixes as they are": track(raw.trajectories, "qp", RUN),
    "behind the filter": track(tables, "qp", RUN),
}
with house_style():
    figure, axes = plt.subplots(figsize=(7.2, 2.4), layout="constrained")
    for (words, one), colour in zip(flown.items(), (GREY, planner_colour("qp")), strict=True):
        axes.plot(one.time_s, k * one.sigma[:, 0, 1], color=colour, label=f"{words}")
    axes.set(xlabel="time (s)", ylabel=f"{k:g} sigma north, UAV 1 (m)", ylim=(0.0, None))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.16), ncol=2)
plt.show()

# %% [markdown]
# What that means on the map: dashed, the obstacles as inflated for each UAV when it came closest to them.

# %%
with house_style():
    figure = uncertainty_figure(many, track(tables, "qp", RUN), obstacles)
figure

# %% [markdown]
# ## 4. What does slack mean?
#
# A row of the QP says "stay k sigma clear". Where that cannot be had, the row yields by a slack, in metres,
# at a price above what the slot is worth. `slack_m` is the most that a plan yields anywhere on
# its horizon: a forecast, mostly of seconds ahead, not a contact. A slack below the margin spends
# confidence; one above it is a plan that goes through the obstacle, as far as this step sees it.
#
# Behind the filter there is little of it once the filter has settled. With the fixes as they are, k sigma
# grows to 15 m among obstacles that stand closer than that, and slack is common. The UAV with the largest
# one: what its plans yielded (where they did), the margins of the obstacles in its range, and how far the
# truth was from any obstacle meanwhile.

# %%
table = raw.trajectories
uav = int(table["uav"][np.nanargmax(table["slack_m"])])
mine = table["uav"] == uav
one = track(table, "qp", RUN)
seen = acting(rough, one, obstacles)
near = seen.uav == uav
with house_style():
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(7.2, 3.8), sharex=True, layout="constrained")
    margins = one.time_s[seen.sample[near]], seen.margin_m[near]
    top.plot(*margins, ".", color=GREY, markersize=2.0, label=f"margin {k:g} sigma of obstacles in range")
    yielded = np.where(table["slack_m"][mine] > 1e-6, table["slack_m"][mine], np.nan)
    top.plot(table["t_s"][mine], yielded, ".", color=uav_colour(uav), markersize=2.5, label="slack")
    top.set(ylabel="slack, margin (m)", ylim=(0.0, None), title=f"UAV {uav + 1}, fixes as they are")
    top.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncol=2, markerscale=3.0)
    bottom.plot(one.time_s, clearances(one, obstacles, rough.vehicle.radius_m)[:, uav], color=uav_colour(uav))
    bottom.axhline(0.0, color="black", linewidth=0.6)
    bottom.set(xlabel="time (s)", ylabel="true clearance (m)", ylim=(-2.0, 30.0))
plt.show()
print("outcome:", raw.score.outcome[0], f"| least clearance {raw.score.metrics['min_clearance_m'][0]:.2f} m")

# %% [markdown]
# `solver_status` says what became of each program. A plan flies only if it was solved *and* passes the
# acceptance test; otherwise the tail of the last plan flies, then a hover, then a descent. Each is counted.

# %%
words, counts = np.unique(table["solver_status"].astype(str), return_counts=True)
print("programs, as recorded every 0.1 s:", dict(zip(words.tolist(), counts.tolist(), strict=True)))
for name, flown in (("behind the filter", missions["qp"]), ("fixes as they are", raw)):
    counted = {key: int(count[0]) for key, count in flown.tally.counts.items() if count[0]}
    print(f"{name}: largest slack {flown.tally.largest_slack_m[0]:.2f} m, {counted}")

# %% [markdown]
# `margin_short` counts steps in which the formation itself, flown perfectly, is too tight for k sigma
# between two UAVs; the planner then asks for less and says so here.
#
# ## 5. How often, and at what price?
#
# Many missions among 40 obstacles, the same for all three. The risk counts every mission; the intervals are
# 95 % Wilson; the last lines test pairs of planners on the missions in which just one of them hit something.

# %%
rows = (
    "collision risk, any UAV and obstacle",
    "UAV-UAV contact",
    "finished, contacts or not",
    "path RMS [m]",
    "shape RMS [m]",
    "  from navigation errors alone [m]",
    "path length ratio",
    "control effort [N² s]",
    "finish time [s]",
)
whole = comparison(compare(many, PLANNERS, runs=RUNS, seed=SEED))
display(Markdown(replace(whole, rows=tuple(row for row in whole.rows if row[0] in rows)).markdown()))

# %% [markdown]
# No contact in N missions does not make the risk zero: the upper end of its interval is about 3.8 / N. The
# large tables, on seeds that nothing was tuned on, come from `benchmarks/comparison.py`.
