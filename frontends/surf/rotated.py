"""The descriptor in a turned window: box sums interpolated on a rotated lattice."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit
from frontends.surf.subregions import (
    FIRST_DX,
    FIRST_DY,
    HAAR_LENGTH,
    LANES,
    RESPONSES,
    SUMS_LENGTH,
    gather_bands,
)

_PITCH = 32  # from one row of the patch to the next


@kernel
def box_pairs(integral: NDArray[np.int32], out: NDArray[np.uint32]) -> None:
    """Sum 2 x 2 pixels at every position: the samples of the rotated window.

    Parameters
    ----------
    integral : ndarray (M, N) int32
        Padded integral image in grey*4.
    out : ndarray (M - 2, N) uint32
        The low half of ``out[i, j]`` is the sum centred on the pixel edge (i + 1, j + 1), the
        high half the one centred on (i + 1, j + 2): one read gives both for interpolation.
        The last three columns hold nothing of use.
    """
    columns = np.uint64(out.shape[1])
    one = np.uint64(1)
    two = np.uint64(2)
    three = np.uint64(3)
    sums = np.zeros(out.shape[1] + 3, np.int32)
    for y in range(out.shape[0]):
        for x in range(columns):
            sums[x] = np.int32(integral[y + 2, x] - integral[y, x])
        for x in range(columns):
            low = np.uint32(np.int32(sums[x + two] - sums[x])) & np.uint32(0xFFFF)
            high = np.uint32(np.int32(sums[x + three] - sums[x + one]))
            out[y, x] = low | np.uint32(high << np.uint32(16))


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
    boxes : ndarray uint32
        From `box_pairs`.
    x, y : float
        Centre, in pixel edges of the padded image.
    scale : float
        s in pixels.
    angle : float
        Radians from the x axis towards the y axis.
    weights : ndarray (36,) float32
        From `reach_weights`.
    index, rows, pairs, patch, haar, sums : ndarray
        Scratch: uint64 (24,), float32 (2, 24), uint32 (2, 24), float32 (32 * 21,), and that of
        `gather_bands`.
    out : ndarray (N, 64) float32
    which : int
        Row of `out` to write.
    """
    cos = np.float32(scale * math.cos(angle))
    sin = np.float32(scale * math.sin(angle))
    half = np.float32(10)
    flat = boxes.reshape(-1)
    stride = boxes.shape[1]
    below = np.uint64(stride)
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
            index[j] = np.uint64(np.int64(iy) * stride + ix)
        for j in range(LANES):
            pairs[0, j] = flat[index[j]]
            pairs[1, j] = flat[index[j] + below]
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
    boxes: NDArray[np.uint32],
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
    boxes : ndarray uint32
        From `box_pairs`.
    centres, scales, order, weights, out : ndarray
        As in `describe_upright_level`.
    angles : ndarray (N,) float32
        Radians.
    """
    index = np.zeros(LANES, np.uint64)
    rows = np.zeros((2, LANES), np.float32)
    pairs = np.zeros((2, LANES), np.uint32)
    patch = np.zeros(21 * _PITCH, np.float32)
    haar = np.zeros(HAAR_LENGTH, np.float32)
    sums = np.zeros(SUMS_LENGTH, np.float32)
    for i in order:
        x, y, scale = float(centres[i, 0]), float(centres[i, 1]), float(scales[i])
        angle = float(angles[i])
        describe_rotated(
            boxes, x, y, scale, angle, weights, index, rows, pairs, patch, haar, sums, out, i
        )
