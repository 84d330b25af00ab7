"""When the rover is back at an old place, and what it sees there of the way between.

The landmarks of a keyframe every few metres are kept (`frontends.revisit.Place`). When a later
keyframe sees the same ground, the motion between both is measured anew and the graph judges it
as it judges fixes. What makes a closed loop independent of the rest of the graph:

- Each keyframe is in one closed loop at most, and two keyframes that share a tracked landmark
  are never tied: no pixel says twice how two poses lie.
- A loop is closed only where the graph knows the motion four times worse than the two views
  tell it. The segments around either keyframe have used the same pixels; their share in what
  the loop corrects is then below a sixteenth, and so is what the correlation could add.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Gt, Lt
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.errors import EstimationError
from frontends.geometry import inverse
from frontends.measurements import Estimate
from frontends.relative import LANDMARK_CORRELATION, MotionPrediction, RelativeConfig
from frontends.revisit import Place, Revisiting
from frontends.stereo_features import StereoFeatures
from frontends.tracking import TrackingConfig
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.graph.ledger import FixDecision, LedgerEntry, LoopClosure
from lunar_fg.graph.planar import planar
from lunar_fg.kept_places import KeptPlaces

logger = logging.getLogger("lunar_fg.loop_closing")

FloatArray = NDArray[np.float64]

_LEAST_LANDMARKS = 30
_MOST_LANDMARKS = 300
_SIGMAS = 3.0
#: How many places are tried at a keyframe.
_MOST_TRIED = 3
#: The graph must know the motion so many times worse than two views tell it.
_TELLING = 4.0


@dataclass(frozen=True, slots=True)
class LoopClosingConfig:
    """When loops are closed.

    Attributes
    ----------
    use
        False: never.
    view_change_deg
        Largest change of view between an old place and now: of heading, and of the direction
        in which a landmark at median depth is seen.
    false_alarms
        Loops closed by chance, a pair of views that share nothing.
    memory_mb
        For the kept landmarks; when it is full, every other place is let go.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "allow_inf_nan": False}

    use: bool = True
    view_change_deg: Annotated[float, Gt(0), Lt(90)] = 20.0
    false_alarms: Annotated[float, Gt(0), Lt(1)] = 1e-6
    memory_mb: Annotated[float, Gt(0)] = 64.0


