"""A finished run's folder without navigating: what `lunar_fg.results` reads."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from synthetic import CAMERA, rover_T_camera

from frontends.geometry import pose, se3_exp, so3_exp
from frontends.measurements import AbsoluteFix, Estimate, FixCandidate, StartPrior, Verdict
from lunar_fg.evaluation import Metrics, evaluate
from lunar_fg.frame_table import FrameTable
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.graph.ledger import FixDecision, LedgerEntry, Ruling
from lunar_fg.log import RunHeader, TraverseLog
from lunar_fg.record import FrameReport
from lunar_fg.route import PlannedRoute, RouteMonitor, states_text
from lunar_fg.run_folder import RunFolder
from lunar_fg.run_source import RunSource
from lunar_fg.trajectory import Trajectory
from lunar_fg.trajectory_io import write_tum

STEP = se3_exp([0.0, 0.0, 0.03, 0.5, 0.0, 0.0])


def trajectory(frames: int, seed: int = 0) -> tuple[Trajectory, Trajectory]:
    """A drive with errors as large as its covariance says, and the truth."""
    rng = np.random.default_rng(seed)
    true = estimated = pose(so3_exp([0.0, 0.0, 0.4]), [1.0, 2.0, 0.5])
    true_poses, poses, covariance = [], [], []
    for index in range(frames):
        true_poses.append(true)
        poses.append(estimated)
        covariance.append(np.diag([1e-6] * 3 + [1e-4 * (index + 1)] * 3))
        true = true @ STEP
        noise = np.concatenate([np.zeros(3), rng.normal(0.0, 1e-2, 3)])
        estimated = estimated @ STEP @ se3_exp(noise)
    stamps = np.arange(frames, dtype=float)
    estimate = Trajectory(stamps, np.array(poses), np.array(covariance))
    return estimate, Trajectory(stamps, np.array(true_poses))


def write_finished_run(
    path: Path,
    frames: int = 40,
    *,
    name: str = "rendered drive",
    crs: str | None = "IAU_2015:30135",
    ortho: Path | None = None,
    seed: int = 0,
) -> RunFolder:
    """Write everything that a run of this many frames leaves behind."""
    folder = RunFolder.create(path, {"seed": seed, "graph": {"landmarks": "segments"}})
    estimate, truth = trajectory(frames, seed)
    folder.write_trajectory(estimate)
    folder.write_truth(truth)
    wheels = truth.map_T_rover.copy()
    wheels[:, :3, 3] += 0.03 * (wheels[:, :3, 3] - wheels[0, :3, 3])
    write_tum(path / "dead_reckoning.tum", Trajectory(estimate.stamp_s, wheels))
    reports = [FrameReport(900, 500, 450, 400 + i, 300, 250 + i % 7, 0.1) for i in range(frames)]
    timing = {"total": np.full(frames, 40.0), "stereo": np.linspace(20.0, 30.0, frames)}
    table = FrameTable.of_run(estimate.stamp_s, reports, timing)
    folder.frames_path.write_text(table.text())
    line = {"type": "LineString", "coordinates": [[1.0, 2.0], [12.0, 8.0]]}
    crs_member = {"type": "name", "properties": {"name": "map"}}
    feature = {"type": "Feature", "properties": {"name": "plan"}, "geometry": line}
    folder.route_path.write_text(json.dumps({**feature, "crs": crs_member}))
    monitor = RouteMonitor(PlannedRoute(np.array([[1.0, 2.0], [12.0, 8.0]]), name="plan"))
    header = RunHeader(CAMERA, rover_T_camera(), StartPrior(), "{}")
    assert estimate.covariance is not None
    with TraverseLog.create(folder.database_path, header) as log:
        for index in range(frames):
            found = Estimate(
                index,
                float(estimate.stamp_s[index]),
                estimate.map_T_rover[index] @ pose(np.eye(3), [0.0, 0.004 * (index % 9), 0.0]),
                estimate.covariance[index],
                lost=index == 5,
            )
            monitor.observe(found)
            log.append(Keyframe(index, found.stamp_s), found)
        if frames > 20:
            log.append_decisions([_decision(estimate, 10, good=True), _decision(estimate, 20)])
    (path / "route.csv").write_text(states_text(monitor.states))
    metrics = Metrics.of_run(
        evaluate(estimate, truth),
        frames=frames,
        frames_lost=1,
        timing_ms=timing,
        matches={"inliers": np.full(frames, 250.0)},
        warnings=("the images are -3.2 px apart vertically: removed",),
        route=monitor.summary(),
    )
    folder.write_metrics(metrics)
    source = RunSource(
        name=name, dataset=path, crs=crs, origin_m=(12_000.0, -8_000.0, 100.0), ortho=ortho
    )
    source.write(folder)
    return folder


def _decision(estimate: Trajectory, frame: int, *, good: bool = False) -> FixDecision:
    """A fix near the estimate that is believed, or one far off that is not."""
    x, y, _ = estimate.positions[frame] + (0.0 if good else 6.0)
    place = FixCandidate(x, y, 0.5, np.diag([0.04, 0.09, 1e-3]), 0.8, "relief", 30)
    fix = AbsoluteFix(frame, (place,), 0.4)
    verdict = Verdict.ACCEPTED if good else Verdict.REFUSED
    reason = "agrees <b>well</b>" if good else "9.1 sigma from what was expected"
    ruling = Ruling(frame, verdict, 0 if good else None, 0.9 if good else 9.1, reason, frame)
    return FixDecision(LedgerEntry(frame, fix, (ruling,)), (), (), ())
