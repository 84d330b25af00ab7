"""The descriptor for wide baselines and absolute matching: finer samples.

Where the fast descriptor takes one box sum a lattice point, this one adds 2 x 2 bilinear samples
of pitch s/2 a cell, which follows a turned Haar wavelet closely, and the window is 24s wide.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel
from frontends.surf.subregions import normalise

RESPONSES = 24  # a row of Haar responses
_CELLS = 25  # a row of cells of side s; a wavelet spans 2 x 2


@kernel
def describe_accurate(
    image: NDArray[np.uint16],
    centres: NDArray[np.float32],
    scales: NDArray[np.float32],
    order: NDArray[np.int64],
    angles: NDArray[np.float32],
    weights: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Accurate descriptors of the keypoints of one pyramid level.

    Parameters
    ----------
    image : ndarray (H, W) uint16
        The level, in grey*4; its border pixels continue outside.
    centres : ndarray (N, 2) float32
        x, y, with pixel centres at integers.
    scales : ndarray (N,) float32
        s in pixels of the level.
    order : ndarray (M,) int64
        Which keypoints, in the order to visit them.
    angles : ndarray (N,) float32
        Radians from the x axis towards the y axis.
    weights : ndarray (4, 24) float32
        From `subregion_weights`.
    out : ndarray (N, 64) float32
    """
    cells = np.zeros((_CELLS, _CELLS), np.float32)
    sums = np.zeros((4, 4, RESPONSES), np.float32)  # subregion row, kind, column
    zero = np.float32(0)
    # a hair inside the last pixel, so that the one after it exists
    right = np.float32(image.shape[1] - 1.001)
    bottom = np.float32(image.shape[0] - 1.001)
    for which in order:
        step = np.float32(0.5) * scales[which]
        cos = step * np.float32(math.cos(angles[which]))
        sin = step * np.float32(math.sin(angles[which]))
        for i in range(_CELLS):
            for j in range(_CELLS):
                total = zero
                for k in range(4):
                    u = np.float32(2 * j + (k & 1)) - np.float32(_CELLS - 0.5)
                    v = np.float32(2 * i + (k >> 1)) - np.float32(_CELLS - 0.5)
                    x = min(max(centres[which, 0] + u * cos - v * sin, zero), right)
                    y = min(max(centres[which, 1] + u * sin + v * cos, zero), bottom)
                    column, row = np.uint64(x), np.uint64(y)
                    fx = x - np.float32(column)
                    fy = y - np.float32(row)
                    one = np.uint64(1)
                    a, b = np.float32(image[row, column]), np.float32(image[row, column + one])
                    c = np.float32(image[row + one, column])
                    d = np.float32(image[row + one, column + one])
                    upper = a + fx * (b - a)
                    total += upper + fy * (c + fx * (d - c) - upper)
                cells[i, j] = total
        sums[:] = 0
        for i in range(RESPONSES):
            for j in range(RESPONSES):
                falling = cells[i + 1, j + 1] - cells[i, j]
                rising = cells[i, j + 1] - cells[i + 1, j]
                dx = falling + rising
                dy = falling - rising
                for band in range(4):
                    weight = weights[band, i]
                    sums[band, 0, j] += weight * dx
                    sums[band, 1, j] += weight * dy
                    sums[band, 2, j] += weight * abs(dx)
                    sums[band, 3, j] += weight * abs(dy)
        for band in range(4):
            for block in range(4):
                for kind in range(4):
                    total = zero
                    for j in range(RESPONSES):
                        total += weights[block, j] * sums[band, kind, j]
                    out[which, 16 * band + 4 * block + kind] = total
        normalise(out, which)
