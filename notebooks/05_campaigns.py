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
# # Campaigns
#
# A collision risk is worth what its campaign is worth. How many runs does a claim take, when may one stop,
# and what if the risk is too small to be counted? The formulas are in
# [statistics.md](../docs/statistics.md).
#
# The number of runs follows from the variable `NAPF_MPC_NOTEBOOK_RUNS` (300 unless set).

# %%
import os
from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt
import numpy as np
import polars as pl

from napf_mpc import load_problem, run_campaign
from napf_mpc.plot.style import BLUE, GREY, VERMILION, house_style
from napf_mpc.rare_events.estimate import estimate_collision_risk
from napf_mpc.risk import wilson
from napf_mpc.stopping import StoppingRule, sequential_interval

# %matplotlib inline

RUNS = int(os.environ.get("NAPF_MPC_NOTEBOOK_RUNS", "300"))
OUT = Path(mkdtemp(prefix="napf-mpc-"))
# A corner of Table 1 that is flown in seconds: one small ball ahead, five seconds of flight.
SHORT = {
    "mission": {"length_m": 1.0, "initial_velocities_mps": [[2.0, 0.0, 0.0]] * 4},
    "world.count": 1,
    "world.along_range_m": [9.0, 12.0],
    "world.radius_m": [0.3, 1.5],
    "simulation.time_limit_s": 5.0,
    "simulation.controller_rate_hz": 25.0,
    "planner.rate_hz": 5.0,
    "planner.k": 1.0,
    "navigation.rate_hz": 5.0,
}
problem = load_problem("table1_8", SHORT)

# %% [markdown]
# ## 1. What does a campaign leave behind?
#
# A folder with a row for every run, in Parquet. Any run can be flown again from its row:
# `napf-mpc run FILE --seed S --run-index I`.

# %%
summary = run_campaign(problem, ["napf"], RUNS, 1, OUT / "fixed")
rows = pl.read_parquet(OUT / "fixed" / "runs.parquet").sort("run")
print(rows.group_by("outcome").len().sort("len", descending=True))
print(rows.filter(pl.col("obstacle_contact")).select("run", "uavs_hit", "min_clearance_m").head())

# %% [markdown]
# ## 2. How far may small campaigns lie apart?
#
# A funnel plot: the same runs, cut into campaigns of different sizes, each a dot. The funnel holds 95 % of
# them if all have the risk of the whole. Campaigns of ten say almost anything.

# %%
contact = rows["obstacle_contact"].to_numpy()
risk = wilson(int(contact.sum()), len(contact))
sizes = np.array([size for size in (5, 10, 20, 50, 100) if size <= RUNS])
with house_style():
    figure, axes = plt.subplots(figsize=(4.6, 3.0), layout="constrained")
    for size in sizes:
        parts = contact[: len(contact) // size * size].reshape(-1, size).mean(axis=1)
        axes.plot(np.full(len(parts), size), 100 * parts, "o", color=BLUE, markersize=3.0, alpha=0.4)
    n = np.geomspace(sizes[0], sizes[-1], 100)
    spread = 1.96 * np.sqrt(max(risk.value, 1.0 / RUNS) * (1.0 - risk.value) / n)
    axes.fill_between(
        n,
        100 * np.maximum(risk.value - spread, 0.0),
        100 * (risk.value + spread),
        color=GREY,
        alpha=0.2,
        label="95 % of campaigns",
    )
    axes.axhline(100 * risk.value, color=GREY, linewidth=0.8, label=f"all {RUNS} runs")
    axes.set(xscale="log", xlabel="runs of a campaign", ylabel="collision risk (%)")
    axes.set_xticks(sizes, [str(size) for size in sizes])
    axes.minorticks_off()
    axes.legend()
plt.show()
print(f"{risk.count} of {risk.total}: {100 * risk.low:.1f} to {100 * risk.high:.1f} %")

# %% [markdown]
# ## 3. How many runs do I need?
#
# To show that a risk is below a limit takes about 4 / limit clean runs if their number is fixed beforehand,
# twice as many if one wants to look at them on the way.

# %%
for limit in (0.05, 0.01, 0.002):
    needed = [
        next(n for n in range(1, 10_000) if wilson(0, n).high < limit),
        next(n for n in range(1, 10_000) if StoppingRule(upper=limit).met(0, n)),
    ]
    print(f"risk below {100 * limit:g} %: {needed[0]} clean runs, number fixed; {needed[1]} with looks")

# %% [markdown]
# ## 4. May I stop when I have seen enough?
#
# Yes, with an interval that holds at every look: `--until-width`, `--until-upper`. Below, both intervals
# after every run. Wilson's is narrower, and wrong for whoever waits until it suits: looked at after each of
# 5000 runs it ever misses the true rate in 38 to 62 % of campaigns, the sequential one in at most 5 %.

# %%
counts = contact.cumsum()
runs = np.arange(1, len(contact) + 1)
sequential = np.array([sequential_interval(int(c), int(n)) for c, n in zip(counts, runs, strict=True)])
fixed = np.array([(r.low, r.high) for r in map(wilson, counts.tolist(), runs.tolist())])
with house_style():
    figure, axes = plt.subplots(figsize=(4.6, 3.0), layout="constrained")
    for ends, colour, label in ((sequential, BLUE, "sequential"), (fixed, VERMILION, "Wilson, N fixed")):
        axes.plot(runs, 100 * ends[:, 0], color=colour, label=label)
        axes.plot(runs, 100 * ends[:, 1], color=colour)
    axes.plot(runs, 100 * counts / runs, color=GREY, linewidth=0.8, label="risk so far")
    axes.set(xlabel="runs", ylabel="collision risk (%)", ylim=(0.0, 40.0), xlim=(1, len(runs)))
    axes.legend()
plt.show()

stopped = run_campaign(problem, ["napf"], RUNS, 1, OUT / "stopped", enough=StoppingRule(width=0.3))
print(stopped["stopping"], "runs:", stopped["planners"]["napf"]["runs"])

# %% [markdown]
# ## 5. What if it is too rare to be counted?
#
# Subset simulation goes there by levels, each ten times rarer: first any missions, then only those that came
# as near as the nearest tenth, and so on down to contact. Here with a smaller ball and a larger margin.

# %%
rare = load_problem("table1_8", SHORT | {"world.radius_m": [0.3, 0.6], "planner.k": 3.0})
found = estimate_collision_risk(rare, "napf", OUT / "rare", samples=max(20, RUNS // 10 * 10), seed=1)
levels = pl.DataFrame(found["levels"])
print(levels)
if found["reached"]:
    print(f"risk {found['collision_risk']:.1e}, interval {found['collision_risk_low']:.1e} to", end=" ")
    print(f"{found['collision_risk_high']:.1e}, from {found['calls']} missions")
else:
    print(f"not reached; below about {found['below']:.0e}")

with house_style():
    figure, axes = plt.subplots(figsize=(4.6, 3.0), layout="constrained")
    axes.semilogy(levels["threshold"], levels["probability"].cum_prod(), "o-", color=BLUE)
    axes.axvline(0.0, color=GREY, linewidth=0.8, linestyle="--", label="contact")
    axes.set(xlabel="least clearance of a mission (m)", ylabel="chance to come as near")
    axes.legend()
plt.show()

# %% [markdown]
# The interval lets the errors of all levels add up. What it cannot know is a way to collide that no mission
# came near: compare several seeds.
