"""Maxima of the fast Hessian over two neighbouring layers.

Two layers (lobes l and l + 2) are evaluated densely, a row at a time; the layers below and
above are evaluated only where a candidate beats its dense neighbours (`refinement`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit
from frontends.surf.dense_rows import RING, dense_row, lobe_shift, narrow
from frontends.surf.integral import FRACTION_BITS, PAD, padded_length

NEIGHBOURS = 18  # dense responses stored with a candidate: 2 layers x 3 x 3


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
def _store_candidate(
    dense: NDArray[np.float32],
    centre: int,
    k: int,
    layer: int,
    target: int,
    neighbours: NDArray[np.float32],
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
                neighbours[np.uint64(target), np.uint64(place)] = response
                ties += (response >= value) & (place < here)
    return ties == 0


@kernel
def detect_pair(
    integral: NDArray[np.int32],
    w: int,
    lobe: int,
    threshold: np.float32,
    single: bool,
    positions: NDArray[np.int32],
    neighbours: NDArray[np.float32],
    responses: NDArray[np.float32],
) -> int:
    """Candidates of two dense layers: maxima of their 3x3 neighbours in both.

    Ties go to the first in (layer, row, column) order, so that exactly one response of a
    symmetric structure survives.

    Parameters
    ----------
    integral : ndarray (H + 2 PAD + 1, N) int32
        Padded integral image in grey*4, from `integral_image`.
    w : int
        Width W of the level.
    lobe : int
        l of the lower layer; the upper one has l + 2.
    threshold : float
        Least response.
    single : bool
        True: only maxima in the lower layer are wanted.
    positions : ndarray (C, 3) int32
        Out: layer (0 or 1), row, column of each candidate, in image pixels.
    neighbours : ndarray (C, 18) float32
        Out: its dense responses, [layer][row - 1 .. row + 1][column - 1 .. column + 1].
    responses : ndarray (C,) float32
        Out: its own response.

    Returns
    -------
    int
        Number of candidates; above C, not all were stored.
    """
    h = integral.shape[0] - 2 * PAD - 1
    lobes = (lobe, lobe + 2)
    margin = lobes[1] + lobes[1] // 2  # half of the upper filter
    shifts = (lobe_shift(lobe), lobe_shift(lobe + 2))
    if h <= 2 * margin + 2 or w <= 2 * margin + 2:
        return 0

    n = padded_length(w - 2 * margin)  # columns evaluated
    reach = n + padded_length(2 * margin + 1)  # integral columns they need
    available = min(reach, integral.shape[1] - PAD)
    rings = np.zeros((2, RING, reach), np.int16)
    work = np.zeros((3, reach), np.int16)
    dense = np.zeros((2, 4, n), np.float32)  # the last rows of each layer's responses
    best = np.zeros((4, n + 2), np.float32)  # and of the larger of the two
    column = np.zeros(n + 2, np.float32)
    flag_words = np.zeros(n // 8, np.uint64)
    flags = flag_words.view(np.uint8)
    found = np.zeros(n + 1, np.int64)
    above = np.nextafter(threshold, np.float32(np.inf))
    drop0 = FRACTION_BITS + shifts[0]
    drop1 = FRACTION_BITS + shifts[1]
    mask = RING - 1
    count = 0

    for y in range(2 * margin + 1):
        narrow(integral, PAD + y, available, drop0, drop1, rings, y & mask)
    for y in range(margin, h - margin):
        newest = y + margin + 1
        narrow(integral, PAD + newest, available, drop0, drop1, rings, newest & mask)
        slot = y & 3
        dense_row(rings[0], y, lobes[0], margin, n, shifts[0], work, dense, 0, slot)
        dense_row(rings[1], y, lobes[1], margin, n, shifts[1], work, dense, 1, slot)
        _best_of_layers(dense, slot, best, n)
        centre = y - 1
        if centre <= margin:
            continue
        _flag_maxima(best, centre, above, column, flags, n)
        for i in range(_collect(flags, flag_words, found)):
            k = found[np.uint64(i)] + 1
            layer = 0 if dense[0, centre & 3, k] >= dense[1, centre & 3, k] else 1
            if layer == 1 and single:
                continue
            x = k + margin
            edge = margin + 1 + 3 * layer  # the filter one layer up must fit, and one pixel more
            if centre < edge or centre >= h - edge or x < edge or x >= w - edge:
                continue
            target = min(count, positions.shape[0] - 1)
            if not _store_candidate(dense, centre, k, layer, target, neighbours):
                continue
            positions[np.uint64(target), 0] = layer
            positions[np.uint64(target), 1] = centre
            positions[np.uint64(target), 2] = x
            responses[np.uint64(target)] = dense[layer, centre & 3, k]
            count += 1
    return count
