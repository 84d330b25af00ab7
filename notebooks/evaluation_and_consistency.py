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
# # Evaluation and consistency
#
# How far off is a trajectory, and does its covariance tell the truth? The stereo landmarks of a
# real drive (KITTI 00, part of gtsam) for the first; simulated drives, whose noise is known, for
# the second.

# %%
import matplotlib.pyplot as plt

from lunar_fg.datasets.landmarks import read_landmarks
from lunar_fg.evaluation import evaluate
from lunar_fg.graph import IncrementalSmoother, optimize_batch
from lunar_fg.truth import as_trajectory

sequence = read_landmarks("00")
smoother = IncrementalSmoother(sequence.camera, sequence.rover_T_camera, sequence.start)
for keyframe in sequence.keyframes[:40]:
    smoother.add(keyframe)
smoother.finish()
incremental = as_trajectory(smoother.trajectory())
result = optimize_batch(
    sequence.camera, sequence.rover_T_camera, sequence.start, sequence.keyframes[:40]
)
batch = as_trajectory(result.trajectory)
accuracy = evaluate(incremental, batch, same_map=True)
print(
    f"incremental against batch over {accuracy.distance_m:.0f} m: ATE {accuracy.ate_rmse_m.none:.3f} m"
)

# %%
from lunar_fg.evaluation.top_view import top_view

top_view(incremental, batch, title="KITTI 00, 40 keyframes: incremental over batch")

# %% [markdown]
# ## Is the covariance honest?
#
# NEES a degree of freedom is 1 on average when errors are as large as stated. Errors of successive
# poses are nearly the same error; the band counts how many independent ones they are worth.

# %%
from lunar_fg.evaluation.association import associate
from lunar_fg.evaluation.consistency import NeesFrame, nees, pooled
from lunar_fg.simulation.measurements import TraverseSpec, simulate
from lunar_fg.trajectory import Trajectory


def consistency(seed, noise=1.0):
    """NEES of one drive; the true pixel noise is `noise` times the stated one."""
    spec = TraverseSpec(keyframes=30, landmarks=50, tilt=True, odometry=True)
    drive = simulate(spec, seed)
    smoother = IncrementalSmoother(drive.camera, drive.rover_T_camera, drive.start)
    for keyframe in drive.keyframes:
        smoother.add(keyframe)
    smoother.finish()
    estimate = as_trajectory(smoother.trajectory())
    lied = Trajectory(estimate.stamp_s, estimate.map_T_rover, estimate.covariance / noise**2)
    truth = Trajectory(estimate.stamp_s, drive.map_T_rover)
    return nees(associate(lied, truth), NeesFrame.SAME_MAP)


runs = [consistency(seed) for seed in range(12)]
together = pooled(runs)
print(
    f"12 drives: NEES {together.mean:.2f}, honest between {together.lower95:.2f} and {together.upper95:.2f}"
)

# %% [markdown]
# A covariance that claims half the sigma is found out at once:

# %%
lying = pooled([consistency(seed, noise=2.0) for seed in range(12)])
print(f"claiming half the sigma: NEES {lying.mean:.2f}, honest: {lying.honest}")
figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
axes.axhspan(
    together.lower95, together.upper95, color="tab:green", alpha=0.2, label="95 % band of all"
)
axes.plot([run.mean for run in runs], "o", label="each drive")
axes.axhline(together.mean, label="all")
axes.axhline(lying.mean, color="tab:red", ls="--", label="all, claiming half the sigma")
axes.set(xlabel="drive", ylabel="NEES / dof", ylim=(0, None))
axes.legend(fontsize=8)
