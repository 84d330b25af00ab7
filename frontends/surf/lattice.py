"""Sub-pixel sampling of an integral image on an upright lattice.

Every upright Haar response with a side that is a multiple of the lattice pitch is a
difference of lattice values, so one sampling serves all of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import njit
from frontends.surf.windows import WINDOW_ROWS

# Fraction bits of the bilinear weights in each direction. Sums over the largest Haar wavelet
# (half of 4s x 4s at s = 3.6, grey*4) times 2^14 stay below 2^31; lattice values themselves wrap.
WEIGHT_BITS = 7
LATTICE_LANES = 24  # columns sampled: the n in use, rounded up for SIMD
LATTICE_PITCH = 32  # from one row to the next: responses of a whole row read beyond its end
LINE_LENGTH = 128  # of the scratch line: 21 * 3.6 + 3 pixels, rounded up to _CHUNK
_CHUNK = 32


@njit
def sample_lattice(
    ring: NDArray[np.int32],
    x: float,
    y: float,
    pitch: float,
    n: int,
    line: NDArray[np.int32],
    columns: NDArray[np.uint64],
    weights: NDArray[np.int32],
    out: NDArray[np.int32],
) -> None:
    """Bilinear samples of an integral image on an n x n lattice centred at (x, y).

    Parameters
    ----------
    ring : ndarray (WINDOW_ROWS, N) int32
        The rows of an integral image that contain the lattice, row r at r % WINDOW_ROWS.
    x, y : float
        Centre, in pixel edges of the ring (pixel i spans i .. i + 1).
    pitch : float
        Distance of the lattice lines in pixels.
    n : int
        Lines, at most 24.
    line, columns, weights : ndarray
        Scratch: int32 (128,), uint64 (24,), int32 (24,).
    out : ndarray (>= 32 n,) int32
        Samples times 2**14, modulo 2**32, row i from 32 i on: only differences over boxes mean
        something. Columns beyond n are copies of the first.
    """
    # Positions in fixed point: all cells have exactly the same size, so that differences of
    # boxes cancel the mean grey exactly, whatever the rounding of the weights.
    one = 1 << WEIGHT_BITS
    fraction = one - 1
    step = int(pitch * one + 0.5)
    start_x = int(x * one + 0.5) - (n - 1) * step // 2
    start_y = int(y * one + 0.5) - (n - 1) * step // 2
    first = start_x >> WEIGHT_BITS
    span = ((start_x + (n - 1) * step) >> WEIGHT_BITS) + 2 - first
    span = (span + _CHUNK - 1) // _CHUNK * _CHUNK  # no scalar remainder
    for j in range(LATTICE_LANES):
        position = start_x + (j * step if j < n else 0)
        columns[j] = np.uint64((position >> WEIGHT_BITS) - first)
        weights[j] = np.int32(position & fraction)
    left_edge = np.uint64(first)
    next_column = np.uint64(1)
    mask = WINDOW_ROWS - 1
    for i in range(n):
        position = start_y + i * step
        row = position >> WEIGHT_BITS
        weight = np.int32(position & fraction)
        upper, lower = np.uint64(row & mask), np.uint64((row + 1) & mask)
        for k in range(np.uint64(span)):
            above = ring[upper, left_edge + k]
            below = ring[lower, left_edge + k]
            # each step cut to 32 bits: otherwise numba works in 64, three times as slow
            slope = np.int32(np.int32(below - above) * weight)
            line[k] = np.int32(np.int32(above << WEIGHT_BITS) + slope)
        place = np.uint64(LATTICE_PITCH * i)
        for j in range(LATTICE_LANES):
            left = line[columns[j]]
            right = line[columns[j] + next_column]
            slope = np.int32(np.int32(right - left) * weights[j])
            out[place + np.uint64(j)] = np.int32(np.int32(left << WEIGHT_BITS) + slope)
