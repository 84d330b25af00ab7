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
# # The paper, step by step, on real images
#
# Li & Zhong, *A machine vision based autonomous navigation system for Lunar rover* (Sensor
# Review 36/4, 2016): stereo perception (2.1), relative positioning (2.2), and matching results as
# in its figures 4 to 6. The images are real: Curiosity's Navcam and a drive of the KITTI benchmark.
# `LUNAR_FG_DATA` names the folder that holds them.

# %%
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from frontends.camera import StereoCamera
from frontends.measurements import StereoFrame
from lunar_fg.datasets.images import read_grey

data = Path(os.environ.get("LUNAR_FG_DATA", "../../shared/data"))
left, right = (
    read_grey(data / f"msl-navcam-pair/N{eye}B_524534514EDR_F0562034NCAM00280M_.jpeg", 65535)
    for eye in "LR"
)
# Nominal model of the pair: focal length 1220 px, baseline 0.424 m.
camera = StereoCamera(1024, 1024, 1220.0, 1220.0, 511.5, 511.5, 0.424)

# %% [markdown]
# ## Features (eqs. 8 to 11)
#
# SURF finds blobs with an integral image (eq. 8) and box filters (eqs. 9, 10), and describes each by
# 64 numbers (eq. 11).

# %%
from frontends.surf import SURF

keypoints, descriptors = SURF(20.0, max_keypoints=1500).detectAndCompute(left)
print(len(keypoints), "keypoints, descriptors", descriptors.shape)
figure, axes = plt.subplots(figsize=(6, 6), layout="constrained")
axes.imshow(left, cmap="gray")
axes.scatter(
    *keypoints.xy.T, s=4 * keypoints.size, facecolors="none", edgecolors="tab:orange", lw=0.6
)
axes.set_title("SURF keypoints in Curiosity's left Navcam")
axes.axis("off")
# %% [markdown]
# ## Stereo perception (eqs. 1 to 5, 12)
#
# Features are matched along the epipolar lines; each disparity D gives a point,
# X = B x / D, Y = B y / D, Z = B f / D, with a covariance.

# %%
from frontends.stereo import StereoPerception

perception = StereoPerception(camera)
features = perception.perceive(StereoFrame(0, 0.0, left, right, camera))
landmarks = features.observations
depth = camera.depth(landmarks.disparity_px)
print(
    f"{features.matches} matches, {len(features)} landmarks from {depth.min():.1f} to {depth.max():.1f} m"
)
print(f"median sigma of a disparity {np.median(landmarks.sigma_disparity_px):.3f} px")
figure, axes = plt.subplots(figsize=(7, 6), layout="constrained")
axes.imshow(left, cmap="gray")
dots = axes.scatter(landmarks.u_left, landmarks.v, c=np.log10(depth), s=7, cmap="turbo_r")
figure.colorbar(dots, label="log10 depth (m)", shrink=0.8)
axes.set_title("Stereo landmarks")
axes.axis("off")
# %% [markdown]
# ## Relative positioning (eq. 6)
#
# The same landmarks, seen again after a step, give the motion: RANSAC over rigid transforms of three
# landmarks, then least squares on the reprojection. The navigator does it for every frame of a drive.

# %%
from lunar_fg.datasets import open_dataset
from lunar_fg.navigator import Navigator

drive = open_dataset(data / "kitti-06-000-050")
navigator = Navigator(drive.camera, rover_T_camera=drive.rover_T_camera)
for frame, _ in zip(drive.frames(), range(10), strict=False):
    estimate = navigator.step(frame)
navigator.finish()
steps = np.linalg.norm(np.diff(navigator.trajectory().positions, axis=0), axis=1)
truth = drive.ground_truth.position_m[:10]
print("steps by the images, m", np.round(steps[:6], 3))
print("true steps,          m", np.round(np.linalg.norm(np.diff(truth, axis=0), axis=1)[:6], 3))
rejected = np.mean([report.wrong_match_rate for report in navigator.reports[1:]])
print(f"{rejected:.0%} of the tracked landmarks disagree with the motion and are left out")

# %% [markdown]
# ## Matching results (figures 4 to 6)
#
# Two images of one place, with view and scale changed, are matched and related by a homography
# (eq. 13); images of different places are refused, with the reason.

# %%
from lunar_fg.match import MatchModel, match_images


def show(first, second, title):
    result = match_images(first, second, MatchModel.HOMOGRAPHY)
    height = max(first.shape[0], second.shape[0])
    both = np.full((height, first.shape[1] + second.shape[1]), 255, np.uint8)
    both[: first.shape[0], : first.shape[1]] = first
    both[: second.shape[0], first.shape[1] :] = second
    _, axes = plt.subplots(figsize=(9, 4), layout="constrained")
    axes.imshow(both, cmap="gray")
    for a, b in list(zip(result.first_xy, result.second_xy, strict=True))[
        :: max(1, result.inliers // 60)
    ]:
        axes.plot([a[0], b[0] + first.shape[1]], [a[1], b[1]], lw=0.5)
    verdict = (
        result.reason
        or f"{result.inliers} of {result.matches} matches agree, {result.error_px:.2f} px"
    )
    axes.set_title(f"{title}: {verdict}", fontsize=9)
    axes.axis("off")
    return result


graf = [read_grey(data / f"homography-pairs/graf/img{i}.png", 65535) for i in (1, 2)]
same = show(*graf, "same wall, another view")
other = show(left, graf[0], "Mars and a wall")
print("refused:", other.reason)
