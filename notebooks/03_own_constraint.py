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
# # A constraint of your own
#
# The QP planner takes its rows from constraints: objects with a `name` and one method `rows`. Nobody who
# writes one ever sees a column of a matrix. No planner of the library knows the ground: they duck below
# spheres and each other as gladly as they climb above. Here is a ground for them, from the first line to
# the flight.

# %%
import matplotlib.pyplot as plt
import numpy as np

from napf_mpc import load_problem, simulate
from napf_mpc.constraints.constraint import Horizon, LinearRows
from napf_mpc.constraints.contract import check_constraint, sample_horizons
from napf_mpc.errors import NapfError
from napf_mpc.planners.mpc import QpPlanner, default_constraints
from napf_mpc.plot.states import uav_handles
from napf_mpc.plot.style import GREY, PALE, house_style, uav_colour
from napf_mpc.plot.tracks import track

# %matplotlib inline

# %% [markdown]
# ## 1. How does one say "stay above the ground"?
#
# With one row a stage: the signal is the position, the coefficients pick its height, the lower bound is the
# ground's height and k times the reported sigma on top. (The lanes lie at height 0 here; no row asks for
# more than they keep, however bad navigation is at take-off.) Everything is an array over (run, UAV,
# stage); `horizon` holds the covariance along the horizon.
#
# `w1` and `w2` make the row soft: s metres too low cost `w1 s + w2 s^2 / 2` a second. A hard row on a state
# would leave no plan at all as soon as navigation jumps below it.


# %%
class Ground:
    """Stay k sigma above a height, softly [m]."""

    name = "ground"

    def __init__(self, height_m: float, k: float) -> None:
        self.height_m, self.k = height_m, k

    def rows(self, horizon: Horizon) -> LinearRows:
        up = np.broadcast_to([0.0, 0.0, 1.0], (*horizon.shape, 1, 3))
        sigma = np.sqrt(horizon.covariance[..., 2:3, 2])
        lower = np.minimum(self.height_m + self.k * sigma, 0.0)
        price = np.full(lower.shape, 300.0)
        return LinearRows("position", up, lower=lower, w1=price, w2=price)


# %% [markdown]
# ## 2. Is it a constraint?
#
# `check_constraint` asks for its rows in worlds without and with obstacles, with and without errors, alone
# and in company. It is silent when all is well:

# %%
check_constraint(Ground(height_m=-3.0, k=3.0))

# %% [markdown]
# and names what is wrong otherwise:

# %%
try:
    check_constraint(Ground(height_m=np.nan, k=3.0), sample_horizons()[:1])
except NapfError as error:
    print(error)

# %% [markdown]
# What a row means can be asked as well: `violation` is the shortfall of any positions, in metres.

# %%
horizon = sample_horizons()[0]
rows = Ground(height_m=-3.0, k=0.0).rows(horizon)
print(f"lowest planned position: {horizon.position[..., 2].min():.2f} m")
print(f"most below the ground:   {rows.violation(horizon.position).max():.2f} m")

# %% [markdown]
# ## 3. Does the formation keep above it?
#
# The same mission twice: with the library's rows alone, and with the ground beside them.

# %%
problem = load_problem("study_8s", {"navigation.filter": "kalman"})
GROUND_M, SEED, RUN = -3.0, 1, 1
planners = {
    "the library's rows": QpPlanner(problem),
    "ours beside them": QpPlanner(
        problem, constraints=[*default_constraints(problem), Ground(GROUND_M, k=3.0)]
    ),
}
missions = {
    words: simulate(problem, planner, seed=SEED, runs=range(RUN, RUN + 1), record_every=5)
    for words, planner in planners.items()
}
for words, flown in missions.items():
    lowest = flown.trajectories["z_m"].min()
    metrics = {name: round(float(values[0]), 2) for name, values in flown.score.metrics.items()}
    print(
        f"{words:18}: {flown.score.outcome[0]}, lowest {lowest:.2f} m, least clearance "
        f"{metrics['min_clearance_m']} m, path RMS {metrics['path_rms_m']} m, "
        f"answers refused {flown.tally.counts['answers_refused'][0]}"
    )

# %% [markdown]
# True heights, not those that navigation reported:

# %%
with house_style():
    figure, panels = plt.subplots(1, 2, figsize=(7.2, 2.6), sharey=True, layout="constrained")
    for axes, (words, flown) in zip(panels, missions.items(), strict=True):
        one = track(flown.trajectories, "qp", RUN)
        for uav in range(one.uavs):
            axes.plot(one.time_s, one.position[:, uav, 2], color=uav_colour(uav))
        axes.axhspan(-20.0, GROUND_M, facecolor=PALE, edgecolor=GREY, linewidth=0.6, zorder=0)
        axes.set(xlabel="time (s)", title=words.capitalize(), ylim=(-6.5, 6.5), xlim=(0.0, one.time_s[-1]))
    panels[0].set_ylabel("true height (m)")
    panels[0].text(0.98, 0.05, "ground", transform=panels[0].transAxes, ha="right")
    figure.legend(handles=uav_handles(one.uavs), loc="outside upper center", ncol=one.uavs)
plt.show()

# %% [markdown]
# The ground costs path: who may not duck goes round. It is soft, so that a jump of navigation is answered
# by a climb and not by "no solution"; how soft is its price, to be set against that of the contact rows,
# `planner.contact_price`.
