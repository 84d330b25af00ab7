"""The mosaic command."""

import json

import cv2
from typer.testing import CliRunner

from lunar_fg.cli import app

GRAF = "homography-pairs/graf/img{}.png"


def lunar_fg(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_merged_and_refused_images_are_named(shared_data, tmp_path):
    images = [shared_data / GRAF.format(i) for i in (1, 2, 3)]
    images.append(shared_data / "homography-pairs/nonoverlap/mars1.png")
    output = tmp_path / "merged.png"
    result = lunar_fg("mosaic", *images, "-o", output, "--json")
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert figures["merged"] == ["img1.png", "img2.png", "img3.png"]
    assert list(figures["refused"]) == ["mars1.png"]
    assert "needed" in figures["refused"]["mars1.png"]
    assert cv2.imread(str(output)).shape[1::-1] == tuple(figures["size_px"])
    spoken = lunar_fg("mosaic", *images[2:], images[0], "-o", output).stdout
    assert "2 of 3 images merged" in spoken
    assert "refused: mars1.png: matches no other" in spoken


def test_images_that_do_not_overlap_end_with_an_error(shared_data, tmp_path):
    images = shared_data / GRAF.format(1), shared_data / "homography-pairs/nonoverlap/mars1.png"
    output = tmp_path / "merged.png"
    result = lunar_fg("mosaic", *images, "-o", output)
    assert result.exit_code == 2
    assert "no two of the 2 images overlap" in result.stderr
    assert not output.exists()
    nowhere = lunar_fg("mosaic", *images, "-o", tmp_path / "no" / "merged.png")
    assert nowhere.exit_code == 2
    assert "folder does not exist" in nowhere.stderr
