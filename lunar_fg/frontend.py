"""Images to measurements: perceive, track, position (paper, 2.1 and 2.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.detector import FeatureDetector
from frontends.measurements import RelativePose, StartPrior, StereoFrame, UnusableFrame, Verdict
from frontends.own_parts import without_own_parts
from frontends.relative import MotionPrediction, RelativePositioning
from frontends.stereo import StereoPerception
from frontends.stereo_features import StereoFeatures
from frontends.tracking import LandmarkTracker, Reach, in_view
from frontends.tracks import Tracks
from lunar_fg.checkpoint import Checkpoint
from lunar_fg.config import Config
from lunar_fg.dead_reckoning import DeadReckoning
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.motion import MotionModel, tilt_of
from lunar_fg.plausibility import (
    DeadCamera,
    Episodes,
    Plausibility,
    Refound,
    Richness,
    other_ground,
    was_carried,
)
from lunar_fg.record import FrameRecord, FrameReport, Sensors
from lunar_fg.standstill import zero_motion
from lunar_fg.stereo_alignment import StereoAlignment
from lunar_fg.stopwatch import Stopwatch

FloatArray = NDArray[np.float64]

#: With more of the tracks in disagreement, the motion is looked for in a wider search, too.
_MOST_WRONG = 0.5


class Frontend:
    """Turns frames into keyframes: stereo landmarks, relative pose, odometry, tilt.

    Parameters
    ----------
    camera, rover_T_camera
        The rectified pair and its place in the rover.
    start
        Where the rover starts, for its dead reckoning.
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
        start: StartPrior,
        config: Config,
        stopwatch: Stopwatch,
        detector: FeatureDetector | None = None,
    ) -> None:
        self.perception = StereoPerception(camera, config.stereo, detector)
        self.positioning = RelativePositioning(
            camera, config.relative, config.seed, config.graph.landmark_correlation
        )
        self.records: list[FrameRecord] = []
        #: What describes the newest keyframe's landmarks, in their order.
        self.features: StereoFeatures | None = None
        self._tracker = LandmarkTracker(camera, config.tracking)
        self._unusable: dict[str, Episodes] = {}
        self._dead_camera = DeadCamera()
        self._alignment = StereoAlignment()
        self._richness = Richness()
        self._rover_T_camera = rover_T_camera
        self._start = start
        self._config = config
        #: Of the last motion; None where it was not seen.
        self._refound: Refound | None = None
        self._relive(())
        self._stopwatch = stopwatch

    def measure(self, frame: StereoFrame | UnusableFrame) -> Keyframe:
        """Measure all that one frame gives.

        Raises
        ------
        InputError
            When the images do not fit the camera, or left and right look swapped.
        """
        taken, frame = frame, self._refuse_dead(frame)
        self.features = None
        odometry = self._motion.odometry(frame)
        prediction = self._motion.predict(frame)
        if isinstance(frame, UnusableFrame):
            relative = _unmeasured(prediction, frame.reason)
            observations, carried = None, False
            self._refound = None
            self._tracker.skip(relative)
            report, unusable = FrameReport(), frame.reason
            self._note_unusable(frame.index, frame.reason)
        else:
            with self._stopwatch.stage("stereo"):
                features = self.perception.perceive(frame)
            if self.perception.vertical_measured:
                offset_px = float(self.perception.rectification.vertical_px[0])
                self._alignment.see(frame.index, offset_px)
            possible = min(self._tracker.in_view(prediction), len(features))
            tracks, relative = self._locate(features, prediction)
            now = Refound(possible, relative.agreeing)
            carried = not relative.accepted and other_ground(self._refound, now)
            self._refound = now if relative.accepted else None
            self._richness.see(frame.index, self._refound)
            tracks, relative = self._follow(features, tracks, relative)
            standing = zero_motion(relative)
            if standing is None:
                with self._stopwatch.stage("tracking"):
                    observations = self._tracker.commit(features, tracks, relative)
                self.features = features.named(observations.landmark_id)
            else:
                observations, relative = None, standing
            report, unusable = _report(features, relative), ""
        sensors = Sensors.of(frame)
        by_wheels = self._dead_reckoning.step(sensors)
        self.records.append(FrameRecord(sensors, report, unusable, by_wheels))
        self._motion.update(sensors, relative)
        if isinstance(taken, StereoFrame):
            self._dead_camera.remember()
        tilt = self._plausibility.tilt(frame.index, tilt_of(frame), relative)
        if len(self.records) == 1:
            return Keyframe(frame.index, frame.stamp_s, observations, tilt=tilt)
        odometry = self._plausibility.odometry(frame.index, odometry, relative, carried=carried)
        if observations is None and relative.accepted:  # standing still: nothing new
            odometry = tilt = None
        return Keyframe(frame.index, frame.stamp_s, observations, relative, odometry, tilt)

    @property
    def frames_unusable(self) -> int:
        """How many frames had images that could not be used."""
        return sum(bool(record.unusable) for record in self.records)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What of the sensors was not used, one sentence each."""
        told = (line for episodes in self._unusable.values() for line in episodes.sentences())
        failure = self._dead_reckoning.failure
        given_up = (f"dead reckoning was given up {failure}",) if failure else ()
        of_images = (*self._alignment.warnings, *self._richness.warnings)
        return (*told, *of_images, *self._plausibility.warnings, *given_up)

    def _refuse_dead(self, frame: StereoFrame | UnusableFrame) -> StereoFrame | UnusableFrame:
        if isinstance(frame, UnusableFrame):
            return frame
        self.perception.check_size(frame)
        reason = self._dead_camera.found(frame)
        if not reason:
            return frame
        return UnusableFrame(frame.index, frame.stamp_s, reason, frame.odometry, frame.attitude)

    def adopt(self, disparity_px: FloatArray, keyframes: Sequence[Keyframe]) -> None:
        """Correct disparities by this field, too, from now on; go on from corrected keyframes."""
        known = self.perception.rectification
        self.perception.rectification = replace(
            known, disparity_px=known.disparity_px + disparity_px
        )
        newest = keyframes[-1].observations
        if newest is None:
            self._tracker.forget()
        else:
            self._tracker.replace_points(newest)
        self._relive(list(zip(keyframes, self.records, strict=True)))

    def checkpoint(self) -> Checkpoint:
        """What cannot be computed anew from the measurements of the frames so far."""
        perception = self.perception
        return Checkpoint(
            *self._tracker.state,
            perception.rectification,
            perception.vertical_measured,
            self._dead_camera.seen,
            alignment=self._alignment.state,
        )

    def restore(
        self, checkpoint: Checkpoint, frames: Sequence[tuple[Keyframe, FrameRecord]]
    ) -> None:
        """Go on as after these frames, which ended with this checkpoint."""
        self._tracker.restore(checkpoint.memory, checkpoint.next_id)
        self.perception.rectification = checkpoint.rectification
        self.perception.vertical_measured = checkpoint.vertical_measured
        self._dead_camera.seen = checkpoint.images
        self._alignment.restore(checkpoint.alignment)
        self.records = [record for _, record in frames]
        for keyframe, record in frames:
            if record.unusable:
                self._note_unusable(keyframe.index, record.unusable)
        self._relive(frames)

    def _relive(self, frames: Sequence[tuple[Keyframe, FrameRecord]]) -> None:
        """Bring all that follows from the measurements to where these frames leave it."""
        self._motion = MotionModel(self._rover_T_camera, self._config.motion)
        self._plausibility = Plausibility(self._rover_T_camera, self._config.motion)
        self._dead_reckoning = DeadReckoning(self._start, self._config.motion)
        self._refound, seen = None, None
        self._richness = Richness()
        for keyframe, record in frames:
            sensors, relative = record.sensors, keyframe.relative
            odometry, prediction = self._motion.odometry(sensors), self._motion.predict(sensors)
            self._motion.update(sensors, relative)
            self._dead_reckoning.step(sensors)
            self._refound = None
            if relative is None:  # at the first frame
                relative = _unmeasured(prediction, "")
            else:
                if relative.accepted and seen is not None:
                    possible = in_view(self._tracker.camera, seen.points_cam, prediction)
                    possible = min(possible, record.report.landmarks)
                    self._refound = Refound(possible, len(relative.inlier_ids))
                    self._richness.see(keyframe.index, self._refound)
                carried = was_carried(keyframe, self._config.motion)
                self._plausibility.odometry(keyframe.index, odometry, relative, carried=carried)
            self._plausibility.tilt(keyframe.index, tilt_of(sensors), relative)
            if keyframe.observations is not None or record.unusable:
                seen = keyframe.observations

    def _note_unusable(self, frame: int, reason: str) -> None:
        self._unusable.setdefault(reason, Episodes(reason)).note(frame)

    def _locate(
        self, features: StereoFeatures, prediction: MotionPrediction
    ) -> tuple[Tracks, RelativePose]:
        """Track and position; where most tracks disagree, search wider, too.

        A turn or slip that nobody told of takes landmarks out of the near windows; where these
        hold them, they are found best there, among the least others. What moved goes before what
        stood still: that may be the rover itself.
        """
        best: tuple[Tracks, RelativePose] | None = None
        most = (False, -1)
        for reach in Reach if self._motion.known else (Reach.WIDE, Reach.ANYWHERE):
            with self._stopwatch.stage("tracking"):
                tracks = self._tracker.associate(features, prediction, reach)
            with self._stopwatch.stage("relative pose"):
                relative = self.positioning.estimate(
                    tracks.points_a, tracks.covariance_a, tracks.observations_b, prediction
                )
                tracks, relative, still = without_own_parts(
                    self.positioning, tracks, relative, prediction
                )
            support = relative.accepted and not still, len(relative.inlier_ids)
            if best is None or support > most:
                best, most = (tracks, relative), support
            if relative.accepted and relative.wrong_match_rate < _MOST_WRONG:
                break
        assert best is not None
        return best

    def _follow(
        self, features: StereoFeatures, tracks: Tracks, relative: RelativePose
    ) -> tuple[Tracks, RelativePose]:
        """Put the landmarks where their patches are, and position once more."""
        if not relative.accepted:
            return tracks, relative
        with self._stopwatch.stage("tracking"):
            tracks = self._tracker.follow(features, tracks, relative)
        with self._stopwatch.stage("relative pose"):
            start = MotionPrediction(relative.a_T_b, relative.covariance)
            again = self.positioning.refine(
                tracks.points_a, tracks.covariance_a, tracks.observations_b, start
            )
        return tracks, again if again.accepted else relative


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
