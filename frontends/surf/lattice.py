"""Sub-pixel sampling of an integral image on an upright lattice.

Every upright Haar response with a side that is a multiple of the lattice pitch is a
difference of lattice values, so one sampling serves all of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.surf._jit import njit

# Fraction bits of the bilinear weights in each direction. Sums over the largest Haar wavelet
# (half of 4s x 4s at s = 3.6, grey*4) times 2^14 stay below 2^31; lattice values themselves wrap.
WEIGHT_BITS = 7


@njit
def sample_lattice(
    integral: NDArray[np.int32],
    x: float,
    y: float,
    pitch: float,
    line: NDArray[np.int32],
    out: NDArray[np.int32],
) -> None:
    """Bilinear samples of an integral image on an n x n lattice centred at (x, y).

    Parameters
    ----------
    integral : ndarray int32
        Integral image, padded enough to contain the lattice.
    x, y : float
        Centre, in pixel edges of the padded image (pixel i spans i .. i + 1).
    pitch : float
        Distance of the lattice lines in pixels.
    line : ndarray (>= (n - 1) * pitch + 3,) int32
        Scratch.
    out : ndarray (n, n) int32
        Samples times 2**14, modulo 2**32: only differences over boxes mean something.
    """
    n = out.shape[0]
    one = 1 << WEIGHT_BITS
    start_x = x - 0.5 * (n - 1) * pitch
    start_y = y - 0.5 * (n - 1) * pitch
    first = int(start_x)
    span = int(start_x + (n - 1) * pitch) + 2 - first
    columns = np.empty(n, np.int32)
    weights = np.empty(n, np.int32)
    for j in range(n):
        position = start_x - first + j * pitch
        columns[j] = int(position)
        weights[j] = int((position - columns[j]) * one)
    for i in range(n):
        position = start_y + i * pitch
        row = int(position)
        weight = np.int32((position - row) * one)
        above = integral[row][first : first + span]
        below = integral[row + 1][first : first + span]
        for k in range(span):
            line[k] = np.int32((above[k] << WEIGHT_BITS) + (below[k] - above[k]) * weight)
        target = out[i]
        for j in range(n):
            left = line[columns[j]]
            right = line[columns[j] + 1]
            target[j] = np.int32((left << WEIGHT_BITS) + (right - left) * weights[j])
