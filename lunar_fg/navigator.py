"""The paper's method as code: perceive, track, position, smooth; one frame at a time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera, level_rover_T_camera
from frontends.detector import FeatureDetector
from frontends.measurements import Estimate, StartPrior, StereoFrame, UnusableFrame
from frontends.orbital import OrbitalMap
from frontends.rectification import RectificationError
from frontends.revisit import Place
from lunar_fg.blas import one_blas_thread
from lunar_fg.checkpoint import Checkpoint
from lunar_fg.config import Config
from lunar_fg.frontend import Frontend
from lunar_fg.graph.feed import feed
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.graph.ledger import FixDecision, LedgerEntry
from lunar_fg.journal import Journal
from lunar_fg.localisation import Localisation
from lunar_fg.log import TraverseLog
from lunar_fg.loop_closing import LoopClosing
from lunar_fg.order import FrameOrder
from lunar_fg.plausibility import was_carried
from lunar_fg.record import FrameReport, dead_reckoning_of
from lunar_fg.self_calibration import SelfCalibration
from lunar_fg.stereo_alignment import NOTEWORTHY_OFFSET_PX
from lunar_fg.stopwatch import Stopwatch
from lunar_fg.trajectory import Trajectory

FloatArray = NDArray[np.float64]


class Navigator:
    """Estimates the rover's pose from stereo frames.

    Parameters
    ----------
    camera
        The rectified pair.
    config
        Settings; the defaults suit any sequence.
    rover_T_camera
        (4, 4) pose of the left camera in the rover; level and forward by default.
    start
        Where the rover starts; the map's origin by default.
    log
        Where every measurement and estimate is kept, for `lunar_fg.offline.optimize`.
    detector
        Feature detector; upright SURF by default.
    stopwatch
        Times the stages; by the wall clock by default.
    orbital
        Map from orbit; with it, absolute fixes remove the drift.
    """

    def __init__(
        self,
        camera: StereoCamera,
        config: Config | None = None,
        rover_T_camera: FloatArray | None = None,
        start: StartPrior | None = None,
        log: TraverseLog | None = None,
        detector: FeatureDetector | None = None,
        stopwatch: Stopwatch | None = None,
        orbital: OrbitalMap | None = None,
    ) -> None:
        self.camera = camera
        self.config = config or Config()
        self.rover_T_camera = level_rover_T_camera() if rover_T_camera is None else rover_T_camera
        self.stopwatch = stopwatch or Stopwatch()
        self.frames_lost = 0
        self.frames_before = 0
        """Frames that came before the run was resumed."""
        self._journal = Journal(log)
        self._start = start or StartPrior()
        self._frontend = Frontend(
            camera, self.rover_T_camera, self._start, self.config, self.stopwatch, detector
        )
        self._calibration = SelfCalibration(
            camera, self.config.disparity_check, self.config.stereo.max_depth_sigma
        )
        self._corrected = False
        #: Measurements of the newest frame.
        self.keyframe: Keyframe | None = None
        self._order = FrameOrder(camera)
        self._smoother = self._new_smoother()
        self.loops = None
        if self.config.loop_closing.use:
            self.loops = LoopClosing(
                camera, self.rover_T_camera, self.config.loop_closing, self.config.relative,
                self.config.seed, self.config.graph.landmark_correlation, self.config.tracking,
            )  # fmt: skip
        self.localisation = None if orbital is None else Localisation(
            camera, self.rover_T_camera, orbital,
            self.config.localisation, self.config.absolute, self.config.dense,
            self.config.motion,
        )  # fmt: skip

    def step(self, frame: StereoFrame | UnusableFrame) -> Estimate:
        """Take in the next frame and return the pose it leads to.

        Raises
        ------
        InputError
            When the frame does not fit the camera or does not follow the one before;
            nothing that was estimated is lost.
        """
        self._order.check(frame)
        with one_blas_thread(), self.stopwatch.frame(), self._journal.one_entry():
            keyframe = self.keyframe = self._frontend.measure(frame)
            with self.stopwatch.stage("graph"):
                estimate = self._smoother.add(keyframe)
            with self.stopwatch.stage("log"):
                record = self._frontend.records[-1]
                self._journal.frame(keyframe, estimate, record, self._checkpoint())
            if self._calibration.watch(keyframe):
                with self.stopwatch.stage("self-calibration"):
                    estimate = self._recalibrate()
            elif self.loops is not None:
                with self.stopwatch.stage("loop closing"):
                    estimate = self._close_loop(self.loops, keyframe, estimate)
            if self.localisation is not None:
                with self.stopwatch.stage("absolute fix"):
                    estimate = self._localise(frame, keyframe, estimate)
        self._order.accept(frame)
        self.frames_lost += estimate.lost
        return estimate

    def resume(self, frames: Iterable[StereoFrame | UnusableFrame] = ()) -> None:
        """Go on where the log ends: what follows is as if there had been no interruption.

        The graph is built anew from the logged measurements, the images' side set to the
        logged checkpoint.

        Parameters
        ----------
        frames
            The dataset's, from its beginning: with an orbital map, ground that is not in a
            fix yet is measured again. Not read without a map.

        Raises
        ------
        InputError
            The log lacks what is needed, or cannot be read.
        """
        past = self._journal.past()
        if past is None:
            return
        keyframes, checkpoint = past.keyframes, past.checkpoint
        list(feed(self._smoother, keyframes, past.ledger))
        if _rulings(past.ledger) != _rulings(self._smoother.ledger):
            # A sitting that ended has voted once more; the next one goes on from before that.
            self._journal.ledger(self._smoother.ledger)
        self._frontend.restore(checkpoint, list(zip(keyframes, past.records, strict=True)))
        self._corrected = checkpoint.corrected
        self._order.accept(keyframes[-1])
        self.frames_before = len(keyframes)
        self.frames_lost = sum(estimate.lost for estimate in past.estimates)
        if not checkpoint.watching:
            self._calibration.concluded(checkpoint.finding)
        elif self._calibration.resume(checkpoint.finding, checkpoint.watched_from, keyframes):
            last = self._recalibrate()
            self.frames_lost += last.lost
            past = self._journal.past() or past  # corrected
        if self.loops is not None:
            self.loops.restore(past.places, past.estimates, self._smoother.ledger)
        if self.localisation is not None:
            self.localisation.restore(
                frames,
                {frame.keyframe.index: frame for frame in past.frames},
                self._smoother.ledger,
                self._frontend.perception.rectification,
            )

    def finish(self) -> None:
        """Smooth what is still open; call it after the last frame."""
        if self._calibration.conclude():
            last = self._recalibrate()
            self.frames_lost += last.lost
        if self.localisation is not None:
            decision = self.localisation.fix(self._smoother, last=True)
            if decision is not None:
                self._journal.decision(decision)
        if self._smoother.finish():
            self._journal.ledger(self._smoother.ledger)

    def trajectory(self) -> Trajectory:
        """Return the smoothed pose and covariance of every frame so far."""
        smoothed = self._smoother.trajectory()
        return Trajectory(smoothed.stamp_s, smoothed.map_T_rover, smoothed.covariance)

    def dead_reckoning(self) -> Trajectory | None:
        """Return where the rover would be by wheels and attitude alone; None without wheels."""
        return dead_reckoning_of(self._frontend.records)

    @property
    def reports(self) -> list[FrameReport]:
        """Counts of every frame so far."""
        return [record.report for record in self._frontend.records]

    @property
    def ledger(self) -> tuple[LedgerEntry, ...]:
        """Every absolute fix and loop closure so far, with all verdicts."""
        return tuple(self._smoother.ledger)

    @property
    def frames_usable(self) -> int:
        """How many frames so far had images that could be used."""
        return len(self.reports) - self._frontend.frames_unusable

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user should know about the run, one sentence each."""
        found: list[str] = []
        vertical = float(self._frontend.perception.rectification.vertical_px[0])
        if abs(vertical) > NOTEWORTHY_OFFSET_PX:
            found.append(
                f"the images are {vertical:+.2f} px apart vertically (v_left - v_right): removed"
            )
        finding = self._calibration.finding
        if finding is not None and finding.significant:
            found.append(f"{finding}; {'removed' if self._corrected else 'not removed'}")
        of_map = () if self.localisation is None else self.localisation.warnings
        return (*found, *self._frontend.warnings, *self._smoother.warnings, *of_map)

    def _new_smoother(self) -> IncrementalSmoother:
        return IncrementalSmoother(self.camera, self.rover_T_camera, self._start, self.config.graph)

    def _localise(
        self, frame: StereoFrame | UnusableFrame, keyframe: Keyframe, estimate: Estimate
    ) -> Estimate:
        """Map the ground, and fix the rover to the orbital map where that is due."""
        assert self.localisation is not None
        if was_carried(keyframe, self.config.motion):
            self.localisation.lose()
        rectification = self._frontend.perception.rectification
        new_ground = self.localisation.observe(
            frame, keyframe.observations, rectification, estimate.map_T_rover
        )
        # before the calibration is settled, the ground may have another scale
        if not new_ground or self._calibration.watching:
            return estimate
        return self._judged(self.localisation.fix(self._smoother), estimate, "absolute fix")

    def _close_loop(self, loops: LoopClosing, keyframe: Keyframe, estimate: Estimate) -> Estimate:
        """Keep what is seen of this place, and recognise it if the rover was here before."""
        features = self._frontend.features
        place = loops.observe(keyframe, features, estimate)
        if place is None or features is None:
            return estimate
        self._journal.place(place)
        # before the calibration is settled, old and new places may have another scale
        if self._calibration.watching:
            return estimate
        decision = loops.close(self._smoother, keyframe, features, estimate)
        return self._judged(decision, estimate, "loop closure")

    def _judged(self, decision: FixDecision | None, estimate: Estimate, name: str) -> Estimate:
        """Log a verdict, and say where the rover is after it."""
        if decision is None:
            return estimate
        self._journal.decision(decision)
        latest = self._smoother.predicted(estimate.index)
        used = (*estimate.used, name) if decision.accepted else estimate.used
        return replace(
            estimate, map_T_rover=latest.map_T_rover, covariance=latest.covariance, used=used
        )

    def _checkpoint(self) -> Checkpoint:
        return replace(
            self._frontend.checkpoint(),
            watching=self._calibration.watching,
            watched_from=self._calibration.watched_from,
            finding=self._calibration.finding,
            corrected=self._corrected,
        )

    def _recalibrate(self) -> Estimate:
        """Start again from the measurements so far, with the disparity error removed."""
        disparity_px = self._calibration.correction_px
        keyframes = self._calibration.corrected(disparity_px, self._frontend.positioning)
        smoother = self._new_smoother()
        fed = feed(smoother, keyframes, self._smoother.ledger)
        entries = [
            (keyframe, estimate) for keyframe, (estimate, _) in zip(keyframes, fed, strict=True)
        ]
        self._frontend.adopt(disparity_px, keyframes)
        self._calibration.adopted(keyframes)
        places: list[Place] = []
        if self.loops is not None:
            places = self.loops.corrected(keyframes)
            self.loops.restore(places, (e for _, e in entries), smoother.ledger)
        if self.localisation is not None:
            self.localisation.correct(RectificationError(disparity_px=disparity_px))
        self._corrected = True
        self._journal.rewrite(entries, self._checkpoint(), smoother.ledger, places)
        self._smoother = smoother
        self.frames_lost = sum(estimate.lost for _, estimate in entries[:-1])
        return entries[-1][1]


def _rulings(ledger: Iterable[LedgerEntry]) -> int:
    return sum(len(entry.history) for entry in ledger)
