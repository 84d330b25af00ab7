"""Matching two images: real pairs are matched, unrelated ones refused with a reason."""

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from frontends.errors import InputError
from lunar_fg.cli import app
from lunar_fg.match import MatchModel, draw, match_images
from lunar_fg.pictures import grey, read_picture

GRAF = "homography-pairs/graf/img{}.png"
MSL = "msl-navcam-pair/N{}B_524534514EDR_F0562034NCAM00280M_.jpeg"
KITTI = "kitti-06-000-050/image_{}/000000.png"
APOLLO = "apollo17-surface/half-1170/AS17-137-2090{}HR.png"


def images(folder, *names):
    return [read_picture(folder / name) for name in names]


@pytest.mark.parametrize(
    ("names", "model", "least", "error_px"),
    [
        ((GRAF.format(1), GRAF.format(2)), MatchModel.HOMOGRAPHY, 500, 1.2),  # 1.03
        ((MSL.format("L"), MSL.format("R")), MatchModel.STEREO, 1000, 0.1),
        ((KITTI.format("l"), KITTI.format("r")), MatchModel.STEREO, 1000, 0.2),
        ((APOLLO.format(6), APOLLO.format(7)), MatchModel.FUNDAMENTAL, 800, 0.5),
    ],
)
def test_overlapping_images_match(shared_data, names, model, least, error_px):
    pictures = images(shared_data, *names)
    result = match_images(*map(grey, pictures), model)
    assert result.verdict == "accepted", result.reason
    assert least < result.inliers <= result.matches
    assert result.error_px < error_px
    drawn = draw(pictures, result)
    assert drawn.shape[1] == pictures[0].shape[1] + pictures[1].shape[1]
    assert (drawn[: len(pictures[0]), : pictures[0].shape[1]] != pictures[0]).any(), "no lines"


@pytest.mark.parametrize("model", list(MatchModel))
def test_unrelated_images_are_refused(shared_data, model):
    first, second = images(shared_data, "homography-pairs/nonoverlap/mars1.png", GRAF.format(1))
    result = match_images(grey(first), grey(second)[:512, :512].copy(), model)
    assert result.verdict == "refused"
    assert "needed" in result.reason or "needs" in result.reason
    assert result.inliers == 0
    assert np.isnan(result.error_px)


@pytest.mark.parametrize("model", list(MatchModel))
def test_images_without_any_texture_are_refused(model):
    blank = np.full((120, 160), 99, np.uint8)
    result = match_images(blank, blank, model)
    assert result.verdict == "refused"
    assert "0 matches" in result.reason
    assert draw([np.dstack(3 * [blank])] * 2, result).shape == (120, 320, 3)


def test_stereo_stays_in_the_band(shared_data):
    """Rows differ by the vertical field of the pair only; disparities are not negative."""
    left, right = images(shared_data, KITTI.format("l"), KITTI.format("r"))
    result = match_images(grey(left), grey(right), MatchModel.STEREO)
    offset = result.first_xy - result.second_xy
    assert np.ptp(offset[:, 1]) < 3.0
    assert offset[:, 0].min() > -3.0
    alike = match_images(grey(left), grey(left), MatchModel.STEREO)
    assert alike.reason == "every match is at infinity"
    with pytest.raises(InputError, match="swapped"):
        match_images(grey(right), grey(left), MatchModel.STEREO)
    with pytest.raises(InputError, match="1226x370 and 1226x300"):
        match_images(grey(left), grey(right)[:300], MatchModel.STEREO)


def lunar_fg(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_the_command_prints_figures_and_writes_a_picture(shared_data, tmp_path):
    pair = [shared_data / KITTI.format(side) for side in "lr"]
    result = lunar_fg("match", *pair, "--stereo", "--json", "-o", tmp_path / "matches.png")
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert figures["verdict"] == "accepted"
    assert figures["inliers"] > 1000
    assert cv2.imread(str(tmp_path / "matches.png")).shape == (370, 2 * 1226, 3)
    table = lunar_fg("match", *pair, "--stereo").stdout
    assert f"{figures['inliers']} inliers" in table
    assert "median error" in table


def test_the_command_ends_with_1_when_it_refuses_and_2_on_bad_input(shared_data, tmp_path):
    pair = shared_data / GRAF.format(1), shared_data / "homography-pairs/nonoverlap/mars1.png"
    refused = lunar_fg("match", *pair)
    assert refused.exit_code == 1
    assert "refused: inliers at" in refused.stdout
    both = lunar_fg("match", *pair, "--stereo", "--similarity")
    assert both.exit_code == 2
    assert "only one of" in both.stderr
    (tmp_path / "words.img").write_text("not an image")
    for bad in (tmp_path / "absent.png", tmp_path / "words.img"):
        result = lunar_fg("match", pair[0], bad)
        assert result.exit_code == 2
        assert result.stderr.startswith(f"error: {bad}"), result.stderr
    unwritable = lunar_fg("match", *pair, "-o", tmp_path / "no" / "folder.png")
    assert "cannot be written" in unwritable.stderr
