"""Images to measurements: perceive, track, position (paper, 2.1 and 2.2)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.detector import FeatureDetector
from frontends.measurements import RelativePose, StereoFrame, UnusableFrame, Verdict
from frontends.relative import MotionPrediction, RelativePositioning
from frontends.stereo import StereoFeatures, StereoPerception
from frontends.tracking import LandmarkTracker, Tracks
from lunar_fg.config import Config
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.motion import MotionModel, tilt_of
from lunar_fg.plausibility import DeadCamera, Episodes, Plausibility
from lunar_fg.stopwatch import Stopwatch

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class FrameReport:
    """Counts of one frame.

    Attributes
    ----------
    keypoints
        In the left image.
    stereo_matches, refined
        Pairs in the epipolar band; those whose disparity was refined.
    landmarks
        Stereo landmarks within the useful range.
    tracked, inliers
        Landmarks found again; those that agree with the motion.
    wrong_match_rate
        Share of the tracked landmarks that do not.
    """

    keypoints: int = 0
    stereo_matches: int = 0
    refined: int = 0
    landmarks: int = 0
    tracked: int = 0
    inliers: int = 0
    wrong_match_rate: float = float("nan")


class Frontend:
    """Turns frames into keyframes: stereo landmarks, relative pose, odometry, tilt.

    Parameters
    ----------
    camera, rover_T_camera
        The rectified pair and its place in the rover.
    config
        Settings.
    stopwatch
        Where the stages' times go.
    detector
        Feature detector; upright SURF by default.
    """

    def __init__(
        self,
        camera: StereoCamera,
        rover_T_camera: FloatArray,
        config: Config,
        stopwatch: Stopwatch,
        detector: FeatureDetector | None = None,
    ) -> None:
        self.perception = StereoPerception(camera, config.stereo, detector)
        self.positioning = RelativePositioning(camera, config.relative, config.seed)
        self.reports: list[FrameReport] = []
        self.frames_unusable = 0
        self._unusable: dict[str, Episodes] = {}
        self._dead_camera = DeadCamera()
        self._plausibility = Plausibility(rover_T_camera)
        self._tracker = LandmarkTracker(camera, config.tracking)
        self._motion = MotionModel(rover_T_camera, config.motion)
        self._stopwatch = stopwatch

    def measure(self, frame: StereoFrame | UnusableFrame) -> Keyframe:
        """Measure all that one frame gives.

        Raises
        ------
        InputError
            When the images do not fit the camera, or left and right look swapped.
        """
        taken, frame = frame, self._refuse_dead(frame)
        odometry = self._motion.odometry(frame)
        prediction = self._motion.predict(odometry)
        if isinstance(frame, UnusableFrame):
            relative = _unmeasured(prediction, frame.reason)
            observations = None
            self._tracker.skip(relative)
            self.reports.append(FrameReport())
            self.frames_unusable += 1
            self._unusable.setdefault(frame.reason, Episodes(frame.reason)).note(frame.index)
        else:
            with self._stopwatch.stage("stereo"):
                features = self.perception.perceive(frame)
            tracks, relative = self._locate(features, prediction)
            observations = self._tracker.commit(features, tracks, relative)
            self.reports.append(_report(features, relative))
        self._motion.update(frame, relative)
        if isinstance(taken, StereoFrame):
            self._dead_camera.remember(taken)
        first = len(self.reports) == 1
        return Keyframe(
            frame.index,
            frame.stamp_s,
            observations,
            None if first else relative,
            None if first else self._plausibility.odometry(frame.index, odometry, relative),
            self._plausibility.tilt(frame.index, tilt_of(frame), relative),
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """What of the sensors was not used, one sentence each."""
        told = (line for episodes in self._unusable.values() for line in episodes.sentences())
        return (*told, *self._plausibility.warnings)

    def _refuse_dead(self, frame: StereoFrame | UnusableFrame) -> StereoFrame | UnusableFrame:
        if isinstance(frame, UnusableFrame):
            return frame
        self.perception.check_size(frame)
        reason = self._dead_camera.found(frame)
        if not reason:
            return frame
        return UnusableFrame(frame.index, frame.stamp_s, reason, frame.odometry, frame.attitude)

    def adopt(self, disparity_px: FloatArray, newest: Keyframe) -> None:
        """Correct disparities by this field from now on; go on from a corrected keyframe."""
        self.perception.rectification = replace(
            self.perception.rectification, disparity_px=disparity_px
        )
        if newest.observations is None:
            self._tracker.forget()
        else:
            self._tracker.replace_points(newest.observations)

    def _locate(
        self, features: StereoFeatures, prediction: MotionPrediction
    ) -> tuple[Tracks, RelativePose]:
        """Track and position; where the motion was not as predicted, search wider."""
        searches = (False, True) if self._motion.known else (True,)
        for wide in searches:
            with self._stopwatch.stage("tracking"):
                tracks = self._tracker.associate(features, prediction, wide=wide)
            with self._stopwatch.stage("relative pose"):
                relative = self.positioning.estimate(
                    tracks.points_a, tracks.covariance_a, tracks.observations_b, prediction
                )
            if relative.accepted:
                break
        return tracks, relative


def _report(features: StereoFeatures, relative: RelativePose) -> FrameReport:
    return FrameReport(
        features.keypoints[0],
        features.matches,
        features.refined,
        len(features),
        relative.correspondences,
        len(relative.inlier_ids),
        relative.wrong_match_rate,
    )


def _unmeasured(prediction: MotionPrediction, reason: str) -> RelativePose:
    nothing = np.zeros(0, dtype=np.int64)
    return RelativePose(
        prediction.a_T_b, prediction.covariance, nothing, 0, Verdict.REFUSED, reason
    )
