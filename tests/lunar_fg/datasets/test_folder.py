from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dataset_files import HEIGHT, WIDTH, textured, write_image

from frontends.errors import InputError
from frontends.measurements import StereoFrame, UnusableFrame
from lunar_fg.datasets import open_dataset


def refusal(path: Path, *parts: str, images_root: Path | None = None) -> InputError:
    """Open a bad folder: one line with file, field or line, and remedy."""
    with pytest.raises(InputError) as caught:
        open_dataset(path, images_root=images_root)
    error = caught.value
    assert "\n" not in str(error)
    assert error.source
    assert error.field
    assert error.remedy
    for part in parts:
        assert part in str(error)
    return error


def replace(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def flags(path: Path) -> list[str]:
    """Reasons of the frames, empty for usable ones."""
    frames = list(open_dataset(path).frames())
    assert [frame.index for frame in frames] == list(range(5))
    return [frame.reason if isinstance(frame, UnusableFrame) else "" for frame in frames]


def test_a_valid_folder(folder):
    dataset = open_dataset(folder)
    assert (dataset.name, len(dataset), dataset.notes) == ("run", 5, ())
    frames = list(dataset.frames())
    assert all(isinstance(frame, StereoFrame) for frame in frames)
    np.testing.assert_array_equal(frames[2].left, textured(20))
    np.testing.assert_array_equal(frames[2].right, textured(21))
    assert (frames[2].stamp_s, frames[2].camera) == (12.0, dataset.camera)
    assert dataset.ground_truth is dataset.map_reference is dataset.orbital is None
    assert len(list(dataset.frames())) == 5, "frames() can be called again"
    assert [frame.index for frame in dataset.frames(after=2)] == [3, 4]
    assert open_dataset(folder / "traverse.yaml").name == "run"


def test_optional_tables_and_keys(folder):
    (folder / "odometry.csv").write_text(
        "stamp_s,d_forward_m,d_lateral_m,d_yaw_rad\n"
        + "".join(f"{10 + i},{0.1 * i},0,0\n" for i in range(5))
    )
    (folder / "attitude.csv").write_text(
        "stamp_s,roll_rad,pitch_rad,yaw_rad,sigma_rp_rad,sigma_yaw_rad\n12,0.1,0.2,0.3,0.01,0.1\n"
    )
    (folder / "ground_truth.tum").write_text("10 1 2 3 0 0 0 1\n")
    (folder / "orbital").mkdir()
    (folder / "orbital" / "dem.tif").write_bytes(b"not opened here")
    with (folder / "traverse.yaml").open("a") as file:
        file.write(
            "sun: {azimuth_deg: 205, elevation_deg: 18}\n"
            "map: {crs: 'IAU_2015:30135', origin: [1, 2, 3]}\n"
            "orbital: {dem: orbital/dem.tif}\n"
        )
    (folder / "left" / "000003.png").write_bytes(b"")
    dataset = open_dataset(folder)
    frames = list(dataset.frames())
    assert frames[0].odometry is None
    assert frames[2].odometry.d_forward_m == 0.2
    assert frames[2].attitude.yaw_rad == 0.3
    assert frames[1].attitude is None
    assert frames[2].sun.azimuth_deg == 205
    assert isinstance(frames[3], UnusableFrame)
    assert frames[3].odometry.d_forward_m == pytest.approx(0.3), "odometry outlives the images"
    assert dataset.ground_truth.map_T_rover.shape == (1, 4, 4)
    assert dataset.map_reference.origin_m == (1.0, 2.0, 3.0)
    assert dataset.orbital.dem == folder / "orbital" / "dem.tif"
    assert dataset.orbital.ortho is None


def test_images_may_lie_elsewhere(folder, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for side in ("left", "right"):
        (folder / side).rename(elsewhere / side)
    refusal(folder, "frames.csv", "line 2", "left/000000.png does not exist", "9 more")
    assert flags_of(open_dataset(folder, images_root=elsewhere)) == [""] * 5
    refusal(folder, "is not a folder", images_root=tmp_path / "none")


def flags_of(dataset) -> list[str]:
    return [getattr(frame, "reason", "") for frame in dataset.frames()]


def test_a_missing_right_image(folder):
    (folder / "right" / "000003.png").unlink()
    refusal(folder, "frames.csv: line 5: right/000003.png does not exist", "drop the row")


def test_a_truncated_png_is_a_flagged_frame(folder):
    path = folder / "right" / "000002.png"
    path.write_bytes(path.read_bytes()[:-200])
    reasons = flags(folder)
    assert "right/000002.png: is cut off" in reasons[2]
    assert [bool(reason) for reason in reasons] == [False, False, True, False, False]


def test_an_image_that_vanishes_during_the_run_is_a_flagged_frame(folder):
    frames = open_dataset(folder).frames()
    next(frames)
    (folder / "left" / "000001.png").unlink()
    assert "left/000001.png: cannot be read" in next(frames).reason
    assert isinstance(next(frames), StereoFrame)


def test_an_all_black_and_a_flat_image_are_flagged_frames(folder):
    write_image(folder / "left" / "000001.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    write_image(folder / "right" / "000004.png", np.full((HEIGHT, WIDTH), 200, np.uint8))
    reasons = flags(folder)
    assert "left/000001.png: is black" in reasons[1]
    assert "right/000004.png: has no texture" in reasons[4]


@pytest.mark.parametrize("side", ["left", "right"])
def test_another_size_than_calibrated(folder, side):
    write_image(folder / side / "000000.png", textured(1, (32, 48)))
    refusal(folder, "traverse.yaml: camera", "64x48 px", f"{side}/000000.png has 32x48 px")


def test_another_size_later_is_a_flagged_frame(folder):
    write_image(folder / "right" / "000003.png", textured(1, (32, 48)))
    assert "right/000003.png: has 32x48 px, the calibration 64x48" in flags(folder)[3]


def test_a_truncated_first_image_does_not_stop_the_run(folder):
    (folder / "left" / "000000.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    assert "left/000000.png" in flags(folder)[0]


def test_no_readable_image_at_all(folder):
    for path in (folder / "left").iterdir():
        path.write_text("nothing")
    refusal(folder, "none of the 5 image pairs", "left/000000.png", "is not a PNG")


def test_nan_in_the_calibration(folder):
    replace(folder / "traverse.yaml", "fx: 50.0", "fx: .nan")
    refusal(folder, "traverse.yaml: camera.fx", "nan", "finite")


def test_repeated_stamps(folder):
    replace(folder / "frames.csv", "3,13.0", "3,12.0")
    refusal(folder, "frames.csv: line 5", "stamp_s 12 repeats 12 of line 4")


@pytest.mark.parametrize(
    "name", ["/etc/hosts", "../left/000000.png", "left/../../x.png", "C:\\x.png", ".", "a\x00b"]
)
def test_paths_that_lead_out_of_the_folder(folder, name):
    replace(folder / "frames.csv", "left/000002.png", name)
    refusal(folder, "frames.csv: line 4", "not a path inside the folder")


def test_the_same_image_twice(folder):
    replace(folder / "frames.csv", "left/000002.png", "right/000002.png")
    refusal(folder, "frames.csv: line 4", "left and right are both right/000002.png")


def test_a_nearly_right_table_name_is_not_left_out_silently(folder):
    (folder / "odometrie.csv").write_text("")
    refusal(folder, "odometrie.csv", "did you mean 'odometry.csv'")


def test_two_truths(folder):
    (folder / "ground_truth.tum").write_text("10 1 2 3 0 0 0 1\n")
    (folder / "ground_truth_position.csv").write_text("stamp_s,x_m,y_m\n1,2,3\n")
    refusal(folder, "holds both", "keep one")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("map: {crs: nonsense, origin: [0, 0, 0]}", ["map.crs", "'nonsense'"]),
        ("map: {crs: 'EPSG:4326', origin: [0, 0, 0]}", ["map.crs", "degrees", "projected"]),
        ("orbital: {dem: d.tif}", ["orbital.dem", "d.tif does not exist"]),
        ("orbital: {ortho: ../d.tif}", ["orbital.ortho", "inside the folder"]),
    ],
)
def test_bad_map_and_orbital(folder, text, parts):
    with (folder / "traverse.yaml").open("a") as file:
        file.write(text)
    refusal(folder, "traverse.yaml", *parts)


def test_sixteen_bit_images_share_one_scale(folder):
    for path in folder.glob("*/*.png"):
        seed = int(path.stem) * 10 + (path.parent.name == "right")
        write_image(path, textured(seed).astype(np.uint16) * 16)
    dataset = open_dataset(folder)
    assert "12-bit" in dataset.notes[0]
    for frame in dataset.frames():
        np.testing.assert_allclose(frame.left, textured(10 * frame.index), atol=1)


def test_moonranger(shared_data, moonranger):
    dataset = open_dataset(moonranger, images_root=shared_data / "moonranger-run1")
    assert len(dataset) == len(dataset.ground_truth) == 128
    frames = list(dataset.frames())
    assert all(isinstance(frame, StereoFrame) for frame in frames)
    np.testing.assert_array_equal([f.stamp_s for f in frames], dataset.ground_truth.stamp_s)
    assert dataset.ground_truth.map_T_rover is None
    assert not dataset.ground_truth.has_height
    path_m = np.linalg.norm(np.diff(dataset.ground_truth.position_m, axis=0), axis=1).sum()
    assert path_m == pytest.approx(4.1, abs=0.2)
    down = np.degrees(np.arcsin(-dataset.rover_T_camera[2, 2]))
    assert down == pytest.approx(26.0)
