"""Archives of arrays with random bytes changed or missing: read, or refused by name."""

from types import SimpleNamespace

import numpy as np
import pytest

from frontends.errors import InputError
from lunar_fg.bounded import MAX_BYTES
from lunar_fg.checkpoint import Checkpoint
from lunar_fg.run_folder import RunFolder
from lunar_fg.terrain_points import read_points
from lunar_fg.trajectory import Trajectory
from lunar_fg.trajectory_io import read_trajectory


def spoiled(data, seed):
    rng = np.random.default_rng(seed)
    changed = bytearray(data)
    for at in rng.integers(0, len(data), 1 + seed % 8):
        changed[at] = rng.integers(256)
    return bytes(changed[: rng.integers(1, len(data))] if seed % 5 == 0 else changed)


def test_points_of_the_ground(tmp_path):
    path, length = tmp_path / "points.npz", np.array([3, 4])
    np.savez_compressed(
        path, frame=[0, 1], length=length, points=np.zeros((7, 3), np.float32),
        sigma_m=np.ones(7, np.float32), grey=np.ones(7, np.float32), count=np.ones(7, np.int64),
    )  # fmt: skip
    assert len(read_points(path)) == 2
    sound, refused = path.read_bytes(), 0
    for seed in range(400):
        path.write_bytes(spoiled(sound, seed))
        try:
            read_points(path)
        except InputError:
            refused += 1
    assert refused > 100


def test_covariances_of_a_run(tmp_path):
    folder = RunFolder(tmp_path)
    poses = np.tile(np.eye(4), (5, 1, 1))
    trajectory = Trajectory(np.arange(5.0), poses, np.tile(np.eye(6), (5, 1, 1)))
    folder.write_trajectory(trajectory, rover_T_camera=np.eye(4))
    [archive] = tmp_path.glob("*.npz")
    sound, refused = archive.read_bytes(), 0
    for seed in range(400):
        archive.write_bytes(spoiled(sound, seed))
        try:
            folder.read_trajectory()
        except InputError:
            refused += 1
    assert refused > 100


def test_a_checkpoint_says_what_is_wrong():
    for data in (b"", b"PK", b"\x93NUMPY\x01\x00\xff\xff{'descr': '<f8', 'shape': (9" * 20):
        with pytest.raises((ValueError, KeyError, OSError, EOFError)):
            Checkpoint.from_bytes(data)


def test_a_table_larger_than_any_is_refused_unread(tmp_path, monkeypatch):
    path = tmp_path / "huge.tum"
    path.write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    assert len(read_trajectory(path)) == 2
    size = SimpleNamespace(st_size=MAX_BYTES + 1, st_mode=path.stat().st_mode)
    monkeypatch.setattr(type(path), "stat", lambda *_, **__: size)
    with pytest.raises(InputError, match="more than"):
        read_trajectory(path)
