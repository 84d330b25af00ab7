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
from lunar_fg.graph.descent import Descent, descend, named_landmark, values_without, without
from lunar_fg.graph.factors import pose_key
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.graph.keyframe import Keyframe, SmoothedTrajectory
from lunar_fg.graph.landmarks import WholeGraph, map_point

_ITERATIONS_FACTOR = 10
_MOST_CULPRITS = 50


@dataclass(frozen=True, slots=True)
class ConvergenceReport:
    """How the optimiser ended.

    Attributes
    ----------
    iterations
        Of Levenberg-Marquardt.
    cost_before, cost_after
        Half the robust chi-square.
    converged
        Whether it stopped because nothing improved any more.
    reason
        Why it stopped.
    factors, landmarks
        Size of the graph.
    landmarks_set_aside
        Landmarks left out: they had no place in front of the cameras that saw them.
    """

    iterations: int
    cost_before: float
    cost_after: float
    converged: bool
    reason: str
    factors: int
    landmarks: int
    landmarks_set_aside: int = 0


@dataclass(frozen=True, slots=True)
class BatchResult:
    """The optimised trajectory and how it was reached."""

    trajectory: SmoothedTrajectory
    report: ConvergenceReport


def optimize_batch(
    camera: StereoCamera,
    rover_T_camera: FloatArray,
    start: StartPrior,
    keyframes: Sequence[Keyframe],
    config: GraphConfig | None = None,
    initial: SmoothedTrajectory | None = None,
) -> BatchResult:
    """Optimise all poses and landmarks together.

    Parameters
    ----------
    camera, rover_T_camera, start
        As for `IncrementalSmoother`.
    keyframes
        Everything that was measured, in order.
    config
        Gate, robust threshold and iterations; `landmarks` does not matter here.
    initial
        The incremental solution; None computes it (segments).

    Raises
    ------
    InputError
        Empty or disordered keyframes, or `initial` of another run.
    EstimationError
        The graph cannot be solved.
    """
    config = config or GraphConfig()
    check_pose(rover_T_camera, "rover_T_camera", "")
    if not keyframes:
        raise InputError("is empty", source="keyframes", remedy="record a run first")
    if initial is None:
        initial = _incremental(camera, rover_T_camera, start, keyframes, config)
    if initial.index.tolist() != [keyframe.index for keyframe in keyframes]:
        raise InputError(
            "is of other keyframes", source="initial", remedy="give the trajectory of this run"
        )
    whole = WholeGraph(camera, rover_T_camera, start, config)
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
    end = descend(graph, values, _ITERATIONS_FACTOR * config.max_iterations, whole.unsound)
    poses, covariances, aside = _marginals(end, len(keyframes))
    report = ConvergenceReport(
        end.iterations,
        end.cost_before,
        end.cost_after,
        end.converged,
        end.reason,
        int(end.graph.size()),
        landmarks - len(aside),
        len(aside),
    )
    trajectory = SmoothedTrajectory(initial.index, initial.stamp_s, poses, covariances)
    return BatchResult(trajectory, report)


def _incremental(
    camera: StereoCamera,
    rover_T_camera: FloatArray,
    start: StartPrior,
    keyframes: Sequence[Keyframe],
    config: GraphConfig,
) -> SmoothedTrajectory:
    segments = config.model_copy(update={"landmarks": "segments"})
    smoother = IncrementalSmoother(camera, rover_T_camera, start, segments)
    for keyframe in keyframes:
        smoother.add(keyframe)
    smoother.finish()
    return smoother.trajectory()


def _marginals(end: Descent, count: int) -> tuple[FloatArray, FloatArray, set[int]]:
    """Poses, covariances, landmarks set aside; by QR, which has no 4096 rule."""
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
    return np.stack(poses), np.stack(covariances), aside
