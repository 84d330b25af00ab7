# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Drift and absolute adjustment, offline and incremental
#
# A traverse simulated at measurement level, with exact truth: relative poses and an inclinometer
# drift; absolute fixes from a map (paper, 2.3) take the drift away. A fifth of the fixes is
# false on purpose.

# %%
import matplotlib.pyplot as plt
import numpy as np

from lunar_fg.graph import IncrementalSmoother
from lunar_fg.simulation.fixes import FixSpec, simulate_fixes
from lunar_fg.simulation.measurements import TraverseSpec, simulate

spec = TraverseSpec(
    keyframes=240,
    landmarks=0,
    tilt=True,
    relative_sigma_rot_rad=5e-3,
    relative_sigma_trans_m=0.02,
)
traverse = simulate(spec, seed=4)
frames = [keyframe.index for keyframe in traverse.keyframes]
fixes = simulate_fixes(
    frames, traverse.map_T_rover, FixSpec(every=20, sigma_xy_m=0.5, false_share=0.2), seed=4
)
print(len(fixes.fixes), "fixes,", np.count_nonzero(~fixes.true), "of them false")

# %% [markdown]
# ## Incremental: as the rover would
#
# Each fix passes a chi-square gate and a vote over the last fixes; every verdict can be taken back.


# %%
def navigate(with_fixes):
    smoother = IncrementalSmoother(traverse.camera, traverse.rover_T_camera, traverse.start)
    waiting = {fix.frame: fix for fix in fixes.fixes} if with_fixes else {}
    on_the_way = []
    for keyframe in traverse.keyframes:
        estimate = smoother.add(keyframe)
        if keyframe.index in waiting:
            decision = smoother.add_fix(waiting[keyframe.index])
            print(f"keyframe {keyframe.index:3d}: {decision.verdict}, {decision.reason}")
        on_the_way.append(estimate.map_T_rover[:3, 3])
    smoother.finish()
    return smoother, np.array(on_the_way)


smoother, on_the_way = navigate(with_fixes=True)
alone, drifting = navigate(with_fixes=False)

# %% [markdown]
# ## What the ledger says against the truth

# %%
believed = np.array([entry.ruling.verdict.value == "accepted" for entry in smoother.ledger])
print("true and believed ", np.count_nonzero(believed & fixes.true), "of", fixes.true.sum())
print("false and believed", np.count_nonzero(believed & ~fixes.true), "of", (~fixes.true).sum())

# %% [markdown]
# ## Offline: everything at once
#
# After the drive, all poses are smoothed with all that was measured.

# %%
truth = traverse.map_T_rover[:, :3, 3]
smoothed, without = (s.trajectory().map_T_rover[:, :3, 3] for s in (smoother, alone))
distance = spec.step_m * np.arange(len(truth))


def error(positions):
    return np.linalg.norm(positions[:, :2] - truth[:, :2], axis=1)


figure, (above, below) = plt.subplots(2, 1, figsize=(8, 8), layout="constrained")
above.plot(*truth[:, :2].T, color="0.6", lw=5, label="truth")
above.plot(*without[:, :2].T, "--", label="without fixes")
above.plot(*smoothed[:, :2].T, label="with fixes")
for fix, true in zip(fixes.fixes, fixes.true, strict=True):
    place = fix.candidates[0]
    above.plot(place.x_m, place.y_m, "go" if true else "rx")
low, high = truth[:, :2].min(axis=0) - 10, truth[:, :2].max(axis=0) + 10
above.set(
    xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x (m)", ylabel="y (m)"
)
above.legend()
below.plot(distance, error(without), "--", label="without fixes")
below.plot(distance, error(on_the_way), label="with fixes, on the way")
below.plot(distance, error(smoothed), label="with fixes, smoothed")
below.set(xlabel="distance (m)", ylabel="error in the plane (m)")
below.legend()
for name, positions in (
    ("without fixes", without),
    ("on the way", on_the_way),
    ("smoothed", smoothed),
):
    print(f"{name:14} mean error {error(positions).mean():.2f} m")
