"""The incremental smoother: measurements in, the latest and all smoothed poses out."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np

from frontends.camera import StereoCamera
from frontends.errors import EstimationError, InputError
from frontends.measurements import (
    AbsoluteFix,
    Estimate,
    FloatArray,
    Odometry,
    RelativePose,
    StartPrior,
    StereoObservations,
    Tilt,
)
from frontends.relative import MotionPrediction
from lunar_fg.graph import kernels
from lunar_fg.graph.backend import Backend
from lunar_fg.graph.ballot import NONE
from lunar_fg.graph.checks import check_closure, check_fix, check_height
from lunar_fg.graph.config import GraphConfig
from lunar_fg.graph.considered import ConsideredScale
from lunar_fg.graph.fixes import FixJudge
from lunar_fg.graph.fullgraph import FullGraph
from lunar_fg.graph.keyframe import Keyframe, PredictedPose, SmoothedTrajectory
from lunar_fg.graph.ledger import FixDecision, Height, LedgerEntry, LoopClosure
from lunar_fg.graph.motions import compose, in_rover_frames
from lunar_fg.graph.planar import Planar
from lunar_fg.graph.posegraph import SegmentGraph
from lunar_fg.graph.setup import Setup

NO_VERTICAL_WARNING = (
    "nothing anchors the vertical (no attitude, no elevation model): roll, pitch and height "
    "are dead reckoned from the start"
)


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
        self._setup = setup = Setup.checked(camera, rover_T_camera, start, config)
        kernels.warm()
        backend = SegmentGraph if setup.config.landmarks == "segments" else FullGraph
        self._graph: Backend = backend(setup)
        self._judge = FixJudge(self._graph, setup)
        self._index: list[int] = []
        self._stamp_s: list[float] = []
        self._vertical = False
        self._scale = ConsideredScale(setup, self._judge, self._index)
        self._before: tuple[FloatArray, FloatArray] | None = None
        self._failures: list[str] = []

    @property
    def warnings(self) -> tuple[str, ...]:
        """One line each for the run's warnings."""
        vertical = () if self._vertical or len(self._index) < 2 else (NO_VERTICAL_WARNING,)
        return (*vertical, *self._scale.warning, *self._graph.warnings, *self._failures)

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
        pose, covariance = self._considered(keyframe.index, *self._latest(keyframe))
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
            motion = keyframe.motion(self._setup.rover_T_camera)
            if motion is None or self._before is None:
                raise
            self._failures.append(f"keyframe {keyframe.index}: {error}")
            latest = compose(*self._before, *in_rover_frames(*motion, self._setup.rover_T_camera))
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

    def predicted(self, frame: int) -> PredictedPose:
        """Pose and marginal covariance of any keyframe so far.

        Raises
        ------
        InputError
            There is no such keyframe.
        EstimationError
            Its covariance cannot be computed.
        """
        pose, covariance = self._graph.at(self._ordinal(frame))
        return PredictedPose(frame, *self._considered(frame, pose, covariance))

    def pose(self, frame: int) -> FloatArray:
        """Pose (4, 4) of any keyframe so far, as smoothed by now.

        Raises
        ------
        InputError
            There is no such keyframe.
        """
        return self._graph.pose(self._ordinal(frame))

    def between(self, i: int, j: int) -> MotionPrediction:
        """Motion between two keyframes as all says that is known, fixes and closures too.

        Raises
        ------
        InputError
            There is no such keyframe.
        EstimationError
            They are too close to each other to tell yet, or the covariance failed.
        """
        return MotionPrediction(*self._graph.between(self._ordinal(i), self._ordinal(j)))

    def motion(self, i: int, j: int) -> Planar:
        """Planar motion between two keyframes by the rover's own measurements, no fix in it.

        In the level axes of `i`, with covariance.

        Raises
        ------
        InputError, EstimationError
            As for `predicted`.
        """
        first, second = self._ordinal(i), self._ordinal(j)
        self._graph.anchor(second)
        return self._graph.motion(first, second)

    def add_fix(self, fix: AbsoluteFix) -> FixDecision:
        """Judge an absolute fix of any keyframe so far, and all recent ones anew with it.

        Raises
        ------
        InputError
            The fix cannot be used, or its keyframe has one; nothing was entered.
        EstimationError
            Its keyframe cannot be solved for; nothing was entered.
        """
        check_fix(fix)
        decision = self._judge.add_fix(fix, self._ordinal(fix.frame), self._index[-1])
        self._refresh()
        return decision

    def add_relative(
        self, i: int, j: int, a_T_b: FloatArray, covariance: FloatArray
    ) -> FixDecision:
        """Judge a loop-closing motion between any two keyframes, rover frames.

        Parameters
        ----------
        i, j
            Their indices, `i` the earlier one.
        a_T_b
            (4, 4) pose of `j` in `i`.
        covariance
            (6, 6), right perturbation, axes of `j`; independent of what else was measured.

        Raises
        ------
        InputError, EstimationError
            As for `add_fix`.
        """
        check_closure(i, j, a_T_b, covariance)
        base, ordinal = self._ordinal(i), self._ordinal(j)
        closure = LoopClosure(i, j, np.array(a_T_b), np.array(covariance))
        decision = self._judge.add_relative(closure, base, ordinal, self._index[-1])
        self._refresh()
        return decision

    def add_height(self, frame: int, z_m: float, sigma_m: float) -> FixDecision:
        """Enter the height of a keyframe, e.g. from the orbital elevation model.

        Heights must be independent of each other: from a raster, one a cell or fewer.

        Raises
        ------
        InputError, EstimationError
            As for `add_fix`.
        """
        check_height(frame, z_m, sigma_m)
        ordinal = self._ordinal(frame)
        decision = self._judge.add_height(Height(frame, z_m, sigma_m), ordinal, self._index[-1])
        self._vertical = self._vertical or decision.accepted
        self._refresh()
        return decision

    def revote(self) -> tuple[LedgerEntry, ...]:
        """Judge all fixes and loop closures together, also those that are no longer voted on.

        Takes some 0.1 s with 400 of them, and grows with their square.

        Returns
        -------
        tuple of LedgerEntry
            Those whose verdict changed.
        """
        if not self._index:
            return ()
        changed = self._judge.revote(self._index[-1])
        self._refresh()
        return changed

    def accept(self, frame: int, base: int | None = None, candidate: int = 0) -> FixDecision:
        """Let a person believe a fix (with `base`, a loop closure), whatever the vote says.

        Raises
        ------
        InputError
            There is no such fix, or it has no such candidate.
        """
        return self._overrule(frame, base, candidate)

    def reject(self, frame: int, base: int | None = None) -> FixDecision:
        """Let a person refuse a fix (with `base`, a loop closure), whatever the vote says.

        Raises
        ------
        InputError
            There is no such fix.
        """
        return self._overrule(frame, base, NONE)

    def _overrule(self, frame: int, base: int | None, choice: int) -> FixDecision:
        name = f"fix {frame}" if base is None else f"closure {base} to {frame}"
        decision = self._judge.overrule(name, choice, self._index[-1] if self._index else 0)
        self._refresh()
        return decision

    @property
    def ledger(self) -> tuple[LedgerEntry, ...]:
        """Every fix and loop closure so far with its verdicts, as they came."""
        return self._judge.ledger

    def _ordinal(self, frame: int) -> int:
        ordinal = bisect_left(self._index, frame)
        if ordinal == len(self._index) or self._index[ordinal] != frame:
            raise InputError(
                "is not in the graph", source=f"keyframe {frame}",
                remedy="add the keyframe before what refers to it",
            )  # fmt: skip
        return ordinal

    def _considered(
        self, frame: int, pose: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Pose and covariance of a keyframe, the error of the scale considered."""
        return pose, self._scale.covariances([frame], pose[None], covariance[None])[0]

    def _refresh(self) -> None:
        """Carry the next estimate on from where the fix has put the rover."""
        self._scale.changed()
        try:
            self._before = self._graph.latest()
        except EstimationError as error:
            self._failures.append(f"keyframe {self._index[-1]}: {error}")

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
        index = np.array(self._index, dtype=np.int64)
        covariances = self._scale.covariances(self._index, poses, covariances)
        return SmoothedTrajectory(index, np.array(self._stamp_s), poses, covariances)

    def finish(self) -> tuple[LedgerEntry, ...]:
        """Judge all fixes and loop closures together, then relinearise until nothing moves.

        Returns
        -------
        tuple of LedgerEntry
            Those whose verdict changed, see `revote`.
        """
        if not self._index:
            return ()
        changed = self.revote()
        self._graph.finish()
        return changed
