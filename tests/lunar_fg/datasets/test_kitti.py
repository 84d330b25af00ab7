from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dataset_files import kitti_projection, textured, write_image

from frontends.camera import level_rover_T_camera
from frontends.errors import InputError
from frontends.geometry import is_rigid
from frontends.measurements import StereoFrame
from lunar_fg.datasets import open_dataset


def refusal(path: Path, *parts: str) -> None:
    """Open a bad sequence: one line with file, field or line, and remedy."""
    with pytest.raises(InputError) as caught:
        open_dataset(path)
    error = caught.value
    assert "\n" not in str(error)
    assert error.source
    assert error.field
    assert error.remedy
    for part in parts:
        assert part in str(error)


def test_official_layout(kitti):
    dataset = open_dataset(kitti)
    assert (dataset.name, len(dataset)) == ("06", 4)
    assert dataset.camera.baseline_m == 0.5
    assert "0.1 s apart" in dataset.notes[0]
    np.testing.assert_allclose(dataset.rover_T_camera, level_rover_T_camera())
    frames = list(dataset.frames())
    assert [frame.stamp_s for frame in frames] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(frames[3].right, textured(31))
    truth = dataset.ground_truth
    np.testing.assert_allclose(truth.map_T_rover[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(truth.position_m, [[i, 0, 0] for i in range(4)], atol=1e-12)


def test_colour_pair_and_its_offset(kitti):
    (kitti / "image_0").rename(kitti / "image_2")
    (kitti / "image_1").rename(kitti / "image_3")
    dataset = open_dataset(kitti)
    assert dataset.camera.baseline_m == pytest.approx(25 / 50)
    # P2's fourth column is +3: camera 2 lies 3/50 m left of camera 0.
    np.testing.assert_allclose(dataset.rover_T_camera[:3, 3], [0, 0.06, 0], atol=1e-12)


def test_bare_rows_and_times(kitti):
    (kitti / "image_0").rename(kitti / "image_l")
    (kitti / "image_1").rename(kitti / "image_r")
    (kitti / "calib.txt").write_text(kitti_projection(0) + "\n" + kitti_projection(-25))
    (kitti / "times.txt").write_text("0\n0.5\n1e0\n2")
    dataset = open_dataset(kitti)
    assert dataset.camera.baseline_m == 0.5
    assert dataset.notes == ()
    assert [frame.stamp_s for frame in dataset.frames()] == [0.0, 0.5, 1.0, 2.0]
    (kitti / "calib.txt").write_text(kitti_projection(0) + " " + kitti_projection(-25))
    assert open_dataset(kitti).camera.baseline_m == 0.5


def test_frame_numbers_come_from_the_names(kitti):
    for side in ("image_0", "image_1"):
        for number in (2, 1):
            (kitti / side / f"00000{number}.png").rename(kitti / side / f"{number + 10}.png")
    dataset = open_dataset(kitti)
    frames = list(dataset.frames())
    assert [frame.index for frame in frames] == [0, 3, 11, 12]
    assert frames[2].stamp_s == 1.1


def test_a_missing_right_image(kitti):
    (kitti / "image_1" / "000002.png").unlink()
    refusal(kitti, "image_1/000002.png: does not exist", "image_0/000002.png does", "by name")


def test_a_truncated_image_is_a_flagged_frame(kitti):
    path = kitti / "image_0" / "000001.png"
    path.write_bytes(path.read_bytes()[:-20])
    frames = list(open_dataset(kitti).frames())
    assert "image_0/000001.png: is cut off" in frames[1].reason
    assert isinstance(frames[2], StereoFrame)


def test_left_and_right_of_different_sizes(kitti):
    write_image(kitti / "image_1" / "000000.png", textured(1, (32, 48)))
    refusal(kitti, "64x48", "image_1/000000.png has 32x48")


@pytest.mark.parametrize(("rows", "word"), [(3, "3 rows"), (5, "5 rows")])
def test_poses_of_the_wrong_length(kitti, rows, word):
    (kitti / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * rows)
    refusal(kitti, "poses.txt", word, "4 image pairs")


@pytest.mark.parametrize(
    ("name", "text", "parts"),
    [
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0\n", ["line 2", "3 values", "12"]),
        (
            "poses.txt",
            "1 0 0 0 0 1 0 0 0 0 1 0\n" * 3 + "2 0 0 0 0 1 0 0 0 0 1 0\n",
            ["line 4", "rigid"],
        ),
        ("times.txt", "0\n1\n1\n2\n", ["line 3", "repeats"]),
        ("times.txt", "0\n1\n", ["2 rows", "4 image pairs"]),
        ("calib.txt", "", ["P0, P1", "no named"]),
        ("calib.txt", "P0: 1 2 3\n", ["line 1", "3 values", "12"]),
        (
            "calib.txt",
            f"P0: {kitti_projection(0)}\nP2: {kitti_projection(-25)}\n",
            ["P0, P1", "P0, P2"],
        ),
        (
            "calib.txt",
            f"P0: {kitti_projection(0)}\nP1: {kitti_projection(25)}\n",
            ["baseline", "swapped"],
        ),
        (
            "calib.txt",
            f"P0: {kitti_projection(0)}\nP1: {kitti_projection(-25).replace('50', '51', 1)}\n",
            ["rectified"],
        ),
        (
            "calib.txt",
            f"P0: {kitti_projection(0)}\nP1: {kitti_projection(-25).replace('50', 'nan', 1)}\n",
            ["line 2", "'nan'", "P1"],
        ),
        ("calib.txt", f"{kitti_projection(0)}{kitti_projection(0.5)}\n", ["no named", "23 bare"]),
        ("calib.txt", "0.000000000000e+001.000000e+00", ["line 1", "finite number"]),
    ],
)
def test_one_line_names_file_and_remedy(kitti, name, text, parts):
    (kitti / name).write_text(text)
    refusal(kitti, name, *parts)


def test_no_calibration_and_no_images(kitti):
    (kitti / "calib.txt").unlink()
    with pytest.raises(InputError, match=r"calib\.txt: cannot be read"):
        open_dataset(kitti)
    for path in kitti.glob("image_*/*"):
        path.unlink()
    with pytest.raises(InputError, match="holds no images"):
        open_dataset(kitti)


def test_an_images_folder_is_not_for_kitti(kitti):
    with pytest.raises(InputError, match="leave the images folder out"):
        open_dataset(kitti, images_root=kitti)


def test_kitti_06(shared_data):
    dataset = open_dataset(shared_data / "kitti-06-000-050")
    assert len(dataset) == 51
    assert dataset.camera.baseline_m == pytest.approx(0.5372, abs=1e-4)
    frames = dataset.frames()
    assert next(frames).left.shape == (370, 1226)
    assert all(isinstance(frame, StereoFrame) for frame in frames)
    poses = dataset.ground_truth.map_T_rover
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-9)
    assert all(is_rigid(pose) for pose in poses)
    steps = np.diff(dataset.ground_truth.position_m, axis=0)
    assert np.linalg.norm(steps, axis=1).sum() == pytest.approx(59.9, abs=0.1)
    assert (steps[:, 0] > 1.0).all(), "the car drives along the rover's x axis"
