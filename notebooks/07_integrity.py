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
# # How far may a position be off?
#
# A receiver reports a sigma. The planner keeps k of them from obstacles. This holds if the errors are normal,
# the sigma is right, and no satellite is wrong. Here: what is left when they are not, and what can be had
# instead. The page [integrity.md](../docs/integrity.md) has the equations and the measured numbers.
#
# Everything here is drawn by the library's own streams, so it needs no data; the number of missions in the
# last part follows from `NAPF_MPC_NOTEBOOK_RUNS` (100 unless set).

# %%
import math
import os

import matplotlib.pyplot as plt
import numpy as np

from napf_mpc import load_problem, simulate
from napf_mpc.navigation.integrity.araim import IntegrityRequirement, RangeErrors, protection_level
from napf_mpc.navigation.integrity.overbound import paired_overbound
from napf_mpc.navigation.integrity.tails import confidence_factor, fit_student, student_factor
from napf_mpc.plot import StanfordPanel, TailPanel
from napf_mpc.plot.stanford import stanford_figure
from napf_mpc.plot.style import BLUE, GREY, VERMILION, house_style
from napf_mpc.plot.tails import tail_figure
from napf_mpc.risk import wilson
from napf_mpc.streams import Stream, normals, uniforms

# %matplotlib inline

RUNS = int(os.environ.get("NAPF_MPC_NOTEBOOK_RUNS", "100"))

# %% [markdown]
# ## 1. Which k for which confidence?
#
# Normal errors on one axis, in the plane and in space; and errors of Student's t law, whose tail is heavier
# the fewer degrees of freedom it has.

# %%
for confidence in (0.95, 0.9973, 0.99999):
    normal = ", ".join(f"{confidence_factor(confidence, d):.2f}" for d in (1, 2, 3))
    heavy = ", ".join(f"{student_factor(confidence, dof):.1f} ({dof:g})" for dof in (30.0, 4.0, 2.0))
    print(f"{100 * confidence:g} %: k = {normal} in 1, 2, 3 dimensions; Student's t, one axis: {heavy}")

# %% [markdown]
# ## 2. What does a log say beyond its own sigmas?
#
# 400 errors of a heavy-tailed law on three axes; the first half makes the overbound, the second judges it.
# Where the line is dashed, the first half cannot tell any more: 200 errors say nothing of one in a thousand.

# %%
draws = normals(5, range(3), Stream.OWN_ERROR, 1, 5, 400)[:, 0]
errors = draws[:, 0] / np.sqrt((draws[:, 1:] ** 2).mean(1))
first, second = errors[:, :200], errors[:, 200:]
bounds = [paired_overbound(axis) for axis in first]
with house_style():
    figure = tail_figure(
        [
            TailPanel(name, axis, bound)
            for name, axis, bound in zip(("East", "North", "Up"), second, bounds, strict=True)
        ]
    )
display(figure)  # noqa: F821

for name, axis, fitted, bound in zip(("east", "north", "up"), second, first, bounds, strict=True):
    before, after = (np.abs(axis) <= 3.0).mean(), (np.abs(axis) <= 3.0 * bound.factor(3.0)).mean()
    law = fit_student(fitted)
    print(
        f"{name}: within 3 sigma {100 * before:.1f} %, within the overbound {100 * after:.1f} % "
        f"(b = {bound.bias:.2f}, s = {bound.sigma:.2f}, told up to k = {bound.supported_k:.1f}); "
        f"t law with {law.degrees_of_freedom:.1f} degrees of freedom"
    )

# %% [markdown]
# ## 3. What if a satellite is wrong?
#
# Eight satellites of one constellation, six of another. A protection level bounds the error although any of
# them may fail, by looking at what the others say. In a street, where signals arrive by reflection alone, it
# takes hypotheses of several wrong signals at a time, and at some point there is no level any more.

