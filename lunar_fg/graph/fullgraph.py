"""Every stereo landmark in one iSAM2, for those who want the joint map."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import gtsam
import numpy as np

from frontends.errors import EstimationError
from frontends.measurements import FloatArray
from lunar_fg.graph.anchors import Anchor, motion_between
from lunar_fg.graph.factors import between_factor, pose_key, start_factor
from lunar_fg.graph.far import exchange, onto, shifts, turned_by
from lunar_fg.graph.isam import GuardedIsam
from lunar_fg.graph.keyframe import Entered, Keyframe
from lunar_fg.graph.landmarks import WholeGraph, map_point
from lunar_fg.graph.planar import Planar, PlanarChain
from lunar_fg.graph.setup import Setup

_FRAMES_NAMED = 8
#: A turn by more takes no linear steps: to second order it misplaces a landmark 10 m off by
#: 5 cm, past which iSAM2 linearises anew.
_FAR_RAD = 0.1


class FullGraph:
    """The graph of ``landmarks="full"``.

    Parameters
    ----------
    setup
        What it is made for.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._whole = WholeGraph(setup)
        # Cholesky is two to three times faster with landmarks; the guard turns to QR
        # where the 4096 rule stops it.
        self._isam = GuardedIsam(qr=False, unsound=self._whole.unsound)
        self._count = 0
        self._chain = PlanarChain(setup.config.scale_sigma)
        self._motions: list[tuple[FloatArray, FloatArray]] = []
        self._landmarks_aside = 0
        self._frames_aside: list[int] = []
        self._failures: list[str] = []

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user should know about the solver and about landmarks set aside."""
        aside: tuple[str, ...] = ()
        if self._landmarks_aside:
            frames = ", ".join(map(str, self._frames_aside[:_FRAMES_NAMED]))
            more = " ..." if len(self._frames_aside) > _FRAMES_NAMED else ""
            aside = (
                f"{self._landmarks_aside} landmarks had no place in front of the cameras that "
                f"saw them and were set aside (keyframes {frames}{more})",
            )
        return (*self._isam.warnings, *aside, *self._failures)

    def add(self, keyframe: Keyframe) -> Entered:
        """Take in a keyframe, if need be by its motion alone."""
        new = self._whole.add(keyframe)
        here = self._count
        values = gtsam.Values()
        if new.previous_T_rover is None or new.covariance is None:
            pose = self._setup.start.map_T_rover
        else:
            before = self._isam.pose(pose_key(here - 1))
            pose = before @ new.previous_T_rover
            step = np.stack([np.eye(4), new.previous_T_rover])
            self._chain.add(before, step, new.covariance)
            self._motions.append((new.previous_T_rover, new.covariance))
        values.insert(pose_key(here), gtsam.Pose3(pose))
        seen_from: dict[int, FloatArray] = {here: pose}
        for key, ordinal, point in new.landmarks:
            if ordinal not in seen_from:
                seen_from[ordinal] = self._isam.pose(pose_key(ordinal))
            values.insert(key, map_point(seen_from[ordinal], self._setup.rover_T_camera, point))
        entered = new.entered
        try:
            self._set_aside(self._isam.update(new.factors, values, keyframe.index), keyframe.index)
        except EstimationError as error:
            self._failures.append(
                f"keyframe {keyframe.index}: entered by its motion alone ({error})"
            )
            self._set_aside({key for key, _, _ in new.landmarks}, keyframe.index)
            self._enter_by_motion(keyframe.index, pose)
            entered = replace(entered, linked=0, used=("relative pose",))
        self._count += 1
        self._inspect(new.seen, keyframe.index)
        return entered

    def _enter_by_motion(self, frame: int, pose: FloatArray) -> None:
        here = self._count
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(pose_key(here), gtsam.Pose3(pose))
        if here == 0:
            factors.add(start_factor(pose_key(0), self._setup.start))
        else:
            ends = (pose_key(here - 1), pose_key(here))
            factors.add(between_factor(*ends, *self._motions[-1], f"keyframe {frame}"))
        try:
            self._set_aside(self._isam.update(factors, values, frame), frame)
        except EstimationError as error:
            self._failures.append(
                f"keyframe {frame}: the graph was started anew from the motions alone ({error})"
            )
            self._start_anew()

    def _start_anew(self) -> None:
        """Rebuild without a landmark: start prior and measured motions, which always solve."""
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        factors.add(start_factor(pose_key(0), self._setup.start))
        pose = self._setup.start.map_T_rover
        values.insert(pose_key(0), gtsam.Pose3(pose))
        for i, motion in enumerate(self._motions, start=1):
            pose = pose @ motion[0]
            values.insert(pose_key(i), gtsam.Pose3(pose))
            factors.add(between_factor(pose_key(i - 1), pose_key(i), *motion, "restart"))
        self._isam.start_anew(factors, values)
        self._whole.set_aside(self._whole.live())

    def _set_aside(self, landmarks: set[int], frame: int) -> None:
        if landmarks:
            self._whole.set_aside(landmarks)
            self._landmarks_aside += len(landmarks)
            self._frames_aside.append(frame)

    def _inspect(self, seen: tuple[int, ...], frame: int) -> None:
        """Take out landmarks just seen that the update threw behind the camera."""
        estimate = self._isam.estimate(pose_key(self._count - 1), seen)
        bad = self._whole.unsound(estimate, latest=1)
        if bad:
            self._isam.remove(bad)
            self._set_aside(bad, frame)

    def finish(self) -> None:
        """Relinearise all until nothing moves."""
        try:
            aside = self._isam.settle()
        except EstimationError as error:
            self._failures.append(f"the last smoothing was left out: {error}")
            return
        self._whole.set_aside(aside)
        self._landmarks_aside += len(aside)

    def anchor(self, ordinal: int) -> Anchor:
        """Where in the graph a keyframe is."""
        return Anchor((pose_key(ordinal),))

    def pose(self, ordinal: int) -> FloatArray:
        """(4, 4) of a keyframe."""
        return self._isam.pose(pose_key(ordinal))

    def between(self, first: int, second: int) -> tuple[FloatArray, FloatArray]:
        """Motion between two keyframes as all says that is known, and its covariance."""
        ends = self.anchor(first), self.anchor(second)
        poses = {key: self._isam.pose(key) for end in ends for key in end.keys}
        return motion_between(*ends, poses, self._isam.joint_covariance(*poses))

    def motion(self, first: int, second: int) -> Planar:
        """Planar motion between two keyframes, no fix in it."""
        return self._chain.between(first, second)

    def exchange(
        self,
        entering: Mapping[str, gtsam.NonlinearFactor],
        leaving: Collection[str],
        frame: int,
        places: Mapping[int, FloatArray],
    ) -> None:
        """See `FixGraph.exchange`."""
        far = any(map(self._far, places, places.values()))
        bad = exchange(self._isam, entering, leaving, frame, lambda: self._moved(places), far=far)
        self._set_aside(bad, frame)

    def _far(self, ordinal: int, place: FloatArray) -> bool:
        return turned_by(self.pose(ordinal), place) > _FAR_RAD

    def _moved(self, places: Mapping[int, FloatArray]) -> gtsam.Values:
        """Everything as it stands, laid on believed places."""
        now = self._isam.values()
        wanted = {ordinal: onto(self.pose(ordinal), place) for ordinal, place in places.items()}
        loose = [float(np.trace(covariance[3:, 3:])) for _, covariance in self._motions]
        by = shifts(loose, wanted)
        moved = gtsam.Values()
        for i, shift in enumerate(by):
            moved.insert(pose_key(i), shift.compose(now.atPose3(pose_key(i))))
        for key, ordinal in self._whole.first_seen().items():
            if now.exists(key):
                moved.insert(key, by[ordinal].transformFrom(now.atPoint3(key)))
        return moved

    def at(self, ordinal: int) -> tuple[FloatArray, FloatArray]:
        """Pose (4, 4) and covariance (6, 6) of a keyframe."""
        return self._isam.pose(pose_key(ordinal)), self._isam.covariance(pose_key(ordinal))

    def latest(self) -> tuple[FloatArray, FloatArray]:
        """Pose (4, 4) and covariance (6, 6) of the last keyframe."""
        return self.at(self._count - 1)

    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Poses (N, 4, 4) and covariances (N, 6, 6) of all keyframes."""
        if not self._count:
            return np.empty((0, 4, 4)), np.empty((0, 6, 6))
        keys = [pose_key(i) for i in range(self._count)]
        return (
            np.stack([self._isam.pose(key) for key in keys]),
            np.stack([self._isam.covariance(key) for key in keys]),
        )
