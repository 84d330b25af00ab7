"""Responses of one filter along one image row, in 16-bit integers.

An integral image modulo 2^16 still gives every sum that fits 16 bits exactly, at twice the
SIMD width; larger filters use the integral image shifted right until their sums fit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import njit
from frontends.surf.box_filters import lobe_wing, weight_xy
from frontends.surf.integral import padded_length


@njit
def lobe_shift(lobe: int) -> int:
    """Bits to drop from sums of 8-bit grey so that the responses of a filter fit 16 bits."""
    largest = 2 * lobe * (2 * lobe_wing(lobe) + 1) * 255
    shift = 0
    while largest >> shift > 32767:
        shift += 1
    return shift


@njit
def narrow(
    ring: NDArray[np.int32],
    slot: int,
    n: int,
    shift0: int,
    shift1: int,
    rings: NDArray[np.int16],
) -> None:
    """Cut row `slot` of the integral to 16 bits, for each of the two filters."""
    if shift0 == 2 and shift1 == 3:
        # the usual case with constants: a variable shift would be done in 64-bit lanes
        for x in range(np.uint64(n)):
            rings[0, slot, x] = np.int16(ring[slot, x] >> 2)
            rings[1, slot, x] = np.int16(ring[slot, x] >> 3)
        return
    for x in range(np.uint64(n)):
        rings[0, slot, x] = np.int16(ring[slot, x] >> shift0)
        rings[1, slot, x] = np.int16(ring[slot, x] >> shift1)


# In the next three, the arguments ya.. are rows of the cumulative edges a <= b <= c <= d. Rows are
# passed as indices because slices cost a reference count each, and indices are unsigned because
# signed ones get a test for negative values in the loop. Few pointers a loop: with more, the
# compiler does not check whether they overlap, and gives up on SIMD.


@njit
def _second_difference(
    ring: NDArray[np.int16], rows: tuple[int, int, int, int], work: NDArray[np.int16], n: int
) -> None:
    """Sum of the outer lobes minus twice the middle one, down the columns: `work` row 0."""
    ya, yb, yc, yd = rows
    for x in range(np.uint64(n)):
        work[0, x] = np.int16(ring[yd, x] - ring[ya, x] + 3 * (ring[yb, x] - ring[yc, x]))


@njit
def _difference(
    ring: NDArray[np.int16], rows: tuple[int, int], work: NDArray[np.int16], n: int
) -> None:
    """Sum between two edges, down the columns: `work` row 1."""
    ya, yb = rows
    for x in range(np.uint64(n)):
        work[1, x] = np.int16(ring[yb, x] - ring[ya, x])


@njit
def _lobe_difference(
    ring: NDArray[np.int16], rows: tuple[int, int, int, int], work: NDArray[np.int16], n: int
) -> None:
    """First lobe minus second lobe, down the columns: `work` row 2."""
    ya, yb, yc, yd = rows
    for x in range(np.uint64(n)):
        work[2, x] = np.int16((ring[yb, x] - ring[ya, x]) - (ring[yd, x] - ring[yc, x]))


@njit
def _determinant(
    work: NDArray[np.int16],
    lobe: int,
    first: int,
    scale: np.float32,
    scale_xy: np.float32,
    out: NDArray[np.float32],
    layer: int,
    slot: int,
    n: int,
) -> None:
    """Differences along the row of what is in `work`, and their determinant."""
    half = lobe + lobe // 2
    inner = lobe // 2
    wing = lobe_wing(lobe)
    a, b = np.uint64(first - half), np.uint64(first - inner)
    c, d = np.uint64(first + inner + 1), np.uint64(first + half + 1)
    before, after = np.uint64(first - wing), np.uint64(first + wing + 1)
    left, middle = np.uint64(first - lobe), np.uint64(first)
    next_one, right = np.uint64(first + 1), np.uint64(first + lobe + 1)
    for x in range(np.uint64(n)):
        yy = np.int16(work[0, x + after] - work[0, x + before])
        xx = np.int16(work[1, x + d] - work[1, x + a] + 3 * (work[1, x + b] - work[1, x + c]))
        xy = np.float32(
            np.int16(
                (work[2, x + middle] - work[2, x + left])
                - (work[2, x + right] - work[2, x + next_one])
            )
        )
        out[layer, slot, x] = scale * (np.float32(xx) * np.float32(yy)) - scale_xy * (xy * xy)


@njit
def dense_row(
    ring: NDArray[np.int16],
    y: int,
    lobe: int,
    first: int,
    n: int,
    shift: int,
    work: NDArray[np.int16],
    out: NDArray[np.float32],
    layer: int,
    slot: int,
) -> None:
    """Responses of one filter along row `y`, for columns first <= x < first + n of the ring.

    Parameters
    ----------
    ring : ndarray (R, N) int16
        Integral rows modulo 2^16, row r of the image's integral at r % R; R is a power of two.
    y : int
        Image row.
    lobe : int
        l = L / 3 of the filter.
    first : int
        The filter's half, at least.
    n : int
        Columns, a multiple of `LANES`; first + n and the filter's half more must not exceed N.
    shift : int
        Bits dropped in `ring`.
    work : ndarray (3, N) int16
        Scratch rows.
    out : ndarray (2, 4, >= n) float32
        Written at [layer, slot, x - first].
    """
    half = lobe + lobe // 2  # the filter covers y - half .. y + half
    inner = lobe // 2
    wing = lobe_wing(lobe)  # a lobe's long side covers y - wing .. y + wing
    mask = ring.shape[0] - 1
    reach = n + padded_length(first + half + 1)
    rows = (
        (y - half) & mask,
        (y - inner) & mask,
        (y + inner + 1) & mask,
        (y + half + 1) & mask,
    )
    _second_difference(ring, rows, work, reach)
    _difference(ring, ((y - wing) & mask, (y + wing + 1) & mask), work, reach)
    _lobe_difference(
        ring, ((y - lobe) & mask, y & mask, (y + 1) & mask, (y + lobe + 1) & mask), work, reach
    )
    unit = np.float32(1 << shift)
    area = np.float32(lobe * (2 * wing + 1))
    unit_xy = weight_xy(lobe) * unit / np.float32(lobe * lobe)
    scale = (unit / area) * (unit / area)
    _determinant(work, lobe, first, scale, unit_xy * unit_xy, out, layer, slot, n)