# %%
azimuth = np.deg2rad([10, 60, 105, 150, 200, 245, 290, 335, 30, 85, 140, 190, 260, 310])
elevation = np.deg2rad([20, 45, 15, 65, 35, 75, 25, 50, 60, 30, 40, 18, 55, 38])
sight = np.stack(
    [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)], axis=-1
)
asked = IntegrityRequirement(
    p_hmi_horizontal=1e-3, p_hmi_vertical=1e-3, p_fa_horizontal=1e-2, p_fa_vertical=1e-2, p_unmonitored=1e-4
)
shares = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1)
levels = []
for share in shares:
    ranges = RangeErrors(
        line_of_sight=sight,
        constellation=np.array([0] * 8 + [1] * 6),
        sigma_m=1.0 + 1.0 / np.sin(elevation),
        bias_m=np.full(14, 0.5),
        p_satellite=np.full(14, 1e-3),
        p_constellation={0: 1e-4, 1: 1e-4},
        p_nlos=np.full(14, share),
    )
    levels.append(protection_level(ranges, asked))
    words = levels[-1].reason or f"HPL {levels[-1].horizontal_m:.1f} m, VPL {levels[-1].vertical_m:.1f} m"
    print(f"chance of a reflection {100 * share:g} %: {len(levels[-1].prior)} hypotheses, {words}")

# %% [markdown]
# ## 4. Does it hold, and what does the diagram show?
#
# Faults of 25 m, drawn with a chance of 2 % for each signal. Left: k sigma of the same solution, at the same
# probability. Right: the protection level, at epochs at which its own test raises no alarm.

# %%
epochs = 200 * RUNS
noise = normals(6, range(1), Stream.OWN_ERROR, 14, 1, epochs)[0, :, 0].T * ranges.sigma_m
wrong = 25.0 * (uniforms(6, range(1), Stream.OUTAGE, 14, 1, epochs)[0, :, 0].T < 0.02)
guarded = levels[shares.index(0.02)]
error = np.abs(np.einsum("n,en->e", guarded.gain[0, 2], noise + wrong))
quiet = guarded.consistent(noise + wrong)
sigma = math.sqrt(float(guarded.gain[0, 2] ** 2 @ ranges.sigma_m**2))
plain = np.full(epochs, confidence_factor(1.0 - asked.p_hmi_vertical) * sigma)
for words, beyond in (("k sigma", error > plain), ("VPL", quiet & (error > guarded.vertical_m))):
    rate = wilson(int(beyond.sum()), epochs)
    print(f"error beyond {words}: {rate.count} of {epochs} [{rate.low:.2e}, {rate.high:.2e}], asked 1e-3")
with house_style():
    figure = stanford_figure(
        [
            StanfordPanel("k sigma", error, plain, 25.0),
            StanfordPanel("Protection level", error[quiet], np.full(quiet.sum(), guarded.vertical_m), 25.0),
        ]
    )
display(figure)  # noqa: F821

# %% [markdown]
# ## 5. What if the receiver claims a fifth of its sigma?
#
# The navigation filter's monitor of innovations sees it within seconds and says so.

# %%
for scale in (1.0, 0.2):
    for monitor in ("none", "innovations"):
        problem = load_problem(
            "study_8s",
            [
                'navigation.filter="kalman"',
                f'navigation.monitor="{monitor}"',
                f"navigation.reported_sigma_scale={scale}",
            ],
        )
        missions = simulate(problem, "napf", seed=300, runs=max(5, RUNS // 10))
        score = missions.score
        hit = wilson(int(score.obstacle_contact.any(-1).sum()), len(score.runs))
        alarms = [event.time_s for event in missions.tally.events if "innovations" in event.cause]
        told = f", {len(alarms)} alarms, the first at {min(alarms):.1f} s" if alarms else ""
        print(
            f"sigma x {scale:g}, monitor {monitor}: {hit.count} of {hit.total} touch an obstacle "
            f"[{100 * hit.low:.0f}, {100 * hit.high:.0f}] %{told}"
        )

# %% [markdown]
# ## 6. What does a larger margin cost?
#
# Twice the sigma is twice the margin; towards obstacles that stand closer than that there is no way through.

# %%
factors = [bound.factor(3.0) for bound in bounds]
with house_style():
    figure, axes = plt.subplots(figsize=(3.5, 2.0), layout="constrained")
    axes.bar(range(3), [3.0] * 3, color=GREY, width=0.35, label="k sigma")
    axes.bar(np.arange(3) + 0.36, [3.0 * f for f in factors], color=VERMILION, width=0.35, label="overbound")
    axes.axhline(3.0, color=BLUE, linewidth=0.6)
    axes.set_xticks(np.arange(3) + 0.18, ["east", "north", "up"])
    axes.set(ylabel="margin (reported sigmas)")
    axes.legend(loc="upper left", ncols=2)
    axes.set_ylim(0.0, 1.35 * 3.0 * max(factors))
plt.show()
