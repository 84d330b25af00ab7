"""Raw stereo images with a calibration, and EuRoC folders: real data."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from frontends.calibration_check import check_calibration
from frontends.errors import InputError
from frontends.measurements import StereoFrame
from lunar_fg.datasets import open_dataset
from lunar_fg.datasets.raw_pairs import find_pairs


def first_frame(dataset) -> StereoFrame:
    frame = next(iter(dataset.frames()))
    assert isinstance(frame, StereoFrame)
    return frame


def test_euroc_is_rectified_as_it_is_read(shared_data: Path) -> None:
    dataset = open_dataset(shared_data / "euroc-v101-still")
    assert len(dataset) == 8
    assert dataset.camera.baseline_m == pytest.approx(0.11008, abs=1e-4)
    frame = first_frame(dataset)
    check = check_calibration(dataset.camera, [frame])
    assert check.findings == ()
    assert abs(check.vertical_px) < 0.1
    assert check.spread_px < 0.4
    assert not any("calibration check" in note for note in dataset.notes)
    stamps = [each.stamp_s for each in dataset.frames()]
    np.testing.assert_allclose(np.diff(stamps), 0.6, atol=1e-6)


def test_euroc_as_published(shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "euroc-v101-still"
    for name in ("cam0", "cam1"):
        shutil.copytree(source / name, tmp_path / "mav0" / name / "data")
        shutil.copy(source / f"{name}_sensor.yaml", tmp_path / "mav0" / name / "sensor.yaml")
    (tmp_path / "mav0/cam1/data/1403715273262142976.png").unlink()
    truth = tmp_path / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir()
    zeros = ",0" * 9
    (truth / "data.csv").write_text(
        f"#timestamp,x,y,z,qw,qx,qy,qz\n1403715274302142976,1,2,3,1,0,0,0{zeros}\n"
    )
    dataset = open_dataset(tmp_path)
    assert len(dataset) == 7
    assert "1 images of one eye only are left out" in dataset.notes
    assert dataset.ground_truth is not None
    np.testing.assert_allclose(dataset.ground_truth.position_m, [[1.0, 2.0, 3.0]])
    shutil.rmtree(tmp_path / "mav0" / "cam1")
    with pytest.raises(InputError, match="right camera's folder"):
        open_dataset(tmp_path)


def test_the_check_finds_what_is_wrong_with_k10(shared_data: Path) -> None:
    """Its calibration is of another day: toe-in off by 0.9 degrees, seen two ways."""
    folder = shared_data / "k10-stereo"
    dataset = open_dataset(folder, calibration=[folder / "black_left.tsai"])
    findings = [note for note in dataset.notes if "calibration check" in note]
    assert any("beyond infinity" in text for text in findings)
    assert any("looks turned by" in text for text in findings)
    check = check_calibration(dataset.camera, [first_frame(dataset)])
    assert check.turn_deg[1] == pytest.approx(-0.9, abs=0.15)
    np.testing.assert_allclose(check.turn_deg[[0, 2]], 0.0, atol=0.15)


def test_the_msl_pair_with_the_nominal_model(shared_data: Path) -> None:
    dataset = open_dataset(shared_data / "msl-navcam-pair", calibration=["msl-navcam"])
    assert dataset.camera.baseline_m == 0.424
    frame = first_frame(dataset)
    assert frame.stamp_s == 524534514.0
    check = check_calibration(dataset.camera, [frame])
    assert check.matches > 500
    assert 10.0 < check.median_depth_m < 40.0
    assert any("nominal model" in note for note in dataset.notes)


def test_raw_images_without_calibration_are_told_of_it(shared_data: Path) -> None:
    with pytest.raises(InputError, match="--calibration"):
        open_dataset(shared_data / "k10-stereo")


def test_pairs_by_name_and_number(tmp_path: Path) -> None:
    for name in ("left10.png", "right10.png", "left9.png", "right9.png", "left11.png"):
        (tmp_path / name).write_bytes(b"")
    pairs, notes = find_pairs(tmp_path)
    assert [pair.left.name for pair in pairs] == ["left9.png", "left10.png"]
    assert [pair.stamp_s for pair in pairs] == [0.0, 1.0]
    assert notes


def test_a_folder_without_pairs(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no stereo pairs"):
        open_dataset(tmp_path, calibration=["msl-navcam"])


def test_calibration_goes_alone(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--calibration goes with"):
        open_dataset(tmp_path, calibration=["msl-navcam"], traverse="traverse.yaml")
