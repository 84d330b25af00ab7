"""Integral image, Hessian, maxima, descriptor: each against a slow reference."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from surf_images import blob, hessian_reference, textured

from frontends.surf import SURF, Keypoints
from frontends.surf.box_filters import response_at
from frontends.surf.integral import PAD, half_image, integral_image
from frontends.surf.maxima import NEIGHBOURS, detect_pair
from frontends.surf.subregions import subregion_weights


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    height=st.integers(1, 70),
    width=st.integers(1, 70),
    data=st.data(),
)
def test_box_sums_are_exact(seed: int, height: int, width: int, data: st.DataObject) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (height, width)).astype(np.uint8)
    integral = integral_image(image).astype(np.int64)
    padded = np.pad(image.astype(np.int64), PAD, mode="edge")
    y0, y1 = sorted(data.draw(st.tuples(*[st.integers(0, height + 2 * PAD)] * 2)))
    x0, x1 = sorted(data.draw(st.tuples(*[st.integers(0, width + 2 * PAD)] * 2)))
    found = integral[y1, x1] - integral[y0, x1] - integral[y1, x0] + integral[y0, x0]
    assert found == 4 * padded[y0:y1, x0:x1].sum()


def test_integral_wraps_harmlessly() -> None:
    """A bright image of 16 Mpx overflows 32 bits; small boxes must not notice."""
    image = np.full((4096, 4096), 255, np.uint8)
    integral = integral_image(image)
    corner = integral[-41:, 4200 - 40 : 4200 + 1].astype(np.int64)
    found = corner[40, 40] - corner[0, 40] - corner[40, 0] + corner[0, 0]
    assert found % 2**32 == 4 * 255 * 1600


def test_halving_means_blocks() -> None:
    image = textured(3, 61, 75)
    blocks = image[:60, :74].astype(int).reshape(30, 2, 37, 2).sum(axis=(1, 3))
    first = half_image(image)
    np.testing.assert_array_equal(first, blocks)
    second = half_image(first)
    means = first[:30, :36].astype(int).reshape(15, 2, 18, 2).sum(axis=(1, 3))
    np.testing.assert_array_equal(second, (means + 2) // 4)


@pytest.mark.parametrize("side", [9, 15, 21, 27])
def test_response_matches_convolution(side: int) -> None:
    image = textured(5, 60, 64)
    det, trace = hessian_reference(image, side)
    integral = integral_image(image)
    found = np.array(
        [[response_at(integral, PAD + y, PAD + x, side // 3) for x in range(64)] for y in range(60)]
    )
    inside = np.isfinite(det)
    scale = np.abs(det[inside]).max()
    np.testing.assert_allclose(found[..., 0][inside], det[inside], atol=1e-5 * scale)
    np.testing.assert_allclose(
        found[..., 1][inside], trace[inside], atol=1e-5 * np.abs(trace[inside]).max()
    )


def _candidates(image: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    integral = integral_image(image)
    positions = np.empty((20000, 3), np.int32)
    neighbours = np.empty((20000, NEIGHBOURS), np.float32)
    count = detect_pair(
        integral,
        image.shape[1],
        5,
        np.float32(threshold),
        False,
        positions,
        neighbours,
        np.empty(20000, np.float32),
    )
    return positions[:count], neighbours[:count]


@pytest.mark.parametrize(("height", "width"), [(90, 70), (77, 141), (64, 200)])
def test_candidates_are_the_maxima_of_both_layers(height: int, width: int) -> None:
    image = textured(7, height, width)
    dense = np.stack([hessian_reference(image, side)[0] for side in (15, 21)])
    threshold = 5.0
    expected = set()
    # 16-bit sums of the larger filter drop a bit: responses carry an error of that size
    tolerance = 2e-3 * np.nanmax(np.abs(dense))
    unsure = set()
    for layer, margin in ((0, 11), (1, 14)):
        for y in range(margin, height - margin):
            for x in range(margin, width - margin):
                cube = dense[:, y - 1 : y + 2, x - 1 : x + 2].copy()
                value = cube[layer, 1, 1]
                cube[layer, 1, 1] = -np.inf
                lead = value - max(np.nanmax(cube), threshold)
                if lead > 0:
                    expected.add((layer, y, x))
                if abs(lead) < tolerance:
                    unsure.add((layer, y, x))
    positions, neighbours = _candidates(image, threshold)
    found = {tuple(int(v) for v in row) for row in positions}
    assert len(expected) > 10
    assert (found ^ expected) <= unsure
    assert len(found ^ expected) <= 0.1 * len(expected)
    for (layer, y, x), values in zip(positions, neighbours, strict=True):
        cube = dense[:, y - 1 : y + 2, x - 1 : x + 2]
        known = np.isfinite(cube)
        error = np.abs(values.reshape(2, 3, 3) - cube)[known]
        assert error.max() < tolerance
        assert values[9 * layer + 4] == values.max()


def test_extreme_contrast_does_not_overflow_16_bits() -> None:
    """A full-range blob gives the largest sums there are, in both dense layers."""
    image = np.full((80, 80), 255, np.uint8)
    image[37:44, 37:44] = 0
    positions, neighbours = _candidates(image, 1.0)
    _, y, x = positions[neighbours.max(axis=1).argmax()]
    assert max(abs(y - 40), abs(x - 40)) <= 1
    expected = max(np.nanmax(hessian_reference(image, side)[0]) for side in (15, 21))
    assert neighbours.max() == pytest.approx(expected, rel=1e-3)


def test_ties_leave_exactly_one_candidate() -> None:
    """A blob centred between pixels has equal responses on both sides."""
    image = np.full((64, 64), 30, np.uint8)
    image[30:34, 30:34] = 220  # even side: symmetric about (31.5, 31.5)
    positions, _ = _candidates(image, 100.0)
    near = np.abs(positions[:, 1:] - 31.5).max(axis=1) < 3
    assert near.sum() == 1


@settings(max_examples=25, deadline=None)
@given(
    x=st.floats(40, 56), y=st.floats(40, 56), sigma=st.floats(2.6, 4.0)
)  # fmt: skip
def test_blob_is_found_to_a_fifth_of_a_pixel(x: float, y: float, sigma: float) -> None:
    keypoints = SURF(hessian_threshold=50).detect(blob(x, y, sigma))
    assert len(keypoints) >= 1
    assert np.abs(keypoints.xy[0] - (x, y)).max() < 0.2
    assert keypoints.laplacian[0] == -1  # bright


def test_blob_size_is_that_of_its_gaussian() -> None:
    """A filter of side L stands for a Gaussian of 1.2 / 9 L; the best one grows as the blob."""
    sigmas = np.array([2.7, 4, 6, 9])
    sizes = [SURF(50).detect(blob(99.3, 98.8, s, (200, 200))).size[0] for s in sigmas]
    ratio = np.array(sizes) * 1.2 / 9 / sigmas
    assert (np.abs(ratio / ratio.mean() - 1) < 0.12).all()
    assert 0.7 < ratio.mean() < 1.3


def _descriptor_reference(image: np.ndarray, x: int, y: int, scale: int) -> np.ndarray:
    """Upright descriptor at a whole pixel and a whole s, by explicit box sums."""
    edge_x, edge_y = x + 0.5, y + 0.5
    fine = np.kron(image.astype(float), np.ones((2, 2)))  # half pixels, so edges are whole

    def box(y0: float, y1: float, x0: float, x1: float) -> float:
        return float(fine[int(2 * y0) : int(2 * y1), int(2 * x0) : int(2 * x1)].sum())

    out = np.zeros((4, 4, 4))
    weights = subregion_weights(20, 20).astype(float)
    for i in range(20):
        for j in range(20):
            cy = edge_y + (i - 9.5) * scale
            cx = edge_x + (j - 9.5) * scale
            top, bottom, left, right = cy - scale, cy + scale, cx - scale, cx + scale
            dx = box(top, bottom, cx, right) - box(top, bottom, left, cx)
            dy = box(cy, bottom, left, right) - box(top, cy, left, right)
            share = np.outer(weights[:, i], weights[:, j])
            out += share[:, :, None] * np.array([dx, dy, abs(dx), abs(dy)])
    return out.ravel() / np.linalg.norm(out)


def test_upright_descriptor_matches_eq_11() -> None:
    image = textured(11, 120, 130)
    surf = SURF(upright=True)
    spot = Keypoints(
        np.array([[60, 58]], np.float32),
        np.array([15.0], np.float32),  # s = 2
        np.zeros(1, np.float32),
        np.ones(1, np.float32),
        np.zeros(1, np.int32),
        np.zeros(1, np.int8),
    )
    _, descriptors = surf.compute(image, spot)
    expected = _descriptor_reference(image, 60, 58, 2)
    np.testing.assert_allclose(descriptors[0], expected, atol=2e-4)
