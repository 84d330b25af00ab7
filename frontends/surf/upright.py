"""The upright descriptor: Haar responses as differences on a sampled lattice."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit
from frontends.surf.lattice import LATTICE_LANES, LINE_LENGTH, sample_lattice
from frontends.surf.subregions import LANES, gather_bands, normalise

LINES = 22  # of the lattice


@njit
def describe_upright(
    integral: NDArray[np.int32],
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
    integral : ndarray int32
        Padded integral image.
    x, y : float
        Centre, in pixel edges of the padded image.
    scale : float
        s in pixels.
    weights : ndarray (4, 24) float32
        From `subregion_weights`.
    line, columns, fractions, lattice : ndarray
        Scratch of `sample_lattice`, the lattice (22, 32).
    haar, sums : ndarray
        Scratch: float32 (2, 20, 24), float32 (4, 24).
    out : ndarray (N, 64) float32
    which : int
        Row of `out` to write.
    """
    sample_lattice(integral, x, y, scale, LINES, line, columns, fractions, lattice)
    for i in range(20):
        for j in range(LANES):
            # quadrants of the wavelet; casts keep the arithmetic in 32-bit lanes
            upper = np.int32(lattice[i + 1, j] - lattice[i, j])
            lower = np.int32(lattice[i + 2, j] - lattice[i + 1, j])
            upper_mid = np.int32(lattice[i + 1, j + 1] - lattice[i, j + 1])
            lower_mid = np.int32(lattice[i + 2, j + 1] - lattice[i + 1, j + 1])
            upper_end = np.int32(lattice[i + 1, j + 2] - lattice[i, j + 2])
            lower_end = np.int32(lattice[i + 2, j + 2] - lattice[i + 1, j + 2])
            left = np.int32(np.int32(upper_mid - upper) + np.int32(lower_mid - lower))
            right = np.int32(np.int32(upper_end - upper_mid) + np.int32(lower_end - lower_mid))
            top = np.int32(upper_end - upper)
            bottom = np.int32(lower_end - lower)
            haar[0, i, j] = np.float32(np.int32(right - left))
            haar[1, i, j] = np.float32(np.int32(bottom - top))
    gather_bands(haar, weights, sums, out, which)
    normalise(out, which)


@kernel
def describe_upright_level(
    integral: NDArray[np.int32],
    centres: NDArray[np.float32],
    scales: NDArray[np.float32],
    order: NDArray[np.int64],
    weights: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Upright descriptors of the keypoints `order` of one pyramid level.

    Parameters
    ----------
    integral : ndarray int32
        Padded integral image of the level.
    centres : ndarray (N, 2) float32
        x, y in pixel edges of the padded level.
    scales : ndarray (N,) float32
        s in pixels of the level.
    order : ndarray (M,) int64
        Which keypoints, in the order to visit them.
    weights : ndarray (4, 24) float32
        From `subregion_weights`.
    out : ndarray (N, 64) float32
    """
    line = np.zeros(LINE_LENGTH, np.int32)
    columns = np.zeros(LATTICE_LANES, np.uint64)
    fractions = np.zeros(LATTICE_LANES, np.int32)
    lattice = np.zeros((LINES, LATTICE_LANES + 8), np.int32)
    haar = np.zeros((2, 20, LANES), np.float32)
    sums = np.zeros((4, LANES), np.float32)
    for i in order:
        x, y, scale = float(centres[i, 0]), float(centres[i, 1]), float(scales[i])
        describe_upright(
            integral, x, y, scale, weights, line, columns, fractions, lattice, haar, sums, out, i
        )
