"""The disparity check in a run: watch the first frames, correct what they already gave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.disparity_check import DisparityCheck, DisparityCheckConfig, DisparityFinding
from frontends.rectification import DISPARITY_TERMS, RectificationError
from frontends.relative import MotionPrediction, RelativePositioning
from frontends.tracks import common_landmarks
from lunar_fg.graph.keyframe import Keyframe

FloatArray = NDArray[np.float64]


class SelfCalibration:
    """Holds the first keyframes until the disparities are judged.

    Where a large error is found, there is a second look: until then the tracks were chosen by
    motions that had the error in them, which hides a part of it (a sixth of 1 px). After the
    first correction tracks are right, and the second one takes what was left.

    Parameters
    ----------
    camera
        The rectified pair.
    config
        Settings of the check.
    max_depth_sigma
        Useful range, see `frontends.stereo.StereoConfig`.
    """

    #: Share of an error that tracks hide which were chosen with it in (rendered drives: .1 to .3).
    _HIDDEN = 0.2
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
        self.watched_from = 0
        self.finding: DisparityFinding | None = None
        self.correction_px: FloatArray = np.zeros(DISPARITY_TERMS)

    def watch(self, keyframe: Keyframe) -> bool:
        """Take in a keyframe; True when a correction is to be applied with this one."""
        if self._check is None:
            return False
        self._keyframes.append(keyframe)
        if keyframe.observations is not None:
            self._check.add(keyframe.observations)
        watched = len(self._keyframes) - self.watched_from
        patient = watched < self._PATIENCE * self._config.frames
        return (self._check.ready or not patient) and self._judge()

    def conclude(self) -> bool:
        """Judge with the frames there are; True when a correction is to be applied."""
        return self._check is not None and self._judge()

    def _judge(self) -> bool:
        """End this look; True when its finding is to be applied."""
        assert self._check is not None
        found, before = self._check.finding(), self.finding
        self._check = None
        if before is None:
            self.finding = found
            apply = self._config.mode == "apply" and found is not None and found.significant
        else:  # that there is an error is known: what was left of it need not be significant
            apply = found is not None
            self.finding = before if found is None else before.refined(found)
        if apply and found is not None:
            self.correction_px = found.field_px
        else:
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

    def adopted(self, keyframes: Sequence[Keyframe]) -> None:
        """Go on from keyframes that are corrected: look again, or let go of them."""
        self._keyframes = []
        if self.finding is not None and self.watched_from == 0:
            # of the constant, which makes the scale
            hidden_px = self._HIDDEN * np.abs(self.finding.border_px)
            if hidden_px[0] > self._config.floor_px:
                self._keyframes = list(keyframes)
                self.watched_from = len(keyframes)
                self._check = self._second_look(hidden_px)

    def _second_look(self, hidden_px: FloatArray) -> DisparityCheck:
        expected = self._config.floor_px + hidden_px
        return DisparityCheck(self._camera, self._config, self._max_depth_sigma, expected)

    def concluded(self, finding: DisparityFinding | None) -> None:
        """Go on as after an earlier conclusion."""
        self._check, self._keyframes, self.finding = None, [], finding

    def resume(
        self, finding: DisparityFinding | None, watched_from: int, keyframes: Sequence[Keyframe]
    ) -> bool:
        """Go on as after these keyframes, watched from that one on; True as for `watch`."""
        self.finding = finding
        if finding is not None:
            self.adopted(keyframes[:watched_from])
        return bool([k for k in keyframes[watched_from:] if self.watch(k)])
