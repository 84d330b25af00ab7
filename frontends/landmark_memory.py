"""Landmarks that may be seen again, carried from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from frontends.geometry import inverse, transform_points
from frontends.rows import joined_rows, selected_rows
from frontends.templates import Templates

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LandmarkMemory:
    """Landmarks that may be seen again, in the left-camera axes of the newest frame.

    Attributes
    ----------
    landmark_id, descriptors, laplacian
        (N,), (N, D), (N,): as in `StereoFeatures`.
    points, covariance
        (N, 3) m, (N, 3, 3) m^2.
    unseen
        (N,) frames since each was last seen.
    first_depth_m
        (N,) how far each was when it was first seen.
    slope
        (N, 2) change of the disparity in the image where it was last seen, px per px.
    templates
        The patches around them.
    """

    landmark_id: NDArray[np.int64]
    descriptors: NDArray[np.float32]
    laplacian: NDArray[np.int8]
    points: FloatArray
    covariance: FloatArray
    unseen: NDArray[np.int64]
    first_depth_m: FloatArray
    slope: FloatArray
    templates: Templates

    def __len__(self) -> int:
        return len(self.landmark_id)

    def select(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> LandmarkMemory:
        """The landmarks at a mask or an index array."""
        return selected_rows(self, keep)

    def joined(self, other: LandmarkMemory) -> LandmarkMemory:
        """These landmarks and those."""
        return joined_rows(self, other)

    def carried(
        self, a_T_b: FloatArray, seen_again: NDArray[np.int64], max_unseen: int
    ) -> LandmarkMemory:
        """These landmarks in a new frame's axes, without what was seen again or lost.

        Parameters
        ----------
        a_T_b
            (4, 4) the new left camera in the one the landmarks are in.
        seen_again
            Ids of the landmarks that the new frame sees.
        max_unseen
            Kept for so many frames after they were last seen.
        """
        keep = (self.unseen < max_unseen) & ~np.isin(self.landmark_id, seen_again, kind="table")
        kept = self.select(keep)
        b_T_a = inverse(a_T_b)
        # R C R^T of every landmark as one matrix product
        twice = np.kron(b_T_a[:3, :3], b_T_a[:3, :3])
        return replace(
            kept,
            points=transform_points(b_T_a, kept.points),
            covariance=(kept.covariance.reshape(-1, 9) @ twice.T).reshape(-1, 3, 3),
            unseen=kept.unseen + 1,
        )
