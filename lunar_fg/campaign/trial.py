"""One run of a campaign, in whatever process: a trial in, its figures out."""

from __future__ import annotations

import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from frontends.errors import LunarFgError
from frontends.geometry import inverse
from lunar_fg.campaign.source import open_source
from lunar_fg.campaign.study import Trial
from lunar_fg.config import Config
from lunar_fg.evaluation import evaluate
from lunar_fg.evaluation.association import associate
from lunar_fg.evaluation.consistency import NeesFrame, coverage
from lunar_fg.evaluation.fixes import FixCounts, count_fixes
from lunar_fg.faults import parse_fault
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.log import TraverseLog
from lunar_fg.run_folder import RunFolder
from lunar_fg.runs import run
from lunar_fg.simulation.measurements import simulate
from lunar_fg.trajectory import Trajectory, Truth
from lunar_fg.truth import as_trajectory, truth_of


@dataclass(frozen=True, slots=True)
class Outcome:
    """The figures of one trial: a row of the results' table.

    Attributes
    ----------
    number, seed, group
        Of the trial.
    error
        Why it failed, in one line; empty when it ran to its end.
    frames, frames_lost
        Read, and carried by a prediction alone.
    distance_m, ate_m, final_error_m, drift_percent
        Against the truth, in the map where the truth is in it (ATE: rmse, no alignment).
    nees, coverage
        Mean NEES a degree of freedom; share of the poses within 3 sigma on every map axis.
    fixes_tried, fixes_right, fixes_accepted, fixes_accepted_right, fixes_nees
        See `lunar_fg.evaluation.fixes.FixCounts`.
    drift_after_percent
        Error of the motion from where the last fault ended to the end of the drive, as a share
        of its way: what is left of the fault once it is over.
    cpu_s, wall_s
        Of the run, without its simulation.
    warnings
        What it said.
    """

    number: int
    seed: int
    group: str
    error: str = ""
    frames: int = 0
    frames_lost: int = 0
    distance_m: float | None = None
    ate_m: float | None = None
    final_error_m: float | None = None
    drift_percent: float | None = None
    nees: float | None = None
    coverage: float | None = None
    fixes_tried: int = 0
    fixes_right: int = 0
    fixes_accepted: int = 0
    fixes_accepted_right: int = 0
    fixes_nees: float | None = None
    drift_after_percent: float | None = None
    cpu_s: float = 0.0
    wall_s: float = 0.0
    warnings: tuple[str, ...] = ()


def run_trial(trial: Trial) -> Outcome:
    """Run a trial; whatever it raises of lunar-fg's own becomes its outcome's error."""
    try:
        if trial.base.measurements is not None:
            return _without_images(trial)
        return _with_images(trial)
    except LunarFgError as error:
        return Outcome(trial.number, trial.seed, trial.group, error=str(error))


def failed(trial: Trial, reason: str) -> Outcome:
    """Outcome of a trial that its worker did not survive."""
    return Outcome(trial.number, trial.seed, trial.group, error=reason)


def _without_images(trial: Trial) -> Outcome:
    config = Config.model_validate(trial.base.config)
    made = simulate(trial.base.traverse(), trial.seed)
    cpu, wall = time.process_time(), time.perf_counter()
    smoother = IncrementalSmoother(made.camera, made.rover_T_camera, made.start, config.graph)
    lost = sum(smoother.add(keyframe).lost for keyframe in made.keyframes)
    smoother.finish()
    trajectory = as_trajectory(smoother.trajectory())
    spent = time.process_time() - cpu, time.perf_counter() - wall
    truth = Trajectory(trajectory.stamp_s, made.map_T_rover)
    return _judged(trial, trajectory, truth, lost, spent, smoother.warnings)


def _with_images(trial: Trial) -> Outcome:
    config = Config.model_validate(trial.base.config).model_copy(update={"seed": trial.seed})
    with tempfile.TemporaryDirectory(prefix="lunar-fg-trial-") as scratch:
        dataset = open_source(trial, Path(scratch))
        folder = RunFolder.create(Path(scratch) / "run", config)
        cpu, wall = time.process_time(), time.perf_counter()
        metrics = run(dataset, folder, config)
        spent = time.process_time() - cpu, time.perf_counter() - wall
        trajectory, truth = folder.read_trajectory(), truth_of(dataset.ground_truth)
        fixes = FixCounts() if truth is None else _fixes(folder, truth)
        after = None if truth is None else _drift_after(trial, len(dataset), trajectory, truth)
    if truth is None:
        return Outcome(
            trial.number, trial.seed, trial.group, "", metrics.frames, metrics.frames_lost,
            cpu_s=spent[0], wall_s=spent[1], warnings=metrics.warnings,
        )  # fmt: skip
    outcome = _judged(trial, trajectory, truth, metrics.frames_lost, spent, metrics.warnings)
    counts = {f"fixes_{name}": count for name, count in asdict(fixes).items()}
    return replace(outcome, drift_after_percent=after, **counts)


def _drift_after(trial: Trial, frames: int, trajectory: Trajectory, truth: Truth) -> float | None:
    """See `Outcome`; None where no fault ends during the drive."""
    ends = [parse_fault(text).span.last + 1 for text in trial.base.faults]
    # the truth has a pose a frame in simulated traverses: a frame's number is its row
    known = isinstance(truth, Trajectory) and len(truth) == frames
    if not known or not ends or max(ends) > frames - 2:
        return None
    pair = associate(trajectory, truth)
    rows = np.flatnonzero(pair.truth.stamp_s >= truth.stamp_s[max(ends)])
    if len(rows) < 2:
        return None
    a, b = rows[0], rows[-1]
    made, true = (inverse(p[a]) @ p[b] for p in (pair.estimate.map_T_rover, pair.true_poses))
    way = float(pair.travelled_m()[b] - pair.travelled_m()[a])
    error = float(np.linalg.norm(made[:3, 3] - true[:3, 3]))
    return 100.0 * error / way if way > 0.0 else None


def _fixes(folder: RunFolder, truth: Truth) -> FixCounts:
    with TraverseLog.open(folder.database_path) as log:
        ledger, keyframes = log.ledger(), log.keyframes()
    stamps = np.array([keyframe.stamp_s for keyframe in keyframes])
    nearest = np.abs(truth.stamp_s[None, :] - stamps[:, None]).argmin(axis=1)
    return count_fixes(
        ledger,
        {k.index: truth.positions[row] for k, row in zip(keyframes, nearest, strict=True)},
    )


def _judged(
    trial: Trial,
    trajectory: Trajectory,
    truth: Truth,
    lost: int,
    spent: tuple[float, float],
    warnings: tuple[str, ...],
) -> Outcome:
    in_map = isinstance(truth, Trajectory)
    accuracy = evaluate(trajectory, truth, same_map=in_map)
    ate = accuracy.ate_rmse_m
    pair = associate(trajectory, truth)
    return Outcome(
        trial.number,
        trial.seed,
        trial.group,
        frames=len(trajectory),
        frames_lost=lost,
        distance_m=accuracy.distance_m,
        ate_m=ate.none if in_map else ate.se3,
        final_error_m=accuracy.final_error_m,
        drift_percent=accuracy.kitti.translation_percent,
        nees=accuracy.nees.mean,
        coverage=float(np.mean(coverage(pair, NeesFrame.SAME_MAP))) if in_map else None,
        cpu_s=spent[0],
        wall_s=spent[1],
        warnings=warnings,
    )
