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
# # Asked against achieved
#
# A margin of k sigma is asked for. What is the chance of a contact then: at one moment, in a mission, and of
# a planner that flies? Three answers, each measured here, each with its 95 % Wilson interval and its N.
#
# The number of missions behind the rates follows from the variable `NAPF_MPC_NOTEBOOK_RUNS` (300 unless
# set). Rates of some per cent need thousands of missions: a point at a wall is cheap and gets a hundred
# times as many, a flight takes seconds and gets a tenth as many.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np
from scipy.special import ndtr

from napf_mpc import compare, load_problem
from napf_mpc.first_passage import first_passage_probability, long_run, mission_k
from napf_mpc.navigation.error_models import position_errors
from napf_mpc.plot.style import BLUE, GREEN, GREY, VERMILION, house_style, planner_colour, planner_name
from napf_mpc.problem import GaussMarkov
from napf_mpc.risk import wilson
from napf_mpc.risk_budget import RiskBudget, error_correlation_time

# %matplotlib inline

RUNS = int(os.environ.get("NAPF_MPC_NOTEBOOK_RUNS", "300"))
ACTIVE_S, PERIOD_S = 15.0, 0.1
TIMES = dict(zip((2.0, 10.0, 50.0), (VERMILION, BLUE, GREEN), strict=True))

# %% [markdown]
# ## 1. What does k sigma buy for a whole mission?
#
# At one moment a normal error exceeds k sigma to one side with probability Phi(-k). In 15 s at the margin it
# gets more than one chance; how many depends on its correlation time tau. The chance that it passes k at some
# moment is computed, not simulated (`first_passage_probability`), and `mission_k` is the inverse.

# %%
levels = np.linspace(0.5, 4.0, 15)
with house_style():
    figure, axes = plt.subplots(figsize=(4.6, 3.0), layout="constrained")
    for tau, colour in TIMES.items():
        chance = [first_passage_probability(float(k), ACTIVE_S, tau, PERIOD_S) for k in levels]
        axes.semilogy(levels, chance, color=colour, label=f"15 s, tau {tau:g} s")
    axes.semilogy(levels, ndtr(-levels), color=GREY, linestyle="--", label="one moment")
    axes.set(xlabel="margin k (sigma)", ylabel="chance of passing it", ylim=(1e-4, 1.0), xlim=(0.5, 4.0))
    axes.legend(loc="lower left")
plt.show()

for risk in (0.1, 0.05, 0.01):
    ks = ", ".join(f"{mission_k(risk, ACTIVE_S, tau, PERIOD_S):.2f} for {tau:g} s" for tau in TIMES)
    print(f"k for {100 * risk:g} % in {ACTIVE_S:g} s: {ks}")

# %% [markdown]
# For a margin that is kept for long, all that counts is a price for being there at all and a price per
# second. This is what the certificate of a flight adds up along the distances flown (`RiskLedger`):

# %%
for k in (2.0, 3.0, 4.0):
    entry, rate = long_run(k, 10.0, PERIOD_S)
    print(f"k = {k:g}, tau 10 s: {entry:.2e} once, {rate:.2e} a second")

# %% [markdown]
# ## 2. Is that what a point at a wall gets?
#
# The estimate is held exactly k sigma(t) from a wall for 15 s; the errors are the library's own, sigma
# swings between 1 and 5 m. The truth touches the wall if the error towards it exceeds the margin once.

# %%
risks = (0.2, 0.1, 0.05, 0.02)
runs = 100 * RUNS
with house_style():
    figure, axes = plt.subplots(figsize=(4.6, 3.0), layout="constrained")
    for tau, colour in TIMES.items():
        navigation = GaussMarkov(correlation_time_s=tau)
        errors = position_errors(navigation, 1, range(runs), 1, ACTIVE_S, None)
        largest = np.full(runs, -np.inf)
        for step in range(round(ACTIVE_S / PERIOD_S)):
            fix = errors.fix(step)
            largest = np.fmax(largest, fix.error[:, 0, 0] / np.sqrt(fix.covariance[:, 0, 0, 0]))
        budgets = [
            RiskBudget(risk, 1, ACTIVE_S, error_correlation_time(navigation), PERIOD_S) for risk in risks
        ]
        rates = [wilson(int((largest > budget.k).sum()), runs) for budget in budgets]
        spread = [[r.value - r.low for r in rates], [r.high - r.value for r in rates]]
        shift = {2.0: 0.96, 10.0: 1.0, 50.0: 1.04}[tau]
        places = [shift * 100 * risk for risk in risks]
        axes.errorbar(
            places, [100 * r.value for r in rates], yerr=100 * np.array(spread), fmt="o", markersize=4,
            capsize=2.5, color=colour, label=f"tau {tau:g} s",
        )  # fmt: skip
        print(f"tau {tau:g} s:", ", ".join(f"{r.count} of {r.total}" for r in rates))
    axes.plot([0.4, 30.0], [0.4, 30.0], color=GREY, linewidth=0.8, label="as asked")
    axes.set(xscale="log", yscale="log", xlim=(1.5, 27.0), ylim=(0.4, 30.0))
    axes.set_xticks([2, 5, 10, 20], ["2", "5", "10", "20"])
    axes.set_yticks([0.5, 1, 2, 5, 10, 20], ["0.5", "1", "2", "5", "10", "20"])
    axes.minorticks_off()
    axes.set(xlabel="asked, chance in 15 s (%)", ylabel=f"achieved (%), N = {runs}")
    axes.legend(loc="upper left")
