"""The fast-Hessian detector over all octaves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.surf.checks import LEAST_SIDE
from frontends.surf.keypoints import Keypoints
from frontends.surf.maxima import detect_pair
from frontends.surf.pyramid import Pyramid

_BASE_LOBE = 5  # of the lowest layer that can hold a maximum (filter 15); 9 lies below it


def detect(
    pyramid: Pyramid,
    octaves: int,
    layers: int,
    threshold: float,
    wanted: int | None,
    mask: NDArray[np.bool_] | None,
    guess: float = 0.0,
) -> Keypoints:
    """Keypoints of one image, strongest first, all at angle 0.

    Parameters
    ----------
    pyramid : Pyramid
    octaves, layers : int
        Octaves, and layers an octave that can hold a maximum.
    threshold : float
        Least response.
    wanted : int, optional
        Keep the strongest.
    mask : ndarray (H, W) bool, optional
        Where keypoints are allowed.
    guess : float
        A response that the weakest of the `wanted` may reach. It saves work if so, and an image
        is looked through twice if not; the result is the same.
    """
    rows = np.empty((0, 6), np.float32)
    if wanted is not None and guess > threshold:
        rows = _allowed(_maxima(pyramid, octaves, layers, guess), mask)
    if wanted is None or len(rows) < wanted:
        rows = _allowed(_maxima(pyramid, octaves, layers, threshold), mask)
    rows = rows[_falling(rows[:, 3])[:wanted]]
    return Keypoints(
        rows[:, :2],
        rows[:, 2],
        np.zeros(len(rows), np.float32),
        rows[:, 3],
        rows[:, 5].astype(np.int32),
        np.sign(rows[:, 4]).astype(np.int8),
    )


def _allowed(rows: NDArray[np.float32], mask: NDArray[np.bool_] | None) -> NDArray[np.float32]:
    """Keypoints where the mask is set."""
    if mask is None:
        return rows
    return rows[mask[np.rint(rows[:, 1]).astype(np.intp), np.rint(rows[:, 0]).astype(np.intp)]]


def _falling(values: NDArray[np.float32]) -> NDArray[np.intp]:
    """Order of falling positive values; equal ones stay as they are, whatever the sort.

    One sort of integers, value above index, which numpy does ten times as fast as a stable
    sort of indices.
    """
    high = ~np.ascontiguousarray(values).view(np.uint32)
    keys = (high.astype(np.uint64) << np.uint64(32)) | np.arange(len(values), dtype=np.uint64)
    keys.sort()
    return (keys & np.uint64(0xFFFFFFFF)).astype(np.intp)


def _maxima(pyramid: Pyramid, octaves: int, layers: int, threshold: float) -> NDArray[np.float32]:
    """Keypoints of each pair of layers of each octave: rows as `detect_pair` gives them."""
    height, width = pyramid.shape(0)
    capacity = height * width // 128 + 64
    rows = pyramid.buffers.get("maxima", shape=(capacity, 6), dtype=np.float32)
    count = 0
    for octave in range(octaves):
        if min(pyramid.shape(octave)) < LEAST_SIDE:
            break
        level = pyramid.level(octave)
        for first in range(0, layers, 2):
            single = first + 1 == layers
            lobe = _BASE_LOBE + 2 * first
            while True:
                found = detect_pair(
                    *level, octave, lobe, np.float32(threshold), single, rows[count:]
                )
                if count + found < len(rows):
                    break
                more = np.empty((2 * (count + found), 6), np.float32)
                more[:count] = rows[:count]
                rows = more
            count += found
    return rows[:count]
