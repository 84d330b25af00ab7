"""The fix ledger: kept bit for bit, printed, and overruled by a person."""

import dataclasses
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from frontends.errors import InputError
from frontends.measurements import AbsoluteFix, FixCandidate, Verdict
from lunar_fg.cli import app
from lunar_fg.config import Config
from lunar_fg.evaluation import Metrics
from lunar_fg.graph import IncrementalSmoother, feed
from lunar_fg.graph.planar import planar
from lunar_fg.ledger import overrule, read_ledger
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import RunHeader
from lunar_fg.run_folder import RunFolder
from lunar_fg.simulation.measurements import TraverseSpec, simulate
from lunar_fg.trajectory import Trajectory
from lunar_fg.truth import as_trajectory, compare

COVARIANCE = np.diag([0.01, 0.01, 1e-4])


def fix(run, frame, off=(0.0, 0.0), **more):
    x, y, yaw = planar(run.map_T_rover[frame])
    places = (
        FixCandidate(x + off[0], y + off[1], yaw, COVARIANCE, 0.8, "image [match]", 31),
        FixCandidate(x + 40.0, y, yaw, COVARIANCE, 0.3, "relief", 7),
    )
    return AbsoluteFix(frame, places, 0.4, window_m=(-9.0, -8.0, 7.0, 6.5), **more)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A blind run of 41 keyframes with good and bad fixes, a closure and a height."""
    run = simulate(TraverseSpec(keyframes=41, landmarks=0, odometry=True, tilt=True), seed=2)
    folder = RunFolder.create(tmp_path_factory.mktemp("runs") / "one", Config())
    header = RunHeader(run.camera, run.rover_T_camera, run.start, Config().model_dump_json())
    smoother = IncrementalSmoother(run.camera, run.rover_T_camera, run.start)
    with TraverseLog.create(folder.database_path, header) as log:
        for keyframe in run.keyframes:
            estimate = smoother.add(keyframe)
            decisions = []
            if keyframe.index == 12:
                decisions = [
                    smoother.add_fix(fix(run, 10, height_m=0.0, sigma_height_m=2.0)),
                    smoother.add_fix(AbsoluteFix(11, reason="too dark")),
                ]
            if keyframe.index == 20:
                decisions = [smoother.add_fix(fix(run, 20, (0.0, 6.0)))]
            if keyframe.index == 30:
                motion = np.linalg.inv(run.map_T_rover[3]) @ run.map_T_rover[30]
                decisions = [
                    smoother.add_relative(3, 30, motion, 1e-3 * np.eye(6)),
                    smoother.add_height(29, float(run.map_T_rover[29, 2, 3]), 0.3),
                    smoother.add_fix(fix(run, 30)),
                ]
            log.append(keyframe, estimate, decisions=decisions)
    smoother.finish()
    trajectory = smoother.trajectory()
    return run, folder, smoother.ledger, trajectory


def same(a, b):
    if dataclasses.is_dataclass(a):
        assert type(a) is type(b)
        for field in dataclasses.fields(a):
            same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for left, right in zip(a, b, strict=True):
            same(left, right)
    else:
        np.testing.assert_array_equal(a, b)


def test_the_log_gives_the_ledger_back(recorded):
    _, folder, ledger, _ = recorded
    same(tuple(read_ledger(folder)), ledger)
    verdicts = {(e.base, e.frame): e.ruling.verdict is Verdict.ACCEPTED for e in ledger}
    assert verdicts == {
        (None, 10): True, (None, 11): False, (None, 20): False, (3, 30): True, (None, 29): True,
        (None, 30): True,
    }  # fmt: skip


def test_a_replay_ends_where_the_run_ended(recorded):
    run, folder, ledger, trajectory = recorded
    with TraverseLog.open(folder.database_path) as log:
        keyframes = log.keyframes()
    again = IncrementalSmoother(run.camera, run.rover_T_camera, run.start)
    assert len(list(feed(again, keyframes, read_ledger(folder)))) == 41
    again.finish()
    np.testing.assert_array_equal(again.trajectory().map_T_rover, trajectory.map_T_rover)
    same(again.ledger, ledger)


def call(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_the_command_prints_and_overrules(recorded, tmp_path):
    run, folder, _, trajectory = recorded
    stamps = np.array([keyframe.stamp_s for keyframe in run.keyframes])
    folder.write_truth(Trajectory(stamps, run.map_T_rover))
    folder.write_trajectory(as_trajectory(trajectory))
    accuracy = compare(as_trajectory(trajectory), folder.read_truth())
    warnings = ["of the run"]
    metrics = Metrics.of_run(accuracy, frames=41, frames_lost=3, warnings=warnings)
    folder.write_metrics(metrics)
    table = call("fixes", folder.path)
    assert table.exit_code == 0, table.output
    for word in ("image [match]", "0.80", "31", "0.40", "too dark", "refused", "3-30", "gate"):
        assert word in table.output
    result = call("fixes", folder.path, "--accept", 20)
    assert result.exit_code == 0, result.output
    moved = folder.read_trajectory().map_T_rover[20, :2, 3] - trajectory.map_T_rover[20, :2, 3]
    assert np.linalg.norm(moved) > 0.3
    worse = folder.read_metrics()
    assert worse["ate_rmse_m"]["none"] > 1.2 * metrics.ate_rmse_m.none
    assert (worse["frames_lost"], worse["warnings"]) == (3, [*warnings, *accuracy.warnings])
    again = json.loads(call("fixes", folder.path, "--reject", 20, "--json").output)
    entry = next(e for e in again if e["keyframe"] == 20)
    assert [past["by_person"] for past in entry["history"]] == [False, True, True]
    assert [past["verdict"] for past in entry["history"]] == ["refused", "accepted", "refused"]
    back = folder.read_trajectory().map_T_rover[:, :3, 3]
    np.testing.assert_allclose(back, trajectory.map_T_rover[:, :3, 3], atol=5e-3)
    assert folder.read_metrics()["ate_rmse_m"]["none"] == pytest.approx(
        metrics.ate_rmse_m.none, rel=0.05
    )
    for arguments in (
        ("--accept", 5),
        ("--accept", 20, "--candidate", 2),
        ("--reject", 30, "--base", 4),
        ("--accept", 11),
        ("--accept", 10, "--reject", 20),
    ):
        failed = call("fixes", folder.path, *arguments)
        assert failed.exit_code == 2, arguments
    assert call("fixes", tmp_path).exit_code == 2


def test_a_written_ruling_is_not_written_twice(recorded):
    _, folder, _, _ = recorded
    decision = overrule(folder, 10, candidate=None)
    overrule(folder, 10, candidate=0)
    with (
        TraverseLog.reopen(folder.database_path) as log,
        pytest.raises(InputError, match="in the log already"),
    ):
        log.append_decisions([decision])
