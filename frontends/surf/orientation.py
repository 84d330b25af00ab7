"""Dominant orientation (Bay et al., section on orientation assignment).

Haar responses of side 4s on a grid of pitch s within 6s of the keypoint, Gaussian-weighted;
the 60-degree sector with the longest sum vector gives the angle.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit
from frontends.surf.lattice import LATTICE_LANES, LATTICE_PITCH, LINE_LENGTH, sample_lattice
from frontends.surf.windows import (
    LINE,
    NOWHERE,
    RING_COLUMNS,
    WINDOW_ROWS,
    extend_integral,
    strip_of,
)

LINES = 17  # lattice lines: samples at -6 .. 6, wavelets reaching 2 further
_BINS = 72  # 5 degrees each
_SECTOR = 12  # bins in 60 degrees
_SIGMA = 2.5  # of the weights, in s


_LANES = 16  # 13 samples a row, rounded up for SIMD
_TURN = 96  # 72 bins, the first 12 again behind them, rounded up for SIMD
BINS_LENGTH = _TURN + 8  # room for reading ahead


def sample_weights() -> NDArray[np.float32]:
    """Gaussian weights of the 13 x 13 samples, zero beyond the radius of 6.

    Returns
    -------
    ndarray (13, 16) float32
        The last three columns are zero.
    """
    x = np.arange(_LANES) - 6
    y = np.arange(13) - 6
    squared = y[:, None] ** 2 + x[None, :] ** 2
    weights = np.exp(squared / (-2 * _SIGMA**2)) * (squared < 36)
    return np.ascontiguousarray(weights, dtype=np.float32)


@njit
def _responses(
    lattice: NDArray[np.int32],
    weights: NDArray[np.float32],
    haar: NDArray[np.float32],
    bin_of: NDArray[np.int32],
) -> None:
    """Weighted Haar responses of side 4s and the bins of their directions."""
    two, four = np.uint64(2), np.uint64(4)
    for i in range(13):
        for j in range(np.uint64(_LANES)):
            # casts keep the arithmetic in 32-bit lanes
            a = np.uint64(LATTICE_PITCH * i) + j
            b = np.uint64(LATTICE_PITCH * (i + 2)) + j
            c = np.uint64(LATTICE_PITCH * (i + 4)) + j
            left = np.int32(lattice[c] - lattice[a])
            middle = np.int32(lattice[c + two] - lattice[a + two])
            right = np.int32(lattice[c + four] - lattice[a + four])
            dx = np.int32(np.int32(left + right) - np.int32(middle << 1))
            top = np.int32(lattice[a + four] - lattice[a])
            middle = np.int32(lattice[b + four] - lattice[b])
            bottom = np.int32(lattice[c + four] - lattice[c])
            dy = np.int32(np.int32(top + bottom) - np.int32(middle << 1))
            haar[0, i, j] = weights[i, j] * np.float32(dx)
            haar[1, i, j] = weights[i, j] * np.float32(dy)
    for i in range(13):
        for j in range(_LANES):
            dx = haar[0, i, j]
            dy = haar[1, i, j]
            ax = abs(dx)
            ay = abs(dy)
            # atan2 in turns: a cubic in min / max, good to 0.1 degrees
            ratio = (ax if ax < ay else ay) / ((ax if ax > ay else ay) + np.float32(1e-30))
            square = ratio * ratio
            turn = ratio * (
                np.float32(0.15903) + square * (np.float32(-0.04930) + square * np.float32(0.01545))
            )
            turn = np.float32(0.25) - turn if ay > ax else turn
            turn = np.float32(0.5) - turn if dx < 0 else turn
            turn = np.float32(1) - turn if dy < 0 else turn
            bin_of[i, j] = np.int32(turn * np.float32(_BINS))


@njit
def _sector_sums(sums: NDArray[np.float32], work: NDArray[np.float32]) -> None:
    """Replace bins by sums over the 12 bins from each one on: 12 = 8 + 4."""
    for axis in range(2):
        for k in range(_SECTOR):
            sums[axis, _BINS + k] = sums[axis, k]
        for k in range(_TURN):
            work[0, k] = sums[axis, k] + sums[axis, k + 1]
        for k in range(_TURN):
            work[1, k] = work[0, k] + work[0, k + 2]
        for k in range(_TURN):
            work[0, k] = work[1, k] + work[1, k + 4]
        for k in range(_BINS):
            sums[axis, k] = work[0, k] + work[1, k + 8]


@njit
def orientation(
    ring: NDArray[np.int32],
    x: float,
    y: float,
    scale: float,
    weights: NDArray[np.float32],
    line: NDArray[np.int32],
    columns: NDArray[np.uint64],
    fractions: NDArray[np.int32],
    lattice: NDArray[np.int32],
    haar: NDArray[np.float32],
    bin_of: NDArray[np.int32],
    sums: NDArray[np.float32],
    work: NDArray[np.float32],
) -> float:
    """Dominant orientation at one keypoint.

    Parameters
    ----------
    ring : ndarray (WINDOW_ROWS, RING_COLUMNS) int32
        From `extend_integral`.
    x, y : float
        Centre, in pixel edges of the ring.
    scale : float
        s in pixels.
    weights : ndarray (13, 16) float32
        From `sample_weights`.
    line, columns, fractions, lattice : ndarray
        Scratch of `sample_lattice`.
    haar, bin_of, sums, work : ndarray
        Scratch: float32 (2, 13, 16), int32 (13, 16), float32 (2, 104), float32 (2, 104).

    Returns
    -------
    float
        Radians in [0, 2 pi), from the x axis towards the y axis (down).
    """
    sample_lattice(ring, x, y, scale, LINES, line, columns, fractions, lattice)
    _responses(lattice, weights, haar, bin_of)
    sums[:] = 0
    for i in range(13):
        for j in range(13):
            if weights[i, j] > 0:
                k = min(max(bin_of[i, j], 0), _BINS - 1)
                sums[0, k] += haar[0, i, j]
                sums[1, k] += haar[1, i, j]
    _sector_sums(sums, work)
    for k in range(_BINS):
        work[0, k] = sums[0, k] * sums[0, k] + sums[1, k] * sums[1, k]
    best = 0
    for k in range(1, _BINS):
        if work[0, k] > work[0, best]:
            best = k
    angle = math.atan2(sums[1, best], sums[0, best])
    return angle if angle >= 0 else angle + 2 * math.pi


@kernel
def orient_level(
    grey: NDArray[np.uint8],
    blocks: NDArray[np.uint16],
    centres: NDArray[np.float32],
    scales: NDArray[np.float32],
    order: NDArray[np.int64],
    weights: NDArray[np.float32],
    angles: NDArray[np.float32],
) -> None:
    """Orientations of the keypoints `order` of one pyramid level.

    Parameters
    ----------
    grey, blocks : ndarray (H, W)
        The level; one of the two is empty, see `integral`.
    centres : ndarray (N, 2) float32
        x, y in pixel edges of the level.
    scales : ndarray (N,) float32
        s in pixels of the level.
    order : ndarray (M,) int64
        Which keypoints, by strip, and by row within it.
    weights : ndarray (13, 16) float32
        From `sample_weights`.
    angles : ndarray (N,) float32
        Out: radians.
    """
    line = np.zeros(LINE_LENGTH, np.int32)
    columns = np.zeros(LATTICE_LANES, np.uint64)
    fractions = np.zeros(LATTICE_LANES, np.int32)
    lattice = np.zeros((LINES + 5) * LATTICE_PITCH, np.int32)
    haar = np.zeros((2, 13, _LANES), np.float32)
    bin_of = np.zeros((13, _LANES), np.int32)
    sums = np.zeros((2, BINS_LENGTH), np.float32)
    work = np.zeros((2, BINS_LENGTH), np.float32)
    scratch = np.zeros((2, LINE), np.uint16)
    prefix = np.zeros(LINE, np.int32)
    ring = np.zeros((WINDOW_ROWS, RING_COLUMNS), np.int32)
    left, newest = NOWHERE, NOWHERE
    for i in order:
        x, y, scale = float(centres[i, 0]), float(centres[i, 1]), float(scales[i])
        if strip_of(x) != left:
            left, newest = strip_of(x), NOWHERE
        newest = extend_integral(grey, blocks, left, y, newest, scratch, prefix, ring)
        angles[i] = orientation(
            ring, x - left, y, scale, weights, line, columns, fractions, lattice, haar, bin_of,
            sums, work,
        )  # fmt: skip
