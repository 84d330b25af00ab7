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
# # Bring your own frontend
#
# Two seams: a feature detector of your own in the images' side, or measurements of your own (a
# learned matcher, a lidar, a star tracker) straight into the graph. Neither needs the other.

# %% [markdown]
# ## A detector: anything of the shape of `cv2.Feature2D`

# %%
import os
from pathlib import Path

import cv2
import numpy as np

from frontends.detector import OpenCVDetector
from lunar_fg.datasets import open_dataset
from lunar_fg.evaluation import evaluate
from lunar_fg.navigator import Navigator
from lunar_fg.truth import truth_of

data = Path(os.environ.get("LUNAR_FG_DATA", "../../shared/data"))
drive = open_dataset(data / "kitti-06-000-050")


def accuracy(detector=None, frames=12):
    navigator = Navigator(drive.camera, rover_T_camera=drive.rover_T_camera, detector=detector)
    for frame, _ in zip(drive.frames(), range(frames), strict=False):
        navigator.step(frame)
    navigator.finish()
    return evaluate(navigator.trajectory(), truth_of(drive.ground_truth)).ate_rmse_m.se3


print(f"SURF {1e3 * accuracy():.0f} mm")
print(f"SIFT {1e3 * accuracy(OpenCVDetector(cv2.SIFT_create(1500))):.0f} mm")

# %% [markdown]
# ## Measurements: build the dataclasses, feed the graph
#
# Suppose a lidar gives the motion between stops, and a star tracker the heading. A relative pose
# with its covariance is all that the graph wants; the heading enters as an absolute fix whose
# position is left open by a large sigma.

# %%
from frontends.camera import StereoCamera, level_rover_T_camera
from frontends.geometry import inverse, se3_exp
from frontends.measurements import (
    AbsoluteFix,
    FixCandidate,
    Odometry,
    StartPrior,
)
from lunar_fg.graph import IncrementalSmoother, Keyframe

rng = np.random.default_rng(7)
stops = 60
motion = se3_exp([0.0, 0.0, 0.04, 2.0, 0.0, 0.0])
sigmas = np.array([2e-3, 2e-3, 1e-2, 0.03, 0.03, 0.03])
truth, heading = [np.eye(4)], [0.0]
for _ in range(stops - 1):
    truth.append(truth[-1] @ motion)
    heading.append(heading[-1] + 0.04)


def lidar(i):
    """Motion since the stop before, as a lidar's scan matching would measure it."""
    true = inverse(truth[i - 1]) @ truth[i]
    return Odometry(true @ se3_exp(sigmas * rng.normal(size=6)), np.diag(sigmas**2))


def star_tracker(i, sigma=0.005):
    """Heading alone: where the rover is stays open."""
    place = FixCandidate(
        *truth[i][:2, 3],
        heading[i] + sigma * rng.normal(),
        np.diag([1e4, 1e4, sigma**2]),
        proposer="stars",
    )
    return AbsoluteFix(i, (place,))


# The camera is only there for landmarks, of which there are none here.
camera = StereoCamera(640, 480, 500.0, 500.0, 320.0, 240.0, 0.3)


def drive_with(stars):
    smoother = IncrementalSmoother(camera, level_rover_T_camera(), StartPrior())
    for i in range(stops):
        smoother.add(Keyframe(i, float(i), odometry=lidar(i) if i else None))
        if stars and i and i % 10 == 0:
            smoother.add_fix(star_tracker(i))
    smoother.finish()
    end = smoother.trajectory()
    sigma = np.sqrt(np.diag(end.covariance[-1]))
    off = np.linalg.norm(end.map_T_rover[-1][:2, 3] - truth[-1][:2, 3])
    return off, np.rad2deg(sigma[2])


for name, stars in (("lidar alone", False), ("lidar and stars", True)):
    off, yaw = drive_with(stars)
    print(f"{name:16} {off:.2f} m off at the end, heading known to {yaw:.2f} deg")
