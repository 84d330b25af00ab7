"""Invariance under rotation, scale, brightness and contrast; the mask, the limits, the options."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from surf_images import apply, mutual_matches, similarity, textured, warped

from frontends.surf import SURF, Keypoints


def _correct(
    a: Keypoints, b: Keypoints, pairs: np.ndarray, matrix: np.ndarray, radius: float = 2.0
) -> np.ndarray:
    error = np.linalg.norm(apply(matrix, a.xy[pairs[:, 0]]) - b.xy[pairs[:, 1]], axis=1)
    return error < radius


def _matched(
    first: np.ndarray, second: np.ndarray, *, upright: bool = False, limit: int = 300
) -> tuple[Keypoints, Keypoints, np.ndarray]:
    surf = SURF(hessian_threshold=50, upright=upright, max_keypoints=limit)
    a, da = surf.detectAndCompute(first)
    b, db = surf.detectAndCompute(second)
    return a, b, mutual_matches(da, db)


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 1000), degrees=st.floats(0, 360))
def test_rotation(seed: int, degrees: float) -> None:
    image = textured(seed)
    matrix = similarity(1, degrees, image.shape)
    a, b, pairs = _matched(image, warped(image, matrix))
    right = _correct(a, b, pairs, matrix)
    assert right.sum() >= 50
    assert right.mean() >= 0.8  # the corners have no counterpart
    good = pairs[right]
    # y points down: a turn by +degrees in OpenCV's convention lowers the angle
    turn = np.degrees(b.angle[good[:, 1]] - a.angle[good[:, 0]]) + degrees
    assert np.median(np.abs((turn + 180) % 360 - 180)) < 8


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 1000), scale=st.floats(0.6, 1.8), upright=st.booleans())
def test_scale(seed: int, scale: float, upright: bool) -> None:
    image = textured(seed)
    matrix = similarity(scale, 0, image.shape)
    a, b, pairs = _matched(image, warped(image, matrix), upright=upright)
    right = _correct(a, b, pairs, matrix, 2.0 * max(1, scale))
    assert right.sum() >= 25
    assert right.mean() >= 0.8
    good = pairs[right]
    growth = b.size[good[:, 1]] / a.size[good[:, 0]]
    assert np.median(growth) == pytest.approx(scale, rel=0.08)


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 1000), gain=st.floats(0.4, 1.0), offset=st.floats(0, 40))
def test_brightness_and_contrast(seed: int, gain: float, offset: float) -> None:
    image = textured(seed)
    darker = np.clip(np.rint(gain * (image * 0.8) + offset), 0, 255).astype(np.uint8)
    a, b, pairs = _matched((image * 0.8).astype(np.uint8), darker)
    right = _correct(a, b, pairs, similarity(1, 0, image.shape), 0.5)
    assert right.sum() >= 0.75 * min(len(a), len(b))
    assert right.mean() >= 0.97


@pytest.mark.parametrize("upright", [False, True])
def test_offset_changes_nothing(upright: bool) -> None:
    """Box filters have no constant part: a plain offset leaves everything the same."""
    image = (textured(1) // 2).astype(np.uint8)
    surf = SURF(20, upright=upright)
    a, da = surf.detectAndCompute(image)
    b = surf.detect(image + np.uint8(100))
    distance = np.linalg.norm(a.xy[:, None] - b.xy[None], axis=2)
    # 16-bit sums round, so the odd candidate may change
    assert (distance.min(axis=1) < 0.05).mean() > 0.97
    _, db = surf.compute(image + np.uint8(100), a)
    np.testing.assert_allclose(da, db, atol=1e-5)


def test_translation_by_whole_blocks_is_exact_away_from_the_border() -> None:
    image = textured(2, 400, 400)
    surf = SURF(50, octaves=2, upright=True)
    a, da = surf.detectAndCompute(image[:320, :320])
    b, db = surf.detectAndCompute(image[16:336, 16:336])
    inner = ((a.xy > 130) & (a.xy < 190)).all(axis=1)
    assert inner.sum() >= 8
    for xy, size, descriptor in zip(a.xy[inner], a.size[inner], da[inner], strict=True):
        offset = np.abs(b.xy - (xy - 16)).max(axis=1)
        at = np.flatnonzero((offset < 0.05) & (np.abs(b.size / size - 1) < 0.02))
        assert len(at) == 1
        assert np.abs(db[at[0]] - descriptor).max() < 0.02


def test_upright_is_what_oriented_gives_at_angle_zero() -> None:
    image = textured(4)
    keypoints = SURF(50, upright=True, max_keypoints=100).detect(image)
    assert not keypoints.angle.any()
    _, upright = SURF(upright=True).compute(image, keypoints)
    _, oriented = SURF(upright=False).compute(image, keypoints)
    # two ways of sampling: close, not equal
    assert np.median(np.sum(upright * oriented, axis=1)) > 0.95


@pytest.mark.parametrize("upright", [False, True])
def test_descriptors_are_unit_vectors(upright: bool) -> None:
    keypoints, descriptors = SURF(20, upright=upright).detectAndCompute(textured(5))
    assert descriptors.dtype == np.float32
    assert descriptors.shape == (len(keypoints), 64)
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, atol=1e-5)
    blocks = descriptors.reshape(-1, 16, 4)
    assert (blocks[..., 2:] >= np.abs(blocks[..., :2]) - 1e-6).all()  # sum |d| >= |sum d|


def test_same_input_same_output() -> None:
    image = textured(6)
    surf = SURF(20)
    first, descriptors = surf.detectAndCompute(image)
    surf.detectAndCompute(textured(7))
    again, same = SURF(20).detectAndCompute(image.copy())
    np.testing.assert_array_equal(descriptors, same)
    for name in ("xy", "size", "angle", "response", "octave", "laplacian"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))


@pytest.mark.parametrize("limit", [1, 7, 60, 10**6])
def test_max_keypoints_keeps_the_strongest(limit: int) -> None:
    image = textured(8)
    everything, descriptors = SURF(20).detectAndCompute(image)
    some, their = SURF(20, max_keypoints=limit).detectAndCompute(image)
    assert len(some) == min(limit, len(everything))
    assert (np.diff(everything.response) <= 0).all()
    np.testing.assert_array_equal(some.xy, everything.xy[:limit])
    np.testing.assert_array_equal(their, descriptors[:limit])


def test_threshold_only_cuts() -> None:
    image = textured(9)
    low = SURF(20).detect(image)
    high = SURF(500).detect(image)
    assert 0 < len(high) < len(low)
    assert (high.response > 500).all()
    np.testing.assert_array_equal(high.xy, low.xy[: len(high)])


def test_mask_keeps_what_lies_in_it() -> None:
    image = textured(10)
    mask = np.zeros(image.shape, np.uint8)
    mask[100:250, 50:200] = 255
    surf = SURF(20)
    everything = surf.detect(image)
    kept = surf.detect(image, mask)
    inside = mask[
        np.rint(everything.xy[:, 1]).astype(int), np.rint(everything.xy[:, 0]).astype(int)
    ]
    assert 0 < len(kept) < len(everything)
    np.testing.assert_array_equal(kept.xy, everything.xy[inside > 0])
    limited = SURF(20, max_keypoints=20).detect(image, mask)
    np.testing.assert_array_equal(limited.xy, kept.xy[:20])
    assert len(surf.detect(image, np.zeros_like(mask))) == 0


@pytest.mark.parametrize("layers", [1, 2, 3, 4])
def test_layers(layers: int) -> None:
    """Every layer count finds the blob; sizes stay within what its layers can represent."""
    keypoints = SURF(20, octaves=3, layers=layers).detect(textured(12))
    assert len(keypoints) > 20
    largest = (9 + 6 * (layers + 1)) * 4
    assert keypoints.size.min() >= 9
    assert keypoints.size.max() <= largest
    two = SURF(20, octaves=3, layers=2).detect(textured(12))
    if layers > 2:  # the first pair of layers is the same
        lower = two.size < 24
        ours = {tuple(p) for p in np.round(keypoints.xy, 3).tolist()}
        assert np.mean([tuple(p) in ours for p in np.round(two.xy[lower], 3).tolist()]) == 1


@pytest.mark.parametrize("shape", [(24, 24), (60, 60), (25, 300), (61, 47)])
def test_small_images_work(shape: tuple[int, int]) -> None:
    keypoints, descriptors = SURF(5, octaves=4).detectAndCompute(textured(13, *shape))
    assert len(keypoints) == len(descriptors)
    assert np.isfinite(descriptors).all()
    if shape == (60, 60):
        assert len(keypoints) > 0


def test_a_flat_image_has_no_keypoints() -> None:
    keypoints, descriptors = SURF(0).detectAndCompute(np.full((100, 100), 77, np.uint8))
    assert len(keypoints) == 0
    assert descriptors.shape == (0, 64)


def test_colour_is_grey_by_opencv() -> None:
    image = np.random.default_rng(0).integers(0, 256, (80, 90, 3)).astype(np.uint8)
    image = cv2.GaussianBlur(image, (0, 0), 2)
    colour = SURF(1).detect(image)
    grey = SURF(1).detect(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    assert len(grey) > 0
    np.testing.assert_array_equal(colour.xy, grey.xy)


def test_strided_and_read_only_images() -> None:
    image = textured(14)
    view = np.asfortranarray(image)[:, ::-1]
    expected = SURF(50).detect(np.ascontiguousarray(view))
    view.flags.writeable = False
    np.testing.assert_array_equal(SURF(50).detect(view).xy, expected.xy)
    fixed = np.ascontiguousarray(view)
    fixed.flags.writeable = False
    np.testing.assert_array_equal(SURF(50).detect(fixed).xy, expected.xy)


@pytest.mark.parametrize("gain", [0.3, 1.0])
def test_earlier_images_do_not_change_the_result(gain: float) -> None:
    """The threshold guessed from the image before saves work only, also if it is too high."""
    surf = SURF(5, upright=True, max_keypoints=150)
    surf.detectAndCompute(textured(41))
    image = (textured(42) * gain).astype(np.uint8)
    after, descriptors = surf.detectAndCompute(image)
    fresh, expected = SURF(5, upright=True, max_keypoints=150).detectAndCompute(image)
    np.testing.assert_array_equal(after.xy, fresh.xy)
    np.testing.assert_array_equal(descriptors, expected)
