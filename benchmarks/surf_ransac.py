"""What RANSAC lets pass, where the truth is known: wrong matches among the inliers.

* homographies: the 20 warps of five real images; an inlier farther than 3 px from its true
  place is wrong (RANSAC works at 2 px);
* rendered pairs (`lunar-fg simulate --depth`): what stereo perception makes of them, without
  RANSAC, against the exact depth; wrong by more than 3 px from all depths within 2 px;
* rectified pairs: RANSAC is not told that rows are equal; an inlier farther than 3 px from
  its row (a smooth vertical field removed) is wrong, and so is one nearer than infinity.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter
from surf_features import read_grey
from surf_warps import WARPS, about_centre, degraded, resampled

from frontends.matching import find_fundamental, find_homography, match_descriptors
from frontends.rectification import robust_fit
from frontends.stereo import StereoPerception
from frontends.surf import SURF, Keypoints
from lunar_fg.datasets import open_dataset

KEYPOINTS = 3000
WRONG_PX = 3.0
IMAGES = (
    "msl-navcam-pair/NLB_524534514EDR_F0562034NCAM00280M_.jpeg",
    "k10-stereo/left4.png",
    "moonranger-run1/left/000040.png",
    "kitti-06-000-050/image_l/000000.png",
    "apollo17-surface/half-1170/AS17-137-20908HR.png",
)
PAIRS = (
    ("msl-navcam-pair/NLB_524534514EDR_F0562034NCAM00280M_.jpeg",
     "msl-navcam-pair/NRB_524534514EDR_F0562034NCAM00280M_.jpeg"),
    *((f"kitti-06-000-050/image_l/{i:06d}.png", f"kitti-06-000-050/image_r/{i:06d}.png")
      for i in range(0, 51, 5)),
    *((f"moonranger-run1/left/{i:06d}.png", f"moonranger-run1/right/{i:06d}.png")
      for i in range(0, 128, 8)),
)  # fmt: skip

Found = tuple[Keypoints, NDArray[np.float32]]


def wrong_matches(data: Path) -> dict[str, dict[str, int]]:
    """Pairs tried, refused, inliers and wrong ones among them, of both kinds."""
    surf = SURF(20, max_keypoints=KEYPOINTS)
    return {"homographies": _of_warps(data, surf), "rectified pairs": _of_stereo(data, surf)}


def _matched(first: Found, second: Found) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    pairs = match_descriptors(first[1], second[1])
    return first[0].xy[pairs.query].astype(float), second[0].xy[pairs.train].astype(float)


def _of_warps(data: Path, surf: SURF) -> dict[str, int]:
    count = {"pairs": 0, "refused": 0, "inliers": 0, "wrong": 0}
    for name in IMAGES:
        image = read_grey(data / name)
        first = surf.detectAndCompute(image)
        for _, inner, effect, strength in WARPS:
            truth = about_centre(image.shape, inner)
            other = degraded(resampled(image, truth), effect, strength)
            a, b = _matched(first, surf.detectAndCompute(other))
            found = find_homography(a, b)
            error = np.hypot(*(cv2.perspectiveTransform(a[None], truth)[0] - b).T)
            count["pairs"] += 1
            count["refused"] += bool(found.reason)
            count["inliers"] += int(found.inlier.sum())
            count["wrong"] += int((error[found.inlier] > WRONG_PX).sum())
    return count


def _of_stereo(data: Path, surf: SURF) -> dict[str, int]:
    count = {"pairs": 0, "refused": 0, "inliers": 0, "off row": 0, "beyond infinity": 0}
    for names in PAIRS:
        images = [read_grey(data / name) for name in names]
        a, b = _matched(*(surf.detectAndCompute(image) for image in images))
        found = find_fundamental(a, b)
        count["pairs"] += 1
        count["refused"] += bool(found.reason)
        if found.reason:
            continue
        a, b = a[found.inlier], b[found.inlier]
        x, y = ((a - np.array(images[0].shape[::-1]) / 2) / images[0].shape[1]).T
        basis = np.stack([np.ones_like(x), x, y, x * y, x**2, y**2], axis=-1)
        offset = a[:, 1] - b[:, 1]
        coefficients, _ = robust_fit(basis, offset)
        count["inliers"] += len(a)
        count["off row"] += int((np.abs(offset - basis @ coefficients) > WRONG_PX).sum())
        count["beyond infinity"] += int((a[:, 0] - b[:, 0] < -WRONG_PX).sum())
    return count


def of_rendered(folder: Path) -> dict[str, int]:
    """Landmarks of stereo perception, those with a refined disparity, and wrong ones of both."""
    dataset = open_dataset(folder, None, None)
    camera = dataset.camera
    perception = StereoPerception(camera)
    count = {"pairs": 0, "landmarks": 0, "wrong": 0, "refined": 0, "refined wrong": 0}
    for frame in dataset.frames():
        path = folder / "truth" / "depth" / f"{frame.index:06d}.npy"
        if not path.exists():
            continue  # of a rendering that was stopped
        depth = np.load(path)
        disparity = np.nan_to_num(camera.fx * camera.baseline_m / depth)  # none in the sky
        most, least = maximum_filter(disparity, 5), minimum_filter(disparity, 5)
        found = perception.perceive(frame).observations
        row, column = np.rint(found.v).astype(int), np.rint(found.u_left).astype(int)
        beyond = np.maximum(
            found.disparity_px - most[row, column], least[row, column] - found.disparity_px
        )
        # the keypoints' own precision is much coarser than a patch's
        scatter = np.sqrt(2.0) * perception.config.stereo_localisation_sigma * 1.2
        refined = found.sigma_disparity_px < scatter
        wrong = beyond > WRONG_PX
        count["pairs"] += 1
        count["landmarks"] += len(wrong)
        count["wrong"] += int(wrong.sum())
        count["refined"] += int(refined.sum())
        count["refined wrong"] += int((wrong & refined).sum())
    return count
