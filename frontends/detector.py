"""Feature detectors that stereo perception can use: SURF, or anything of OpenCV's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from frontends.measurements import Image
from frontends.surf import Keypoints

Descriptors = NDArray[np.float32]


class FeatureDetector(Protocol):
    """What finds and describes features; `frontends.SURF` is one."""

    def detectAndCompute(
        self, image: Image, mask: NDArray[np.uint8] | None = None
    ) -> tuple[Keypoints, Descriptors]:
        """Features of an image and their descriptors, (N, D) float32 of unit length."""
        ...


class OpenCVDetector:
    """Makes a ``cv2.Feature2D`` a `FeatureDetector`.

    Descriptors are brought to unit length. Binary ones (ORB, AKAZE) are spread to one
    number a bit first, so that their squared distance goes as the Hamming distance.

    Parameters
    ----------
    feature2d
        Any ``cv2.Feature2D``, e.g. ``cv2.SIFT_create(1500)``.
    """

    def __init__(self, feature2d: Any) -> None:
        self._feature2d = feature2d

    def detectAndCompute(
        self, image: Image, mask: NDArray[np.uint8] | None = None
    ) -> tuple[Keypoints, Descriptors]:
        """Features of an image and their descriptors, see `FeatureDetector`."""
        found, descriptors = self._feature2d.detectAndCompute(image, mask)
        keypoints = Keypoints.from_cv2(found)
        if descriptors is None or len(keypoints) == 0:
            return Keypoints.empty(), np.zeros((0, 1), dtype=np.float32)
        if descriptors.dtype == np.uint8:
            descriptors = np.unpackbits(descriptors, axis=1)
        unit = descriptors.astype(np.float32)
        unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-12)
        return keypoints, unit


@dataclass(frozen=True, slots=True)
class DescribedPair:
    """What a detector gives of the two images of a pair.

    Attributes
    ----------
    left, right
        N and M keypoints.
    left_descriptors, right_descriptors
        (N, D) and (M, D) float32.
    """

    left: Keypoints
    left_descriptors: Descriptors
    right: Keypoints
    right_descriptors: Descriptors
