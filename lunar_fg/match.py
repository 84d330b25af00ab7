"""Matches between two images: SURF, nearest neighbours, RANSAC (paper, figure 5)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.detector import Descriptors
from frontends.errors import InputError
from frontends.matching import (
    EpipolarGeometry,
    ImageTransform,
    find_fundamental,
    find_homography,
    find_similarity,
    match_descriptors,
)
from frontends.matching.chance import agreement, line_chance
from frontends.measurements import Image, StereoFrame, Verdict
from frontends.stereo import StereoConfig, StereoPerception
from frontends.surf import SURF, Keypoints, warmup
from lunar_fg.pictures import Picture

FloatArray = NDArray[np.float64]
Features = tuple[Keypoints, Descriptors]

#: Largest transfer or epipolar error of an inlier, px.
THRESHOLD_PX = 2.0
#: Lines drawn at most; more hide the images.
_MAX_LINES = 150
#: Coefficients of the vertical field of a rectified pair.
_FIELD_TERMS = 6
#: Ratio of a normal distribution's median absolute value to its sigma.
_MEDIAN_OF_SIGMA = 0.6745


class MatchModel(StrEnum):
    """What relates the two images."""

    HOMOGRAPHY = "homography"
    SIMILARITY = "similarity"
    STEREO = "stereo"
    FUNDAMENTAL = "fundamental"


_FITS: dict[MatchModel, Callable[..., ImageTransform | EpipolarGeometry]] = {
    MatchModel.HOMOGRAPHY: find_homography,
    MatchModel.SIMILARITY: find_similarity,
    MatchModel.FUNDAMENTAL: find_fundamental,
}


@dataclass(frozen=True, slots=True)
class MatchResult:
    """Matches of two images, or why there are none.

    Attributes
    ----------
    keypoints
        Of the first and the second image.
    matches
        Pairs of nearest descriptors; of a stereo pair those in the epipolar band.
    first_xy, second_xy
        (N, 2) pixels of the matches that agree with the model; empty when refused.
    error_px
        Their median error, px; NaN when refused.
    seconds
        Wall time of detection, matching and the fit.
    reason
        Why the images are refused (chance alone explains the inliers); empty otherwise.
    """

    keypoints: tuple[int, int]
    matches: int
    first_xy: FloatArray
    second_xy: FloatArray
    error_px: float
    seconds: float
    reason: str = ""

    @property
    def verdict(self) -> Verdict:
        """Whether the images match."""
        return Verdict.REFUSED if self.reason else Verdict.ACCEPTED

    @property
    def inliers(self) -> int:
        """Matches that agree with the model."""
        return len(self.first_xy)

    @property
    def rejected_share(self) -> float:
        """Share of the matches that the model rejects."""
        return 1.0 - self.inliers / self.matches if self.matches else 1.0

    def as_dict(self) -> dict[str, object]:
        """Return the figures by name, for JSON."""
        refused = self.verdict is Verdict.REFUSED
        return {
            "keypoints": list(self.keypoints),
            "matches": self.matches,
            "inliers": self.inliers,
            "rejected_share": None if refused else self.rejected_share,
            "error_px": None if refused else self.error_px,
            "seconds": self.seconds,
            "verdict": str(self.verdict),
            "reason": self.reason,
        }


def match_images(
    first: Image, second: Image, model: MatchModel, *, max_keypoints: int = 5000, seed: int = 0
) -> MatchResult:
    """Match two grey images; upright features for a stereo pair, oriented otherwise.

    Parameters
    ----------
    first, second
        (H, W) uint8; left and right of equal size for a stereo pair.
    model
        What relates them.
    max_keypoints
        Strongest keypoints kept in each image.
    seed
        Of RANSAC.

    Raises
    ------
    InputError
        When a stereo pair is not of one size, or left and right look swapped.
    """
    warmup()
    start = time.perf_counter()
    surf = SURF(1.0, upright=model is MatchModel.STEREO, max_keypoints=max_keypoints)
    a, b = surf.detectAndCompute(first), surf.detectAndCompute(second)
    pairs = match_descriptors(a[1], b[1])
    first_xy = a[0].xy[pairs.query].astype(np.float64)
    second_xy = b[0].xy[pairs.train].astype(np.float64)
    matches = len(pairs)
    if model is MatchModel.STEREO:
        matches, first_xy, second_xy, error, reason = _stereo(
            (first, second), (a, b), (first_xy, second_xy)
        )
    else:
        found = _FITS[model](first_xy, second_xy, threshold_px=THRESHOLD_PX, seed=seed)
        first_xy, second_xy = first_xy[found.inlier], second_xy[found.inlier]
        error, reason = found.error_px, found.reason
    seconds = time.perf_counter() - start
    keypoints = (len(a[0]), len(b[0]))
    return MatchResult(keypoints, matches, first_xy, second_xy, error, seconds, reason)


@dataclass(frozen=True, slots=True)
class _Found:
    """A detector that hands out what was found in two images before."""

    images: tuple[Image, Image]
    features: tuple[Features, Features]

    def detectAndCompute(self, image: Image, mask: NDArray[np.uint8] | None = None) -> Features:
        return self.features[0 if image is self.images[0] else 1]


def _stereo(
    images: tuple[Image, Image],
    features: tuple[Features, Features],
    matched: tuple[FloatArray, FloatArray],
) -> tuple[int, FloatArray, FloatArray, float, str]:
    """Matches in the band, those triangulated (left and right), median error, reason.

    Perception measures the vertical field; whether that is more than chance is told by the
    matches found without it, of which the field's rows must hold enough.
    """
    if images[0].shape != images[1].shape:
        sizes = " and ".join(f"{w}x{h}" for h, w in (image.shape for image in images))
        raise InputError(
            f"images are {sizes} px", source="stereo pair", remedy="give a rectified pair"
        )
    height, width = images[0].shape
    # a nominal camera: pixels are all that is asked for, and disparities up to half the width
    camera = StereoCamera(width, height, width, width, (width - 1) / 2, (height - 1) / 2, 1.0)
    config = StereoConfig(max_depth_sigma=1.0)
    perception = StereoPerception(camera, config, _Found(images, features))
    perceived = perception.perceive(StereoFrame(0, 0.0, *images, camera))
    field = perception.rectification
    left, right = matched
    residual = left[:, 1] - right[:, 1] - field.vertical_at(camera, left[:, 0], left[:, 1])
    in_band = np.abs(residual) <= config.band_px
    weighed = agreement(left, right, in_band, _FIELD_TERMS, line_chance(right, config.band_px))
    nothing = np.zeros((0, 2))
    if weighed.reason or not perception.vertical_measured:
        reason = weighed.reason or "too few matches in equal rows"
        return perceived.matches, nothing, nothing, float("nan"), f"not a stereo pair: {reason}"
    seen = perceived.observations
    if len(seen) == 0:
        return perceived.matches, nothing, nothing, float("nan"), "every match is at infinity"
    vertical = field.vertical_at(camera, seen.u_left, seen.v)
    error = _MEDIAN_OF_SIGMA * perceived.epipolar_sigma_px
    if not np.isfinite(error):
        error = float(np.median(np.abs(residual[in_band])))
    return (
        perceived.matches,
        np.column_stack([seen.u_left, seen.v]),
        np.column_stack([seen.u_right, seen.v - vertical]),
        error,
        "",
    )


def draw(pictures: Sequence[Picture], result: MatchResult) -> Picture:
    """Both pictures side by side, a line for each inlier (evenly thinned to 150); BGR.

    The hue goes with the position in the first picture, so that crossing lines show.
    """
    first, second = pictures
    shift = first.shape[1]
    canvas = np.zeros((max(len(first), len(second)), shift + second.shape[1], 3), np.uint8)
    canvas[: len(first), :shift] = first
    canvas[: len(second), shift:] = second
    ends = np.rint(np.hstack([result.first_xy, result.second_xy + np.array([shift, 0])]))
    ends = ends[np.argsort(result.first_xy[:, 1], kind="stable")]
    ends = ends[:: max(1, -(-len(ends) // _MAX_LINES))]
    hues = np.linspace(0, 150, len(ends)).astype(np.uint8)
    hsv = np.stack([hues, np.full_like(hues, 200), np.full_like(hues, 255)], axis=-1)
    colours = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2BGR)[0] if len(ends) else hsv
    for (x, y, u, v), colour in zip(ends.astype(int).tolist(), colours.tolist(), strict=True):
        cv2.line(canvas, (x, y), (u, v), colour, 1, cv2.LINE_AA)
        for end in ((x, y), (u, v)):
            cv2.circle(canvas, end, 4, colour, 1, cv2.LINE_AA)
    return canvas
