"""The demo: a simulated lunar traverse through everything that the project does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from frontends.measurements import Estimate
from lunar_fg import runs
from lunar_fg.config import Config
from lunar_fg.datasets.base import Dataset
from lunar_fg.evaluation import Accuracy, Metrics
from lunar_fg.evaluation.plots import write_plots
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.log import TraverseLog
from lunar_fg.run_folder import RunFolder
from lunar_fg.run_source import RunSource
from lunar_fg.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class DemoResult:
    """What the demo found.

    Attributes
    ----------
    frames, frames_lost
        Stereo pairs, and those whose motion was only predicted.
    wheels, vision, batch
        Accuracy of wheels and attitude alone, of the run, and of the batch over its log.
    report
        The page.
    """

    frames: int
    frames_lost: int
    wheels: Accuracy
    vision: Accuracy
    batch: Accuracy
    report: Path


def demo(
    dataset: Dataset, folder: RunFolder, on_estimate: Callable[[Estimate], None] | None = None
) -> DemoResult:
    """Navigate through a simulated traverse, smooth it in batch, and report.

    Parameters
    ----------
    dataset
        A traverse with truth, wheels and attitude.
    folder
        A new run folder; ``wheels/`` and ``batch/`` are written into it.
    on_estimate
        Called with each frame's estimate.
    """
    from lunar_fg.report import write_report

    RunSource.of(dataset).write(folder)
    metrics = runs.run(dataset, folder, Config(), on_estimate)
    wheels = _by_wheels(folder)
    _, batch = runs.optimize(folder)
    truth = folder.read_truth()
    page = folder.path / "report.html"
    write_report([folder, wheels], page)
    return DemoResult(
        metrics.frames,
        metrics.frames_lost,
        runs.compare(wheels.read_trajectory(), truth),
        runs.compare(folder.read_trajectory(), truth),
        batch,
        page,
    )


def _by_wheels(folder: RunFolder) -> RunFolder:
    """Run folder of what wheels and attitude alone say, from the log of a run."""
    with TraverseLog.open(folder.database_path) as log:
        header, keyframes = log.header(), log.keyframes()
    trajectory = dead_reckoning(header.start.map_T_rover, keyframes)
    truth = folder.read_truth()
    wheels = RunFolder.create(folder.path / "wheels", Config(), overwrite=True)
    wheels.write_trajectory(trajectory, rover_T_camera=header.rover_T_camera)
    if truth is not None:
        wheels.write_truth(truth)
    accuracy = runs.compare(trajectory, truth)
    wheels.write_metrics(Metrics.of_run(accuracy, frames=len(keyframes), frames_lost=0))
    write_plots(wheels.plots_path, trajectory, truth, name="wheels and attitude")
    return wheels


def dead_reckoning(map_T_rover: np.ndarray, keyframes: list[Keyframe]) -> Trajectory:
    """Trajectory by the odometry alone; where there is none, the rover is taken to stand.

    Parameters
    ----------
    map_T_rover
        (4, 4) pose at the first keyframe.
    keyframes
        With the motions since the keyframes before.
    """
    poses = [np.asarray(map_T_rover, dtype=np.float64)]
    for keyframe in keyframes[1:]:
        step = np.eye(4) if keyframe.odometry is None else keyframe.odometry.a_T_b
        poses.append(poses[-1] @ step)
    stamps = np.array([keyframe.stamp_s for keyframe in keyframes])
    return Trajectory(stamps, np.array(poses))