plt.show()

# %% [markdown]
# Where sigma swings, long correlation times come out careful beside a wall across an axis: towards an oblique
# one the axes take turns in carrying the error, and the budget allows for that
# ([risk_budget.md](../docs/risk_budget.md) has both, with larger N).
#
# ## 3. What does a flight achieve?
#
# 40 spheres, errors of 1 to 5 m behind the Kalman filter, k = 1, 2 and 3; NAPF and QP on the same seeds. The
# dashed line bounds what k promises if each of the four UAVs spends 15 s exactly at its margin: a planner
# that spends less time there stays below it. N is small here, and the intervals say so.

# %%
flights = RUNS // 10
factors = (1.0, 2.0, 3.0)
planners = ("napf", "qp")
summaries = {
    k: compare(
        load_problem("study_40s", {"navigation.filter": "kalman", "planner.k": k}),
        planners,
        runs=flights,
        seed=1,
    )["planners"]
    for k in factors
}
tau = error_correlation_time(load_problem("study_40s", {"navigation.filter": "kalman"}).navigation)
promised = [min(1.0, 4 * first_passage_probability(float(k), ACTIVE_S, tau, PERIOD_S)) for k in levels]
with house_style():
    figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 2.8), layout="constrained")
    left.plot(levels, 100 * np.array(promised), "--", color=GREY, label="15 s at the margin", zorder=1)
    for planner, shift in zip(planners, (-0.04, 0.04), strict=True):
        colour, name = planner_colour(planner), planner_name(planner)
        results = [summaries[k][planner] for k in factors]
        risk = 100 * np.array([[r["collision_risk" + end] for r in results] for end in ("", "_low", "_high")])
        path = [r["path_rms_m"]["median"] for r in results]
        places = np.array(factors) + shift
        spread = [risk[0] - risk[1], risk[2] - risk[0]]
        left.errorbar(
            places, risk[0], yerr=spread, fmt="o", markersize=4, capsize=2.5, color=colour, label=name
        )
        right.plot(factors, path, "o-", markersize=4, color=colour, label=name)
        for k, result in zip(factors, results, strict=True):
            hits = round(result["collision_risk"] * result["runs"])
            low, high = (100 * result[f"collision_risk_{end}"] for end in ("low", "high"))
            print(
                f"{name:4} k = {k:g}: {hits} of {result['runs']} collided [{low:.1f}, {high:.1f}] %, "
                f"finished {100 * result['finished']:.0f} %"
            )
    left.set(xlabel="margin k (sigma)", ylabel=f"collision risk (%), N = {flights}")
    left.set(xlim=(0.8, 3.2), ylim=(-2.0, 104.0), xticks=factors)
    left.legend()
    right.set(xlabel="margin k (sigma)", ylabel="path RMS, median (m)", xlim=(0.8, 3.2), ylim=(0.0, None))
    right.set_xticks(factors)
    right.legend()
plt.show()

# %% [markdown]
# The left picture alone would favour whoever flies farthest away; the right one is what that costs.
#
# ## 4. May one ask for a mission's risk instead of k?
#
# Yes: `planner.risk_per_mission` turns into k by the same formula, divided by the UAVs.

# %%
for asked in (0.1, 0.05, 0.01):
    problem = load_problem(
        "study_40s", ['navigation.filter="kalman"', "planner.risk_per_mission=" + str(asked)]
    )
    print(f"{100 * asked:g} % of missions: k = {RiskBudget.of_problem(problem).k:.2f}")
