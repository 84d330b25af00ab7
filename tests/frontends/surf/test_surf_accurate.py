"""The accurate mode: more correct matches than the fast one, the same call shape."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from surf_images import apply, mutual_matches, similarity, textured, warped

from frontends.surf import SURF, Keypoints
from frontends.surf.subregions import subregion_weights


def _correct(surf: SURF, image: np.ndarray, matrix: np.ndarray) -> tuple[int, float]:
    a, first = surf.detectAndCompute(image)
    b, second = surf.detectAndCompute(warped(image, matrix))
    pairs = mutual_matches(first, second)
    error = np.linalg.norm(apply(matrix, a.xy[pairs[:, 0]]) - b.xy[pairs[:, 1]], axis=1)
    return int((error < 2).sum()), float((error < 2).mean())


@pytest.mark.parametrize(("scale", "degrees"), [(1.0, 40.0), (1.5, -75.0)])
def test_more_correct_matches_than_the_fast_mode(scale: float, degrees: float) -> None:
    image = textured(31)
    matrix = similarity(scale, degrees, image.shape)
    fast, _ = _correct(SURF(50, max_keypoints=300), image, matrix)
    accurate, share = _correct(SURF(50, max_keypoints=300, accurate=True), image, matrix)
    assert accurate > fast
    assert share > 0.85


def test_positions_and_sizes_are_those_of_the_original_image() -> None:
    image = textured(32)
    plain = SURF(100).detect(image)
    doubled = SURF(100, accurate=True).detect(image)
    assert doubled.octave.min() == -1
    large = plain[plain.size > 24]
    distance = np.linalg.norm(large.xy[:, None] - doubled.xy[None], axis=2)
    distance[np.abs(np.log(large.size[:, None] / doubled.size)) > 0.1] = np.inf
    nearest = distance.argmin(axis=1)
    same = distance.min(axis=1) < 1.5
    assert same.mean() > 0.7
    offset = doubled.xy[nearest[same]] - large.xy[same]
    assert np.abs(np.median(offset, axis=0)).max() < 0.1


def test_mask_and_compute() -> None:
    image = textured(33)
    mask = np.zeros(image.shape, bool)
    mask[100:200, 150:300] = True
    surf = SURF(50, accurate=True)
    keypoints, descriptors = surf.detectAndCompute(image, mask)
    assert len(keypoints) > 10
    assert mask[tuple(np.rint(keypoints.xy[:, ::-1]).astype(int).T)].all()
    _, again = surf.compute(image, keypoints)
    np.testing.assert_allclose(again, descriptors, atol=1e-4)
    corner = [cv2.KeyPoint(x, y, s, 33) for x, y in ((0, 0), (399, 359)) for s in (1, 9, 30, 5000)]
    assert np.isfinite(surf.compute(image, corner)[1]).all()


def test_upright_takes_angle_zero() -> None:
    image = textured(34)
    keypoints, descriptors = SURF(200, upright=True, accurate=True).detectAndCompute(image)
    assert (keypoints.angle == 0).all()
    _, turned = SURF(accurate=True).compute(image, keypoints)
    np.testing.assert_allclose(turned, descriptors, atol=1e-5)


def test_descriptor_matches_explicit_sums() -> None:
    """Bilinear samples at a pitch of s/2, Haar differences, linear weights of subregions."""
    image = textured(35, 120, 130)
    size, angle = 15.0, 0.6  # s = 2 px, 4 px in the doubled image: level 1 of it
    spot = Keypoints(
        np.array([[60, 58]]), np.array([size]), np.array([angle]), np.ones(1), np.zeros(1),
        np.zeros(1),
    )  # fmt: skip
    _, found = SURF(accurate=True).compute(image, spot)
    level = cv2.resize(image, None, fx=2, fy=2).astype(np.float32)
    level = level.reshape(120, 2, 130, 2).mean(axis=(1, 3))  # block means of the doubled image
    steps = np.arange(50) - 24.5
    u, v = np.meshgrid(steps, steps)  # in s / 2 = 1 px
    x = 60 + u * np.cos(angle) - v * np.sin(angle)
    y = 58 + u * np.sin(angle) + v * np.cos(angle)
    patch = cv2.remap(level, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    cells = patch.reshape(25, 2, 25, 2).sum(axis=(1, 3))
    dx = cells[:-1, 1:] + cells[1:, 1:] - cells[:-1, :-1] - cells[1:, :-1]
    dy = cells[1:, :-1] + cells[1:, 1:] - cells[:-1, :-1] - cells[:-1, 1:]
    weights = subregion_weights(24, 24)
    kinds = [weights @ response @ weights.T for response in (dx, dy, abs(dx), abs(dy))]
    expected = np.stack(kinds, axis=2).ravel()
    np.testing.assert_allclose(found[0], expected / np.linalg.norm(expected), atol=0.01)
