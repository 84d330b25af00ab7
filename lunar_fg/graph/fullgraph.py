"""Every stereo landmark in one iSAM2, for those who want the joint map."""

from __future__ import annotations

import gtsam
import numpy as np

from frontends.camera import StereoCamera
from frontends.measurements import FloatArray, StartPrior
from lunar_fg.graph.config import GraphConfig
from lunar_fg.graph.factors import pose_key
from lunar_fg.graph.isam import GuardedIsam
from lunar_fg.graph.keyframe import Entered, Keyframe
from lunar_fg.graph.landmarks import WholeGraph, map_point


class FullGraph:
    """The graph of ``landmarks="full"``.

    Parameters
    ----------
    camera, rover_T_camera, start, config
        As for `IncrementalSmoother`.
    """

    def __init__(
        self,
        camera: StereoCamera,
        rover_T_camera: FloatArray,
        start: StartPrior,
        config: GraphConfig,
    ) -> None:
        self._rover_T_camera = rover_T_camera
        self._start = start
        self._whole = WholeGraph(camera, rover_T_camera, start, config)
        # Cholesky is two to three times faster with landmarks; the guard turns to QR
        # where the 4096 rule stops it.
        self._isam = GuardedIsam(qr=False)
        self._count = 0

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user should know about the solver."""
        return self._isam.warnings

    def add(self, keyframe: Keyframe) -> Entered:
        """Take in a keyframe."""
        new = self._whole.add(keyframe)
        here = self._count
        values = gtsam.Values()
        if new.previous_T_rover is None:
            pose = self._start.map_T_rover
        else:
            pose = self._isam.pose(pose_key(here - 1)) @ new.previous_T_rover
        values.insert(pose_key(here), gtsam.Pose3(pose))
        seen_from: dict[int, FloatArray] = {here: pose}
        for key, ordinal, point in new.landmarks:
            if ordinal not in seen_from:
                seen_from[ordinal] = self._isam.pose(pose_key(ordinal))
            values.insert(key, map_point(seen_from[ordinal], self._rover_T_camera, point))
        self._isam.update(new.factors, values, keyframe.index)
        self._count += 1
        return new.entered

    def finish(self) -> None:
        """Relinearise all until nothing moves."""
        self._isam.settle()

    def latest(self) -> tuple[FloatArray, FloatArray]:
        """Pose (4, 4) and covariance (6, 6) of the last keyframe."""
        key = pose_key(self._count - 1)
        return self._isam.pose(key), self._isam.covariance(key)

    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Poses (N, 4, 4) and covariances (N, 6, 6) of all keyframes."""
        if not self._count:
            return np.empty((0, 4, 4)), np.empty((0, 6, 6))
        keys = [pose_key(i) for i in range(self._count)]
        return (
            np.stack([self._isam.pose(key) for key in keys]),
            np.stack([self._isam.covariance(key) for key in keys]),
        )
