"""Offline: the true map measurements are in, the report says what fits badly."""

from dataclasses import replace

import numpy as np
import pytest

from frontends.measurements import Verdict
from lunar_fg.graph import GraphConfig, IncrementalSmoother, LedgerEntry, optimize_batch
from lunar_fg.simulation.fixes import FixSpec, simulate_fixes
from lunar_fg.simulation.measurements import TraverseSpec, simulate


@pytest.fixture(scope="module")
def fixed():
    run = simulate(TraverseSpec(keyframes=41, landmarks=25, odometry=True, tilt=True), seed=6)
    spec = FixSpec(every=5, sigma_xy_m=0.05, sigma_yaw_rad=0.005, false_share=0.4)
    fixes = simulate_fixes(range(41), run.map_T_rover, spec, seed=1)
    smoother = IncrementalSmoother(run.camera, run.rover_T_camera, run.start)
    waiting = {fix.frame: fix for fix in fixes.fixes}
    for keyframe in run.keyframes:
        smoother.add(keyframe)
        if keyframe.index in waiting:
            smoother.add_fix(waiting[keyframe.index])
    motion = np.linalg.inv(run.map_T_rover[2]) @ run.map_T_rover[38]
    smoother.add_relative(2, 38, motion, 1e-4 * np.eye(6))
    smoother.add_height(33, float(run.map_T_rover[33, 2, 3]), 0.1)
    smoother.finish()
    return run, fixes, smoother


def batch(run, ledger, **more):
    return optimize_batch(
        run.camera, run.rover_T_camera, run.start, run.keyframes, ledger=ledger, **more
    )


def test_batch_believes_the_true_ones_and_reports(fixed):
    run, fixes, smoother = fixed
    result = batch(run, smoother.ledger)
    verdicts = [e.ruling.verdict is Verdict.ACCEPTED for e in result.ledger[: len(fixes.true)]]
    assert verdicts == fixes.true.tolist()
    report = result.report
    assert report.fixes_accepted == fixes.true.sum() + 2
    assert report.fixes_refused == (~fixes.true).sum()
    kinds = {kind.name: kind for kind in report.kinds}
    assert {"stereo landmarks", "motions", "tilt", "start", "fixes"} <= set(kinds)
    assert kinds["fixes"].factors == fixes.true.sum()
    total = sum(kind.chi_square_after for kind in report.kinds)
    assert total == pytest.approx(2.0 * report.cost_after, rel=1e-9)
    assert len(report.worst) == 10
    incremental = smoother.trajectory()
    gap = result.trajectory.map_T_rover[:, :3, 3] - incremental.map_T_rover[:, :3, 3]
    assert np.abs(gap).max() < 0.05


def test_a_wrong_verdict_is_taken_back_in_the_whole_graph(fixed):
    run, fixes, smoother = fixed
    wrong = int(np.flatnonzero(~fixes.true)[0])
    entries = list(smoother.ledger)
    believed = replace(entries[wrong].ruling, verdict=Verdict.ACCEPTED, candidate=0)
    entries[wrong] = LedgerEntry(wrong, entries[wrong].measurement, (believed,))
    result = batch(run, entries, initial=smoother.trajectory())
    entry = result.ledger[wrong]
    assert entry.ruling.verdict is Verdict.REFUSED
    assert "taken back" in entry.ruling.reason
    named = [worst.name for worst in result.report.worst]
    assert all(not name.startswith("fix") for name in named)


def test_a_false_closure_is_taken_back_in_the_whole_graph_and_a_true_one_let_in(fixed):
    run, _, smoother = fixed
    entries = list(smoother.ledger)
    at = next(i for i, e in enumerate(entries) if e.base == 2)
    true = entries[at].measurement
    refused = replace(entries[at].ruling, verdict=Verdict.REFUSED, candidate=None)
    off = np.eye(4)
    off[2, 3] = 1.5
    false = replace(true, base=3, frame=37, a_T_b=np.linalg.inv(run.map_T_rover[3])
                    @ run.map_T_rover[37] @ off)  # fmt: skip
    entries[at] = LedgerEntry(at, true, (refused,))
    believed = replace(refused, candidate=0, verdict=Verdict.ACCEPTED)
    entries.append(LedgerEntry(len(entries), false, (believed,)))
    result = batch(run, entries, initial=smoother.trajectory())
    assert result.ledger[at].ruling.verdict is Verdict.ACCEPTED
    assert result.ledger[-1].ruling.verdict is Verdict.REFUSED


def test_the_last_vote_is_on_all(fixed):
    run, fixes, _ = fixed
    config = GraphConfig(fix_window=1)
    smoother = IncrementalSmoother(run.camera, run.rover_T_camera, run.start, config)
    for keyframe in run.keyframes:
        smoother.add(keyframe)
    for fix in fixes.fixes:
        smoother.add_fix(fix)
    smoother.finish()
    verdicts = [e.ruling.verdict is Verdict.ACCEPTED for e in smoother.ledger]
    assert verdicts == fixes.true.tolist()
