"""Matching two images: real pairs are matched, unrelated ones refused with a reason."""

import numpy as np
import pytest

from lunar_fg.datasets.images import read_grey
from lunar_fg.match import MatchModel, draw, match_images

GRAF = "homography-pairs/graf/img{}.png"
MSL = "msl-navcam-pair/N{}B_524534514EDR_F0562034NCAM00280M_.jpeg"


def images(folder, *names):
    return [read_grey(folder / name, 65535) for name in names]


@pytest.mark.parametrize(
    ("names", "model", "least"),
    [
        ((GRAF.format(1), GRAF.format(2)), MatchModel.HOMOGRAPHY, 500),
        ((MSL.format("L"), MSL.format("R")), MatchModel.STEREO, 1000),
    ],
)
def test_overlapping_images_match(shared_data, names, model, least):
    first, second = images(shared_data, *names)
    result = match_images(first, second, model)
    assert result.verdict == "accepted"
    assert result.inlier.sum() > least
    assert result.error_px < 1.2  # graf 1-2: 1.03
    assert draw(first, second, result).shape[1] == first.shape[1] + second.shape[1]


@pytest.mark.parametrize("model", list(MatchModel))
def test_unrelated_images_are_refused(shared_data, model):
    first, second = images(shared_data, GRAF.format(1), "homography-pairs/nonoverlap/mars2.png")
    result = match_images(first, second, model)
    assert result.verdict == "refused"
    assert "needed" in result.reason or "needs" in result.reason
    assert not result.inlier.any()
    assert np.isnan(result.error_px)
