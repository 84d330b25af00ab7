"""An interrupted run goes on as if it had not been: from copies of its log, and after kills."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from synthetic import Scene, arc, write_drive
from typer.testing import CliRunner, Result

from frontends.errors import InputError
from lunar_fg import runs, sittings
from lunar_fg.cli import app
from lunar_fg.config import Config, read_config
from lunar_fg.datasets import open_dataset
from lunar_fg.log import TraverseLog
from lunar_fg.run_folder import RunFolder

FRAMES = 16
#: The disparity check judges early, so that there are interruptions before and after.
SETTINGS = {"disparity_check": {"frames": 6}, "graph": {"segment_keyframes": 4}}


def lunar_fg(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def error_of(result: Result) -> str:
    assert result.exit_code == 2, result.output
    return next(line for line in result.stderr.splitlines() if line.startswith("error: "))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("resume")


@pytest.fixture(scope="module")
def drive(place: Path) -> Path:
    """A drive whose disparities are wrong, so that the run corrects itself on the way."""
    return write_drive(place / "drive", arc(FRAMES), wheels=True, scene=Scene(disparity_px=0.8))


@pytest.fixture(scope="module")
def settings(place: Path) -> Path:
    (place / "settings.yaml").write_text(yaml.safe_dump(SETTINGS))
    return place / "settings.yaml"


@pytest.fixture(scope="module")
def snapshots(drive: Path, settings: Path, place: Path) -> list[Path]:
    """The folder of one run as it was after each frame, and last as it was in the end."""
    folder = RunFolder.create(place / "whole", read_config(settings))
    copies: list[Path] = []

    def copy(_: object = None) -> None:
        copies.append(place / f"after-{len(copies)}")
        # the index of the journal belongs to the process
        shutil.copytree(folder.path, copies[-1], ignore=shutil.ignore_patterns("*-shm"))

    runs.run(open_dataset(drive), folder, read_config(settings), copy)
    copy()
    return copies


def same_results(one: Path, other: Path) -> None:
    a, b = RunFolder.open(one), RunFolder.open(other)
    assert a.tum_path.read_text() == b.tum_path.read_text()
    left, right = a.read_trajectory(), b.read_trajectory()
    np.testing.assert_allclose(left.covariance, right.covariance, rtol=1e-9, atol=1e-15)
    with TraverseLog.open(a.database_path) as first, TraverseLog.open(b.database_path) as second:
        for x, y in zip(first.frames(), second.frames(), strict=True):
            np.testing.assert_array_equal(x.estimate.map_T_rover, y.estimate.map_T_rover)
            assert repr(x.record) == repr(y.record)
    found, expected = a.read_metrics(), b.read_metrics()
    for metrics in (found, expected):
        metrics.pop("timing_ms")
    assert found == expected


@pytest.mark.parametrize("frames", [1, 2, 6, 7, 8, 9, 13, FRAMES])
def test_a_run_goes_on_from_any_frame(snapshots: list[Path], drive: Path, frames: int) -> None:
    folder = RunFolder.open(snapshots[frames - 1])
    with TraverseLog.open(folder.database_path) as log:
        assert len(log.keyframes()) == frames
    sittings.resume(open_dataset(drive), folder)
    same_results(folder.path, snapshots[-1])


def test_the_run_did_correct_itself(snapshots: list[Path]) -> None:
    warnings = RunFolder.open(snapshots[-1]).read_metrics()["warnings"]
    assert any("disparity error" in text and "; removed" in text for text in warnings)


def test_a_finished_run_may_be_resumed(snapshots: list[Path], tmp_path: Path) -> None:
    folder = Path(shutil.copytree(snapshots[-1], tmp_path / "again"))
    result = lunar_fg("resume", folder)
    assert result.exit_code == 0, result.output
    same_results(folder, snapshots[-1])


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "lunar_fg.cli", *map(str, arguments)]


def killed_after(arguments: list[str], database: Path, delay_s: float) -> bool:
    """Run a command and kill it some time after its log appeared; False when it ended before."""
    process = subprocess.Popen(
        arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=os.environ
    )
    deadline = time.monotonic() + 120.0
    before = database.stat().st_mtime_ns if database.exists() else None
    while process.poll() is None and time.monotonic() < deadline:
        wal = database.with_name("run.db-wal")
        if wal.exists() and wal.stat().st_size > 0 and wal.stat().st_mtime_ns != before:
            break
        time.sleep(0.01)
    time.sleep(delay_s)
    alive = process.poll() is None
    process.send_signal(signal.SIGKILL)
    process.wait()
    return alive


def test_kill_9_at_random_moments(
    snapshots: list[Path], drive: Path, settings: Path, tmp_path: Path
) -> None:
    """Several kills of one run: each resumption is killed again until the last."""
    folder, moments = tmp_path / "killed", random.Random(4)
    start = command("run", drive, "-o", folder, "--config", settings)
    kills = killed_after(start, folder / "run.db", 0.5 * moments.random())
    for _ in range(2):
        again = command("resume", folder)
        kills += killed_after(again, folder / "run.db", 0.5 * moments.random())
    result = lunar_fg("resume", folder)
    assert result.exit_code == 0, result.output
    assert kills >= 1
    same_results(folder, snapshots[-1])


def test_one_writer_at_a_time(snapshots: list[Path], drive: Path, tmp_path: Path) -> None:
    folder = RunFolder.open(shutil.copytree(snapshots[4], tmp_path / "run"))
    with (
        TraverseLog.reopen(folder.database_path),
        pytest.raises(InputError, match="another process"),
    ):
        sittings.resume(open_dataset(drive), folder)
    sittings.resume(open_dataset(drive), folder)


def test_what_cannot_be_resumed_is_named(
    snapshots: list[Path], drive: Path, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(snapshots[4], tmp_path / "run"))
    other = tmp_path / "other"
    shutil.copytree(drive, other)
    text = (other / "traverse.yaml").read_text()
    (other / "traverse.yaml").write_text(text.replace('"fx": 240.0', '"fx": 241.0'))
    assert "camera" in error_of(lunar_fg("resume", folder, "--dataset", other))
    assert "does not exist" in error_of(lunar_fg("resume", folder, "--dataset", tmp_path / "no"))
    assert "no such folder" in error_of(lunar_fg("resume", tmp_path / "no"))
    (folder / "run.db").unlink()
    (folder / "run.db-wal").unlink(missing_ok=True)
    assert "run.db" in error_of(lunar_fg("resume", folder))


def test_injected_faults_are_injected_again(drive: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert lunar_fg("run", drive, "-o", run, "--inject", "frozen@4-5").exit_code == 0
    before = (run / "trajectory.tum").read_text()
    with TraverseLog.reopen(run / "run.db") as log:
        assert log.sittings()[0].faults == ("frozen@4-5",)
        unusable = [frame.record.unusable for frame in log.frames()]
        assert all("frame before" in text for text in unusable[4:6])
    assert lunar_fg("resume", run).exit_code == 0
    assert (run / "trajectory.tum").read_text() == before


def test_replay_with_the_same_settings_gives_the_same(
    snapshots: list[Path], tmp_path: Path
) -> None:
    result = lunar_fg("replay", snapshots[-1], "-o", tmp_path / "same")
    assert result.exit_code == 0, result.output
    a, b = (RunFolder.open(path) for path in (snapshots[-1], tmp_path / "same"))
    assert a.tum_path.read_text() == b.tum_path.read_text()
    assert "itself" in error_of(lunar_fg("replay", snapshots[-1], "-o", snapshots[-1]))


def test_replay_with_other_settings_takes_them(snapshots: list[Path], tmp_path: Path) -> None:
    (tmp_path / "other.yaml").write_text("graph: {landmarks: full}\nmotion: {slip: 0.5}\n")
    config = tmp_path / "other.yaml"
    result = lunar_fg("replay", snapshots[-1], "--config", config, "-o", tmp_path / "full")
    assert result.exit_code == 0, result.output
    with (
        TraverseLog.open(snapshots[-1] / "run.db") as log,
        TraverseLog.open(tmp_path / "full" / "run.db") as other,
    ):
        assert Config.model_validate_json(other.header().config_json).graph.landmarks == "full"
        before, after = log.keyframes()[3], other.keyframes()[3]
    assert after.odometry.covariance[3, 3] > 10.0 * before.odometry.covariance[3, 3]
    np.testing.assert_array_equal(after.observations.u_left, before.observations.u_left)
    a, b = (RunFolder.open(path).read_trajectory() for path in (snapshots[-1], tmp_path / "full"))
    gap = np.linalg.norm(a.positions - b.positions, axis=1).max()
    assert 0.0 < gap < 0.05
    # a log without images' side is no run to go on with
    assert "replay" in error_of(lunar_fg("resume", tmp_path / "full"))


@pytest.fixture(scope="module")
def two_sittings(place: Path) -> tuple[Path, Path]:
    poses = arc(2 * FRAMES)
    first = write_drive(place / "sol-1", poses[:FRAMES])
    second = write_drive(place / "sol-2", poses[FRAMES - 1 :], first_s=88_000.0)
    return first, second


def test_a_second_sitting_goes_on_with_the_run(
    two_sittings: tuple[Path, Path], tmp_path: Path
) -> None:
    first, second = two_sittings
    run = tmp_path / "run"
    assert lunar_fg("run", first, "-o", run).exit_code == 0
    result = lunar_fg("run", second, "-o", run, "--append")
    assert result.exit_code == 0, result.output
    trajectory = RunFolder.open(run).read_trajectory()
    metrics = json.loads((run / "metrics.json").read_text())
    assert len(trajectory) == 2 * FRAMES + 1 == metrics["frames"]
    # parked over night where it stopped: the landmarks are found again
    assert metrics["frames_lost"] == 0
    assert metrics["ate_rmse_m"]["se3"] < 0.02 * metrics["distance_m"]
    with TraverseLog.open(run / "run.db") as log:
        assert [frame.keyframe.index for frame in log.frames()] == list(range(2 * FRAMES + 1))
        assert [sitting.dataset for sitting in log.sittings()] == [str(first), str(second)]
    before = (run / "trajectory.tum").read_text()
    assert lunar_fg("resume", run).exit_code == 0
    assert (run / "trajectory.tum").read_text() == before


def test_a_sitting_that_does_not_follow_is_named(
    two_sittings: tuple[Path, Path], tmp_path: Path
) -> None:
    first, second = two_sittings
    run = tmp_path / "run"
    assert lunar_fg("run", first, "-o", run).exit_code == 0
    assert "--gap" in error_of(lunar_fg("run", first, "-o", run, "--append"))
    assert lunar_fg("run", second, "-o", run, "--append", "--seed", 3).exit_code == 2
    assert lunar_fg("run", first, "-o", run, "--append", "--gap", 3600).exit_code == 0
    trajectory = RunFolder.open(run).read_trajectory()
    assert trajectory.stamp_s[FRAMES] - trajectory.stamp_s[FRAMES - 1] == pytest.approx(3600.0)
    # it jumped back to the start, of which the images say nothing: told by the covariance
    jump = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)[FRAMES - 1]
    sigma = np.sqrt(np.trace(trajectory.covariance[FRAMES][3:, 3:]))
    assert jump < 3.0 * max(sigma, 1.0)
