"""Matches between two images: SURF, nearest neighbours, RANSAC (paper, figure 5)."""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom

from frontends.errors import InputError
from frontends.matching import find_homography, find_similarity, match_descriptors
from frontends.measurements import Image, Verdict
from frontends.surf import SURF, warmup

FloatArray = NDArray[np.float64]

#: Largest transfer or epipolar error of an inlier, px.
THRESHOLD_PX = 2.0
#: Lines drawn at most; more hide the images.
_MAX_LINES = 150
#: Free parameters of a fundamental matrix: as many matches fit it whatever they are.
_EPIPOLAR_SAMPLE = 8


class MatchModel(StrEnum):
    """What relates the two images."""

    HOMOGRAPHY = "homography"
    SIMILARITY = "similarity"
    STEREO = "stereo"


@dataclass(frozen=True, slots=True)
class MatchResult:
    """Matches of two images, or why there are none.

    Attributes
    ----------
    keypoints
        Of the first and the second image.
    first_xy, second_xy
        (M, 2) matched pixels.
    inlier
        (M,) which agree with the model.
    error_px
        Median error of the inliers, px; NaN when refused.
    seconds
        Wall time of detection, matching and RANSAC.
    verdict, reason
        Refused when chance alone explains the inliers.
    """

    keypoints: tuple[int, int]
    first_xy: FloatArray
    second_xy: FloatArray
    inlier: NDArray[np.bool_]
    error_px: float
    seconds: float
    verdict: Verdict
    reason: str

    def as_dict(self) -> dict[str, object]:
        """Return the figures by name, for JSON."""
        refused = self.verdict is Verdict.REFUSED
        return {
            "keypoints": list(self.keypoints),
            "matches": len(self.inlier),
            "inliers": int(self.inlier.sum()),
            "rejected_share": None if refused else float(1.0 - self.inlier.mean()),
            "error_px": None if refused else self.error_px,
            "seconds": self.seconds,
            "verdict": str(self.verdict),
            "reason": self.reason,
        }


def match_images(
    first: Image, second: Image, model: MatchModel, *, max_keypoints: int = 5000, seed: int = 0
) -> MatchResult:
    """Match two grey images; upright features for a stereo pair, oriented otherwise."""
    warmup()
    start = time.perf_counter()
    surf = SURF(20.0, upright=model is MatchModel.STEREO, max_keypoints=max_keypoints)
    a, a_descriptors = surf.detectAndCompute(first)
    b, b_descriptors = surf.detectAndCompute(second)
    pairs = match_descriptors(a_descriptors, b_descriptors)
    first_xy = a.xy[pairs.query].astype(np.float64)
    second_xy = b.xy[pairs.train].astype(np.float64)
    if model is MatchModel.STEREO:
        inlier, error, reason = _epipolar(first_xy, second_xy, second.shape[0], seed)
    else:
        find = find_homography if model is MatchModel.HOMOGRAPHY else find_similarity
        found = find(first_xy, second_xy, threshold_px=THRESHOLD_PX, seed=seed)
        inlier, error, reason = found.inlier, found.error_px, found.reason
    return MatchResult(
        (len(a), len(b)),
        first_xy,
        second_xy,
        inlier,
        error,
        time.perf_counter() - start,
        Verdict.REFUSED if reason else Verdict.ACCEPTED,
        reason,
    )


def draw(first: Image, second: Image, result: MatchResult) -> NDArray[np.uint8]:
    """Both images side by side, a line for each inlier (evenly thinned to 150); BGR."""
    height = max(first.shape[0], second.shape[0])
    shift = first.shape[1]
    canvas = np.zeros((height, shift + second.shape[1], 3), np.uint8)
    canvas[: first.shape[0], :shift] = first[..., None]
    canvas[: second.shape[0], shift:] = second[..., None]
    ends = np.rint(
        np.hstack([result.first_xy, result.second_xy + np.array([shift, 0])])[result.inlier]
    )
    ends = ends[:: max(1, -(-len(ends) // _MAX_LINES))]
    for k, (x, y, u, v) in enumerate(ends.astype(int).tolist()):
        colour = ((80, 220, 80), (80, 200, 255), (255, 180, 60))[k % 3]
        cv2.line(canvas, (x, y), (u, v), colour, 1, cv2.LINE_AA)
    return canvas


def write_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write a picture; the suffix names the format."""
    try:
        written = cv2.imwrite(str(path), picture)
    except cv2.error:
        written = False
    if not written:
        raise InputError(
            "cannot be written", source=path, remedy="name an existing folder and a .png file"
        )


def _epipolar(
    first_xy: FloatArray, second_xy: FloatArray, height: int, seed: int
) -> tuple[NDArray[np.bool_], float, str]:
    """Inliers of a fundamental matrix, their median error, why it is refused.

    A wrong match falls into the band of its epipolar line with probability
    ``2 t / height``; besides the sample, more inliers are asked for than the binomial
    distribution allows at 1e-10, since RANSAC picks the best of 10^4 trials.
    """
    count = len(first_xy)
    nothing = np.zeros(count, dtype=np.bool_)
    if count < _EPIPOLAR_SAMPLE:
        return nothing, float("nan"), f"{count} matches, epipolar geometry needs 8"
    cv2.setRNGSeed(seed)
    matrix, _ = cv2.findFundamentalMat(
        first_xy, second_xy, cv2.USAC_MAGSAC, THRESHOLD_PX, 0.9999, 10_000
    )
    if matrix is None or matrix.shape != (3, 3):
        return nothing, float("nan"), "no epipolar geometry fits the matches"
    a, b = (np.column_stack([xy, np.ones(count)]) for xy in (first_xy, second_xy))
    lines, back = a @ matrix.T, b @ matrix
    algebraic = np.abs(np.sum(b * lines, axis=1))
    slope = np.minimum(np.hypot(*lines[:, :2].T), np.hypot(*back[:, :2].T))
    error = algebraic / np.maximum(slope, 1e-12)
    inlier = error <= THRESHOLD_PX
    chance = min(1.0, 2.0 * THRESHOLD_PX / height)
    needed = 2 * _EPIPOLAR_SAMPLE + int(binom.isf(1e-10, count, chance)) + 1
    if inlier.sum() < needed:
        reason = f"{inlier.sum()} inliers of {count} matches, {needed} are needed"
        return nothing, float("nan"), reason
    return inlier, float(np.median(error[inlier])), ""
