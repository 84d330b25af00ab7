"""What a run leaves behind when it ends: trajectory, metrics, tables, plots."""

from __future__ import annotations

import logging
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from lunar_fg.datasets.base import Dataset
from lunar_fg.evaluation import Metrics
from lunar_fg.evaluation.plots import write_plots
from lunar_fg.frame_table import FrameTable
from lunar_fg.navigator import Navigator
from lunar_fg.record import FrameReport
from lunar_fg.route import RouteMonitor, states_text
from lunar_fg.run_folder import RunFolder, write_whole
from lunar_fg.truth import compare

logger = logging.getLogger("lunar_fg.runs")


def conclude(
    dataset: Dataset,
    folder: RunFolder,
    navigator: Navigator,
    warnings: tuple[str, ...],
    route: RouteMonitor | None,
) -> Metrics:
    """Smooth what is open and write everything that the run has."""
    truth = folder.read_truth()
    navigator.finish()
    trajectory = navigator.trajectory()
    folder.write_trajectory(trajectory, rover_T_camera=dataset.rover_T_camera)
    by_wheels = navigator.dead_reckoning()
    if by_wheels is not None:
        folder.write_dead_reckoning(by_wheels)
    timing = _timing(navigator)
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
        dead_reckoning=None if by_wheels is None else compare(by_wheels, truth),
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
        by_wheels,
        timing_ms={name: ms for name, ms in timing.items() if name != "total"},
        name=dataset.name,
    )
    return metrics


def _timing(navigator: Navigator) -> dict[str, NDArray[np.float64]]:
    """Milliseconds by stage, one a frame; NaN for the frames before a run was resumed."""
    return {
        name: np.concatenate([np.full(navigator.frames_before, np.nan), ms])
        for name, ms in navigator.stopwatch.milliseconds().items()
    }


def _counts(reports: list[FrameReport]) -> dict[str, list[float]]:
    """Counts by name, one a frame."""
    rows = [asdict(report) for report in reports]
    return {name: [float(row[name]) for row in rows] for name in rows[0]} if rows else {}
