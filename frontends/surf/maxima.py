"""Maxima of the fast Hessian over two neighbouring layers.

Two layers (lobes l and l + 2) are evaluated densely, a row at a time; the layers below and
above are evaluated only where a candidate beats its dense neighbours (`refinement`), while its
rows are in the cache.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit
from frontends.surf.dense_rows import dense_row, lobe_shift, narrow
from frontends.surf.integral import (
    FRACTION_BITS,
    LEAD,
    STRIP,
    append_row,
    level_shape,
    padded_length,
)
from frontends.surf.refinement import refine

_ASIDE = 8  # columns left of a strip, for the filters of the layer above


@njit
def _best_of_layers(
    dense: NDArray[np.float32], slot: int, best: NDArray[np.float32], n: int
) -> None:
    for x in range(np.uint64(n)):
        a = dense[0, slot, x]
        b = dense[1, slot, x]
        best[slot, x] = a if a > b else b


@njit
def _flag_maxima(
    best: NDArray[np.float32],
    centre: int,
    least: np.float32,
    column: NDArray[np.float32],
    flags: NDArray[np.uint8],
    n: int,
) -> None:
    """Flag where row `centre` reaches `least` and the maximum of its 3 x 3 neighbourhood.

    ``flags[x]`` is for column x + 1 of `best`.
    """
    above = (centre - 1) & 3
    middle = centre & 3
    below = (centre + 1) & 3
    for x in range(np.uint64(n)):
        top = best[above, x] if best[above, x] > best[middle, x] else best[middle, x]
        column[x] = top if top > best[below, x] else best[below, x]
    one = np.uint64(1)
    two = np.uint64(2)
    for x in range(np.uint64(n)):
        top = column[x] if column[x] > column[x + one] else column[x + one]
        top = top if top > column[x + two] else column[x + two]
        top = top if top > least else least
        flags[x] = best[middle, x + one] >= top


@njit
def _collect(flags: NDArray[np.uint8], words: NDArray[np.uint64], found: NDArray[np.int64]) -> int:
    """List the columns that are flagged; returns how many.

    Eight flags are one word. A block of 64 without any is the usual case on plain ground, and
    within a word a branch a flag would be mispredicted more often than not.
    """
    count = 0
    for block in range(0, words.size, 8):
        together = np.uint64(0)
        for word in range(8):
            together |= words[np.uint64(block + word)]
        if together == 0:
            continue
        for word in range(block, block + 8):
            if words[np.uint64(word)] == 0:
                continue
            for flag in range(8 * word, 8 * word + 8):
                found[np.uint64(count)] = flag
                count += int(flags[np.uint64(flag)])
    return count


@njit
def _gather_neighbours(
    dense: NDArray[np.float32], centre: int, k: int, layer: int, cube: NDArray[np.float32]
) -> bool:
    """Copy the neighbours of column `k` of `dense`; whether none before it is as high."""
    value = dense[layer, centre & 3, k]
    here = 9 * layer + 4
    ties = 0
    for other in range(2):
        for row in range(3):
            slot = (centre + row - 1) & 3
            for col in range(3):
                place = 9 * other + 3 * row + col
                response = dense[other, slot, np.uint64(k - 1 + col)]
                cube[other + 1 - layer, row, col] = response
                ties += (response >= value) & (place < here)
    return ties == 0


@kernel
def detect_pair(
    grey: NDArray[np.uint8],
    blocks: NDArray[np.uint16],
    octave: int,
    lobe: int,
    threshold: np.float32,
    single: bool,
    out: NDArray[np.float32],
) -> int:
    """Keypoints of two dense layers: maxima of their 3 x 3 x 3 neighbours, interpolated.

    Ties among the dense layers go to the first in (layer, row, column) order, so that exactly
    one response of a symmetric structure survives.

    Parameters
    ----------
    grey, blocks : ndarray (H, W)
        The level; one of the two is empty, see `integral`.
    octave : int
        The level's blocks have 2^octave x 2^octave pixels.
    lobe : int
        l of the lower layer; the upper one has l + 2.
    threshold : float
        Least response.
    single : bool
        True: only maxima in the lower layer are wanted.
    out : ndarray (N, 6) float32
        x, y, size (pixels of the image), response, trace, octave of each keypoint.

    Returns
    -------
    int
        Number of keypoints; above N - 1, not all were stored.
    """
    h, w = level_shape(grey, blocks)
    lobes = (lobe, lobe + 2)
    margin = lobes[1] + lobes[1] // 2  # half of the upper filter
    widest = lobe + 4 + (lobe + 4) // 2  # half of the filter above it
    shifts = (lobe_shift(lobe), lobe_shift(lobe + 2))
    if h <= 2 * margin + 2 or w <= 2 * margin + 2:
        return 0

    # the first and the last response of a strip only serve as neighbours
    wanted = w - 2 * margin - 2
    strips = (wanted + STRIP - 3) // (STRIP - 2)
    n = padded_length((wanted + strips - 1) // strips + 2)  # columns evaluated at a time
    first = margin + _ASIDE  # where the first of them is in the ring
    columns = n + padded_length(first + widest + 2)
    rows = 32 if 2 * widest + 2 <= 32 else 64
    mask = rows - 1
    scratch = np.zeros((2, columns + LEAD), np.uint16)
    sums = np.zeros(columns + LEAD, np.int32)
    ring = np.zeros((rows, columns), np.int32)
    rings = np.zeros((2, rows, columns), np.int16)
    work = np.zeros((3, columns), np.int16)
    dense = np.zeros((2, 4, n), np.float32)  # the last rows of each layer's responses
    best = np.zeros((4, n + 2), np.float32)  # and of the larger of the two
    column = np.zeros(n + 2, np.float32)
    flag_words = np.zeros(n // 8, np.uint64)
    flags = flag_words.view(np.uint8)
    found = np.zeros(n + 1, np.int64)
    cube = np.zeros((3, 3, 3), np.float32)
    above = np.nextafter(threshold, np.float32(np.inf))
    drop0 = FRACTION_BITS + shifts[0]
    drop1 = FRACTION_BITS + shifts[1]
    block = np.float32(1 << octave)
    half = np.float32(0.5)
    count = 0

    for left in range(0, wanted, n - 2):
        ring[0] = 0
        for newest in range(h + widest - margin):
            if newest <= h:
                narrow(ring, newest & mask, columns, drop0, drop1, rings)
                append_row(grey, blocks, newest, left - _ASIDE, scratch, sums, ring)
            y = newest - widest
            if y < margin:
                continue
            slot = y & 3
            dense_row(rings[0], y, lobes[0], first, n, shifts[0], work, dense, 0, slot)
            dense_row(rings[1], y, lobes[1], first, n, shifts[1], work, dense, 1, slot)
            _best_of_layers(dense, slot, best, n)
            centre = y - 1
            if centre <= margin:
                continue
            _flag_maxima(best, centre, above, column, flags, n)
            for i in range(_collect(flags, flag_words, found)):
                k = found[np.uint64(i)] + 1
                layer = 0 if dense[0, centre & 3, k] >= dense[1, centre & 3, k] else 1
                if (layer == 1 and single) or k > n - 2:
                    continue
                x = left + k + margin
                edge = margin + 1 + 3 * layer  # the filter one layer up fits, and one pixel more
                if centre < edge or centre >= h - edge or x < edge or x >= w - edge:
                    continue
                if not _gather_neighbours(dense, centre, k, layer, cube):
                    continue
                target = min(count, out.shape[0] - 1)
                if not refine(ring, mask, centre, k + first, lobe, layer, cube, out, target):
                    continue
                # the centre of block i is at pixel (i + 1/2) block - 1/2
                out[target, 0] = (out[target, 0] + np.float32(x) + half) * block - half
                out[target, 1] = (out[target, 1] + np.float32(centre) + half) * block - half
                out[target, 2] *= block
                out[target, 5] = np.float32(octave)
                count += 1
    return count
