"""Trajectory files: round trips, detection by content, one-line errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from frontends.errors import InputError
from frontends.geometry import se3_exp
from lunar_fg.trajectory import PositionTrack, Trajectory
from lunar_fg.trajectory_io import (
    read_track,
    read_trajectory,
    tum_line,
    tum_text,
    write_kitti,
    write_tum,
)


@pytest.fixture
def trajectory() -> Trajectory:
    rng = np.random.default_rng(7)
    poses = np.array([se3_exp([*rng.normal(0, 1.0, 3), *rng.normal(0, 500, 3)]) for _ in range(20)])
    return Trajectory(1403715273.25 + np.arange(20) * 0.05, poses)


def test_tum_round_trip(tmp_path: Path, trajectory: Trajectory) -> None:
    write_tum(tmp_path / "a.tum", trajectory)
    found = read_trajectory(tmp_path / "a.tum")
    np.testing.assert_allclose(found.stamp_s, trajectory.stamp_s, atol=1e-6, rtol=0)
    np.testing.assert_allclose(found.map_T_rover, trajectory.map_T_rover, atol=2e-9, rtol=0)
    assert not found.indexed


def test_what_rounds_to_zero_has_no_sign() -> None:
    """Runs that differ in the last bit write the same file."""
    pose = np.eye(4)
    pose[:3, 3] = [-1e-12, 1e-12, -1e-10]
    pose[:3, :3] = se3_exp([-1e-14, 1e-14, 0.0, 0.0, 0.0, 0.0])[:3, :3]
    assert tum_line(1.0, pose) == tum_line(1.0, np.eye(4))


def test_tum_line_is_the_line_of_the_text(trajectory: Trajectory) -> None:
    line = tum_line(float(trajectory.stamp_s[3]), trajectory.map_T_rover[3])
    assert tum_text(trajectory).splitlines()[4] == line


def test_kitti_round_trip(tmp_path: Path, trajectory: Trajectory) -> None:
    write_kitti(tmp_path / "a.txt", trajectory)
    found = read_trajectory(tmp_path / "a.txt")
    np.testing.assert_allclose(found.map_T_rover, trajectory.map_T_rover, atol=1e-9, rtol=0)
    assert found.indexed
    np.testing.assert_array_equal(found.stamp_s, np.arange(20))


def test_evo_reads_what_is_written(tmp_path: Path, trajectory: Trajectory) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    write_tum(tmp_path / "a.tum", trajectory)
    write_kitti(tmp_path / "a.kitti", trajectory)
    tum = file_interface.read_tum_trajectory_file(tmp_path / "a.tum")
    kitti = file_interface.read_kitti_poses_file(tmp_path / "a.kitti")
    np.testing.assert_allclose(np.array(tum.poses_se3), trajectory.map_T_rover, atol=2e-9)
    np.testing.assert_allclose(np.array(kitti.poses_se3), trajectory.map_T_rover, atol=1e-9)


def test_euroc_ground_truth(tmp_path: Path) -> None:
    path = tmp_path / "data.csv"
    path.write_text(
        "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x []\n"
        "1403715274302142976,1,2,3,0,0,0,1,0,0,0,0,0,0,0,0,0\n"
        "1403715274307142976,1.5,2,3,1,0,0,0,0,0,0,0,0,0,0,0,0\n"
    )
    found = read_trajectory(path)
    np.testing.assert_allclose(found.stamp_s, [1403715274.302143, 1403715274.307143], atol=1e-6)
    np.testing.assert_allclose(np.diag(found.map_T_rover[0]), [-1, -1, 1, 1], atol=1e-12)
    np.testing.assert_allclose(np.diag(found.map_T_rover[1]), [1, 1, 1, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "planar", "stamps"),
    [
        ("stamp_s,x_m,y_m\n0.5,1,2\n1.5,3,4\n", True, [0.5, 1.5]),
        ("stamp_s,x_m,y_m,z_m\n0.5,1,2,9\n1.5,3,4,9\n", False, [0.5, 1.5]),
        ("frame,time_s,x_m,y_m\n0,0.5,1,2\n1,1.5,3,4\n", True, [0.5, 1.5]),
        ("0.5,1,2\n1.5,3,4\n", True, [0.5, 1.5]),
        (
            "#timestamp, x, y, z\n1403715274302142976,1,2,3\n1403715275302142976,3,4,3\n",
            False,
            None,
        ),
        ("frame,x_m,y_m\n4,1,2\n7,3,4\n", True, [4, 7]),
        ("\ufeffx_m, y_m, stamp_s\r\n1,2,0.5\r\n3,4,1.5\r\n", True, [0.5, 1.5]),
    ],
)
def test_position_tables(
    tmp_path: Path, text: str, planar: bool, stamps: list[float] | None
) -> None:
    path = tmp_path / "gt.csv"
    path.write_text(text, encoding="utf-8", newline="")
    found = read_track(path)
    assert isinstance(found, PositionTrack)
    assert found.planar == planar
    np.testing.assert_array_equal(found.position_m[:, :2], [[1, 2], [3, 4]])
    if stamps is not None:
        np.testing.assert_allclose(found.stamp_s, stamps)
    assert found.indexed == text.startswith("frame,x_m")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ["holds no pose"]),
        ("# only a comment\n", ["holds no pose"]),
        ("1 2 3 4 5\n", ["line 1", "5 columns"]),
        ("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0\n", ["line 2", "7 columns, 8", "cut off"]),
        ("0 1 2 3 0 0 0 1\n\n1 x 2 3 0 0 0 1\n", ["line 3", "'x' is not a number"]),
        ("0 1 2 3 0 0 0 1\n1 nan 2 3 0 0 0 1\n", ["line 2", "NaN"]),
        ("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 0.5\n", ["line 2", "norm 0.5"]),
        ("# c\n0 1 2 3 0 0 0 1\n0 1 2 3 0 0 0 1\n", ["line 3", "does not come after"]),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 2 0 0 0 0 1 0\n", ["line 2", "rigid"]),
        ("stamp_s,x_m,y\n0,1,2\n", None),
        ("stamp_s,x_n,y_m\n0,1,2\n", ["x_n", "unknown column", "'x_m'"]),
        ("stamp_s,y_m\n0,1\n", ["x_m", "missing"]),
        ("x_m,y_m\n0,1\n", ["stamp_s", "missing"]),
        ("stamp_s,x_m,y_m\n", ["holds no pose"]),
        ("stamp_s,x_m,y_m\n0,1,2\n1,2\n", ["line 3", "2 columns, 3"]),
    ],
)
def test_bad_files_are_one_line_errors(tmp_path: Path, text: str, parts: list[str] | None) -> None:
    path = tmp_path / "bad.txt"
    path.write_text(text)
    if parts is None:
        assert len(read_track(path)) == 1
        return
    with pytest.raises(InputError) as caught:
        read_track(path)
    message = str(caught.value)
    assert "\n" not in message
    for part in ["bad.txt", *parts]:
        assert part in message


def test_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        read_track(tmp_path / "none.txt")
    (tmp_path / "image.png").write_bytes(b"\x89PNG\xff\xfe\x00")
    with pytest.raises(InputError, match="not a text file"):
        read_track(tmp_path / "image.png")
    with pytest.raises(InputError, match="cannot be read"):
        read_track(tmp_path)


def test_positions_are_not_poses(tmp_path: Path) -> None:
    (tmp_path / "gt.csv").write_text("0,1,2\n1,2,3\n")
    with pytest.raises(InputError, match="without orientation"):
        read_trajectory(tmp_path / "gt.csv")


def test_real_files(shared_data: Path) -> None:
    kitti = read_trajectory(shared_data / "kitti-06-000-050" / "poses.txt")
    assert len(kitti) == 51
    assert kitti.distance_m == pytest.approx(59.9, abs=0.1)
    rover = read_track(shared_data / "moonranger-run1" / "ground_truth.csv")
    assert isinstance(rover, PositionTrack)
    assert rover.planar
    assert len(rover) == 128
    assert rover.stamp_s[0] == 0.92331
    euroc = read_trajectory(shared_data / "euroc-v101-still" / "gt_V1_01_first6s.txt")
    assert len(euroc) == 1199
    assert euroc.stamp_s[0] == pytest.approx(1403715274.30214, abs=1e-6)
