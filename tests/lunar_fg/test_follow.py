"""Following a folder that is being written."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from synthetic import arc, write_drive
from typer.testing import CliRunner, Result

from frontends.errors import InputError
from frontends.measurements import StereoFrame, UnusableFrame
from lunar_fg import follow
from lunar_fg.cli import app
from lunar_fg.follow import MARKER, FollowedFolder, Policy
from lunar_fg.run_folder import RunFolder

FRAMES = 8


def lunar_fg(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("drives") / "drive", arc(FRAMES))


@pytest.fixture
def live(drive: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "live"
    folder.mkdir()
    shutil.copy(drive / "traverse.yaml", folder)
    return folder


def deliver(drive: Path, live: Path, number: int, sides: tuple[str, ...] = ("left", "right")):
    for side in sides:
        (live / side).mkdir(exist_ok=True)
        shutil.copy(drive / side / f"{number:03d}.png", live / side)


def in_background(work) -> threading.Thread:
    thread = threading.Thread(target=work)
    thread.start()
    return thread


def test_pairs_come_in_order_as_they_arrive_and_the_marker_ends(drive, live) -> None:
    followed = FollowedFolder(live)

    def write() -> None:
        for number in range(4):
            deliver(drive, live, number, ("right",) if number % 2 else ("left",))
            time.sleep(0.05)
            deliver(drive, live, number, ("left",) if number % 2 else ("right",))
        (live / MARKER).touch()

    writer = in_background(write)
    frames = list(followed.frames())
    writer.join()
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    assert all(isinstance(frame, StereoFrame) for frame in frames)
    assert followed.arrivals.skipped == 0


def test_a_half_written_image_is_waited_for(drive, live, monkeypatch) -> None:
    deliver(drive, live, 0)
    deliver(drive, live, 1)
    target = live / "left" / "000.png"
    content = target.read_bytes()
    target.write_bytes(content[: len(content) // 2])

    def complete() -> None:
        time.sleep(0.5)
        target.write_bytes(content)
        (live / MARKER).touch()

    writer = in_background(complete)
    frames = list(FollowedFolder(live).frames())
    writer.join()
    assert [type(frame) for frame in frames] == [StereoFrame, StereoFrame]
    # and one that stays so is given up after a while, as is one without its partner
    monkeypatch.setattr(follow, "STALE_S", 0.3)
    target.write_bytes(content[: len(content) // 2])
    deliver(drive, live, 2, ("left",))
    frames = list(FollowedFolder(live).frames())
    assert [type(frame) for frame in frames] == [UnusableFrame, StereoFrame, UnusableFrame]
    assert "cut off" in frames[0].reason
    assert "one side" in frames[2].reason


def test_newest_skips_what_has_piled_up_and_counts_it(drive, live) -> None:
    for number in range(5):
        deliver(drive, live, number)
    (live / MARKER).touch()
    every = FollowedFolder(live)
    assert [frame.index for frame in every.frames()] == [0, 1, 2, 3, 4]
    newest = FollowedFolder(live, policy=Policy.NEWEST)
    frames = newest.frames()
    assert next(frames).index == 4
    deliver(drive, live, 6)
    deliver(drive, live, 5)
    assert [frame.index for frame in frames] == [6]
    assert newest.arrivals.skipped == 5


def test_a_late_pair_is_counted_not_taken(drive, live) -> None:
    deliver(drive, live, 3)
    followed = FollowedFolder(live, quiet_s=1.0)
    frames = followed.frames()
    assert next(frames).index == 3
    deliver(drive, live, 1)
    assert list(frames) == []
    assert followed.arrivals.late == 1


def test_it_ends_when_told(live) -> None:
    followed = FollowedFolder(live)
    timer = threading.Timer(0.3, followed.stop)
    timer.start()
    assert list(followed.frames()) == []


def test_a_run_says_each_estimate_at_once_and_sums_up(drive, live, tmp_path) -> None:
    for number in range(FRAMES):
        deliver(drive, live, number)
    run, lines = tmp_path / "run", tmp_path / "estimates.jsonl"
    options = ("--follow", "--quiet", 0.5, "--estimates", lines)
    result = lunar_fg("run", live, "-o", run, *options)
    assert result.exit_code == 0, result.output
    told = [json.loads(line) for line in lines.read_text().splitlines()]
    assert [line["frame"] for line in told] == list(range(FRAMES))
    assert told[-1]["x_m"] > 0.3
    summary = json.loads((run / "follow.json").read_text())
    assert summary["frames"] == FRAMES
    latency = summary["latency_ms"]
    assert 0.0 < latency["p50"] <= latency["p95"] <= latency["p99"] <= latency["max"]
    assert "latency" in result.stderr
    # the same run as of the finished folder
    whole = tmp_path / "whole"
    description = live / "traverse.yaml"
    assert lunar_fg("run", live, "--traverse", description, "-o", whole).exit_code == 0
    one, other = (RunFolder.open(path).tum_path.read_text() for path in (run, whole))
    assert one == other
    assert lunar_fg("resume", run).exit_code == 0
    assert RunFolder.open(run).tum_path.read_text() == one


def test_nothing_came(live, tmp_path) -> None:
    result = lunar_fg("run", live, "-o", tmp_path / "run", "--follow", "--quiet", 0.2)
    assert result.exit_code == 2
    assert "no frame" in result.stderr
    with pytest.raises(InputError, match="no such folder"):
        FollowedFolder(live / "none")


def test_ctrl_c_ends_it_cleanly(drive, live, tmp_path) -> None:
    run = tmp_path / "run"
    process = subprocess.Popen(
        [sys.executable, "-m", "lunar_fg.cli", "run", str(live), "-o", str(run), "--follow"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ,
    )  # fmt: skip
    deliver(drive, live, 0)
    deliver(drive, live, 1)
    told = [json.loads(process.stdout.readline()) for _ in range(2)]
    process.send_signal(signal.SIGINT)
    rest, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert [line["frame"] for line in told] == [0, 1]
    assert rest == ""
    assert json.loads((run / "metrics.json").read_text())["frames"] == 2
