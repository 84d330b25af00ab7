"""A whole run: dataset in, run folder out; and the offline optimisation of a run folder."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict

import numpy as np

from frontends.errors import InputError, LunarFgError
from frontends.measurements import Estimate
from lunar_fg.config import Config
from lunar_fg.datasets.base import Dataset, GroundTruth
from lunar_fg.evaluation import Accuracy, Metrics, evaluate, without_truth
from lunar_fg.evaluation.plots import write_plots
from lunar_fg.frame_table import FrameTable
from lunar_fg.frontend import FrameReport
from lunar_fg.graph.batch import ConvergenceReport, optimize_batch
from lunar_fg.graph.keyframe import SmoothedTrajectory
from lunar_fg.log import RunHeader, TraverseLog
from lunar_fg.navigator import Navigator
from lunar_fg.route import RouteMonitor, states_text
from lunar_fg.run_folder import RunFolder, write_whole
from lunar_fg.trajectory import PositionTrack, Trajectory, Truth

logger = logging.getLogger("lunar_fg.runs")

OnEstimate = Callable[[Estimate], None]


def run(
    dataset: Dataset,
    folder: RunFolder,
    config: Config | None = None,
    on_estimate: OnEstimate | None = None,
    route: RouteMonitor | None = None,
) -> Metrics:
    """Navigate through a dataset and write the run folder.

    Whatever ends the run early, the frames before it are written first.

    Parameters
    ----------
    dataset
        From `lunar_fg.datasets.open_dataset`.
    folder
        A new run folder.
    config
        Settings.
    on_estimate
        Called with each frame's estimate, e.g. for a progress bar.
    route
        Watches the estimates against a planned route.

    Returns
    -------
    Metrics
        As written to ``metrics.json``.

    Raises
    ------
    InputError
        When the dataset cannot be used from some frame on, or none of its frames can.
    """
    config = config or Config()
    truth = truth_of(dataset.ground_truth)
    if truth is not None:
        folder.write_truth(truth)
    header = RunHeader(
        dataset.camera, dataset.rover_T_camera, dataset.start, config.model_dump_json()
    )
    with TraverseLog.create(folder.database_path, header) as log:
        navigator = Navigator(dataset.camera, config, dataset.rover_T_camera, dataset.start, log)
        try:
            with folder.recorder(rover_T_camera=dataset.rover_T_camera) as recorder:
                for frame in dataset.frames():
                    estimate = navigator.step(frame)
                    recorder.record(estimate)
                    if route is not None:
                        route.observe(estimate)
                    if on_estimate is not None:
                        on_estimate(estimate)
        except LunarFgError as error:
            logger.error("stopped after %d frames: %s", len(navigator.reports), error)
            if navigator.reports:
                _conclude(dataset, folder, navigator, truth, (f"stopped early: {error}",), route)
            raise
        metrics = _conclude(dataset, folder, navigator, truth, (), route)
    if navigator.frames_usable == 0:
        raise InputError(
            "none of its frames could be used",
            source=dataset.path,
            remedy="run.log names the reason for each",
        )
    return metrics


def optimize(folder: RunFolder) -> tuple[ConvergenceReport, Accuracy]:
    """Smooth a finished run as a whole: all landmarks and poses in one batch.

    Writes ``batch/`` into the run folder: trajectory, covariances, metrics, plots.

    Raises
    ------
    InputError
        When the folder holds no log, or an empty one.
    EstimationError
        When the graph cannot be solved.
    """
    with TraverseLog.open(folder.database_path) as log:
        header, keyframes = log.header(), log.keyframes()
    config = Config.model_validate_json(header.config_json)
    result = optimize_batch(
        header.camera, header.rover_T_camera, header.start, keyframes, config.graph
    )
    trajectory = as_trajectory(result.trajectory)
    batch = RunFolder.create(folder.path / "batch", config, overwrite=True)
    truth = folder.read_truth()
    accuracy = compare(trajectory, truth)
    batch.write_trajectory(trajectory, rover_T_camera=header.rover_T_camera)
    lost = sum(
        keyframe.relative is not None and not keyframe.relative.accepted for keyframe in keyframes
    )
    batch.write_metrics(Metrics.of_run(accuracy, frames=len(keyframes), frames_lost=lost))
    write_plots(
        batch.plots_path,
        trajectory,
        truth,
        folder.read_trajectory(),
        name=f"{folder.path.name}, batch",
    )
    return result.report, accuracy


def compare(estimate: Trajectory, truth: Truth | None) -> Accuracy:
    """Accuracy against the truth, or what can be said without one."""
    return without_truth(estimate) if truth is None else evaluate(estimate, truth)


def truth_of(ground_truth: GroundTruth | None) -> Truth | None:
    """Ground truth of a dataset in the form that the evaluation takes."""
    if ground_truth is None:
        return None
    if ground_truth.map_T_rover is not None:
        return Trajectory(ground_truth.stamp_s, ground_truth.map_T_rover)
    columns = 3 if ground_truth.has_height else 2
    return PositionTrack(ground_truth.stamp_s, ground_truth.position_m[:, :columns])


def as_trajectory(smoothed: SmoothedTrajectory) -> Trajectory:
    """Trajectory of the graph in the form that the evaluation takes."""
    return Trajectory(smoothed.stamp_s, smoothed.map_T_rover, smoothed.covariance)


def _conclude(
    dataset: Dataset,
    folder: RunFolder,
    navigator: Navigator,
    truth: Truth | None,
    warnings: tuple[str, ...],
    route: RouteMonitor | None,
) -> Metrics:
    """Smooth what is open and write everything that the run has."""
    navigator.finish()
    trajectory = navigator.trajectory()
    folder.write_trajectory(trajectory, rover_T_camera=dataset.rover_T_camera)
    timing = {name: np.array(ms) for name, ms in navigator.stopwatch.milliseconds().items()}
    warnings = (*warnings, *dataset.notes, *navigator.warnings)
    for warning in warnings:
        logger.warning(warning)
    metrics = Metrics.of_run(
        compare(trajectory, truth),
        frames=len(trajectory),
        frames_lost=navigator.frames_lost,
        timing_ms=timing,
        matches=_counts(navigator.reports),
        warnings=warnings,
        route=None if route is None else route.summary(),
    )
    folder.write_metrics(metrics)
    if route is not None:
        write_whole(folder.path / "route.csv", states_text(route.states).encode())
    table = FrameTable.of_run(trajectory.stamp_s, navigator.reports, timing)
    write_whole(folder.frames_path, table.text().encode())
    write_plots(
        folder.plots_path,
        trajectory,
        truth,
        timing_ms={name: ms for name, ms in timing.items() if name != "total"},
        name=dataset.name,
    )
    return metrics


def _counts(reports: list[FrameReport]) -> dict[str, list[float]]:
    """Counts by name, one a frame."""
    rows = [asdict(report) for report in reports]
    return {name: [float(row[name]) for row in rows] for name in rows[0]} if rows else {}
