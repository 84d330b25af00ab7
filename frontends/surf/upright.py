"""The upright descriptor: Haar responses as differences on a sampled lattice."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit
from frontends.surf.lattice import LATTICE_LANES, LATTICE_PITCH, LINE_LENGTH, sample_lattice
from frontends.surf.subregions import (
    FIRST_DX,
    FIRST_DY,
    HAAR_LENGTH,
    LANES,
    RESPONSES,
    SUMS_LENGTH,
    gather_bands,
)
from frontends.surf.windows import (
    LINE,
    NOWHERE,
    RING_COLUMNS,
    WINDOW_ROWS,
    extend_integral,
    strip_of,
)

LINES = 22  # of the lattice


@njit
def describe_upright(
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
    sums: NDArray[np.float32],
    out: NDArray[np.float32],
    which: int,
) -> None:
    """Upright descriptor (eq. 11) of one keypoint.

    Parameters
    ----------
    ring : ndarray (WINDOW_ROWS, RING_COLUMNS) int32
        From `extend_integral`.
    x, y : float
        Centre, in pixel edges of the ring.
    scale : float
        s in pixels.
    weights : ndarray (36,) float32
        From `reach_weights`.
    line, columns, fractions, lattice : ndarray
        Scratch of `sample_lattice`.
    haar, sums : ndarray
        Scratch of `gather_bands`.
    out : ndarray (N, 64) float32
    which : int
        Row of `out` to write.
    """
    sample_lattice(ring, x, y, scale, LINES, line, columns, fractions, lattice)
    one, two = np.uint64(1), np.uint64(2)
    for i in range(RESPONSES):
        dx, dy = np.uint64(FIRST_DX + LANES * i), np.uint64(FIRST_DY + LANES * i)
        for j in range(np.uint64(LANES)):
            # casts keep the arithmetic in 32-bit lanes
            a = np.uint64(LATTICE_PITCH * i) + j
            b = np.uint64(LATTICE_PITCH * (i + 1)) + j
            c = np.uint64(LATTICE_PITCH * (i + 2)) + j
            left = np.int32(lattice[c] - lattice[a])
            middle = np.int32(lattice[c + one] - lattice[a + one])
            right = np.int32(lattice[c + two] - lattice[a + two])
            haar[dx + j] = np.float32(np.int32(np.int32(left + right) - np.int32(middle << 1)))
            top = np.int32(lattice[a + two] - lattice[a])
            middle = np.int32(lattice[b + two] - lattice[b])
            bottom = np.int32(lattice[c + two] - lattice[c])
            haar[dy + j] = np.float32(np.int32(np.int32(top + bottom) - np.int32(middle << 1)))
    gather_bands(haar, weights, sums, out, which)


@kernel
def describe_upright_level(
    grey: NDArray[np.uint8],
    blocks: NDArray[np.uint16],
    centres: NDArray[np.float32],
    scales: NDArray[np.float32],
    order: NDArray[np.int64],
    weights: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Upright descriptors of the keypoints `order` of one pyramid level.

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
    weights : ndarray (36,) float32
        From `reach_weights`.
    out : ndarray (N, 64) float32
    """
    line = np.zeros(LINE_LENGTH, np.int32)
    columns = np.zeros(LATTICE_LANES, np.uint64)
    fractions = np.zeros(LATTICE_LANES, np.int32)
    lattice = np.zeros(LINES * LATTICE_PITCH, np.int32)
    haar = np.zeros(HAAR_LENGTH, np.float32)
    sums = np.zeros(SUMS_LENGTH, np.float32)
    scratch = np.zeros((2, LINE), np.uint16)
    prefix = np.zeros(LINE, np.int32)
    ring = np.zeros((WINDOW_ROWS, RING_COLUMNS), np.int32)
    left, newest = NOWHERE, NOWHERE
    for i in order:
        x, y, scale = float(centres[i, 0]), float(centres[i, 1]), float(scales[i])
        if strip_of(x) != left:
            left, newest = strip_of(x), NOWHERE
        newest = extend_integral(grey, blocks, left, y, newest, scratch, prefix, ring)
        describe_upright(
            ring, x - left, y, scale, weights, line, columns, fractions, lattice, haar, sums, out, i
        )
