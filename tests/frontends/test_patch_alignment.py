"""The sampling of the right image, against the formula it stands for."""

from __future__ import annotations

import numpy as np
import pytest

from frontends.patch_sampling import SPAN, sample

SIDE, HALF, CUBIC = 16, 8.0, -0.6


def weights(f):
    """Cubic convolution at a share f of the way between the middle two of four samples."""

    def kernel(x):
        x = abs(x)
        if x < 1:
            return ((CUBIC + 2) * x - (CUBIC + 3)) * x * x + 1
        return CUBIC * (((x - 5) * x + 8) * x - 4)

    return np.array([kernel(f + 1), kernel(f), kernel(f - 1), kernel(f - 2)])


def expected(image, u, v, slope_u, slope_v, mean):
    patch = np.empty((SIDE, SIDE))
    for j in range(SIDE):
        y = v + j - 7.5
        row = int(np.floor(v - 7.5)) + j
        for i in range(SIDE):
            x = u + (i - 7.5) * (1 - slope_u / HALF) - (j - 7.5) * slope_v / HALF
            column = int(np.floor(x))
            around = image[row - 1 : row + 3, column - 1 : column + 3] - mean
            patch[j, i] = weights(y - row) @ around @ weights(x - column)
    return patch.ravel()


@pytest.mark.parametrize("slope_u", [0.0, 0.02, -0.3, 0.5, -0.9, 2.0, -4.5])
@pytest.mark.parametrize("slope_v", [0.0, 0.7, -3.0])
def test_a_slanting_patch_is_the_cubic_convolution(slope_u, slope_v):
    """Gentle slopes are read side by side, steep ones one by one: the same values."""
    image = np.random.default_rng(0).integers(0, 256, (80, 120)).astype(np.uint8)
    rows, patch = np.zeros(SIDE * SPAN + SIDE, np.float32), np.empty(SIDE * SIDE, np.float32)
    u, v = 60.3, 40.7
    inside = sample(
        image.ravel(), *image.shape, u, v, slope_u, slope_v, np.float32(100), rows, patch
    )
    assert inside
    reference = expected(image.astype(float), u, v, slope_u, slope_v, 100.0)
    np.testing.assert_allclose(patch, reference, atol=5e-3)


@pytest.mark.parametrize(("u", "v"), [(8.0, 40.0), (111.5, 40.0), (60.0, 8.0), (60.0, 71.0)])
def test_a_patch_that_leaves_the_image_is_not_sampled(u, v):
    image = np.zeros((80, 120), np.uint8)
    rows, patch = np.zeros(SIDE * SPAN + SIDE, np.float32), np.empty(SIDE * SIDE, np.float32)
    assert not sample(image.ravel(), *image.shape, u, v, 0.0, 0.0, np.float32(0), rows, patch)
