"""The KITTI demo: real stereo landmarks of a drive, smoothed three ways.

The landmark measurements of KITTI sequence 00 come inside the gtsam wheel.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from frontends.geometry import inverse, se3_log
from lunar_fg.config import Config
from lunar_fg.datasets.landmarks import LandmarkSequence, read_landmarks
from lunar_fg.evaluation import Accuracy, Metrics
from lunar_fg.evaluation.plots import write_plots
from lunar_fg.graph.batch import optimize_batch
from lunar_fg.graph.config import GraphConfig
from lunar_fg.graph.convergence import ConvergenceReport
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import RunHeader
from lunar_fg.run_folder import RunFolder
from lunar_fg.trajectory import Trajectory, Truth
from lunar_fg.trajectory_io import read_trajectory
from lunar_fg.truth import as_trajectory, compare


@dataclass(frozen=True, slots=True)
class DemoResult:
    """What the demo found.

    Attributes
    ----------
    keyframes, observations
        Size of the input.
    distance_m
        Length of the incremental trajectory.
    segments, full, batch
        Accuracy of iSAM2 with segments, iSAM2 with all landmarks, and batch.
    convergence
        Of the batch optimiser.
    gap_m
        Largest distance between a pose of iSAM2 with all landmarks and of the batch.
    gap_segments_m
        The same between segments and batch.
    gap_rad
        Largest angle between iSAM2 with all landmarks and the batch.
    folder
        Where the run folder is.
    """

    keyframes: int
    observations: int
    distance_m: float
    segments: Accuracy
    full: Accuracy
    batch: Accuracy
    convergence: ConvergenceReport
    gap_m: float
    gap_segments_m: float
    gap_rad: float
    folder: Path


def demo(folder: RunFolder, truth_path: Path | None = None) -> DemoResult:
    """Smooth the embedded KITTI-00 stereo landmarks and compare with the truth if given.

    Parameters
    ----------
    folder
        A new run folder; the trajectory in it is the one of the segments.
    truth_path
        KITTI's ``poses/00.txt``; without it nothing is said about the accuracy.
    """
    sequence = read_landmarks("00")
    truth = None if truth_path is None else _truth(sequence, truth_path)
    if truth is not None:
        folder.write_truth(truth)
    header = RunHeader(
        sequence.camera, sequence.rover_T_camera, sequence.start, Config().model_dump_json()
    )
    segments, step_ms = _incremental(sequence, GraphConfig(), header, folder)
    full, _ = _incremental(sequence, GraphConfig(landmarks="full"), header, None)
    result = optimize_batch(
        sequence.camera, sequence.rover_T_camera, sequence.start, sequence.keyframes
    )
    batch = as_trajectory(result.trajectory)
    accuracy = compare(segments, truth)
    folder.write_trajectory(segments, rover_T_camera=sequence.rover_T_camera)
    folder.write_metrics(
        Metrics.of_run(accuracy, frames=len(segments), frames_lost=0, timing_ms={"graph": step_ms})
    )
    write_plots(
        folder.plots_path,
        segments,
        truth,
        Trajectory(segments.stamp_s, sequence.initial_map_T_rover),
        timing_ms={"graph": step_ms},
        name="KITTI 00, stereo landmarks",
    )
    return DemoResult(
        len(segments),
        sum(len(k.observations) for k in sequence.keyframes if k.observations is not None),
        segments.distance_m,
        accuracy,
        compare(full, truth),
        compare(batch, truth),
        result.report,
        _gap_m(full, batch),
        _gap_m(segments, batch),
        _gap_rad(full, batch),
        folder.path,
    )


def _incremental(
    sequence: LandmarkSequence, config: GraphConfig, header: RunHeader, folder: RunFolder | None
) -> tuple[Trajectory, list[float]]:
    """Feed the keyframes one by one, as a rover would; log them where there is a folder."""
    smoother = IncrementalSmoother(sequence.camera, sequence.rover_T_camera, sequence.start, config)
    step_ms: list[float] = []
    log = None if folder is None else TraverseLog.create(folder.database_path, header)
    try:
        for keyframe in sequence.keyframes:
            start = time.perf_counter()
            estimate = smoother.add(keyframe)
            step_ms.append(1e3 * (time.perf_counter() - start))
            if log is not None:
                log.append(keyframe, estimate)
    finally:
        if log is not None:
            log.close()
    smoother.finish()
    return as_trajectory(smoother.trajectory()), step_ms


def _truth(sequence: LandmarkSequence, path: Path) -> Truth:
    """KITTI's truth at the keyframes, in rover axes, from the sequence's first pose."""
    poses = read_trajectory(path).map_T_rover[sequence.index]
    mount = sequence.rover_T_camera
    start_T_camera = inverse(poses[0]) @ poses
    map_T_rover = sequence.start.map_T_rover @ mount @ start_T_camera @ inverse(mount)
    stamps = np.array([keyframe.stamp_s for keyframe in sequence.keyframes])
    return Trajectory(stamps, map_T_rover)


def _gap_m(a: Trajectory, b: Trajectory) -> float:
    return float(np.linalg.norm(a.positions - b.positions, axis=1).max())


def _gap_rad(a: Trajectory, b: Trajectory) -> float:
    between = inverse(a.map_T_rover) @ b.map_T_rover
    return max(float(np.linalg.norm(se3_log(pose)[:3])) for pose in between)
