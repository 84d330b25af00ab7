"""The descriptor in a turned window: box sums interpolated on a rotated lattice."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit
from frontends.surf.integral import LEAD, load_row
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
    REACH,
    RING_COLUMNS,
    WINDOW_ROWS,
    first_row,
    strip_of,
)

_PITCH = 32  # from one row of the patch to the next


@njit
def extend_boxes(
    grey: NDArray[np.uint8],
    blocks: NDArray[np.uint16],
    left: int,
    y: float,
    newest: int,
    upper: NDArray[np.uint16],
    lower: NDArray[np.uint16],
    ring: NDArray[np.uint32],
) -> int:
    """Extend the sums of 2 x 2 pixels of a strip to what a window at row `y` touches.

    Parameters
    ----------
    grey, blocks, left, y, newest
        As in `extend_integral`.
    upper, lower : ndarray (LINE,) uint16
        Scratch.
    ring : ndarray (WINDOW_ROWS, RING_COLUMNS) uint32
        The low half of ``ring[i, j]`` is the sum centred on the pixel edge (i + 1, j + 1), the
        high half the one centred on (i + 1, j + 2): one read gives both for interpolation. Row i
        is at i % WINDOW_ROWS.

    Returns
    -------
    int
        The new `newest`.
    """
    lead, next_one, after = np.uint64(LEAD), np.uint64(LEAD + 1), np.uint64(1)
    for row in range(first_row(y, newest), math.floor(y) + REACH + 1):
        load_row(grey, blocks, row, left, RING_COLUMNS, upper)
        load_row(grey, blocks, row + 1, left, RING_COLUMNS, lower)
        for x in range(np.uint64(RING_COLUMNS)):
            upper[lead + x] = np.uint16(upper[lead + x] + lower[lead + x])
        for x in range(np.uint64(RING_COLUMNS - 1)):
            lower[x] = np.uint16(upper[lead + x] + upper[next_one + x])
        slot = np.uint64(row & (WINDOW_ROWS - 1))
        for x in range(np.uint64(RING_COLUMNS - 2)):
            high = np.uint32(np.uint32(lower[x + after]) << np.uint32(16))
            ring[slot, x] = np.uint32(lower[x]) | high
        newest = row + 1
    return newest


@njit
def describe_rotated(
    boxes: NDArray[np.uint32],
    x: float,
    y: float,
    scale: float,
    angle: float,
    weights: NDArray[np.float32],
    index: NDArray[np.uint64],
    rows: NDArray[np.float32],
    pairs: NDArray[np.uint32],
    patch: NDArray[np.float32],
    haar: NDArray[np.float32],
    sums: NDArray[np.float32],
    out: NDArray[np.float32],
    which: int,
) -> None:
    """Descriptor (eq. 11) in a window turned by `angle`.

    The sums of 2 x 2 boxes are interpolated at 21 x 21 points of pitch s; a response is the
    difference of the two pairs of points around it, as in a Haar wavelet of side 2s.

    Parameters
    ----------
    boxes : ndarray (WINDOW_ROWS, RING_COLUMNS) uint32
        From `extend_boxes`.
    x, y : float
        Centre, in pixel edges of the ring.
    scale : float
        s in pixels.
    angle : float
        Radians from the x axis towards the y axis.
    weights : ndarray (36,) float32
        From `reach_weights`.
    index, rows, pairs, patch, haar, sums : ndarray
        Scratch: uint64 (2, 24), float32 (2, 24), uint32 (2, 24), float32 (32 * 21,), and that of
        `gather_bands`.
    out : ndarray (N, 64) float32
    which : int
        Row of `out` to write.
    """
    cos = np.float32(scale * math.cos(angle))
    sin = np.float32(scale * math.sin(angle))
    half = np.float32(10)
    flat = boxes.reshape(-1)
    mask = np.int32(WINDOW_ROWS - 1)
    y += WINDOW_ROWS  # rows above the image are negative
    low = np.uint32(0xFFFF)
    high = np.uint32(16)
    for i in range(21):
        v = np.float32(i) - half
        start_x = np.float32(x - 1) - half * cos - v * sin
        start_y = np.float32(y - 1) - half * sin + v * cos
        for j in range(LANES):
            # the lanes beyond 21 repeat the last point, which is inside
            step = np.float32(min(j, 20))
            px = start_x + step * cos
            py = start_y + step * sin
            ix = np.int32(px)
            iy = np.int32(py)
            rows[0, j] = px - np.float32(ix)
            rows[1, j] = py - np.float32(iy)
            index[0, j] = np.uint64(np.int64(iy & mask) * RING_COLUMNS + ix)
            index[1, j] = np.uint64(np.int64((iy + np.int32(1)) & mask) * RING_COLUMNS + ix)
        for j in range(LANES):
            pairs[0, j] = flat[index[0, j]]
            pairs[1, j] = flat[index[1, j]]
        for j in range(LANES):
            a = np.float32(np.int32(pairs[0, j] & low))
            b = np.float32(np.int32(pairs[0, j] >> high))
            c = np.float32(np.int32(pairs[1, j] & low))
            d = np.float32(np.int32(pairs[1, j] >> high))
            upper = a + rows[0, j] * (b - a)
            lower = c + rows[0, j] * (d - c)
            patch[np.uint64(_PITCH * i + j)] = upper + rows[1, j] * (lower - upper)
    one = np.uint64(1)
    for i in range(RESPONSES):
        dx, dy = np.uint64(FIRST_DX + LANES * i), np.uint64(FIRST_DY + LANES * i)
        for j in range(np.uint64(LANES)):
            here = np.uint64(_PITCH * i) + j
            below_it = np.uint64(_PITCH * (i + 1)) + j
            falling = patch[below_it + one] - patch[here]
            rising = patch[below_it] - patch[here + one]
            haar[dx + j] = falling - rising
            haar[dy + j] = falling + rising
    gather_bands(haar, weights, sums, out, which)


@kernel
def describe_rotated_level(
    grey: NDArray[np.uint8],
    blocks: NDArray[np.uint16],
    centres: NDArray[np.float32],
    scales: NDArray[np.float32],
    order: NDArray[np.int64],
    angles: NDArray[np.float32],
    weights: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Turned descriptors of the keypoints `order` of one pyramid level.

    Parameters
    ----------
    grey, blocks, centres, scales, order, weights, out : ndarray
        As in `describe_upright_level`.
    angles : ndarray (N,) float32
        Radians.
    """
    index = np.zeros((2, LANES), np.uint64)
    rows = np.zeros((2, LANES), np.float32)
    pairs = np.zeros((2, LANES), np.uint32)
    patch = np.zeros(21 * _PITCH, np.float32)
    haar = np.zeros(HAAR_LENGTH, np.float32)
    sums = np.zeros(SUMS_LENGTH, np.float32)
    upper, lower = np.zeros(LINE, np.uint16), np.zeros(LINE, np.uint16)
    boxes = np.zeros((WINDOW_ROWS, RING_COLUMNS), np.uint32)
    left, newest = NOWHERE, NOWHERE
    for i in order:
        x, y, scale = float(centres[i, 0]), float(centres[i, 1]), float(scales[i])
        angle = float(angles[i])
        if strip_of(x) != left:
            left, newest = strip_of(x), NOWHERE
        newest = extend_boxes(grey, blocks, left, y, newest, upper, lower, boxes)
        describe_rotated(
            boxes, x - left, y, scale, angle, weights, index, rows, pairs, patch, haar, sums, out, i
        )
