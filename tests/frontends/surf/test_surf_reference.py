"""Against OpenCV SURF's own output on real images, by the benchmark's metrics."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from frontends.surf import SURF

MSL = "msl-navcam-pair/NLB_524534514EDR_F0562034NCAM00280M_.jpeg"


@pytest.fixture(scope="module")
def quality() -> ModuleType:
    folder = Path(__file__).resolve().parents[3] / "benchmarks"
    monkeypatch = pytest.MonkeyPatch()
    monkeypatch.syspath_prepend(folder)
    module = importlib.import_module("surf_quality")
    monkeypatch.undo()
    return module


@pytest.mark.parametrize(
    "image", [MSL, "homography-pairs/graf/img1.png", "kitti-06-000-050/image_l/000000.png"]
)
def test_keypoints_are_opencvs(shared_data: Path, quality: ModuleType, image: str) -> None:
    """Where both find a keypoint, position, size, response unit and angle agree."""
    theirs = np.load(shared_data / "surf-reference" / (image.replace("/", "__") + ".npz"))
    x, y, size, angle, response = theirs["oriented_keypoints"][:500].T
    ours = SURF(20).detect(quality.read_grey(shared_data / image))
    distance = np.hypot(x[:, None] - ours.xy[:, 0], y[:, None] - ours.xy[:, 1])
    distance[np.abs(np.log(size[:, None] / ours.size)) > 0.15] = np.inf
    nearest = distance.argmin(axis=1)
    same = distance.min(axis=1) < 0.1 * size
    assert same.mean() > 0.65
    mine = ours[nearest[same]]
    fine = size[same] < 24  # octave 0: the same sampling grid
    offset = np.hypot(mine.xy[:, 0] - x[same], mine.xy[:, 1] - y[same])
    assert np.median(offset[fine]) < 0.25
    assert abs(np.median(mine.xy[fine, 0] - x[same][fine])) < 0.03  # no half-pixel shifts
    assert abs(np.median(mine.xy[fine, 1] - y[same][fine])) < 0.03
    assert np.median(mine.size / size[same]) == pytest.approx(1, abs=0.04)
    assert np.median(mine.response / response[same]) == pytest.approx(1, abs=0.15)
    turn = (np.degrees(mine.angle) - angle[same] + 180) % 360 - 180
    assert abs(np.median(turn)) < 1
    assert np.median(np.abs(turn)) < 6


def test_graf_is_at_least_opencvs(shared_data: Path, quality: ModuleType) -> None:
    ours = np.array(quality.graf_table(shared_data, quality.ours(upright=False)))
    theirs = np.array(quality.graf_table(shared_data, quality.reference("oriented")))
    assert ours[:, 1].sum() > 1.1 * theirs[:, 1].sum()  # correct matches
    assert ours[:, 2].mean() > 1.05 * theirs[:, 2].mean()  # matching score
    assert ours[:, 0].mean() > 0.95 * theirs[:, 0].mean()  # repeatability, mostly by chance
    assert ours[:, 3].mean() > theirs[:, 3].mean()  # repeatability by overlap


def test_stereo_is_at_least_opencvs(shared_data: Path, quality: ModuleType) -> None:
    chosen = {
        "ours": quality.ours(upright=False),
        "theirs": quality.reference("oriented"),
        "ours upright": quality.ours(upright=True),
        "theirs upright": quality.reference("upright"),
    }
    quality.cv2.setRNGSeed(1)
    table = quality.stereo_tables(shared_data, chosen)
    for suffix in ("", " upright"):
        ours, theirs = table["ours" + suffix], table["theirs" + suffix]
        for group in ours:
            assert ours[group][0] > theirs[group][0], (suffix, group)
            assert ours[group][1] < theirs[group][1] + 0.04, (suffix, group)
        planetary = [ours[group][0] / theirs[group][0] for group in quality.PLANETARY]
        assert np.mean(planetary) > 1.03, (suffix, planetary)


def test_accurate_mode_matches_as_many_as_sift(shared_data: Path, quality: ModuleType) -> None:
    accurate = quality.graf_table(shared_data, quality.ours(accurate=True))
    sift = quality.graf_table(
        shared_data, quality.opencv(quality.cv2.SIFT_create(quality.KEYPOINTS))
    )
    assert sum(row[1] for row in accurate) >= 0.95 * sum(row[1] for row in sift)
