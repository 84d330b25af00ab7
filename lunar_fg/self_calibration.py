"""The disparity check in a run: watch the first frames, correct what they already gave."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.disparity_check import DisparityCheck, DisparityCheckConfig, DisparityFinding
from frontends.rectification import RectificationError
from frontends.relative import MotionPrediction, RelativePositioning
from frontends.tracks import common_landmarks
from lunar_fg.graph.keyframe import Keyframe

FloatArray = NDArray[np.float64]


class SelfCalibration:
    """Holds the first keyframes until the disparities are judged.

    Parameters
    ----------
    camera
        The rectified pair.
    config
        Settings of the check.
    max_depth_sigma
        Useful range, see `frontends.stereo.StereoConfig`.
    """

    #: A rover that hardly moves is judged, or not, after so many times the frames asked for.
    _PATIENCE = 10

    def __init__(
        self, camera: StereoCamera, config: DisparityCheckConfig, max_depth_sigma: float
    ) -> None:
        self._camera = camera
        self._config = config
        self._max_depth_sigma = max_depth_sigma
        self._check: DisparityCheck | None = (
            None if config.mode == "off" else DisparityCheck(camera, config, max_depth_sigma)
        )
        self._keyframes: list[Keyframe] = []
        self.finding: DisparityFinding | None = None

    def watch(self, keyframe: Keyframe) -> bool:
        """Take in a keyframe; True when this one completes the check."""
        if self._check is None:
            return False
        self._keyframes.append(keyframe)
        if keyframe.observations is not None:
            self._check.add(keyframe.observations)
        patient = len(self._keyframes) < self._PATIENCE * self._config.frames
        return (self._check.ready or not patient) and self.conclude()

    def conclude(self) -> bool:
        """Judge with the frames there are; True when a correction is to be applied."""
        if self._check is None:
            return False
        self.finding = self._check.finding()
        self._check = None
        apply = (
            self._config.mode == "apply" and self.finding is not None and self.finding.significant
        )
        if not apply:
            self._keyframes = []
        return apply

    def corrected(
        self, disparity_px: FloatArray, positioning: RelativePositioning
    ) -> list[Keyframe]:
        """Return the keyframes so far with corrected disparities and motions measured anew."""
        rectification = RectificationError(disparity_px=disparity_px)
        result: list[Keyframe] = []
        for keyframe in self._keyframes:
            observations = keyframe.observations
            relative = keyframe.relative
            if observations is not None:
                observations = rectification.correct(
                    self._camera, observations, self._max_depth_sigma
                )
                before = result[-1].observations if result else None
                if before is not None and relative is not None and relative.accepted:
                    a, b = common_landmarks(before, observations)
                    prediction = MotionPrediction(relative.a_T_b, relative.covariance)
                    relative = positioning.refine(a.points_cam, a.points_covariance, b, prediction)
            result.append(replace(keyframe, observations=observations, relative=relative))
        return result

    @property
    def watching(self) -> bool:
        """Whether frames are still collected."""
        return self._check is not None

    def concluded(self, finding: DisparityFinding | None) -> None:
        """Go on as after an earlier conclusion."""
        self._check, self._keyframes, self.finding = None, [], finding

    def forget(self) -> None:
        """Let go of the keyframes, once the corrected ones are in use."""
        self._keyframes = []
