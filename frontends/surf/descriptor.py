"""The 64-d SURF descriptor (Bay et al., eq. 11), upright and rotated.

A window of 20s x 20s in 4 x 4 subregions of 5 x 5 Haar responses of side 2s; each subregion
gives (sum dx, sum dy, sum |dx|, sum |dy|), Gaussian-weighted; L2-normalised.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from frontends.surf._jit import kernel, njit
from frontends.surf.lattice import LATTICE_LANES, LINE_LENGTH, sample_lattice
from frontends.surf.orientation import BINS_LENGTH, orientation

DESCRIPTOR_SIZE = 64
_SIGMA = 4.0  # of the weights, in s; the paper's 3.3 finds 5 % fewer correct matches
_LINES = 22  # of the upright lattice
_LANES = 24  # 20 responses a row, rounded up for SIMD; the weights of the last 4 are zero


def window_weights() -> NDArray[np.float32]:
    """Gaussian weights of the 20 responses along one axis (the 2-D weight is separable).

    Returns
    -------
    ndarray (24,) float32
        The last four are zero.
    """
    axis = np.arange(_LANES) - 9.5
    return np.asarray(np.exp(axis**2 / (-2 * _SIGMA**2)) * (axis < 10), np.float32)


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
def _gather_bands(
    haar: NDArray[np.float32],
    weights: NDArray[np.float32],
    sums: NDArray[np.float32],
    out: NDArray[np.float32],
    which: int,
) -> None:
    """Sum the 20 x 20 responses (2, 20, 24) into the 4 x 4 subregions of eq. 11."""
    for band in range(4):
        sums[:] = 0
        for i in range(5 * band, 5 * band + 5):
            weight = weights[i]
            for j in range(_LANES):
                dx = weight * haar[0, i, j]
                dy = weight * haar[1, i, j]
                sums[0, j] += dx
                sums[1, j] += dy
                sums[2, j] += abs(dx)
                sums[3, j] += abs(dy)
        for kind in range(4):
            for j in range(_LANES):
                sums[kind, j] *= weights[j]
        for block in range(4):
            for kind in range(4):
                j = 5 * block
                out[which, 16 * band + 4 * block + kind] = (
                    (sums[kind, j] + sums[kind, j + 1])
                    + (sums[kind, j + 2] + sums[kind, j + 3])
                    + sums[kind, j + 4]
                )


@njit
def _normalise(out: NDArray[np.float32], which: int) -> None:
    total = np.float32(0)
    for i in range(DESCRIPTOR_SIZE):
        total += out[which, i] * out[which, i]
    if total > 0:
        scale = np.float32(1) / np.float32(math.sqrt(total))
        for i in range(DESCRIPTOR_SIZE):
            out[which, i] *= scale


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
    weights : ndarray (24,) float32
        From `window_weights`.
    line, columns, fractions, lattice : ndarray
        Scratch of `sample_lattice`, the lattice (22, 32).
    haar, sums : ndarray
        Scratch: float32 (2, 20, 24), float32 (4, 24).
    out : ndarray (N, 64) float32
    which : int
        Row of `out` to write.
    """
    sample_lattice(integral, x, y, scale, _LINES, line, columns, fractions, lattice)
    for i in range(20):
        for j in range(_LANES):
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
    _gather_bands(haar, weights, sums, out, which)
    _normalise(out, which)


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
    weights : ndarray (24,) float32
        From `window_weights`.
    index, rows, pairs, patch, haar, sums : ndarray
        Scratch: uint64 (24,), float32 (2, 24), uint32 (2, 24), float32 (21, 32),
        float32 (2, 20, 24), float32 (4, 24).
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
        for j in range(_LANES):
            # the lanes beyond 21 repeat the last point, which is inside
            step = np.float32(min(j, 20))
            px = start_x + step * cos
            py = start_y + step * sin
            ix = np.int32(px)
            iy = np.int32(py)
            rows[0, j] = px - np.float32(ix)
            rows[1, j] = py - np.float32(iy)
            index[j] = np.uint64(np.int64(iy) * stride + ix)
        for j in range(_LANES):
            pairs[0, j] = flat[index[j]]
            pairs[1, j] = flat[index[j] + below]
        for j in range(_LANES):
            a = np.float32(np.int32(pairs[0, j] & low))
            b = np.float32(np.int32(pairs[0, j] >> high))
            c = np.float32(np.int32(pairs[1, j] & low))
            d = np.float32(np.int32(pairs[1, j] >> high))
            upper = a + rows[0, j] * (b - a)
            lower = c + rows[0, j] * (d - c)
            patch[i, j] = upper + rows[1, j] * (lower - upper)
    for i in range(20):
        for j in range(_LANES):
            falling = patch[i + 1, j + 1] - patch[i, j]
            rising = patch[i + 1, j] - patch[i, j + 1]
            haar[0, i, j] = falling - rising
            haar[1, i, j] = falling + rising
    _gather_bands(haar, weights, sums, out, which)
    _normalise(out, which)


