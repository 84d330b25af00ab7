"""Responses of one filter along one image row, in 16-bit integers.

An integral image modulo 2^16 still gives every sum that fits 16 bits exactly, at twice the
SIMD width; larger filters use the integral image shifted right until their sums fit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import njit
from frontends.surf.box_filters import lobe_wing, weight_xy
from frontends.surf.integral import PAD, padded_length

RING = 64  # integral rows kept in 16 bits: a power of two, more than the tallest filter


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
    integral: NDArray[np.int32],
    row: int,
    n: int,
    shift0: int,
    shift1: int,
    rings: NDArray[np.int16],
    slot: int,
) -> None:
    """Copy one row of the integral, cut to 16 bits, into both rings."""
    first = np.uint64(PAD)
    if shift0 == 2 and shift1 == 3:
        # the usual case with constants: a variable shift would be done in 64-bit lanes
        for x in range(np.uint64(n)):
            rings[0, slot, x] = np.int16(integral[row, first + x] >> 2)
            rings[1, slot, x] = np.int16(integral[row, first + x] >> 3)
        return
    for x in range(np.uint64(n)):
        value = integral[row, first + x]
        rings[0, slot, x] = np.int16(value >> shift0)
        rings[1, slot, x] = np.int16(value >> shift1)


# In the next three, the arguments ya.. are rows and xa.. column offsets of the cumulative
# edges a <= b <= c <= d. Rows are passed as indices because slices cost a reference count each,
# and indices are unsigned because signed ones get a test for negative values in the loop.


@njit
def _second_difference(
    source: NDArray[np.int16],
    rows: tuple[int, int, int, int],
    columns: tuple[int, int, int, int],
    work: NDArray[np.int16],
    target: int,
    n: int,
) -> None:
    """Sum of the outer lobes minus twice the middle one."""
    ya, yb, yc, yd = rows
    xa, xb = np.uint64(columns[0]), np.uint64(columns[1])
    xc, xd = np.uint64(columns[2]), np.uint64(columns[3])
    for x in range(np.uint64(n)):
        work[target, x] = np.int16(
            source[yd, x + xd] - source[ya, x + xa] + 3 * (source[yb, x + xb] - source[yc, x + xc])
        )


@njit
def _difference(
    source: NDArray[np.int16],
    rows: tuple[int, int],
    columns: tuple[int, int],
    work: NDArray[np.int16],
    target: int,
    n: int,
) -> None:
    """Sum between two edges."""
    ya, yb = rows
    xa, xb = np.uint64(columns[0]), np.uint64(columns[1])
    for x in range(np.uint64(n)):
        work[target, x] = np.int16(source[yb, x + xb] - source[ya, x + xa])


@njit
def _lobe_difference(
    source: NDArray[np.int16],
    rows: tuple[int, int, int, int],
    columns: tuple[int, int, int, int],
    work: NDArray[np.int16],
    target: int,
    n: int,
) -> None:
    """First lobe minus second lobe."""
    ya, yb, yc, yd = rows
    xa, xb = np.uint64(columns[0]), np.uint64(columns[1])
    xc, xd = np.uint64(columns[2]), np.uint64(columns[3])
    for x in range(np.uint64(n)):
        work[target, x] = np.int16(
            (source[yb, x + xb] - source[ya, x + xa]) - (source[yd, x + xd] - source[yc, x + xc])
        )


@njit
def _determinant(
    work: NDArray[np.int16],
    scale: np.float32,
    scale_xy: np.float32,
    out: NDArray[np.float32],
    layer: int,
    slot: int,
    n: int,
) -> None:
    for x in range(np.uint64(n)):
        xy = np.float32(work[5, x])
        out[layer, slot, x] = scale * (
            np.float32(work[3, x]) * np.float32(work[4, x])
        ) - scale_xy * (xy * xy)


@njit
def dense_row(
    ring: NDArray[np.int16],
    y: int,
    lobe: int,
    margin: int,
    n: int,
    shift: int,
    work: NDArray[np.int16],
    out: NDArray[np.float32],
    layer: int,
    slot: int,
) -> None:
    """Responses of one filter along image row `y`, for columns margin <= x < margin + n.

    Parameters
    ----------
    ring : ndarray (64, >= n + 2 margin + 1) int16
        Integral rows modulo 2^16, row r of the image's integral at r % 64.
    y : int
        Image row.
    lobe : int
        l = L / 3 of the filter.
    margin : int
        Columns left out on the left, at least the half filter.
    n : int
        Columns, a multiple of `LANES`; those beyond the image get nothing of use.
    shift : int
        Bits dropped in `ring`.
    work : ndarray (6, as `ring`) int16
        Scratch rows.
    out : ndarray (2, 4, >= n) float32
        Written at [layer, slot, x - margin].
    """
    half = lobe + lobe // 2  # the filter covers y - half .. y + half
    inner = lobe // 2
    wing = lobe_wing(lobe)  # a lobe's long side covers y - wing .. y + wing
    mask = RING - 1
    reach = n + padded_length(2 * margin + 1)
    tall = (-half, -inner, inner + 1, half + 1)
    cross = (-lobe, 0, 1, lobe + 1)

    still = (0, 0, 0, 0)
    rows = (
        (y + tall[0]) & mask,
        (y + tall[1]) & mask,
        (y + tall[2]) & mask,
        (y + tall[3]) & mask,
    )
    _second_difference(ring, rows, still, work, 0, reach)
    _difference(ring, ((y - wing) & mask, (y + wing + 1) & mask), (0, 0), work, 1, reach)
    rows = (
        (y + cross[0]) & mask,
        y & mask,
        (y + 1) & mask,
        (y + cross[3]) & mask,
    )
    _lobe_difference(ring, rows, still, work, 2, reach)

    columns = (margin + tall[0], margin + tall[1], margin + tall[2], margin + tall[3])
    _second_difference(work, (1, 1, 1, 1), columns, work, 3, n)
    _difference(work, (0, 0), (margin - wing, margin + wing + 1), work, 4, n)
    columns = (margin + cross[0], margin, margin + 1, margin + cross[3])
    _lobe_difference(work, (2, 2, 2, 2), columns, work, 5, n)

    unit = np.float32(1 << shift)
    area = np.float32(lobe * (2 * wing + 1))
    unit_xy = weight_xy(lobe) * unit / np.float32(lobe * lobe)
    _determinant(
        work,
        (unit / area) * (unit / area),
        unit_xy * unit_xy,
        out,
        layer,
        slot,
        n,
    )
