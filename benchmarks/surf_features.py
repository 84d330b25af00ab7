"""Features of SURF, of OpenCV's detectors and of OpenCV SURF's stored output, in one shape."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.surf import SURF

KEYPOINTS = 1500
RATIO = 0.8


@dataclass(frozen=True)
class Features:
    """Strongest-first positions (N, 2), sizes (N,) and descriptors (N, D)."""

    xy: NDArray[np.float64]
    size: NDArray[np.float64]
    descriptors: NDArray[np.generic]

    def top(self, n: int) -> Features:
        """Strongest n."""
        return Features(self.xy[:n], self.size[:n], self.descriptors[:n])


@dataclass(frozen=True)
class Picture:
    """A grey image, and its name under the data folder if it is stored there as it is."""

    grey: NDArray[np.uint8]
    name: str = ""


Extractor = Callable[[Path, Picture], Features]
Report = dict[str, dict[str, object]]


def read_grey(path: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise SystemExit(f"{path}: no such image")
    return np.asarray(image, np.uint8)


def read(data: Path, name: str) -> Picture:
    return Picture(read_grey(data / name), name)


def ours(upright: bool = False, accurate: bool = False) -> Extractor:
    surf = SURF(20, upright=upright, max_keypoints=KEYPOINTS, accurate=accurate)

    def extract(data: Path, picture: Picture) -> Features:
        keypoints, descriptors = surf.detectAndCompute(picture.grey)
        return Features(keypoints.xy.astype(float), keypoints.size.astype(float), descriptors)

    return extract


def reference(kind: str) -> Extractor:
    """OpenCV SURF's stored keypoints and descriptors (threshold 20, 4 octaves, 2 layers)."""

    def extract(data: Path, picture: Picture) -> Features:
        name = picture.name.replace("/", "__") + ".npz"
        with np.load(data / "surf-reference" / name) as stored:
            keypoints = stored[f"{kind}_keypoints"].astype(float)
            descriptors = stored[f"{kind}_descriptors"].astype(np.float32)
        return Features(keypoints[:, :2], keypoints[:, 2], descriptors)

    return extract


def opencv(detector: cv2.Feature2D, size_scale: float = 1.0) -> Extractor:
    def extract(data: Path, picture: Picture) -> Features:
        keypoints, descriptors = detector.detectAndCompute(picture.grey, None)
        order = np.argsort([-k.response for k in keypoints], kind="stable")
        return Features(
            np.array([keypoints[i].pt for i in order]),
            np.array([keypoints[i].size for i in order]) * size_scale,
            descriptors[order],
        )

    return extract


def akaze() -> cv2.Feature2D:
    # OpenCV 5 moved it to the contrib modules
    module = cv2 if hasattr(cv2, "AKAZE_create") else cv2.xfeatures2d
    return module.AKAZE_create(threshold=1e-4)


def extractors() -> dict[str, Extractor]:
    return {
        "SURF": ours(upright=False),
        "SURF upright": ours(upright=True),
        "SURF accurate": ours(accurate=True),
        "OpenCV SURF": reference("oriented"),
        "OpenCV U-SURF": reference("upright"),
        "cv2.SIFT": opencv(cv2.SIFT_create(KEYPOINTS)),
        "cv2.ORB": opencv(cv2.ORB_create(KEYPOINTS)),
        "cv2.AKAZE": opencv(akaze()),
    }


def match(a: Features, b: Features) -> NDArray[np.intp]:
    """Mutual nearest neighbours that pass the ratio test, as (M, 2) indices."""
    binary = a.descriptors.dtype == np.uint8
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING if binary else cv2.NORM_L2)
    forward = matcher.knnMatch(a.descriptors, b.descriptors, 2)
    backward = {m.queryIdx: m.trainIdx for m in matcher.match(b.descriptors, a.descriptors)}
    pairs = [
        (first.queryIdx, first.trainIdx)
        for first, second in forward
        if first.distance < RATIO * second.distance and backward[first.trainIdx] == first.queryIdx
    ]
    return np.array(pairs, np.intp).reshape(-1, 2)
