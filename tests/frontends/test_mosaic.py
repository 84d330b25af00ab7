"""Merged images lie where the truth says, blend without steps, and name what does not fit."""

import cv2
import numpy as np
import pytest

from frontends import mosaic
from frontends.errors import InputError
from frontends.mosaic import apply, merge

SIZE = 480


def photograph(folder, name="apollo17-surface/half-1170/AS17-137-20908HR.png"):
    picture = cv2.imread(str(folder / name))
    assert picture is not None, name
    return picture


def view(whole, centre, degrees=0.0, scale=1.0, tilt=0.0, gain=1.0):
    """A view of a photograph and the homography from its pixels to the photograph's."""
    middle = (SIZE - 1) / 2
    c, s = np.cos(np.radians(degrees)) / scale, np.sin(np.radians(degrees)) / scale
    turn = np.array([[c, -s, centre[0]], [s, c, centre[1]], [0.0, 0.0, 1.0]])
    lean = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [tilt, 0.0, 1.0]])
    whole_H_view = turn @ lean @ np.array([[1, 0, -middle], [0, 1, -middle], [0, 0, 1.0]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    seen = cv2.warpPerspective(whole, whole_H_view, (SIZE, SIZE), flags=flags)
    return np.clip(gain * seen, 0, 255).astype(np.uint8), whole_H_view


@pytest.fixture(scope="module")
def views(request):
    """Four views of a photograph in a row and back, one of them darker."""
    whole = photograph(request.getfixturevalue("shared_data"))
    return whole, [
        view(whole, (440, 800), gain=0.6),
        view(whole, (620, 820), degrees=8),
        view(whole, (760, 800), degrees=-5, scale=1.1, tilt=2e-4),
        view(whole, (600, 660), degrees=3, tilt=-2e-4),
    ]


@pytest.fixture(scope="module")
def merged(views):
    return merge([picture for picture, _ in views[1]])


def test_images_lie_where_the_truth_says(views, merged):
    whole, given = views
    assert merged.refused == {}
    assert sorted(merged.canvas_H_image) == [0, 1, 2, 3]
    assert merged.error_px < 0.5
    grid = np.stack(np.meshgrid(*2 * [np.linspace(0, SIZE - 1, 9)]), axis=-1).reshape(-1, 2)
    reference_true = given[merged.reference][1]
    canvas_H_whole = merged.canvas_H_image[merged.reference] @ np.linalg.inv(reference_true)
    for i, (_, whole_H_view) in enumerate(given):
        error = apply(merged.canvas_H_image[i], grid) - apply(canvas_H_whole @ whole_H_view, grid)
        assert np.abs(error).max() < 1.5, f"image {i}"
    size = merged.picture.shape[1::-1]
    expected = cv2.cvtColor(cv2.warpPerspective(whole, canvas_H_whole, size), cv2.COLOR_BGR2GRAY)
    found = cv2.cvtColor(merged.picture, cv2.COLOR_BGR2GRAY)
    inside = cv2.erode(merged.covered.astype(np.uint8), np.ones((15, 15))) > 0
    assert inside.mean() > 0.5
    assert np.corrcoef(found[inside], expected[inside])[0, 1] > 0.98


def test_a_darker_image_leaves_no_step(views, merged):
    whole, given = views
    canvas_H_whole = merged.canvas_H_image[merged.reference] @ np.linalg.inv(
        given[merged.reference][1]
    )
    size = merged.picture.shape[1::-1]
    expected = cv2.warpPerspective(whole, canvas_H_whole, size)[..., 1].astype(float)
    found, expected = (
        cv2.blur(image, (31, 31)) for image in (merged.picture[..., 1].astype(float), expected)
    )
    inside = cv2.erode(merged.covered.astype(np.uint8), np.ones((61, 61))) > 0
    inside &= expected > 60
    ratio = found[inside] / expected[inside]
    spread = np.percentile(ratio, 95) / np.percentile(ratio, 5)
    assert spread < 1.15, "the darker image has 0.6 of the light"


def test_an_image_of_another_place_is_named(views, shared_data):
    _, given = views
    other = photograph(shared_data, "homography-pairs/graf/img1.png")
    merged = merge([given[0][0], other, given[1][0]])
    assert sorted(merged.canvas_H_image) == [0, 2]
    assert list(merged.refused) == [1]
    assert "matches no other" in merged.refused[1]
    with pytest.raises(InputError, match="no two of the 2 images overlap"):
        merge([given[0][0], other])
    with pytest.raises(InputError, match="two or more"):
        merge([other])
    with pytest.raises(InputError, match="image 2: 5 x 5 pixels"):
        merge([other, other[:5, :5]])


def test_absurd_warps_and_sizes_are_refused(views, monkeypatch):
    _, given = views
    pictures = [picture for picture, _ in given[:3]]
    monkeypatch.setattr(mosaic, "_MAX_STRETCH", 1.12)
    merged = merge(pictures)
    assert list(merged.refused) == [2]
    assert "stretched" in merged.refused[2]
    monkeypatch.setattr(mosaic, "_MAX_CANVAS_PX", SIZE * SIZE)
    with pytest.raises(InputError, match="more than"):
        merge(pictures)


def test_a_plane_seen_past_its_horizon_is_infinitely_stretched():
    past = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0 / 300.0, 1.0]])
    assert mosaic._stretch(past, (400, 400)) == np.inf
    assert mosaic._stretch(past, (200, 400)) > 3.0
    assert mosaic._stretch(np.eye(3), (400, 400)) == pytest.approx(1.0)


def test_real_navcam_products_of_one_stop_merge(shared_data):
    from lunar_fg.pictures import read_picture

    folder = shared_data / "mer-navcam-spirit"
    names = "2n292280938effb100p0703l0m1.img", "2n292280989effb100p0703l0m1.img"
    merged = merge([read_picture(folder / name) for name in names])
    assert merged.refused == {}
    assert merged.error_px < 1.5
    assert merged.picture.shape[1] > 1.7 * 1024