class LoopClosing:
    """Keeps places and recognises them.

    Parameters
    ----------
    camera, rover_T_camera
        The rectified pair and its place in the rover.
    config
        Settings.
    relative
        Settings of relative positioning.
    seed
        Of its random sampling.
    landmark_correlation
        As for `RelativePositioning`.
    tracking
        As for `Revisiting`.
    """

    def __init__(
        self,
        camera: StereoCamera,
        rover_T_camera: FloatArray,
        config: LoopClosingConfig | None = None,
        relative: RelativeConfig | None = None,
        seed: int = 0,
        landmark_correlation: float = LANDMARK_CORRELATION,
        tracking: TrackingConfig | None = None,
    ) -> None:
        self.config = config or LoopClosingConfig()
        strict = replace(relative or RelativeConfig(), false_alarms=self.config.false_alarms)
        self._camera = camera
        self._rover_T_camera = rover_T_camera
        self._revisiting = Revisiting(camera, strict, seed, landmark_correlation, tracking)
        self._view_change = math.radians(self.config.view_change_deg)
        self._kept = self._nothing_kept()
        self._used: set[int] = set()

    @property
    def places(self) -> list[Place]:
        """What is kept, oldest first."""
        return self._kept.places

    def observe(
        self, keyframe: Keyframe, features: StereoFeatures | None, estimate: Estimate
    ) -> Place | None:
        """Keep what a keyframe sees, where the rover has come far enough since the last place.

        Parameters
        ----------
        keyframe
            The newest one.
        features
            What describes its landmarks, in the same order; None where there are no images.
        estimate
            Where it is.

        Returns
        -------
        Place or None
            What is kept of it.
        """
        self._kept.drive(estimate)
        observations = keyframe.observations
        if observations is None or features is None or len(observations) < _LEAST_LANDMARKS:
            return None
        if not self._kept.is_far(planar(estimate.map_T_rover)):
            return None
        place = Place.of(keyframe.index, features, _MOST_LANDMARKS)
        self._kept.keep(place, estimate, self._reach_m(place))
        return place

    def close(
        self,
        smoother: IncrementalSmoother,
        keyframe: Keyframe,
        features: StereoFeatures,
        estimate: Estimate,
    ) -> FixDecision | None:
        """Recognise an old place from a keyframe that was just kept, and let the graph judge.

        Returns
        -------
        FixDecision or None
            None where no old place was recognised.
        """
        closure = self.recognise(smoother, keyframe, features, estimate)
        if closure is None:
            return None
        i, j = closure.base, closure.frame
        try:
            decision = smoother.add_relative(i, j, closure.a_T_b, closure.covariance)
        except EstimationError as error:
            logger.warning("keyframe %d: the loop is left open: %s", j, error)
            return None
        self._used |= {i, j}
        return decision

    def recognise(
        self,
        smoother: IncrementalSmoother,
        keyframe: Keyframe,
        features: StereoFeatures,
        estimate: Estimate,
    ) -> LoopClosure | None:
        """Motion from an old place to a keyframe that sees it again; None where there is none."""
        observations = keyframe.observations
        if observations is None:
            return None
        for place, reach_m in self._kept.near(smoother, estimate, self._used)[:_MOST_TRIED]:
            try:
                motion = smoother.between(place.frame, keyframe.index)
            except EstimationError:
                continue
            least = _TELLING * self._revisiting.least_sigma_m(place)
            if _spread(motion.covariance) < least:
                break  # of the others, too, the views can tell no more than is known
            shared = np.isin(place.landmark_id, observations.landmark_id).any()
            if shared or not self._may_see(motion, reach_m):
                continue
            prediction = motion.in_frames(inverse(self._rover_T_camera))
            measured = self._revisiting.measure(place, features, prediction)
            if not measured.accepted:
                continue
            closed = measured.in_frames(self._rover_T_camera)
            if _spread(closed.covariance) * _TELLING < _spread(motion.covariance):
                logger.info(
                    "keyframe %d: keyframe %d's place again, %d of %d landmarks agree",
                    keyframe.index, place.frame, len(measured.inlier_ids), measured.correspondences,
                )  # fmt: skip
                return LoopClosure(place.frame, keyframe.index, closed.a_T_b, closed.covariance)
        return None

    def restore(
        self, places: Iterable[Place], estimates: Iterable[Estimate], ledger: Iterable[LedgerEntry]
    ) -> None:
        """Stand as after these frames.

        Parameters
        ----------
        places
            All that were kept, in order.
        estimates
            As each frame came in.
        ledger
            Of the run.
        """
        self._kept, self._used = self._nothing_kept(), set()
        by_frame = {place.frame: place for place in places}
        for estimate in estimates:
            self._kept.drive(estimate)
            place = by_frame.get(estimate.index)
            if place is not None:
                self._kept.keep(place, estimate, self._reach_m(place))
        for entry in ledger:
            if isinstance(entry.measurement, LoopClosure):
                self._used |= {entry.measurement.base, entry.measurement.frame}

    def corrected(self, keyframes: Iterable[Keyframe]) -> list[Place]:
        """Places with a disparity error removed that was found, from the corrected keyframes."""
        seen = {keyframe.index: keyframe.observations for keyframe in keyframes}
        pairs = ((place, seen[place.frame]) for place in self._kept.places)
        return [place if by is None else place.corrected(by) for place, by in pairs]

    def _nothing_kept(self) -> KeptPlaces:
        return KeptPlaces(self._view_change, self.config.memory_mb * 1e6)

    def _reach_m(self, place: Place) -> float:
        """How far from where it was seen a place can be told again."""
        depths = place.observations(self._camera).points_cam[:, 2]
        return float(np.median(depths)) * math.tan(self._view_change)

    def _may_see(self, motion: MotionPrediction, reach_m: float) -> bool:
        """Whether the old view and the new one can be near enough for the same landmarks."""
        x, y, yaw = planar(motion.a_T_b)
        yaw_sigma = math.sqrt(max(float(motion.covariance[2, 2]), 0.0))
        near = math.hypot(x, y) <= reach_m + _SIGMAS * _spread(motion.covariance)
        return near and abs(yaw) <= self._view_change + _SIGMAS * yaw_sigma


def _spread(covariance: FloatArray) -> float:
    """Largest 1-sigma of the translation, m."""
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance[3:, 3:])[-1]), 0.0))
