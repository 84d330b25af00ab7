"""The offline optimisation of a run folder."""

from __future__ import annotations

from lunar_fg.evaluation import Accuracy, Metrics
from lunar_fg.evaluation.plots import write_plots
from lunar_fg.graph.batch import optimize_batch
from lunar_fg.graph.convergence import ConvergenceReport
from lunar_fg.log import TraverseLog
from lunar_fg.run_folder import RunFolder
from lunar_fg.runs import config_of
from lunar_fg.truth import as_trajectory, compare


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
