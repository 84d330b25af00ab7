"""Integral image, Hessian, maxima, descriptor: each against a slow reference."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from surf_images import blob, hessian_reference, textured

from frontends.surf import SURF, Keypoints
from frontends.surf.box_filters import response_at
from frontends.surf.integral import LEAD, STRIP, append_row, half_image, padded_length
from frontends.surf.maxima import detect_pair
from frontends.surf.subregions import subregion_weights

NO_BLOCKS = np.empty((0, 0), np.uint16)
PAD = 56  # pixels around the image in the tests' integral images


def integral_image(image: np.ndarray) -> np.ndarray:
    """The whole integral image in grey*4, of the image with its border continued."""
    height, width = image.shape[0] + 2 * PAD, image.shape[1] + 2 * PAD
    rows = 1 << (height + 1).bit_length()
    ring = np.zeros((rows, padded_length(width + 1)), np.int32)
    scratch = np.zeros((2, ring.shape[1] + LEAD), np.uint16)
    sums = np.zeros(ring.shape[1] + LEAD, np.int32)
    # row 0 of the padded image is row -PAD of the image, and a ring's slots follow the image
    for y in range(-PAD, image.shape[0] + PAD):
        append_row(image, NO_BLOCKS, y, -PAD, scratch, sums, ring)
    return np.roll(ring, PAD, axis=0)[: height + 1]


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
    """The sums of a bright image of 16 Mpx overflow 32 bits; small boxes must not notice."""
    image = np.full((4096, 1000), 255, np.uint8)
    ring = np.zeros((128, 1024), np.int32)
    scratch, sums = np.zeros((2, 1024 + LEAD), np.uint16), np.zeros(1024 + LEAD, np.int32)
    for _ in range(3):
        for y in range(4096):
            append_row(image, NO_BLOCKS, y, 0, scratch, sums, ring)
    corner = ring[[80, 120]][:, [940, 980]].astype(np.int64)
    found = corner[1, 1] - corner[0, 1] - corner[1, 0] + corner[0, 0]
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
        [
            [response_at(integral, -1, PAD + y, PAD + x, side // 3) for x in range(64)]
            for y in range(60)
        ]
    )
    inside = np.isfinite(det)
    scale = np.abs(det[inside]).max()
    np.testing.assert_allclose(found[..., 0][inside], det[inside], atol=1e-5 * scale)
    np.testing.assert_allclose(
        found[..., 1][inside], trace[inside], atol=1e-5 * np.abs(trace[inside]).max()
    )


def _maxima(image: np.ndarray, threshold: float) -> np.ndarray:
    """Rows x, y, size, response, trace, octave of the lowest pair of layers."""
    out = np.empty((20000, 6), np.float32)
    count = detect_pair(image, NO_BLOCKS, 0, 5, np.float32(threshold), False, out)
    return out[:count]


@pytest.mark.parametrize(("height", "width"), [(90, 70), (77, 141), (64, 200), (60, STRIP + 90)])
def test_maxima_are_those_of_all_layers(height: int, width: int) -> None:
    image = textured(7, height, width)
    dense = np.stack([hessian_reference(image, side)[0] for side in (9, 15, 21, 27)])
    threshold = 5.0
    expected, unsure = set(), set()
    # 16-bit sums of the larger dense filter drop a bit: responses carry an error of that size
    tolerance = 2e-3 * np.nanmax(np.abs(dense))
    for layer, margin in ((1, 11), (2, 14)):
        for y in range(margin, height - margin):
            for x in range(margin, width - margin):
                cube = dense[layer - 1 : layer + 2, y - 1 : y + 2, x - 1 : x + 2].copy()
                value = cube[1, 1, 1]
                if value < threshold:
                    continue
                step = _interpolated(cube)
                cube[1, 1, 1] = -np.inf
                lead = value - np.nanmax(cube)
                if lead > 0 and np.abs(step).max() <= 1:
                    expected.add((layer, y, x))
                if abs(lead) < tolerance or abs(np.abs(step).max() - 1) < 0.25:
                    unsure.add((layer, y, x))
    found = {}
    for row in _maxima(image, threshold):
        near = [
            (layer, y, x)
            for layer in (1, 2)
            for y in range(round(row[1]) - 1, round(row[1]) + 2)
            for x in range(round(row[0]) - 1, round(row[0]) + 2)
            if abs(dense[layer, y, x] - row[3]) < tolerance
        ]
        assert near
        # a maximum among them if there is one
        near.sort(key=lambda place: (place not in expected, place not in unsure))
        found[near[0]] = row
    assert len(expected) > 10
    assert set(found) ^ expected <= unsure
    assert len(set(found) ^ expected) <= 0.1 * len(expected)


def _interpolated(cube: np.ndarray) -> np.ndarray:
    """Offset of the extremum of the quadratic through 3 x 3 x 3 responses."""
    gradient, hessian = np.empty(3), np.empty((3, 3))
    unit = np.eye(3, dtype=int)
    for i in range(3):
        gradient[i] = 0.5 * (cube[tuple(1 + unit[i])] - cube[tuple(1 - unit[i])])
        hessian[i, i] = cube[tuple(1 + unit[i])] - 2 * cube[1, 1, 1] + cube[tuple(1 - unit[i])]
        for j in range(i):
            both, apart = unit[i] + unit[j], unit[i] - unit[j]
            hessian[i, j] = hessian[j, i] = 0.25 * (
                cube[tuple(1 + both)]
                + cube[tuple(1 - both)]
                - cube[tuple(1 + apart)]
                - cube[tuple(1 - apart)]
            )
    return -np.linalg.solve(hessian, gradient)


def test_strips_do_not_show() -> None:
    """Wide images are worked through in strips: the same keypoints, once each, at the seams.

    The bit that the larger filter drops depends on where a strip begins: a few that are hardly
    maxima come or go.
    """
    image = textured(17, 80, 4 * STRIP + 300)
    whole = SURF(20, upright=True).detectAndCompute(image)
    lost = all_of_them = 0
    for begin in (0, 300, STRIP - 100, 1500):
        part = SURF(20, upright=True).detectAndCompute(
            np.ascontiguousarray(image[:, begin : begin + 600])
        )
        # octaves 0 and 1 of windows that begin at an even column; away from the cut
        for xy, size, descriptor in zip(part[0].xy, part[0].size, part[1], strict=True):
            if size > 40 or not 150 < xy[0] < 450:
                continue
            place = np.flatnonzero(
                (np.abs(whole[0].xy - xy - (begin, 0)).max(axis=1) < 0.2)
                & (np.abs(whole[0].size - size) < 0.5)
            )
            assert len(place) <= 1
            all_of_them += 1
            lost += len(place) == 0
            assert len(place) == 0 or np.abs(whole[1][place[0]] - descriptor).max() < 0.06
    assert all_of_them > 100
    assert lost <= 0.02 * all_of_them


def test_extreme_contrast_does_not_overflow_16_bits() -> None:
    """A full-range blob gives the largest sums there are, in both dense layers."""
    image = np.full((80, 80), 255, np.uint8)
    image[37:44, 37:44] = 0
    found = _maxima(image, 1.0)
    x, y, _, response, _, _ = found[found[:, 3].argmax()]
    assert max(abs(y - 40), abs(x - 40)) <= 1
    expected = max(np.nanmax(hessian_reference(image, side)[0]) for side in (15, 21))
    assert response == pytest.approx(expected, rel=1e-3)


def test_ties_leave_exactly_one_candidate() -> None:
    """A blob centred between pixels has equal responses on both sides."""
    image = np.full((64, 64), 30, np.uint8)
    image[29:35, 29:35] = 220  # even side: symmetric about (31.5, 31.5)
    near = np.abs(_maxima(image, 100.0)[:, :2] - 31.5).max(axis=1) < 3
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
