"""The same measurements again with other settings, from the log alone."""

from __future__ import annotations

from dataclasses import replace

from frontends.measurements import FloatArray, StartPrior
from lunar_fg.config import Config
from lunar_fg.dead_reckoning import DeadReckoning
from lunar_fg.evaluation import Metrics
from lunar_fg.evaluation.plots import write_plots
from lunar_fg.graph.feed import feed
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import LoggedFrame
from lunar_fg.motion import MotionModel
from lunar_fg.motion_config import MotionConfig
from lunar_fg.plausibility import Plausibility, was_carried
from lunar_fg.record import dead_reckoning_of
from lunar_fg.run_folder import RunFolder
from lunar_fg.runs import config_of
from lunar_fg.trajectory import Trajectory
from lunar_fg.truth import as_trajectory, compare


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
        frames = with_motion(frames, header.rover_T_camera, header.start, config.motion)
        fed = feed(smoother, (frame.keyframe for frame in frames), ledger)
        for frame, (estimate, decisions) in zip(frames, fed, strict=True):
            log.append(frame.keyframe, estimate, frame.record, decisions=decisions)
            lost += estimate.lost
        if smoother.finish():
            log.replace_ledger(smoother.ledger)
    trajectory = as_trajectory(smoother.trajectory())
    target.write_trajectory(trajectory, rover_T_camera=header.rover_T_camera)
    by_wheels = dead_reckoning_of([frame.record for frame in frames if frame.record is not None])
    if by_wheels is not None:
        target.write_dead_reckoning(by_wheels)
    warnings = (f"replayed from the log of {source.path.name}", *smoother.warnings)
    metrics = Metrics.of_run(
        compare(trajectory, truth),
        frames=len(trajectory),
        frames_lost=lost,
        warnings=warnings,
        dead_reckoning=None if by_wheels is None else compare(by_wheels, truth),
    )
    target.write_metrics(metrics)
    name = f"{target.path.name}, replayed"
    write_plots(target.plots_path, trajectory, truth, source.read_trajectory(), name=name)
    return metrics


def without_fixes(source: RunFolder) -> Trajectory:
    """Trajectory of a run as it would be without any map measurement, from its log.

    Raises
    ------
    InputError
        When the run has no log, or an empty one.
    """
    with TraverseLog.open(source.database_path) as log:
        header, keyframes = log.header(), log.keyframes()
    smoother = IncrementalSmoother(
        header.camera, header.rover_T_camera, header.start, config_of(header).graph
    )
    list(feed(smoother, keyframes, []))
    smoother.finish()
    return as_trajectory(smoother.trajectory())


def with_motion(
    frames: list[LoggedFrame], rover_T_camera: FloatArray, start: StartPrior, config: MotionConfig
) -> list[LoggedFrame]:
    """Give each frame the motion by its logged sensors that these settings make of them."""
    motion, plausibility = MotionModel(rover_T_camera, config), Plausibility(rover_T_camera, config)
    by_wheels = DeadReckoning(start, config)
    result: list[LoggedFrame] = []
    for frame in frames:
        if frame.record is not None:
            sensors, keyframe = frame.record.sensors, frame.keyframe
            record = replace(frame.record, dead_reckoned=by_wheels.step(sensors))
            odometry = motion.odometry(sensors) if result else None
            motion.update(sensors, keyframe.relative)
            if keyframe.relative is not None:
                odometry = plausibility.odometry(
                    keyframe.index,
                    odometry,
                    keyframe.relative,
                    carried=was_carried(keyframe, config),
                )
            frame = replace(frame, keyframe=replace(keyframe, odometry=odometry), record=record)
        result.append(frame)
    return result
