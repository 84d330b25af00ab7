"""Stereo perception (paper, 2.1): SURF matches of a rectified pair become 3-D points."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.detector import DescribedPair, FeatureDetector
from frontends.disparity import RefinedDisparities, refine_disparities
from frontends.errors import InputError
from frontends.matching import Matches, SearchWindows, match_in_windows
from frontends.measurements import StereoFrame
from frontends.rectification import RectificationError, observe, within_range
from frontends.smoothing import SHARED_NOISE, smoothed
from frontends.stereo_features import StereoFeatures
from frontends.surf import SURF, Keypoints
from frontends.templates import Templates
from frontends.vertical_field import ENOUGH_PAIRS, fit_vertical, measure_vertical

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class StereoConfig:
    """Settings of stereo perception.

    Attributes
    ----------
    hessian_threshold
        SURF detector threshold, OpenCV's unit; it goes with the square of the contrast. Low, so
        that dim images give landmarks, too: in others `max_keypoints` bounds them.
    max_keypoints
        Strongest keypoints kept in each image.
    band_px
        Half height of the epipolar band after the vertical field is removed.
    near_baselines
        Nearest depth searched, in baselines.
    max_depth_sigma
        Useful range: largest 1-sigma of the depth, as a share of the depth.
    border_px
        Landmarks nearer to the image border are dropped.
    localisation_sigma
        1-sigma of a SURF keypoint per axis from one frame to the next at equal distance,
        in px per unit of its scale (size 9 is scale 1.2).
    stereo_localisation_sigma
        The same between the left and the right image.
    threads
        1 looks at the images one after the other, for the least CPU time; 2 at both at once, for
        the earliest result.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "allow_inf_nan": False}

    hessian_threshold: Annotated[float, Ge(0)] = 1.0
    max_keypoints: Annotated[int, Ge(1)] = 1100
    band_px: Annotated[float, Gt(0)] = 1.5
    near_baselines: Annotated[float, Gt(0)] = 2.0
    max_depth_sigma: Annotated[float, Gt(0), Le(1)] = 0.25
    border_px: Annotated[float, Ge(0)] = 8.0
    localisation_sigma: Annotated[float, Gt(0)] = 0.06
    stereo_localisation_sigma: Annotated[float, Gt(0)] = 0.135
    threads: Annotated[int, Ge(1), Le(2)] = 1


class _Look(NamedTuple):
    """What was seen in a pair of images, and how much noise neighbouring pixels share."""

    frame: StereoFrame
    described: DescribedPair
    pairs: Matches
    found: RefinedDisparities
    noise: float = 1.0


