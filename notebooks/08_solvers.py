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
# # Who solves the planner's programs
#
# Each UAV solves one quadratic program a step: 20 stages of a 12-state quadrotor, 22 rows a stage, 18
# of them soft. Here missions are flown, the programs that the planner shows its solver are kept, and each is
# shown to all solvers that are installed. What a solver claims and what is correct are two different columns.
#
# `NAPF_MPC_NOTEBOOK_RUNS` (300 unless set) decides how many missions are flown: a hundredth of it, at least
# two. Times are processor times of this machine; what carries over to another are their ratios.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np

from napf_mpc import load_problem
from napf_mpc.benchmark.contenders import CONTENDERS, OSQP, SCENES
from napf_mpc.benchmark.programs import flown
from napf_mpc.benchmark.solvers import ALONE, installed, measure, summaries
from napf_mpc.benchmark.tables import machine
from napf_mpc.plot.solvers import solvers_figure
from napf_mpc.plot.style import BLUE, GREY, VERMILION, house_style
from napf_mpc.solvers.batch import make_batch_solver

# %matplotlib inline

RUNS = int(os.environ.get("NAPF_MPC_NOTEBOOK_RUNS", "300"))
MISSIONS, EVERY, SEED = max(2, RUNS // 100), 60, 0
SCENE = "40 spheres"
print(machine())

# %% [markdown]
# ## 1. The same programs for all
#
# One step in sixty of each mission. *Claimed* is the share that a solver calls solved, *correct* the share
# whose first input is within a thousandth of its range of PIQP's at 1e-10. *KKT* is the largest residual of
# the optimality conditions, from the plain matrices. Times of a single program, and of all programs of a
# step together, per program.

# %%
contenders = installed(CONTENDERS, print)
rows = measure(SCENE, SCENES[SCENE], contenders, missions=MISSIONS, every=EVERY, seed=SEED)
found = summaries(rows)
print(f"{'':18}{'claimed':>9}{'correct':>9}{'KKT':>9}{'median us':>11}{'together us':>13}{'gain':>7}")
for one in found:
    print(
        f"{one.contender:18}{one.claimed / one.programs:9.1%}{one.correct / one.programs:9.1%}"
        f"{one.residual:9.0e}{one.median_us:11.0f}{one.together_us:13.0f}{one.together_gain[0]:7.2f}"
    )
print(
    f"N = {found[0].programs} programs, {found[0].calls} of them in calls of their own; "
    f"gain: over {OSQP!r}, together"
)

# %%
alone = {name: [row for row in rows if (row.contender, row.calls) == (name, ALONE)] for name in contenders}
with house_style():
    profile = solvers_figure(
        {name: np.array([row.cpu_us for row in own]) for name, own in alone.items()},
        {name: np.array([row.correct == 1 for row in own]) for name, own in alone.items()},
        1.0 / load_problem("study_40s").planner.rate_hz,
    )
profile

# %% [markdown]
# ## 2. What a program costs the exact solver
#
# The kernel solver starts from the rows that pushed in the last answer and changes its working set row by
# row. So a step costs by how much the situation has changed, and the first step after a surprise costs most.

# %%
problem = load_problem("study_40s", {"navigation.filter": "kalman"})
steps = flown(problem, missions=MISSIONS, every=EVERY // 3, seed=SEED)
kernel = make_batch_solver("kernel")
changes = {}
for label in ("last answer", "nothing"):
    answers = [
        kernel.solve_batch(step.horizon, step.warm if label == "last answer" else None, step.active)
        for step in steps
    ]
    changes[label] = np.concatenate(
        [answer.iterations[step.active].ravel() for answer, step in zip(answers, steps, strict=True)]
    )

with house_style():
    figure, axes = plt.subplots(figsize=(4.6, 2.8), layout="constrained")
    for (label, counts), colour in zip(changes.items(), (BLUE, VERMILION), strict=True):
        share = np.arange(1, len(counts) + 1) / len(counts)
        axes.step(np.sort(counts), share, where="post", color=colour, label=f"from {label}")
        axes.axvline(np.median(counts), color=colour, linewidth=0.6, linestyle=":")
    axes.set(xlabel="changes of the working set", ylabel="share of programs", ylim=(0.0, 1.02))
    axes.set_xscale("symlog", linthresh=1.0)
    axes.set_xlim(left=0.0)
    axes.legend(loc="lower right")
    plt.show()
for label, counts in changes.items():
    print(
        f"from {label}: median {np.median(counts):.0f}, 99 % below {np.percentile(counts, 99):.0f}, "
        f"N = {len(counts)}"
    )

# %% [markdown]
# ## 3. Is it the optimum?
#
# The certificate is computed from the program's own matrices, not from the solver's: a residual of 1e-10 of
# the largest term leaves no room for another answer, since the program is strictly convex in its inputs.

# %%
step = steps[len(steps) // 2]
answer = kernel.solve_batch(step.horizon, step.warm, step.active)
other = make_batch_solver("osqp", eps_abs=1e-6).solve_batch(step.horizon, step.warm, step.active)
thrust = answer.inputs[step.active][..., 0], other.inputs[step.active][..., 0]
print(
    f"largest residual of {thrust[0].shape[0] * thrust[0].shape[1]} programs: "
    f"{max(answer.primal[step.active].max(), answer.dual[step.active].max()):.0e}"
)
print(f"kernel and OSQP differ by {np.abs(thrust[0] - thrust[1]).max():.1e} N of thrust at most")

with house_style():
    figure, axes = plt.subplots(figsize=(4.6, 2.6), layout="constrained")
    run = int(np.flatnonzero(step.active)[0])
    times = np.concatenate([[0.0], np.cumsum(step.horizon.model.step_s)])
    for uav in range(answer.inputs.shape[1]):
        axes.stairs(answer.inputs[run, uav, :, 0], times, baseline=None, color=BLUE, linewidth=0.8)
        axes.plot(0.5 * (times[1:] + times[:-1]), other.inputs[run, uav, :, 0], ".", color=GREY, markersize=3)
    axes.plot([], [], color=BLUE, label="kernel")
    axes.plot([], [], ".", color=GREY, label="OSQP")
    axes.set(xlabel="time ahead (s)", ylabel="thrust about hover (N)")
    axes.legend(loc="upper right")
    plt.show()
