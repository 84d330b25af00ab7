"""Bare left/ and right/ folders, described by a traverse.yaml elsewhere."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dataset_files import TRAVERSE, textured, write_image

from frontends.errors import InputError
from frontends.measurements import StereoFrame
from lunar_fg.datasets import open_dataset


@pytest.fixture
def bare(tmp_path: Path) -> tuple[Path, Path]:
    """Images of frames 3, 4 and 10, and their description beside the folder."""
    description = tmp_path / "camera.yaml"
    description.write_text(TRAVERSE)
    for frame in (3, 4, 10):
        for number, side in enumerate(("left", "right")):
            path = tmp_path / "run" / side / f"img_{frame:04d}.png"
            write_image(path, textured(10 * frame + number))
    return tmp_path / "run", description


def test_images_are_paired_by_name_in_the_order_of_their_numbers(bare) -> None:
    dataset = open_dataset(bare[0], traverse=bare[1])
    frames = list(dataset.frames())
    assert all(isinstance(frame, StereoFrame) for frame in frames)
    assert [(frame.index, frame.stamp_s) for frame in frames] == [(3, 3.0), (4, 4.0), (10, 10.0)]
    np.testing.assert_array_equal(frames[2].right, textured(101))
    assert dataset.ground_truth is None
    assert any("1 s apart" in note for note in dataset.notes)


def test_positions_by_frame_date_the_frames_and_are_the_truth(bare) -> None:
    rows = ["frame,time_s,x_m,y_m", "3,0.5,0,0", "4,0.9,0.1,0", "10,4.5,0.7,0.2"]
    (bare[0] / "ground_truth.csv").write_text("\n".join(rows) + "\n")
    dataset = open_dataset(bare[0], traverse=bare[1])
    assert [frame.stamp_s for frame in dataset.frames()] == [0.5, 0.9, 4.5]
    assert dataset.ground_truth is not None
    assert not dataset.ground_truth.has_height
    np.testing.assert_array_equal(dataset.ground_truth.position_m[2], [0.7, 0.2, 0.0])


def test_a_frame_without_a_time_is_named(bare) -> None:
    (bare[0] / "ground_truth.csv").write_text("frame,time_s,x_m,y_m\n3,0.5,0,0\n")
    with pytest.raises(InputError, match="no time for frame 4"):
        open_dataset(bare[0], traverse=bare[1])


def test_a_missing_partner_is_named(bare) -> None:
    (bare[0] / "right" / "img_0004.png").unlink()
    with pytest.raises(InputError, match=r"right/img_0004\.png does not exist"):
        open_dataset(bare[0], traverse=bare[1])


def test_an_image_without_a_number_is_named(bare) -> None:
    for side in ("left", "right"):
        write_image(bare[0] / side / "cover.png", textured(1))
    with pytest.raises(InputError, match=r"cover\.png has no frame number"):
        open_dataset(bare[0], traverse=bare[1])
