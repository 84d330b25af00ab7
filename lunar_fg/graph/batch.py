"""Offline: Levenberg-Marquardt on the whole graph, every landmark in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from frontends.camera import StereoCamera
from frontends.errors import EstimationError, InputError
from frontends.measurements import FloatArray, StartPrior
from lunar_fg.graph.checks import check_pose
from lunar_fg.graph.config import GraphConfig
from lunar_fg.graph.convergence import ConvergenceReport, factor_kinds
from lunar_fg.graph.descent import Descent, descend, named_landmark, values_without, without
from lunar_fg.graph.factors import pose_key
from lunar_fg.graph.feed import feed
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.graph.keyframe import Keyframe, SmoothedTrajectory
from lunar_fg.graph.landmarks import WholeGraph, map_point
from lunar_fg.graph.ledger import LedgerEntry
from lunar_fg.graph.review import JointCovariance, Review
from lunar_fg.graph.scale import Anchors
from lunar_fg.graph.setup import Setup

_ITERATIONS_FACTOR = 10
_MOST_CULPRITS = 50
_MOST_REVIEWS = 6


@dataclass(frozen=True, slots=True)
class BatchResult:
    """The optimised trajectory, how it was reached, and the last word on map measurements."""

    trajectory: SmoothedTrajectory
    report: ConvergenceReport
    ledger: tuple[LedgerEntry, ...] = ()


def optimize_batch(
    camera: StereoCamera,
    rover_T_camera: FloatArray,
    start: StartPrior,
    keyframes: Sequence[Keyframe],
    config: GraphConfig | None = None,
    initial: SmoothedTrajectory | None = None,
    ledger: Sequence[LedgerEntry] = (),
) -> BatchResult:
    """Optimise all poses and landmarks together, with the map measurements that are true.

    Which these are is voted on by graduated non-convexity over all of them at once, on the
    motions between their keyframes (`vote`); then each is held against what all others say
    in the whole graph, and where that changes a verdict, the graph is solved again.

    Parameters
    ----------
    camera, rover_T_camera, start
        As for `IncrementalSmoother`.
    keyframes
        Everything that was measured, in order.
    config
        Gate, robust threshold and iterations; `landmarks` does not matter here.
    initial
        The incremental solution; None computes it (segments). Verdicts are then as `ledger`
        has them.
    ledger
        Map measurements as they came.

    Raises
    ------
    InputError
        Empty or disordered keyframes, or `initial` of another run.
    EstimationError
        The graph cannot be solved.
    """
    setup = Setup.checked(camera, rover_T_camera, start, config)
    config = setup.config
    if not keyframes:
        raise InputError("is empty", source="keyframes", remedy="record a run first")
    if initial is None:
        smoother = _incremental(setup, keyframes, ledger)
        initial, ledger = smoother.trajectory(), smoother.ledger
    index = [keyframe.index for keyframe in keyframes]
    if initial.index.tolist() != index:
        raise InputError(
            "is of other keyframes", source="initial", remedy="give the trajectory of this run"
        )
    whole = WholeGraph(setup)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    landmarks = 0
    for ordinal, (keyframe, pose) in enumerate(zip(keyframes, initial.map_T_rover, strict=True)):
        keyframe.validate()
        check_pose(pose, "initial", f"map_T_rover of keyframe {keyframe.index}")
        new = whole.add(keyframe)
        graph.push_back(new.factors)
        values.insert(pose_key(ordinal), gtsam.Pose3(pose))
        for key, seen_from, point in new.landmarks:
            values.insert(key, map_point(initial.map_T_rover[seen_from], rover_T_camera, point))
        landmarks += len(new.landmarks)
    review = Review(index, ledger, config)
    most, at = _ITERATIONS_FACTOR * config.max_iterations, values
    gone: set[int] = set()
    for left in reversed(range(_MOST_REVIEWS)):
        entering, names = review.factors(initial.map_T_rover)
        with_fixes = gtsam.NonlinearFactorGraph(graph)
        with_fixes.push_back(entering)
        end = descend(with_fixes, at, most, whole.unsound)
        poses, covariances, aside, joint = _marginals(end, len(keyframes))
        if not left or not review.revise(poses, covariances, joint):
            break
        graph, at, gone = without(graph, end.set_aside), end.values, gone | end.set_aside
    size = int(end.graph.size())
    named = {size - len(names) + i: name for i, name in enumerate(names)}
    kinds, worst = factor_kinds(end.graph, values, end.values, index, named)
    report = ConvergenceReport(
        end.iterations,
        end.cost_before,
        end.cost_after,
        end.converged,
        end.reason,
        size,
        landmarks - len(aside | gone),
        len(aside | gone),
        kinds,
        worst,
        len(review.accepted),
        len(ledger) - len(review.accepted),
    )
    anchors = Anchors.of(index[0], start.map_T_rover, review.ledger)
    covariances = anchors.considered(initial.index, poses, covariances, config.scale_sigma)
    trajectory = SmoothedTrajectory(initial.index, initial.stamp_s, poses, covariances)
    return BatchResult(trajectory, report, review.ledger)


def _incremental(
    setup: Setup, keyframes: Sequence[Keyframe], ledger: Sequence[LedgerEntry]
) -> IncrementalSmoother:
    segments = setup.config.model_copy(update={"landmarks": "segments"})
    smoother = IncrementalSmoother(setup.camera, setup.rover_T_camera, setup.start, segments)
    list(feed(smoother, keyframes, ledger))
    smoother.finish()
    return smoother


def _marginals(
    end: Descent, count: int
) -> tuple[FloatArray, FloatArray, set[int], JointCovariance]:
    """Poses, covariances, landmarks set aside, any joint; by QR, which has no 4096 rule."""
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    params.enableRelinearization = False
    graph, optimum, aside = end.graph, end.values, set(end.set_aside)
    while True:
        isam = gtsam.ISAM2(params)
        try:
            isam.update(graph, optimum)
            covariances = [np.asarray(isam.marginalCovariance(pose_key(i))) for i in range(count)]
            break
        except RuntimeError as error:
            culprit = named_landmark(error) - aside
            if not culprit or len(aside) - len(end.set_aside) >= _MOST_CULPRITS:
                text = str(error).strip().splitlines()[0]
                raise EstimationError(f"the covariances could not be computed ({text})") from error
            aside |= culprit
            graph, optimum = without(graph, culprit), values_without(optimum, culprit)
    poses = [np.asarray(optimum.atPose3(pose_key(i)).matrix()) for i in range(count)]

    def joint(first: int, second: int) -> FloatArray:
        keys = [pose_key(first), pose_key(second)]
        found = isam.jointMarginalCovariance(keys)
        return np.block([[found.at(a, b) for b in keys] for a in keys])

    return np.stack(poses), np.stack(covariances), aside, joint
