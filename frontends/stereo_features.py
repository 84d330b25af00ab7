"""Stereo landmarks of one frame with what tracking needs to find them again."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from frontends.measurements import Image, StereoObservations
from frontends.templates import Templates

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class StereoFeatures:
    """Stereo landmarks of one frame where its features are; ids are -1 until they are tracked.

    Attributes
    ----------
    observations
        N landmarks, corrected by `rectification`.
    descriptors
        (N, 64) float32, from the left image.
    laplacian
        (N,) int8.
    size_px
        (N,) diameter of the image region a feature describes.
    keypoints
        How many in the left and in the right image.
    matches
        Pairs within the epipolar band.
    refined
        How many disparities the refinement confirmed.
    epipolar_sigma_px
        Robust 1-sigma of the vertical residual of the refined pairs.
    slope
        (N, 2) change of the disparity along u and along v, px per px; 0 where it is unknown.
    templates
        The patches around the landmarks in the left image.
    image
        The left image that they were found in: smoothed where the frame's own is too noisy.
    noise
        Factor on the 1-sigma of positions fitted to its pixels: 1 where their noise is independent.
    """

    observations: StereoObservations
    descriptors: NDArray[np.float32]
    laplacian: NDArray[np.int8]
    size_px: FloatArray
    keypoints: tuple[int, int]
    matches: int
    refined: int
    epipolar_sigma_px: float
    slope: FloatArray
    templates: Templates
    image: Image
    noise: float = 1.0

    def __len__(self) -> int:
        return len(self.descriptors)

    def named(self, landmark_id: NDArray[np.int64]) -> StereoFeatures:
        """The same landmarks with ids."""
        return replace(self, observations=replace(self.observations, landmark_id=landmark_id))