class StereoPerception:
    """Finds stereo landmarks in rectified pairs.

    The vertical offset between the images is measured on the first pair that has enough
    matches, and removed from then on.

    Parameters
    ----------
    camera
        The rectified pair.
    config
        Settings.
    detector
        Feature detector; upright SURF by default.
    """

    _BEYOND_INFINITY_PX = -3.0
    #: Of the pairs of an aligned rig the images confirm far more, of chance pairs far fewer.
    _LEAST_CONFIRMED = 0.4
    #: A vertical offset of all pairs below this is left to the band.
    _NOTEWORTHY_SHIFT_PX = 0.25

    def __init__(
        self,
        camera: StereoCamera,
        config: StereoConfig | None = None,
        detector: FeatureDetector | None = None,
    ) -> None:
        self.camera = camera
        self.config = config or StereoConfig()
        self.rectification = RectificationError()
        self.vertical_measured = False
        self._detector = detector or SURF(
            hessian_threshold=self.config.hessian_threshold,
            upright=True,
            max_keypoints=self.config.max_keypoints,
        )

    def perceive(self, frame: StereoFrame) -> StereoFeatures:
        """Stereo landmarks of one rectified pair.

        Pairs that the refinement does not confirm are kept at the keypoints' precision, but
        those that the images contradict are dropped: most of them are wrong matches.

        Raises
        ------
        InputError
            When the images do not fit the camera, or left and right look swapped.
        """
        self.check_size(frame)
        seen = self._look(frame)
        if self._poor(seen.found):
            seen = self._look_again(seen)
        frame, described, pairs, found, noise = seen
        left, right = described.left, described.right
        self._follow(found)
        left_uv = left.xy[pairs.query].astype(np.float64)
        scale = _scale(left, pairs.query)
        sigma = self.config.localisation_sigma * scale
        disparity, sigma_disparity, refined, epipolar_sigma = self._precision(
            left_uv[:, 0] - right.xy[pairs.train, 0].astype(np.float64),
            self.config.stereo_localisation_sigma * scale,
            found,
        )
        u, v = left_uv[:, 0], left_uv[:, 1]
        disparity = disparity - self.rectification.disparity_at(self.camera, u, v)
        keep = within_range(disparity, sigma_disparity, self.config.max_depth_sigma)
        keep &= self.camera.contains(u, v, self.config.border_px) & ~found.contradicted
        chosen = pairs.query[keep]
        observations = observe(
            self.camera,
            np.full(len(chosen), -1, dtype=np.int64),
            u[keep],
            v[keep],
            disparity[keep],
            sigma[keep],
            sigma_disparity[keep],
        )
        return StereoFeatures(
            observations,
            described.left_descriptors[chosen],
            left.laplacian[chosen],
            left.size[chosen].astype(np.float64),
            (len(left), len(right)),
            len(pairs),
            refined,
            epipolar_sigma,
            found.slope[keep],
            Templates.cut(frame.left, left_uv[keep]),
            frame.left,
            noise,
        )

    def check_size(self, frame: StereoFrame) -> None:
        """Raise `InputError` unless both images fit the camera."""
        expected = (self.camera.height, self.camera.width)
        for name, image in (("left", frame.left), ("right", frame.right)):
            if image.shape != expected or image.dtype != np.uint8:
                raise InputError(
                    f"image is {image.shape} {image.dtype}, the camera needs {expected} uint8",
                    source=f"frame {frame.index}",
                    field=name,
                    remedy="check the calibration's width and height",
                )

    def _look(self, frame: StereoFrame) -> _Look:
        described = self._describe(frame)
        if not self.vertical_measured:
            self._measure_vertical(frame, described)
        return _Look(frame, described, *self._match_and_refine(frame, described))

    def _look_again(self, seen: _Look) -> _Look:
        """Smooth the images, measure their rows anew: what shows more pairs that they confirm.

        Smoothing is no rule: where there is no noise it costs precision.
        """
        calm = self._look(smoothed(seen.frame))
        sigma_px = SHARED_NOISE * calm.found.sigma_px
        calm = calm._replace(found=replace(calm.found, sigma_px=sigma_px), noise=SHARED_NOISE)
        if not self._poor(calm.found):
            return calm
        if self._misaligned(seen.found):
            self._measure_vertical(seen.frame, seen.described)
            pairs, found = self._match_and_refine(seen.frame, seen.described)
            seen = seen._replace(pairs=pairs, found=found)
        best = max((seen, calm), key=lambda look: int(look.found.confirmed.sum()))
        if not self._misaligned(best.found):
            return best
        # chance pairs have any depth: only those that the images confirm are kept
        good = best.found.confirmed
        return best._replace(pairs=best.pairs.select(good), found=best.found.select(good))

    def _describe(self, frame: StereoFrame) -> DescribedPair:
        describe = self._detector.detectAndCompute
        if self.config.threads == 1:
            return DescribedPair(*describe(frame.left), *describe(frame.right))
        with ThreadPoolExecutor(max_workers=1) as thread:
            right = thread.submit(describe, frame.right)
            return DescribedPair(*describe(frame.left), *right.result())

    def _measure_vertical(self, frame: StereoFrame, described: DescribedPair) -> None:
        """Fit the vertical field to matches made without it, then to refined pairs."""
        measured = measure_vertical(self.camera, described, f"frame {frame.index}")
        if measured is None:
            return
        self.rectification = replace(self.rectification, vertical_px=measured)
        self.vertical_measured = True
        pairs, found = self._match_and_refine(frame, described)
        good = found.confirmed
        if good.sum() < ENOUGH_PAIRS:
            return
        uv = described.left.xy[pairs.query][good].astype(np.float64)
        correction = fit_vertical(self.camera, uv, found.vertical_px[good])
        self.rectification = replace(self.rectification, vertical_px=measured + correction)

    def _follow(self, found: RefinedDisparities) -> None:
        """Move the vertical field, from the next frame on, with a rig that bends slowly."""
        if found.confirmed.sum() < ENOUGH_PAIRS:
            return
        shift = float(np.median(found.vertical_px[found.confirmed]))
        if abs(shift) > self._NOTEWORTHY_SHIFT_PX:
            moved = self.rectification.vertical_px.copy()
            moved[0] += shift
            self.rectification = replace(self.rectification, vertical_px=moved)

    def _match_and_refine(
        self, frame: StereoFrame, described: DescribedPair
    ) -> tuple[Matches, RefinedDisparities]:
        """Match along the epipolar lines: equal v, disparity from infinity to the nearest depth.

        The search begins a little beyond infinity: noise puts half of the far points there.
        """
        left, right = described.left, described.right
        uv = left.xy.astype(np.float64)
        vertical = self.rectification.vertical_at(self.camera, uv[:, 0], uv[:, 1])
        least = self._BEYOND_INFINITY_PX
        widest = self.camera.fx / self.config.near_baselines - least
        pairs = match_in_windows(
            described.left_descriptors,
            left.laplacian,
            SearchWindows(
                uv[:, 0] - least - 0.5 * widest,
                uv[:, 1] - vertical,
                0.5 * widest,
                self.config.band_px,
            ),
            described.right_descriptors,
            right.laplacian,
            right.xy.astype(np.float64),
        )
        sigma = np.sqrt(2.0) * self.config.stereo_localisation_sigma * _scale(left, pairs.query)
        return pairs, refine_disparities(
            frame.left,
            frame.right,
            uv[pairs.query],
            uv[pairs.query, 0] - right.xy[pairs.train, 0],
            vertical[pairs.query],
            4.0 * np.maximum(sigma, 0.25),
        )

    def _poor(self, found: RefinedDisparities) -> bool:
        """Whether there is so little that noise may hide the rest."""
        return len(found.confirmed) < ENOUGH_PAIRS or self._misaligned(found)

    def _misaligned(self, found: RefinedDisparities) -> bool:
        """Whether the images confirm so few of the pairs that their rows cannot be the same.

        A rig that was bent since the vertical field was measured shows so, and so does noise: the
        pairs are then chance ones, with any depth.
        """
        enough = len(found.confirmed) >= ENOUGH_PAIRS
        return enough and float(found.confirmed.mean()) < self._LEAST_CONFIRMED

    def _precision(
        self, disparity: FloatArray, sigma: FloatArray, found: RefinedDisparities
    ) -> tuple[FloatArray, FloatArray, int, float]:
        """Disparities refined on the images, with the precision that was achieved.

        The vertical residual of the refined pairs is pure error; what it has beyond the
        patches' own noise is the rig's, and may be in the disparities too. Pairs that the
        refinement does not confirm keep the keypoints' disparity and its larger sigma.
        """
        sigma_disparity = np.sqrt(2.0) * sigma
        good = found.confirmed
        if good.sum() < ENOUGH_PAIRS:
            return disparity, sigma_disparity, 0, float("nan")
        epipolar = 1.4826 * float(np.median(np.abs(found.vertical_px[good])))
        rig2 = max(epipolar**2 - float(np.median(found.sigma_px[good] ** 2)), 0.0)
        disparity[good] = found.disparity_px[good]
        sigma_disparity[good] = np.sqrt(found.sigma_px[good] ** 2 + rig2)
        return disparity, sigma_disparity, int(good.sum()), epipolar


def _scale(keypoints: Keypoints, rows: NDArray[np.int64]) -> FloatArray:
    """SURF's scale of some keypoints: its smallest filter, size 9, is scale 1.2."""
    return keypoints.size[rows].astype(np.float64) * (1.2 / 9.0)
