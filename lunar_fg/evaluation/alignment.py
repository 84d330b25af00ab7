"""Bringing an estimate into the frame of the truth, by as little or as much as is asked.

A truth without z counts as flat ground at z = 0: all alignments then fit the estimate's
three-dimensional path to that plane, and what remains off the plane is an error. It is what
`evo` gives when the missing z is filled with zeros.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from frontends.geometry import inverse
from lunar_fg.evaluation.association import Pair, UndefinedMetricError
from lunar_fg.trajectory import Trajectory

FloatArray = NDArray[np.float64]


class AlignmentKind(StrEnum):
    """What is fitted before the estimate is compared with the truth."""

    NONE = "none"
    """Nothing: both are in the same frame."""
    ORIGIN = "origin"
    """First pose on first pose; needs a truth with orientation."""
    YAW = "yaw"
    """Translation and rotation about z, least squares: for maps that are level."""
    SE3 = "se3"
    """Translation and rotation, least squares."""
    SIM3 = "sim3"
    """Translation, rotation and scale, least squares."""


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """``truth = scale * rotation @ estimate + translation``."""

    rotation: FloatArray
    translation: FloatArray
    scale: float = 1.0

    def points(self, points: FloatArray) -> FloatArray:
        """Points (N, 3) of the estimate's frame in the truth's."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)

    def trajectory(self, trajectory: Trajectory) -> Trajectory:
        """Trajectory of the estimate's frame in the truth's, covariances scaled along."""
        poses = trajectory.map_T_rover.copy()
        poses[:, :3, :3] = self.rotation @ poses[:, :3, :3]
        poses[:, :3, 3] = self.points(trajectory.positions)
        covariance = trajectory.covariance
        if covariance is not None and self.scale != 1.0:
            unit = np.repeat([1.0, self.scale], 3)
            covariance = covariance * np.outer(unit, unit)
        return Trajectory(trajectory.stamp_s, poses, covariance, trajectory.indexed)


def align(kind: AlignmentKind, pair: Pair) -> Alignment:
    """Find what carries the estimate of a pair onto its truth.

    Raises
    ------
    UndefinedMetricError
        When the pair does not determine it: no orientation for ``origin``, no extent for
        the fitted ones.
    """
    estimate, truth = pair.estimate.positions, pair.truth.positions
    if kind is AlignmentKind.NONE:
        return Alignment(np.eye(3), np.zeros(3))
    if kind is AlignmentKind.ORIGIN:
        first = pair.true_poses[0] @ inverse(pair.estimate.map_T_rover[0])
        return Alignment(first[:3, :3], first[:3, 3])
    if kind is AlignmentKind.YAW:
        return fit_yaw(estimate, truth)
    return fit_similarity(estimate, truth, with_scale=kind is AlignmentKind.SIM3)


def common_frame(pair: Pair, *, same_map: bool) -> AlignmentKind:
    """Choose the alignment that hides no error that was made on the way.

    None for two trajectories of the same map, the first pose where the truth has an
    orientation, a least-squares fit where there is no other way.
    """
    if same_map:
        return AlignmentKind.NONE
    oriented = isinstance(pair.truth, Trajectory)
    return AlignmentKind.ORIGIN if oriented else AlignmentKind.SE3


def fit_yaw(source: FloatArray, target: FloatArray) -> Alignment:
    """Rotation about z and translation from `source` to `target`, (N, 3) both."""
    source_mean, target_mean = _means(source, target)
    a, b = source - source_mean, target - target_mean
    cross = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    dot = float((a[:, :2] * b[:, :2]).sum())
    angle = np.arctan2(cross, dot)
    cos, sin = np.cos(angle), np.sin(angle)
    rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return Alignment(rotation, target_mean - rotation @ source_mean)


def fit_similarity(source: FloatArray, target: FloatArray, *, with_scale: bool) -> Alignment:
    """Least-squares rotation, translation and, if asked, scale (Umeyama 1991).

    On a straight path the rotation about the path is not determined; any of them leaves
    the same residual, and one is returned.

    Raises
    ------
    UndefinedMetricError
        For fewer than two points, or a scale of points that all coincide.
    """
    source_mean, target_mean = _means(source, target)
    a, b = source - source_mean, target - target_mean
    u, singular, vt = np.linalg.svd(b.T @ a / len(a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * sign) @ vt
    scale = 1.0
    if with_scale:
        spread = float((a**2).sum() / len(a))
        scale = float(singular @ sign) / spread if spread > 0.0 else 0.0
        if not scale > 0.0 or not np.isfinite(scale):
            raise UndefinedMetricError("a path without extent has no scale")
    return Alignment(rotation, target_mean - scale * rotation @ source_mean, scale)


def _means(source: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    if len(source) < 2:
        raise UndefinedMetricError("fewer than two poses have truth")
    return source.mean(axis=0), target.mean(axis=0)
