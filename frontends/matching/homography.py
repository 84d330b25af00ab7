"""Robust 2-D transforms between matched images: homography (paper, eq. 13), similarity."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.errors import InputError
from frontends.matching.chance import agreement, point_chance
from frontends.measurements import Verdict

FloatArray = NDArray[np.float64]

#: SURF does not match over larger changes of scale or stretch than 1 to 20.
_LEAST_SCALE = 0.05


@dataclass(frozen=True, slots=True)
class ImageTransform:
    """A 2-D transform from the first image to the second, or the reason why there is none.

    Attributes
    ----------
    matrix
        (3, 3), homogeneous pixel coordinates; the identity when refused.
    inlier
        (M,) which matches agree.
    error_px
        Median transfer error of the inliers, px; NaN when refused.
    verdict, reason
        Refused when chance alone explains the inliers.
    """

    matrix: FloatArray
    inlier: NDArray[np.bool_]
    error_px: float
    verdict: Verdict
    reason: str = ""

    @property
    def wrong_match_rate(self) -> float:
        """Share of the given matches that the transform rejects."""
        return float(1.0 - self.inlier.mean()) if len(self.inlier) else 1.0


def find_homography(
    first_xy: FloatArray, second_xy: FloatArray, *, threshold_px: float = 2.0, seed: int = 0
) -> ImageTransform:
    """Homography of matched points by MAGSAC++ (OpenCV's USAC).

    Parameters
    ----------
    first_xy, second_xy
        (M, 2) matched pixels.
    threshold_px
        Largest transfer error of an inlier.
    seed
        Of the random sampling; the same seed gives the same result.

    Returns
    -------
    ImageTransform
        Refused unless the inliers are more than chance would give.
    """
    check_points(first_xy, second_xy)
    if len(first_xy) < 4:
        return _refused(len(first_xy), f"{len(first_xy)} matches, a homography needs 4")
    params = cv2.UsacParams()
    params.threshold = threshold_px
    params.confidence = 0.9999
    params.maxIterations = 10_000
    params.randomGeneratorState = seed
    params.sampler = cv2.SAMPLING_UNIFORM
    params.score = cv2.SCORE_METHOD_MAGSAC
    params.loMethod = cv2.LOCAL_OPTIM_SIGMA
    matrix, _ = cv2.findHomography(
        np.ascontiguousarray(first_xy), np.ascontiguousarray(second_xy), params
    )
    if matrix is None:
        return _refused(len(first_xy), "no homography fits the matches")
    return _judge(np.asarray(matrix, dtype=np.float64), first_xy, second_xy, threshold_px, 4)


def find_similarity(
    first_xy: FloatArray, second_xy: FloatArray, *, threshold_px: float = 2.0, seed: int = 0
) -> ImageTransform:
    """Rotation, translation and scale of matched points (paper, eq. 7, with scale).

    Parameters and result as `find_homography`.
    """
    check_points(first_xy, second_xy)
    if len(first_xy) < 2:
        return _refused(len(first_xy), f"{len(first_xy)} matches, a similarity needs 2")
    cv2.setRNGSeed(seed)
    matrix, _ = cv2.estimateAffinePartial2D(
        np.ascontiguousarray(first_xy),
        np.ascontiguousarray(second_xy),
        method=cv2.RANSAC,
        ransacReprojThreshold=threshold_px,
        maxIters=10_000,
        confidence=0.9999,
    )
    if matrix is None:
        return _refused(len(first_xy), "no similarity fits the matches")
    return _judge(
        np.vstack([np.asarray(matrix, dtype=np.float64), [0.0, 0.0, 1.0]]),
        first_xy,
        second_xy,
        threshold_px,
        2,
    )


def check_points(first_xy: FloatArray, second_xy: FloatArray) -> None:
    """Refuse matched points that are not two finite (M, 2) arrays, with an `InputError`."""
    if first_xy.shape != second_xy.shape or first_xy.ndim != 2 or first_xy.shape[1] != 2:
        raise InputError(
            f"matched points have shapes {first_xy.shape} and {second_xy.shape}, "
            "both must be (M, 2)",
            source="image transform",
        )
    if not (np.isfinite(first_xy).all() and np.isfinite(second_xy).all()):
        raise InputError("matched points hold NaN or infinity", source="image transform")


def _refused(count: int, reason: str) -> ImageTransform:
    return ImageTransform(
        np.eye(3), np.zeros(count, dtype=np.bool_), float("nan"), Verdict.REFUSED, reason
    )


def _judge(
    matrix: FloatArray,
    first_xy: FloatArray,
    second_xy: FloatArray,
    threshold_px: float,
    minimal: int,
) -> ImageTransform:
    """Count the inliers and refuse what unrelated images could also reach."""
    homogeneous = np.column_stack([first_xy, np.ones(len(first_xy))]) @ matrix.T
    safe = np.abs(homogeneous[:, 2]) > 1e-12
    mapped = homogeneous[:, :2] / np.where(safe, homogeneous[:, 2], 1.0)[:, None]
    error = np.where(safe, np.hypot(*(mapped - second_xy).T), np.inf)
    inlier = error <= threshold_px
    chance = point_chance(second_xy, threshold_px)
    weighed = agreement(first_xy, second_xy, inlier, minimal, chance)
    if weighed.reason:
        return _refused(len(first_xy), weighed.reason)
    if _collapses(first_xy[inlier], matrix):
        return _refused(len(first_xy), "the transform that fits collapses the image")
    return ImageTransform(matrix, inlier, float(np.median(error[inlier])), Verdict.ACCEPTED)


def _collapses(first_xy: FloatArray, matrix: FloatArray) -> bool:
    """Whether the transform shrinks or flattens the neighbourhood of its inliers to nothing."""
    if len(first_xy) == 0:
        return True
    x, y = np.median(first_xy, axis=0)
    w = matrix[2] @ [x, y, 1.0]
    if abs(w) < 1e-12:
        return True
    mapped = matrix[:2] @ [x, y, 1.0] / w
    jacobian = (matrix[:2, :2] - np.outer(mapped, matrix[2, :2])) / w
    largest, smallest = np.linalg.svd(jacobian, compute_uv=False)
    return bool(smallest < _LEAST_SCALE or smallest < _LEAST_SCALE * largest)
