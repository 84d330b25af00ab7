from __future__ import annotations

from pathlib import Path

import pytest

from frontends.errors import InputError
from lunar_fg.datasets import open_dataset


def refusal(path) -> str:
    with pytest.raises(InputError) as caught:
        open_dataset(path)
    assert "\n" not in str(caught.value)
    assert caught.value.field == "dataset"
    assert caught.value.remedy
    return str(caught.value)


def test_an_empty_folder_says_what_is_looked_for(tmp_path):
    text = refusal(tmp_path)
    for part in ("traverse.yaml", "frames.csv", "calib.txt", "image_2/image_3", "is empty"):
        assert part in text


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("traverse.yml", "traverse.yml is there: did you mean 'traverse.yaml'"),
        ("frames.csv", "frames.csv is there, but what goes with it is not"),
        ("photo.jpg", "holds photo.jpg"),
    ],
)
def test_the_nearest_thing_is_named(tmp_path, name, part):
    (tmp_path / name).write_text("")
    assert part in refusal(tmp_path)


def test_a_sub_folder_that_is_a_dataset_is_named(kitti):
    assert "give its sub-folder 06" in refusal(kitti.parent)


def test_a_path_that_does_not_exist(kitti):
    assert "did you mean '06'" in refusal(kitti.parent / "006")
    assert "check the path" in refusal(kitti.parent / "a" / "b")
    assert "does not exist" in refusal(kitti / ("a" * 5000))
    assert "is a file" in refusal(kitti / "calib.txt")


def test_the_folder_format_comes_first(folder):
    for name in ("image_0", "image_1"):
        (folder / name).mkdir()
    assert open_dataset(folder).path == folder


def test_bare_image_folders_are_told_how_to_be_described(tmp_path: Path) -> None:
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
    with pytest.raises(InputError, match="--traverse"):
        open_dataset(tmp_path)
