"""A whole run: dataset in, run folder out; and the offline optimisation of a run folder."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from itertools import chain
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from frontends.errors import InputError, LunarFgError
from frontends.measurements import Estimate, StereoFrame, UnusableFrame
from lunar_fg.config import Config
from lunar_fg.datasets.base import Dataset, GroundTruth
from lunar_fg.evaluation import Accuracy, Metrics, evaluate, share_start, without_truth
from lunar_fg.evaluation.plots import write_plots
from lunar_fg.fix_pictures import FixPictures
from lunar_fg.frame_table import FrameTable
from lunar_fg.graph.batch import optimize_batch
from lunar_fg.graph.convergence import ConvergenceReport
from lunar_fg.graph.keyframe import SmoothedTrajectory
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import RunHeader, Sitting
from lunar_fg.navigator import Navigator
from lunar_fg.orbital_files import open_orbital
from lunar_fg.order import InOrder
from lunar_fg.record import FrameReport
from lunar_fg.recorder import EstimateRecorder
from lunar_fg.route import RouteMonitor, states_text
from lunar_fg.run_folder import RunFolder, write_whole
from lunar_fg.trajectory import PositionTrack, Trajectory, Truth

logger = logging.getLogger("lunar_fg.runs")

Frame = StereoFrame | UnusableFrame
OnEstimate = Callable[[Estimate], None]


class Watcher(Protocol):
    """Sees every frame of a run with what came of it."""

    def observe(self, frame: Frame, navigator: Navigator, estimate: Estimate) -> None:
        """Take in one frame, after the navigator."""
        ...


def run(
    dataset: Dataset,
    folder: RunFolder,
    config: Config | None = None,
    on_estimate: OnEstimate | None = None,
    route: RouteMonitor | None = None,
    sitting: Sitting | None = None,
    watcher: Watcher | None = None,
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
    sitting
        How the dataset was opened, for `resume`; by its path alone where not given.
    watcher
        Sees every frame with what came of it, e.g. a live view.

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
        log.begin(sitting or Sitting(str(dataset.path.resolve())))
        navigator = Navigator(
            dataset.camera, config, dataset.rover_T_camera, dataset.start, log,
            orbital=open_orbital(dataset, config.map),
        )  # fmt: skip
        return _drive(dataset, dataset.frames(), folder, navigator, (), on_estimate, route, watcher)


def resume(
    dataset: Dataset,
    folder: RunFolder,
    on_estimate: OnEstimate | None = None,
    route: RouteMonitor | None = None,
) -> Metrics:
    """Go on with an interrupted run; it ends as it would have without the interruption.

    Parameters
    ----------
    dataset
        The one of the run's last sitting, see `last_sitting`.
    folder, on_estimate, route
        As for `run`.

    Raises
    ------
    InputError
        As for `run`; also when there is no log to go on from, another process writes it, or
        the dataset is not the run's.
    """
    with TraverseLog.reopen(folder.database_path) as log:
        navigator = _navigator_of(log, dataset)
        earlier, sitting = log.estimates(), log.sittings()[-1]
        last = earlier[-1].index if earlier else -1
        frames = _shifted(dataset.frames(after=last - sitting.index_offset), sitting)
        return _drive(dataset, frames, folder, navigator, earlier, on_estimate, route)


def append(
    dataset: Dataset,
    folder: RunFolder,
    sitting: Sitting,
    gap_s: float | None = None,
    on_estimate: OnEstimate | None = None,
    route: RouteMonitor | None = None,
) -> Metrics:
    """Go on with a run in a further sitting of the same traverse.

    Frame numbers are raised where they do not follow those of the run. Over a gap that is
    long against the time between frames nothing is taken for known of the motion, unless
    the wheels measured it; landmarks are looked for all the same.

    Parameters
    ----------
    dataset
        Of the new sitting: same camera, same place on the rover.
    folder, on_estimate, route
        As for `run`.
    sitting
        How the dataset was opened.
    gap_s
        Time between the run's last frame and the first of this sitting, where the stamps of
        the two do not tell; None takes the stamps as they are.

    Raises
    ------
    InputError
        As for `resume`; also when the stamps do not follow.
    """
    with TraverseLog.reopen(folder.database_path) as log:
        navigator = _navigator_of(log, dataset)
        earlier = log.estimates()
        frames = dataset.frames()
        first = next(frames, None)
        if first is None or not earlier:
            source = folder.path if first else dataset.path
            raise InputError("has no frame", source=source, remedy="start a run without --append")
        last = earlier[-1]
        stamp_offset_s = 0.0 if gap_s is None else last.stamp_s + gap_s - first.stamp_s
        if first.stamp_s + stamp_offset_s <= last.stamp_s:
            raise InputError(
                f"begins at {first.stamp_s:g} s, the run ends at {last.stamp_s:g} s",
                source=dataset.path,
                field="stamp_s",
                remedy="say with --gap how many seconds lie between the two",
            )
        index_offset = 0 if first.index > last.index else last.index + 1 - first.index
        sitting = replace(sitting, index_offset=index_offset, stamp_offset_s=stamp_offset_s)
        _extend_truth(folder, dataset, stamp_offset_s)
        log.begin(sitting)
        frames = _shifted(chain([first], frames), sitting)
        return _drive(dataset, frames, folder, navigator, earlier, on_estimate, route)


def last_sitting(folder: RunFolder) -> Sitting:
    """How the dataset was opened that a run went through last.

    Raises
    ------
    InputError
        The run's log is missing, or does not say.
    """
    with TraverseLog.open(folder.database_path) as log:
        sittings = log.sittings()
    if not sittings:
        raise InputError(
            "does not say which dataset it is of", source=folder.database_path,
            remedy="use `lunar-fg replay`, which needs no images",
        )  # fmt: skip
    return sittings[-1]


def settings_of(folder: RunFolder) -> Config:
    """Settings that a run was made with, from its log."""
    with TraverseLog.open(folder.database_path) as log:
        return config_of(log.header())


def config_of(header: RunHeader) -> Config:
    """Settings that a run was made with.

    Raises
    ------
    InputError
        They are none of this program's.
    """
    try:
        return Config.model_validate_json(header.config_json)
    except ValidationError as error:
        problem = f"holds settings that this program does not know: {error.errors()[0]['msg']}"
        raise InputError(problem, source="log", field="config") from error


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
        header, keyframes, ledger = log.header(), log.keyframes(), log.ledger()
    config = config_of(header)
    result = optimize_batch(
        header.camera, header.rover_T_camera, header.start, keyframes, config.graph, ledger=ledger
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
    """Accuracy against the truth, or what can be said without one.

    Where the truth begins where the estimate says it does, within its covariance, both are in
    one map and nothing is aligned.
    """
    if truth is None:
        return without_truth(estimate)
    return evaluate(estimate, truth, same_map=share_start(estimate, truth))


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


def _navigator_of(log: TraverseLog, dataset: Dataset) -> Navigator:
    """Make a navigator that stands where the log ends."""
    header = log.header()
    mount = np.allclose(header.rover_T_camera, dataset.rover_T_camera, rtol=0.0, atol=1e-9)
    if header.camera != dataset.camera or not mount:
        raise InputError(
            "has another camera, or the camera in another place, than the run",
            source=dataset.path,
            field="camera",
            remedy="give the dataset of the run, or start a new run",
        )
    config = config_of(header)
    navigator = Navigator(
        header.camera, config, header.rover_T_camera, header.start, log,
        orbital=open_orbital(dataset, config.map),
    )  # fmt: skip
    sitting = log.sittings()[-1]
    navigator.resume(_shifted(dataset.frames(), sitting))
    return navigator


def _shifted(frames: Iterable[Frame], sitting: Sitting) -> Iterator[Frame]:
    """Frames with numbers and stamps that follow the sitting before."""
    for frame in frames:
        yield replace(
            frame,
            index=frame.index + sitting.index_offset,
            stamp_s=frame.stamp_s + sitting.stamp_offset_s,
        )


def _extend_truth(folder: RunFolder, dataset: Dataset, stamp_offset_s: float) -> None:
    """Add a sitting's truth to the run's, where both are of a kind."""
    before, more = folder.read_truth(), truth_of(dataset.ground_truth)
    if before is None or more is None:
        return
    stamps = np.concatenate([before.stamp_s, more.stamp_s + stamp_offset_s])
    if isinstance(before, Trajectory) and isinstance(more, Trajectory):
        poses = np.concatenate([before.map_T_rover, more.map_T_rover])
        folder.write_truth(Trajectory(stamps, poses))
    elif isinstance(before, PositionTrack) and isinstance(more, PositionTrack):
        columns = min(before.position_m.shape[1], more.position_m.shape[1])
        positions = np.concatenate([t.position_m[:, :columns] for t in (before, more)])
        folder.write_truth(PositionTrack(stamps, positions))
    else:
        logger.warning("the truth of this sitting is of another kind than the run's: left out")


def _drive(
    dataset: Dataset,
    frames: Iterable[Frame],
    folder: RunFolder,
    navigator: Navigator,
    earlier: Sequence[Estimate],
    on_estimate: OnEstimate | None,
    route: RouteMonitor | None = None,
    watcher: Watcher | None = None,
) -> Metrics:
    """Take the frames through the navigator, and write all whatever happens."""
    if route is not None:
        for estimate in earlier:
            route.observe(estimate)
    if navigator.localisation is not None:
        navigator.localisation.on_attempt = FixPictures(folder.fixes_path).draw
    in_order = InOrder(frames)
    try:
        with EstimateRecorder(folder, navigator.rover_T_camera, earlier) as recorder:
            for frame in in_order:
                estimate = navigator.step(frame)
                recorder.record(estimate)
                if route is not None:
                    route.observe(estimate)
                if watcher is not None:
                    watcher.observe(frame, navigator, estimate)
                if on_estimate is not None:
                    on_estimate(estimate)
    except LunarFgError as error:
        logger.error("stopped after %d frames: %s", len(navigator.reports), error)
        if navigator.reports:
            try:
                reason = (f"stopped early: {error}", *in_order.warnings)
                _conclude(dataset, folder, navigator, reason, route)
            except (LunarFgError, OSError) as second:
                logger.error("and the results could not be written whole: %s", second)
        raise
    if not navigator.reports:
        raise InputError("has no frame", source=dataset.path, remedy="give images")
    metrics = _conclude(dataset, folder, navigator, in_order.warnings, route)
    if navigator.frames_usable == 0:
        raise InputError(
            "none of its frames could be used",
            source=dataset.path,
            remedy="run.log names the reason for each",
        )
    return metrics


def _conclude(
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
