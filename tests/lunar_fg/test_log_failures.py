"""Disks that are full, folders that may not be written, logs that are damaged or in use."""

from __future__ import annotations

import json
import os
import resource
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from synthetic import arc, write_drive

from frontends.errors import InputError
from lunar_fg.checkpoint import Checkpoint
from lunar_fg.graph import IncrementalSmoother
from lunar_fg.log import SCHEMA_VERSION, TraverseLog
from lunar_fg.log_entries import RunHeader
from lunar_fg.log_file import LogFile
from lunar_fg.simulation.measurements import TraverseSpec, simulate

DRIVE = simulate(TraverseSpec(keyframes=12, landmarks=40, odometry=True, tilt=True), seed=3)
HEADER = RunHeader(DRIVE.camera, DRIVE.rover_T_camera, DRIVE.start)


def entries():
    smoother = IncrementalSmoother(DRIVE.camera, DRIVE.rover_T_camera, DRIVE.start)
    return [(keyframe, smoother.add(keyframe)) for keyframe in DRIVE.keyframes]


def test_a_full_database_is_one_clear_error_and_keeps_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "run.db"
    with TraverseLog.create(path, HEADER) as log:
        (pages,) = log._file.connection.execute("PRAGMA page_count").fetchone()
        log._file.connection.execute(f"PRAGMA max_page_count={pages + 15}")

        def fill() -> None:
            for keyframe, estimate in entries():
                log.append(keyframe, estimate)

        with pytest.raises(InputError, match=r"cannot be written.*full.*logged before is kept"):
            fill()
        written = len(log.keyframes())
    assert 0 < written < len(DRIVE.keyframes)
    with TraverseLog.open(path) as log:
        assert [keyframe.index for keyframe in log.keyframes()] == list(range(written))
        assert len(log.estimates()) == written
    with TraverseLog.reopen(path) as log:  # and goes on when there is room again
        for keyframe, estimate in entries()[written:]:
            log.append(keyframe, estimate)
        assert len(log.keyframes()) == len(DRIVE.keyframes)


def test_a_full_disk_ends_a_run_with_one_line_and_what_was_written_can_be_resumed(
    tmp_path: Path,
) -> None:
    """The file-size limit of the process stands in for the disk."""
    drive = write_drive(tmp_path / "drive", arc(8))
    run = tmp_path / "run"
    command = [sys.executable, "-m", "lunar_fg.cli"]

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_500_000, 1_500_000))

    full = subprocess.run(
        [*command, "run", str(drive), "-o", str(run)],
        preexec_fn=limit, capture_output=True, text=True, env=os.environ, check=False,
    )  # fmt: skip
    assert full.returncode == 2, full.stderr
    assert "error: " in full.stderr
    assert "cannot be written" in full.stderr
    assert "Traceback" not in full.stderr
    with TraverseLog.open(run / "run.db") as log:
        kept = len(log.keyframes())
    assert 0 < kept < 8
    resumed = subprocess.run(
        [*command, "resume", str(run)], capture_output=True, text=True, env=os.environ, check=False
    )
    assert resumed.returncode == 0, resumed.stderr
    assert json.loads((run / "metrics.json").read_text())["frames"] == 8


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written_is_named(tmp_path: Path) -> None:
    locked = tmp_path / "locked"
    locked.mkdir()
    locked.chmod(0o500)
    with pytest.raises(InputError, match="cannot be written"):
        TraverseLog.create(locked / "run.db", HEADER)


def written_log(path: Path) -> Path:
    with TraverseLog.create(path, HEADER) as log:
        for keyframe, estimate in entries():
            log.append(keyframe, estimate)
    return path


def test_a_log_on_a_read_only_place_can_be_read_but_not_gone_on_with(tmp_path: Path) -> None:
    path = written_log(tmp_path / "run.db")
    before = path.read_bytes()
    read_only = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
    log = TraverseLog(LogFile(path, read_only))
    with pytest.raises(InputError, match=r"cannot be written.*readonly"):
        log.append(*entries()[0])
    log.close()
    assert path.read_bytes() == before


def test_a_log_is_whole_for_a_reader_at_any_moment_of_its_writer(tmp_path: Path) -> None:
    path = tmp_path / "run.db"
    with TraverseLog.create(path, HEADER) as writer:
        for count, (keyframe, estimate) in enumerate(entries(), start=1):
            writer.append(keyframe, estimate, checkpoint=Checkpoint(next_id=count))
            with TraverseLog.open(path) as reader:
                assert len(reader.frames()) == count
                assert reader.checkpoint()[1].next_id == count


def test_other_versions_and_damage_are_named(tmp_path: Path) -> None:
    path = written_log(tmp_path / "run.db")
    other = Path(shutil.copy(path, tmp_path / "other.db"))
    with sqlite3.connect(other) as db:
        db.execute(f"PRAGMA user_version={SCHEMA_VERSION + 1}")
    db.close()
    for opening in (TraverseLog.open, TraverseLog.reopen):
        with pytest.raises(InputError, match=f"schema version {SCHEMA_VERSION + 1}"):
            opening(other)
    damaged = tmp_path / "damaged.db"
    content = bytearray(path.read_bytes())
    content[4096 * 5 : 4096 * 9] = os.urandom(4096 * 4)
    damaged.write_bytes(content)
    with pytest.raises(InputError, match=r"damaged|readable"):
        TraverseLog.reopen(damaged)


def test_a_damaged_checkpoint_is_named(tmp_path: Path) -> None:
    path = tmp_path / "run.db"
    with TraverseLog.create(path, HEADER) as log:
        log.append(*entries()[0], checkpoint=Checkpoint())
        for damage in (b"", b"not an archive", Checkpoint().to_bytes()[:-40]):
            log._file.connection.execute("UPDATE checkpoint SET state = ?", (damage,))
            with pytest.raises(InputError, match="damaged checkpoint"):
                log.checkpoint()


def test_a_checkpoint_comes_back_bit_for_bit() -> None:
    from frontends.disparity_check import DisparityFinding
    from frontends.landmark_memory import LandmarkMemory
    from frontends.rectification import RectificationError
    from frontends.templates import Templates

    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (60, 80)).astype(np.uint8)
    templates = Templates.cut(image, rng.uniform(20.0, 40.0, (5, 2)))
    memory = LandmarkMemory(
        np.arange(5), rng.random((5, 64), dtype=np.float32), np.ones(5, np.int8),
        rng.random((5, 3)), rng.random((5, 3, 3)), np.zeros(5, np.int64),
        rng.random(5), rng.random((5, 2)), templates,
    )  # fmt: skip
    finding = DisparityFinding(rng.random(3), rng.random(3), rng.random(3), 1e-7, True, 31)
    rectification = RectificationError(rng.random(6), rng.random(3))
    before = Checkpoint(
        memory, 9, rectification, True, (b"l" * 16, b"\0" * 16), False, 4, finding, True
    )
    after = Checkpoint.from_bytes(before.to_bytes())
    assert after.to_bytes() == before.to_bytes()
    np.testing.assert_array_equal(after.memory.descriptors, memory.descriptors)
    assert after.memory.descriptors.dtype == np.float32
    np.testing.assert_array_equal(after.memory.templates.pixels, templates.pixels)
    assert (after.images, after.watching, after.corrected) == (before.images, False, True)
    assert after.finding.pairs == 31
    assert Checkpoint.from_bytes(Checkpoint().to_bytes()).memory is None