@kernel
def describe_level(
    integral: NDArray[np.int32],
    boxes: NDArray[np.uint32],
    upright: bool,
    assign: bool,
    centres: NDArray[np.float32],
    scales: NDArray[np.float32],
    order: NDArray[np.int64],
    window: NDArray[np.float32],
    samples: NDArray[np.float32],
    angles: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Orientations and descriptors of the keypoints of one pyramid level.

    Parameters
    ----------
    integral : ndarray int32
        Padded integral image of the level.
    boxes : ndarray uint32
        From `box_pairs`; not read when `upright`.
    upright : bool
        True: angle 0.
    assign : bool
        True: compute the orientations; False: `angles` holds them.
    centres : ndarray (N, 2) float32
        x, y in pixel edges of the padded level.
    scales : ndarray (N,) float32
        s in pixels of the level.
    order : ndarray (M,) int64
        Which keypoints, in the order to visit them.
    window, samples : ndarray float32
        From `window_weights` and `orientation.sample_weights`.
    angles : ndarray (N,) float32
        Radians; written if `assign`.
    out : ndarray (N, 64) float32
    """
    line = np.zeros(LINE_LENGTH, np.int32)
    columns = np.zeros(LATTICE_LANES, np.uint64)
    fractions = np.zeros(LATTICE_LANES, np.int32)
    lattice = np.zeros((_LINES, LATTICE_LANES + 8), np.int32)
    index = np.zeros(_LANES, np.uint64)
    rows = np.zeros((2, _LANES), np.float32)
    pairs = np.zeros((2, _LANES), np.uint32)
    patch = np.zeros((21, _LANES + 8), np.float32)
    haar = np.zeros((2, 20, _LANES), np.float32)
    sums = np.zeros((4, _LANES), np.float32)
    directions = np.zeros((2, 13, 16), np.float32)
    bin_of = np.zeros((13, 16), np.int32)
    sectors = np.zeros((2, BINS_LENGTH), np.float32)
    work = np.zeros((2, BINS_LENGTH), np.float32)
    for i in order:
        x = float(centres[i, 0])
        y = float(centres[i, 1])
        scale = float(scales[i])
        if upright:
            describe_upright(
                integral,
                x,
                y,
                scale,
                window,
                line,
                columns,
                fractions,
                lattice,
                haar,
                sums,
                out,
                i,
            )
            continue
        if assign:
            angles[i] = orientation(
                integral,
                x,
                y,
                scale,
                samples,
                line,
                columns,
                fractions,
                lattice,
                directions,
                bin_of,
                sectors,
                work,
            )
        describe_rotated(
            boxes,
            x,
            y,
            scale,
            float(angles[i]),
            window,
            index,
            rows,
            pairs,
            patch,
            haar,
            sums,
            out,
            i,
        )
