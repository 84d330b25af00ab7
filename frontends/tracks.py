"""Landmarks that two frames see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from frontends.measurements import RelativePose, StereoObservations
from frontends.rows import selected_rows
from frontends.stereo_features import StereoFeatures
from frontends.templates import Templates

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Tracks:
    """Landmarks of the memory matched with features of the new frame.

    Attributes
    ----------
    points_a, covariance_a
        (M, 3) m, (M, 3, 3) m^2: the landmarks in the previous frame's left-camera axes.
    observations_b
        The M matched observations of the new frame, carrying the landmarks' ids.
    feature
        (M,) rows of the new frame's features.
    first_depth_m
        (M,) how far the landmarks were when they were first seen.
    slope
        (M, 2) change of the disparity around the landmarks in the previous frame, px per px.
    templates
        The patches around the landmarks, warped as in the previous frame, or as found.
    followed
        (M,) bool: found by their patches, not by their features alone.
    """

    points_a: FloatArray
    covariance_a: FloatArray
    observations_b: StereoObservations
    feature: NDArray[np.int64]
    first_depth_m: FloatArray
    slope: FloatArray
    templates: Templates
    followed: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.feature)

    def select(self, rows: NDArray[np.int64]) -> Tracks:
        """Some of the tracks."""
        return selected_rows(self, rows)

    def agreeing(self, relative: RelativePose) -> NDArray[np.bool_]:
        """Which tracks agree with a motion, (M,)."""
        # ids of a few frames lie close together: a table of them is small
        return np.isin(self.observations_b.landmark_id, relative.inlier_ids, kind="table")

    @classmethod
    def none(cls, features: StereoFeatures) -> Self:
        """No tracks to some features."""
        nothing = np.zeros(0, dtype=np.int64)
        return cls(
            np.zeros((0, 3)),
            np.zeros((0, 3, 3)),
            features.observations.select(nothing),
            nothing,
            np.zeros(0),
            np.zeros((0, 2)),
            features.templates.select(nothing),
            np.zeros(0, dtype=np.bool_),
        )


def common_landmarks(
    a: StereoObservations, b: StereoObservations
) -> tuple[StereoObservations, StereoObservations]:
    """Observations of the landmarks that both frames see, in the same order."""
    _, i, j = np.intersect1d(a.landmark_id, b.landmark_id, assume_unique=True, return_indices=True)
    return a.select(i), b.select(j)
