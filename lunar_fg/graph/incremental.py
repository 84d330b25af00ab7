"""The incremental smoother: measurements in, the latest and all smoothed poses out."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from frontends.camera import StereoCamera
from frontends.errors import EstimationError, InputError
from frontends.measurements import (
    Estimate,
    FloatArray,
    Odometry,
    RelativePose,
    StartPrior,
    StereoObservations,
    Tilt,
)
from lunar_fg.graph import kernels
from lunar_fg.graph.checks import check_covariance, check_pose
from lunar_fg.graph.config import GraphConfig
from lunar_fg.graph.fullgraph import FullGraph
from lunar_fg.graph.keyframe import Entered, Keyframe, SmoothedTrajectory
from lunar_fg.graph.landmarks import in_rover_frames
from lunar_fg.graph.posegraph import SegmentGraph, compose

NO_VERTICAL_WARNING = (
    "nothing anchors the vertical (no attitude, no elevation model): roll, pitch and height "
    "are dead reckoned from the start"
)


class _Graph(Protocol):
    @property
    def warnings(self) -> tuple[str, ...]: ...

    def add(self, keyframe: Keyframe) -> Entered: ...

    def finish(self) -> None: ...

    def latest(self) -> tuple[FloatArray, FloatArray]: ...

    def trajectory(self) -> tuple[FloatArray, FloatArray]: ...


class IncrementalSmoother:
    """iSAM2 over keyframes, fed one at a time.

    Parameters
    ----------
    camera
        The rectified stereo camera of all observations.
    rover_T_camera
        (4, 4) pose of the left camera in the rover.
    start
        Where the rover starts: the prior on the first keyframe.
    config
        How the measurements are used.

    Raises
    ------
    InputError
        When an argument is not finite, not rigid, or a sigma is not positive.
    """

    def __init__(
        self,
        camera: StereoCamera,
        rover_T_camera: FloatArray,
        start: StartPrior | None = None,
        config: GraphConfig | None = None,
    ) -> None:
        start = start or StartPrior()
        config = config or GraphConfig()
        check_pose(rover_T_camera, "rover_T_camera", "")
        check_pose(start.map_T_rover, "start", "map_T_rover")
        check_covariance(start.covariance(), 6, "start", "sigmas")
        if min(*start.sigma_rot_rad, *start.sigma_trans_m) <= 0.0:
            raise InputError(
                "must all be above 0", source="start", field="sigmas",
                remedy="1e-4 rad and 1e-3 m hold the start as good as fixed",
            )  # fmt: skip
        kernels.warm()
        backend = SegmentGraph if config.landmarks == "segments" else FullGraph
        self._graph: _Graph = backend(camera, np.array(rover_T_camera, float), start, config)
        self._index: list[int] = []
        self._stamp_s: list[float] = []
        self._vertical = False
        self._rover_T_camera = np.array(rover_T_camera, float)
        self._before: tuple[FloatArray, FloatArray] | None = None
        self._failures: list[str] = []

    @property
    def warnings(self) -> tuple[str, ...]:
        """One line each for the run's warnings."""
        vertical = () if self._vertical or len(self._index) < 2 else (NO_VERTICAL_WARNING,)
        return (*vertical, *self._graph.warnings, *self._failures)

    def add_keyframe(
        self,
        index: int,
        stamp_s: float,
        observations: StereoObservations | None,
        relative: RelativePose | None,
        odometry: Odometry | None = None,
        tilt: Tilt | None = None,
    ) -> Estimate:
        """Enter the measurements of one keyframe; see `Keyframe` for each.

        Raises
        ------
        InputError
            A measurement cannot be used; nothing was entered. Whatever else goes wrong
            becomes a warning: the keyframe enters at least by its motion.
        """
        return self.add(Keyframe(index, stamp_s, observations, relative, odometry, tilt))

    def add(self, keyframe: Keyframe) -> Estimate:
        """`add_keyframe` for a `Keyframe`."""
        keyframe.validate()
        self._check_order(keyframe)
        entered = self._graph.add(keyframe)
        self._index.append(keyframe.index)
        self._stamp_s.append(keyframe.stamp_s)
        self._vertical = self._vertical or keyframe.tilt is not None
        pose, covariance = self._latest(keyframe)
        refused = (f"{entered.cut} landmark tracks: cut",) if entered.cut else ()
        relative = keyframe.relative
        if relative is not None and not relative.accepted:
            refused = (*refused, f"relative pose: {relative.reason}")
        return Estimate(
            keyframe.index,
            keyframe.stamp_s,
            pose,
            covariance,
            lost=entered.lost,
            used=entered.used,
            refused=refused,
        )

    def _latest(self, keyframe: Keyframe) -> tuple[FloatArray, FloatArray]:
        """Ask the graph; where it has no covariance, carry the last estimate on."""
        try:
            latest = self._graph.latest()
        except EstimationError as error:
            motion = keyframe.motion(self._rover_T_camera)
            if motion is None or self._before is None:
                raise
            self._failures.append(f"keyframe {keyframe.index}: {error}")
            latest = compose(*self._before, *in_rover_frames(*motion, self._rover_T_camera))
        self._before = latest
        return latest

    def _check_order(self, keyframe: Keyframe) -> None:
        if not self._index:
            return
        source = f"keyframe {keyframe.index}"
        if keyframe.index <= self._index[-1]:
            raise InputError(
                f"does not follow keyframe {self._index[-1]}", source=source, field="index",
                remedy="give keyframes in order, each once",
            )  # fmt: skip
        if keyframe.stamp_s <= self._stamp_s[-1]:
            raise InputError(
                f"{keyframe.stamp_s} s does not follow {self._stamp_s[-1]} s", source=source,
                field="stamp_s", remedy="time must run forward",
            )  # fmt: skip

    def trajectory(self) -> SmoothedTrajectory:
        """Return the latest smoothed pose and covariance of every keyframe.

        Raises
        ------
        EstimationError
            When there is no keyframe yet.
        """
        if not self._index:
            raise EstimationError("the graph is empty: add a keyframe first")
        poses, covariances = self._graph.trajectory()
        return SmoothedTrajectory(
            np.array(self._index, dtype=np.int64), np.array(self._stamp_s), poses, covariances
        )

    def finish(self) -> None:
        """Close the open segment and relinearise until nothing moves."""
        if self._index:
            self._graph.finish()
