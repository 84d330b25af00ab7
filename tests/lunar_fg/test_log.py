"""The log gives back what was written, bit for bit, and survives what happens to files."""

import dataclasses
import sqlite3

import numpy as np
import pytest

from frontends.errors import InputError
from frontends.measurements import RelativePose, Verdict
from lunar_fg.graph import IncrementalSmoother, optimize_batch
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import RunHeader
from lunar_fg.simulation.measurements import TraverseSpec, simulate


@pytest.fixture(scope="module")
def traverse():
    run = simulate(TraverseSpec(keyframes=13, landmarks=30, odometry=True, tilt=True), seed=1)
    keyframes = list(run.keyframes)
    refused = RelativePose(
        np.eye(4), np.eye(6), np.arange(2), 9, Verdict.REFUSED, "9 'odd' \N{DEGREE SIGN}"
    )
    keyframes[3] = dataclasses.replace(keyframes[3], observations=None, relative=refused)
    keyframes[4] = dataclasses.replace(keyframes[4], odometry=None, tilt=None)
    return dataclasses.replace(run, keyframes=tuple(keyframes))


@pytest.fixture
def written(traverse, tmp_path):
    header = RunHeader(traverse.camera, traverse.rover_T_camera, traverse.start, '{"a": 1}')
    smoother = IncrementalSmoother(traverse.camera, traverse.rover_T_camera, traverse.start)
    estimates = []
    with TraverseLog.create(tmp_path / "run.db", header) as log:
        for keyframe in traverse.keyframes:
            estimates.append(smoother.add(keyframe))
            log.append(keyframe, estimates[-1])
    return tmp_path / "run.db", header, estimates


def same(a, b):
    if dataclasses.is_dataclass(a):
        assert type(a) is type(b)
        for field in dataclasses.fields(a):
            same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, list):
        assert len(a) == len(b)
        for left, right in zip(a, b, strict=True):
            same(left, right)
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        assert a.tobytes() == b.tobytes()
    else:
        assert a == b
        assert type(a) is type(b)


def test_reads_back_bit_for_bit(written, traverse):
    path, header, estimates = written
    with TraverseLog.open(path) as log:
        same(log.header(), header)
        for got, expected in zip(log.keyframes(), traverse.keyframes, strict=True):
            same(got, expected)
        for got, expected in zip(log.estimates(), estimates, strict=True):
            same(got, expected)
    assert [p.name for p in path.parent.iterdir()] == ["run.db"]


def test_optimize_needs_the_log_only(written, traverse):
    with TraverseLog.open(written[0]) as log:
        header, keyframes = log.header(), log.keyframes()
    again = optimize_batch(header.camera, header.rover_T_camera, header.start, keyframes)
    direct = optimize_batch(
        traverse.camera, traverse.rover_T_camera, traverse.start, traverse.keyframes
    )
    np.testing.assert_array_equal(again.trajectory.map_T_rover, direct.trajectory.map_T_rover)


def test_a_writer_can_be_read(written, traverse, tmp_path):
    header = written[1]
    with TraverseLog.create(tmp_path / "live.db", header) as writer:
        writer.append(traverse.keyframes[0], written[2][0])
        with TraverseLog.open(tmp_path / "live.db") as reader:
            assert len(reader.keyframes()) == 1
            writer.append(traverse.keyframes[1], written[2][1])
            assert len(reader.keyframes()) == 2


def test_a_keyframe_is_written_whole_or_not_at_all(written, traverse, tmp_path):
    _, header, estimates = written
    with TraverseLog.create(tmp_path / "new.db", header) as log:
        log.append(traverse.keyframes[0], estimates[0])
        with pytest.raises(InputError, match="in the log already"):
            log.append(traverse.keyframes[0], estimates[0])
        broken = dataclasses.replace(estimates[1], used=(object(),))
        with pytest.raises(TypeError):
            log.append(traverse.keyframes[1], broken)
        assert [k.index for k in log.keyframes()] == [0]
        log.append(traverse.keyframes[1], estimates[1])
        assert len(log.estimates()) == 2


def test_rewrite_replaces_all_or_nothing(written, traverse, tmp_path):
    _, header, estimates = written
    corrected = [
        dataclasses.replace(k, relative=dataclasses.replace(k.relative, reason="measured anew"))
        for k in traverse.keyframes[1:4]
    ]
    with TraverseLog.create(tmp_path / "new.db", header) as log:
        for keyframe, estimate in zip(traverse.keyframes[:6], estimates, strict=False):
            log.append(keyframe, estimate)
        entries = list(zip(corrected, estimates[4:7], strict=True))
        with pytest.raises(InputError, match="keyframe 2"):
            log.rewrite([*entries, entries[1]])
        broken = dataclasses.replace(estimates[1], refused=(object(),))
        with pytest.raises(TypeError):
            log.rewrite([entries[0], (corrected[1], broken)])
        assert [k.index for k in log.keyframes()] == list(range(6))
        same(log.keyframes()[3], traverse.keyframes[3])
        log.rewrite(entries)
        same(log.keyframes(), corrected)
        got = log.estimates()
        assert [e.index for e in got] == [1, 2, 3]
        np.testing.assert_array_equal(got[0].map_T_rover, estimates[4].map_T_rover)
        same(log.header(), header)
        log.append(traverse.keyframes[9], estimates[9])
        assert [k.index for k in log.keyframes()] == [1, 2, 3, 9]
        log.rewrite([])
        assert log.keyframes() == []
        assert log.estimates() == []


def test_a_reader_sees_the_old_keyframes_until_a_rewrite_is_whole(written, traverse, tmp_path):
    _, header, estimates = written
    with TraverseLog.create(tmp_path / "live.db", header) as log:
        log.append(traverse.keyframes[0], estimates[0])
        with TraverseLog.open(tmp_path / "live.db") as reader:
            assert [k.index for k in reader.keyframes()] == [0]
            log.rewrite([(traverse.keyframes[1], estimates[1])])
            assert [k.index for k in reader.keyframes()] == [1]


def test_bad_files_are_named(written, tmp_path):
    path, header, _ = written
    with pytest.raises(InputError, match="missing"):
        TraverseLog.open(tmp_path / "none.db")
    with pytest.raises(InputError, match="exists"):
        TraverseLog.create(path, header)
    with pytest.raises(InputError, match="cannot be written"):
        TraverseLog.create(tmp_path / "no" / "folder.db", header)
    (tmp_path / "text.db").write_text("not a database " * 100)
    with pytest.raises(InputError, match="not a readable log"):
        TraverseLog.open(tmp_path / "text.db")
    data = bytearray(path.read_bytes())
    data[len(data) // 2 :] = bytes(len(data) - len(data) // 2)
    (tmp_path / "half.db").write_bytes(data)
    with pytest.raises(InputError, match=r"damaged|readable"):
        TraverseLog.open(tmp_path / "half.db")
    sqlite3.connect(tmp_path / "empty.db").close()
    (tmp_path / "empty.db").touch()
    with pytest.raises(InputError, match="schema version 0"):
        TraverseLog.open(tmp_path / "empty.db")


def test_a_pickled_array_is_refused(written):
    path = written[0]
    with sqlite3.connect(path) as db:
        import io

        buffer = io.BytesIO()
        np.save(buffer, np.array([{"a": 1}], dtype=object), allow_pickle=True)
        db.execute("UPDATE relative SET pose = ? WHERE frame = 2", (buffer.getvalue(),))
    db.close()
    with TraverseLog.open(path) as log, pytest.raises(InputError, match="keyframe 2"):
        log.keyframes()
