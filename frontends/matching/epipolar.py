"""Epipolar geometry of matched images: two views of a scene with depth (paper, 2.2)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.matching.chance import agreement, line_chance
from frontends.matching.homography import check_points
from frontends.matching.neighbours import among_neighbours
from frontends.measurements import Verdict

FloatArray = NDArray[np.float64]

#: Matches that define a fundamental matrix.
_SAMPLE = 7


@dataclass(frozen=True, slots=True)
class EpipolarGeometry:
    """A fundamental matrix, or the reason why there is none.

    Attributes
    ----------
    matrix
        (3, 3), ``x2^T F x1 = 0`` in homogeneous pixels; zero when refused.
    inlier
        (M,) which matches lie on their epipolar lines, among the same neighbours.
    error_px
        Median distance of the inliers from their epipolar lines, px; NaN when refused.
    verdict, reason
        Refused when chance alone explains the inliers.
    """

    matrix: FloatArray
    inlier: NDArray[np.bool_]
    error_px: float
    verdict: Verdict
    reason: str = ""


def find_fundamental(
    first_xy: FloatArray, second_xy: FloatArray, *, threshold_px: float = 2.0, seed: int = 0
) -> EpipolarGeometry:
    """Fundamental matrix of matched points by MAGSAC++ (OpenCV's USAC).

    A wrong match agrees with an epipolar line far more easily than with a point: many more
    inliers are needed than for a homography, and each must lie among the same neighbours in
    both images.

    Parameters
    ----------
    first_xy, second_xy
        (M, 2) matched pixels.
    threshold_px
        Largest distance of an inlier from its epipolar line, in either image.
    seed
        Of the random sampling; the same seed gives the same result.
    """
    check_points(first_xy, second_xy)
    count = len(first_xy)
    if count <= _SAMPLE:
        return _refused(count, f"{count} matches, epipolar geometry needs {_SAMPLE + 1}")
    params = cv2.UsacParams()
    params.threshold = threshold_px
    params.confidence = 0.9999
    params.maxIterations = 10_000
    params.randomGeneratorState = seed
    params.sampler = cv2.SAMPLING_UNIFORM
    params.score = cv2.SCORE_METHOD_MAGSAC
    params.loMethod = cv2.LOCAL_OPTIM_SIGMA
    found, _ = cv2.findFundamentalMat(
        np.ascontiguousarray(first_xy), np.ascontiguousarray(second_xy), params
    )
    if found is None or found.shape != (3, 3):
        return _refused(count, "no epipolar geometry fits the matches")
    matrix = np.asarray(found, dtype=np.float64)
    error = epipolar_distance(matrix, first_xy, second_xy)
    inlier = error <= threshold_px
    inlier[inlier] = among_neighbours(first_xy[inlier], second_xy[inlier])
    alpha = max(line_chance(xy, threshold_px) for xy in (first_xy, second_xy))
    weighed = agreement(first_xy, second_xy, inlier, _SAMPLE, alpha)
    if weighed.reason:
        return _refused(count, weighed.reason)
    return EpipolarGeometry(matrix, inlier, float(np.median(error[inlier])), Verdict.ACCEPTED)


def epipolar_distance(
    matrix: FloatArray, first_xy: FloatArray, second_xy: FloatArray
) -> FloatArray:
    """Larger of the distances from the two epipolar lines, px, (M,)."""
    ones = np.ones((len(first_xy), 1))
    first, second = np.hstack([first_xy, ones]), np.hstack([second_xy, ones])
    in_second, in_first = first @ matrix.T, second @ matrix
    slope = np.minimum(np.hypot(*in_second[:, :2].T), np.hypot(*in_first[:, :2].T))
    return np.asarray(np.abs(np.sum(second * in_second, axis=1)) / np.maximum(slope, 1e-12))


def _refused(count: int, reason: str) -> EpipolarGeometry:
    nothing = np.zeros(count, dtype=np.bool_)
    return EpipolarGeometry(np.zeros((3, 3)), nothing, float("nan"), Verdict.REFUSED, reason)
