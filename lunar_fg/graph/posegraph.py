"""Segments in, iSAM2 over their boundary poses, every keyframe's pose out."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Mapping

import gtsam
import numpy as np

from frontends.errors import EstimationError, InputError
from frontends.measurements import FloatArray, Tilt
from lunar_fg.graph.anchors import Anchor, motion_between
from lunar_fg.graph.factors import (
    between_factor,
    pose_key,
    start_factor,
    tilt_factor,
    upright_factor,
)
from lunar_fg.graph.far import exchange, onto, shifts, turned_by
from lunar_fg.graph.isam import GuardedIsam
from lunar_fg.graph.isam_steps import Relinearization
from lunar_fg.graph.keyframe import Entered, Keyframe
from lunar_fg.graph.motions import compose
from lunar_fg.graph.network import NO_YAW_SIGMA
from lunar_fg.graph.planar import Planar, PlanarChain
from lunar_fg.graph.segment import Segment, SegmentSolution
from lunar_fg.graph.setup import Setup
from lunar_fg.graph.spread import interior, spread
from lunar_fg.graph.uprights import uprights

#: The path ahead of the last fix is loose: there what turns of 1 mrad leave to second order puts
#: its end off by centimetres (`benchmarks/graph.py`), though by no more than 2 % of its sigma.
_RELINEARIZATION = Relinearization(rad=1e-4, m=0.1, skip=1)
_SNAPSHOTS = 6


class SegmentGraph:
    """The graph of ``landmarks="segments"``.

    Parameters
    ----------
    setup
        What it is made for.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        # One pose in segment_keyframes: QR costs no more than Cholesky and has no 4096 rule.
        self._isam = GuardedIsam(
            qr=True,
            relinearization=_RELINEARIZATION,
            snapshots=_SNAPSHOTS,
        )
        self._segment: Segment | None = None
        self._last: Keyframe | None = None
        self._tilts: dict[int, Tilt] = {}
        # Of the last boundary; it stays as it is while a segment is open.
        self._boundary: tuple[FloatArray, FloatArray] | None = None
        self._solutions: list[SegmentSolution] = []
        # Ordinal of the keyframe that each segment begins with, the open one too.
        self._begins = [0]
        self._chain = PlanarChain(setup.config.scale_sigma)
        self._failures: list[str] = []
        self._close_at = setup.config.segment_keyframes

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user should know about the solver and about segments without landmarks."""
        return (*self._isam.warnings, *self._failures)

    def add(self, keyframe: Keyframe) -> Entered:
        """Take in a keyframe; the segment closes when it is long enough."""
        if self._segment is None:
            self._begin(keyframe)
            return Entered(0, 0, ("start",), lost=False)
        loose = _nothing_holds(keyframe)
        if loose:  # the motion stands alone: what is before it moves apart from what comes after
            self.close()
        entered = self._segment.add(keyframe)
        self._last = keyframe
        if keyframe.tilt is not None:
            self._tilts[len(self._segment) - 1] = keyframe.tilt
        if loose or len(self._segment) > self._close_at:
            self.close()
        return entered

    def _begin(self, keyframe: Keyframe) -> None:
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        factors.add(start_factor(pose_key(0), self._setup.start))
        values.insert(pose_key(0), gtsam.Pose3(self._setup.start.map_T_rover))
        self._add_tilt(factors, keyframe, pose_key(0))
        self._isam.update(factors, values, keyframe.index)
        self._open(keyframe)

    def _open(self, boundary: Keyframe) -> None:
        self._segment = Segment(self._setup, boundary)
        self._last = boundary
        self._tilts = {}

    @staticmethod
    def _add_tilt(factors: gtsam.NonlinearFactorGraph, keyframe: Keyframe, key: int) -> None:
        if keyframe.tilt is not None:
            factors.add(tilt_factor(key, keyframe.tilt, f"keyframe {keyframe.index}"))

    def close(self) -> None:
        """Turn the open segment into one relative pose; its last keyframe opens the next.

        A segment that cannot be solved becomes the chain of its motions; one that iSAM2
        refuses even so stays open and is tried again later. Both become warnings.
        """
        segment, last, self._boundary = self._segment, self._last, None
        if segment is None or last is None or len(segment) == 1:
            return
        name = f"segment that ends at keyframe {last.index}"
        try:
            solution = segment.solve()
            self._enter(solution, last, name)
        except (EstimationError, InputError) as error:
            try:
                solution = segment.chained()
                self._enter(solution, last, name)
            except (EstimationError, InputError) as second:
                self._failures.append(f"{name}: stays open ({second})")
                self._close_at = len(segment) - 1 + self._setup.config.segment_keyframes
                return
            self._failures.append(f"{name}: carried by its motions alone ({error})")
        self._close_at = self._setup.config.segment_keyframes
        self._solutions.append(solution)
        self._begins.append(self._begins[-1] + len(segment) - 1)
        self._open(last)

    def _enter(self, solution: SegmentSolution, last: Keyframe, name: str) -> None:
        first, second = pose_key(len(self._solutions)), pose_key(len(self._solutions) + 1)
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        motion, covariance = solution.first_T_last, solution.last_covariance
        factors.add(between_factor(first, second, motion, covariance, name))
        map_T_first = self._isam.pose(first)
        values.insert(second, gtsam.Pose3(map_T_first @ motion))
        self._add_tilt(factors, last, second)
        for key, upright in zip((first, second), uprights(solution, self._tilts), strict=True):
            if upright is not None:
                factors.add(upright_factor(key, *upright))
        self._isam.update(factors, values, last.index)
        self._chain.add(map_T_first, solution.first_T_rover, solution.covariance)

    def anchor(self, ordinal: int) -> Anchor:
        """Where in the graph a keyframe is; the open segment is closed for it.

        Raises
        ------
        EstimationError
            When the segment cannot be closed.
        """
        if ordinal > self._begins[-1]:
            self.close()
            if ordinal > self._begins[-1]:
                raise EstimationError(self._failures[-1])
        number = bisect_right(self._begins, ordinal) - 1
        position = ordinal - self._begins[number]
        if position == 0:
            return Anchor((pose_key(number),))
        ends = (pose_key(number), pose_key(number + 1))
        return Anchor(ends, spread(self._solutions[number], position))

    def pose(self, ordinal: int) -> FloatArray:
        """(4, 4) of a keyframe; an open segment stays open."""
        begin = self._begins[-1]
        if ordinal > begin and self._segment is not None:
            return np.asarray(self.pose(begin) @ self._segment.chain()[ordinal - begin - 1][0])
        anchor = self.anchor(ordinal)
        return anchor.at({key: self._isam.pose(key) for key in anchor.keys})

    def between(self, first: int, second: int) -> tuple[FloatArray, FloatArray]:
        """Motion between two keyframes as all says that is known; an open segment stays open.

        Raises
        ------
        EstimationError
            When both lie in the open segment.
        """
        begin = self._begins[-1]
        if first > begin:
            raise EstimationError("both keyframes lie in the segment that is open")
        ends = self.anchor(first), self.anchor(min(second, begin))
        keys = dict.fromkeys((*ends[0].keys, *ends[1].keys))
        poses = {key: self._isam.pose(key) for key in keys}
        motion, covariance = motion_between(*ends, poses, self._isam.joint_covariance(*keys))
        if second <= begin or self._segment is None:
            return motion, covariance
        return compose(motion, covariance, *self._segment.chain()[second - begin - 1])

    def motion(self, first: int, second: int) -> Planar:
        """Planar motion between two keyframes in closed segments, no fix in it."""
        return self._chain.between(first, second)

    def exchange(
        self,
        entering: Mapping[str, gtsam.NonlinearFactor],
        leaving: Collection[str],
        frame: int,
        places: Mapping[int, FloatArray],
    ) -> None:
        """See `FixGraph.exchange`."""
        self._boundary = None
        far = any(turned_by(self.pose(o), place) > NO_YAW_SIGMA for o, place in places.items())
        exchange(self._isam, entering, leaving, frame, lambda: self._moved(places), far=far)

    def _moved(self, places: Mapping[int, FloatArray]) -> gtsam.Values:
        """Boundary poses as they stand, laid on believed places."""
        wanted = {}
        for ordinal, place in places.items():
            # a boundary within the same segment moves with the keyframe
            number = bisect_right(self._begins, ordinal) - 1
            number += ordinal > self._begins[number] and number < len(self._solutions)
            wanted[number] = onto(self.pose(ordinal), place)
        loose = [float(np.trace(s.last_covariance[3:, 3:])) for s in self._solutions]
        moved = gtsam.Values()
        for i, shift in enumerate(shifts(loose, wanted)):
            key = pose_key(i)
            moved.insert(key, shift.compose(gtsam.Pose3(self._isam.pose(key))))
        return moved

    def at(self, ordinal: int) -> tuple[FloatArray, FloatArray]:
        """Pose (4, 4) and covariance (6, 6) of a keyframe."""
        begin = self._begins[-1]
        if ordinal >= begin and self._segment is not None:
            here = self._last_boundary()
            return (
                here
                if ordinal == begin
                else compose(*here, *self._segment.chain()[ordinal - begin - 1])
            )
        anchor = self.anchor(ordinal)
        poses = [self._isam.pose(key) for key in anchor.keys]
        if anchor.spread is None:
            return poses[0], self._isam.covariance(anchor.keys[0])
        joint = self._isam.joint_covariance(*anchor.keys)
        by_ends = anchor.by_keys()
        total = by_ends @ joint @ by_ends.T + anchor.rest()
        return anchor.spread.pose(poses[0], poses[1]), 0.5 * (total + total.T)

    def finish(self) -> None:
        """Close the open segment and relinearise all."""
        self.close()
        self._boundary = None
        try:
            self._isam.settle()
        except EstimationError as error:
            self._failures.append(f"the last smoothing was left out: {error}")

    def latest(self) -> tuple[FloatArray, FloatArray]:
        """Pose (4, 4) and covariance (6, 6) of the last keyframe."""
        pose, covariance = self._last_boundary()
        if self._segment is None or len(self._segment) == 1:
            return pose, covariance
        return compose(pose, covariance, *self._segment.predicted())

    def _last_boundary(self) -> tuple[FloatArray, FloatArray]:
        if self._boundary is None:
            key = pose_key(len(self._solutions))
            self._boundary = self._isam.pose(key), self._isam.covariance(key)
        return self._boundary

    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Poses (N, 4, 4) and covariances (N, 6, 6) of all keyframes."""
        poses, covariances = [], []
        if self._segment is None:
            return np.empty((0, 4, 4)), np.empty((0, 6, 6))
        for number, solution in enumerate(self._solutions):
            first, second = pose_key(number), pose_key(number + 1)
            ends = (self._isam.pose(first), self._isam.pose(second))
            poses.append(ends[0])
            covariances.append(self._isam.covariance(first))
            if len(solution.first_T_rover) > 2:
                joint = self._isam.joint_covariance(first, second)
                inner = interior(solution, *ends, joint)
                poses.extend(inner[0])
                covariances.extend(inner[1])
        boundary = pose_key(len(self._solutions))
        pose, covariance = self._isam.pose(boundary), self._isam.covariance(boundary)
        poses.append(pose)
        covariances.append(covariance)
        for open_pose, open_covariance in self._segment.chain():
            composed = compose(pose, covariance, open_pose, open_covariance)
            poses.append(composed[0])
            covariances.append(composed[1])
        return np.stack(poses), np.stack(covariances)


def _nothing_holds(keyframe: Keyframe) -> bool:
    """Whether even the turn of the motion that led to a keyframe is as good as not known."""
    relative, odometry = keyframe.relative, keyframe.odometry
    if relative is None or relative.accepted or odometry is None:
        return False
    return bool(np.diag(odometry.covariance)[:3].max() > NO_YAW_SIGMA**2)
