"""The same measurements again with other settings, from the log alone."""

from __future__ import annotations

from dataclasses import replace

from lunar_fg.config import Config
from lunar_fg.evaluation import Metrics
from lunar_fg.evaluation.plots import write_plots
from lunar_fg.graph.feed import feed
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import LoggedFrame
from lunar_fg.motion import MotionModel
from lunar_fg.run_folder import RunFolder
from lunar_fg.runs import as_trajectory, compare


def replay(source: RunFolder, target: RunFolder, config: Config) -> Metrics:
    """Smooth the measurements of a run anew, as if it had been made with other settings.

    The settings of the graph and of the wheels (`motion`) take effect; what concerns the
    images is as it was in the run. The target is a whole run folder with a log of its own,
    but without what it takes to go on with images.

    Parameters
    ----------
    source
        A run with a log, finished or not.
    target
        A new run folder.
    config
        Settings.

    Returns
    -------
    Metrics
        As written to the target's ``metrics.json``.

    Raises
    ------
    InputError
        When the source has no log, or an empty one.
    """
    with TraverseLog.open(source.database_path) as log:
        header, frames, sittings = log.header(), log.frames(), log.sittings()
        ledger = log.ledger()
    truth = source.read_truth()
    if truth is not None:
        target.write_truth(truth)
    smoother = IncrementalSmoother(header.camera, header.rover_T_camera, header.start, config.graph)
    header = replace(header, config_json=config.model_dump_json())
    lost = 0
    with TraverseLog.create(target.database_path, header) as log:
        for sitting in sittings:
            log.begin(sitting)
        frames = with_motion(frames, MotionModel(header.rover_T_camera, config.motion))
        fed = feed(smoother, (frame.keyframe for frame in frames), ledger)
        for frame, (estimate, decisions) in zip(frames, fed, strict=True):
            log.append(frame.keyframe, estimate, frame.record, decisions=decisions)
            lost += estimate.lost
    smoother.finish()
    trajectory = as_trajectory(smoother.trajectory())
    target.write_trajectory(trajectory, rover_T_camera=header.rover_T_camera)
    warnings = (f"replayed from the log of {source.path.name}", *smoother.warnings)
    metrics = Metrics.of_run(
        compare(trajectory, truth), frames=len(trajectory), frames_lost=lost, warnings=warnings
    )
    target.write_metrics(metrics)
    name = f"{target.path.name}, replayed"
    write_plots(target.plots_path, trajectory, truth, source.read_trajectory(), name=name)
    return metrics


def with_motion(frames: list[LoggedFrame], motion: MotionModel) -> list[LoggedFrame]:
    """Give each frame the wheel motion that this model makes of its logged sensors."""
    result: list[LoggedFrame] = []
    for frame in frames:
        if frame.record is not None:
            odometry = motion.odometry(frame.record.sensors) if result else None
            motion.update(frame.record.sensors, frame.keyframe.relative)
            frame = replace(frame, keyframe=replace(frame.keyframe, odometry=odometry))
        result.append(frame)
    return result
