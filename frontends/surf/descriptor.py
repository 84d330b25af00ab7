"""The 64-d SURF descriptor (Bay et al., eq. 11), upright and rotated.

A window of 20s x 20s in 4 x 4 subregions of 5 x 5 Haar responses of side 2s; each subregion
gives (sum dx, sum dy, sum |dx|, sum |dy|), Gaussian-weighted with sigma 3.3s; L2-normalised.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from frontends.surf._jit import njit
from frontends.surf.lattice import sample_lattice
from frontends.surf.orientation import LINES, orientation

_SIGMA = 3.3  # of the weights, in s
_LATTICE = 22  # lines of the upright lattice
_SCRATCH = 22 * 4 + 8  # pixels of one lattice row at the largest s


def window_weights() -> NDArray[np.float32]:
    """Gaussian weights of the 20 responses along one axis (the 2-D weight is separable).

    Returns
    -------
    ndarray (20,) float32
    """
    axis = np.arange(20) - 9.5
    return np.asarray(np.exp(axis**2 / (-2 * _SIGMA**2)), np.float32)


@njit
def box_sums(integral: NDArray[np.int32], out: NDArray[np.uint16]) -> None:
    """Sum 2 x 2 pixels at every position: the samples of the rotated window.

    Parameters
    ----------
    integral : ndarray (M, N) int32
        Padded integral image in grey*4.
    out : ndarray (M - 2, N - 2) uint16
        ``out[i, j]`` is centred on the pixel edge (i + 1, j + 1).
    """
    for y in range(out.shape[0]):
        above = integral[y]
        below = integral[y + 2]
        above2 = integral[y][2:]
        below2 = integral[y + 2][2:]
        row = out[y]
        for x in range(row.size):
            row[x] = np.uint16((below2[x] - above2[x]) - (below[x] - above[x]))


@njit
def _accumulate(
    dx: NDArray[np.float32],
    dy: NDArray[np.float32],
    weight: np.float32,
    sums: NDArray[np.float32],
) -> None:
    """Add one row of responses to the column sums of its band of subregions."""
    sum_x = sums[0]
    sum_y = sums[1]
    sum_ax = sums[2]
    sum_ay = sums[3]
    for j in range(20):
        vx = weight * dx[j]
        vy = weight * dy[j]
        sum_x[j] += vx
        sum_y[j] += vy
        sum_ax[j] += abs(vx)
        sum_ay[j] += abs(vy)


@njit
def _close_band(
    sums: NDArray[np.float32], weights: NDArray[np.float32], out: NDArray[np.float32]
) -> None:
    """Turn the column sums of a band into its 4 x 4 descriptor entries and clear them."""
    for block in range(4):
        for kind in range(4):
            total = np.float32(0)
            for j in range(5 * block, 5 * block + 5):
                total += weights[j] * sums[kind, j]
            out[4 * block + kind] = total
    sums[:] = 0


@njit
def _normalise(out: NDArray[np.float32]) -> None:
    total = np.float32(0)
    for i in range(out.size):
        total += out[i] * out[i]
    if total > 0:
        scale = np.float32(1) / np.float32(math.sqrt(total))
        for i in range(out.size):
            out[i] *= scale


@njit
def describe_upright(
    integral: NDArray[np.int32],
    x: float,
    y: float,
    scale: float,
    weights: NDArray[np.float32],
    line: NDArray[np.int32],
    lattice: NDArray[np.int32],
    rows: NDArray[np.float32],
    sums: NDArray[np.float32],
    out: NDArray[np.float32],
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
    weights : ndarray (20,) float32
        From `window_weights`.
    line, lattice, rows, sums : ndarray
        Scratch: int32 (96,), int32 (22, 22), float32 (2, 20), float32 (4, 20).
    out : ndarray (64,) float32
    """
    sample_lattice(integral, x, y, scale, line, lattice)
    sums[:] = 0
    dx = rows[0]
    dy = rows[1]
    for i in range(20):
        top = lattice[i]
        middle = lattice[i + 1]
        bottom = lattice[i + 2]
        for j in range(20):
            left = bottom[j] - top[j]
            centre = bottom[j + 1] - top[j + 1]
            right = bottom[j + 2] - top[j + 2]
            dx[j] = np.float32(np.int32(right - 2 * centre + left))
            first = bottom[j] - 2 * middle[j] + top[j]
            last = bottom[j + 2] - 2 * middle[j + 2] + top[j + 2]
            dy[j] = np.float32(np.int32(last - first))
        _accumulate(dx, dy, weights[i], sums)
        if i % 5 == 4:
            _close_band(sums, weights, out[16 * (i // 5) : 16 * (i // 5) + 16])
    _normalise(out)


@njit
def describe_rotated(
    boxes: NDArray[np.uint16],
    x: float,
    y: float,
    scale: float,
    angle: float,
    weights: NDArray[np.float32],
    patch: NDArray[np.float32],
    rows: NDArray[np.float32],
    sums: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Descriptor (eq. 11) in a window turned by `angle`.

    The means of boxes are interpolated at 21 x 21 points of pitch s; a response is the
    difference of the two pairs of points around it, as in a Haar wavelet of side 2s.

    Parameters
    ----------
    boxes : ndarray uint16
        From `box_sums`.
    x, y : float
        Centre, in pixel edges of the padded image.
    scale : float
        s in pixels.
    angle : float
        Radians from the x axis towards the y axis.
    weights : ndarray (20,) float32
        From `window_weights`.
    patch, rows, sums : ndarray float32
        Scratch: (21, 21), (2, 20), (4, 20).
    out : ndarray (64,) float32
    """
    cos = np.float32(scale * math.cos(angle))
    sin = np.float32(scale * math.sin(angle))
    half = np.float32(10)
    for i in range(21):
        v = np.float32(i) - half
        start_x = np.float32(x - 1) - half * cos - v * sin
        start_y = np.float32(y - 1) - half * sin + v * cos
        target = patch[i]
        for j in range(21):
            px = start_x + np.float32(j) * cos
            py = start_y + np.float32(j) * sin
            ix = np.int32(px)
            iy = np.int32(py)
            fx = px - np.float32(ix)
            fy = py - np.float32(iy)
            a = np.float32(boxes[iy, ix])
            b = np.float32(boxes[iy, ix + 1])
            c = np.float32(boxes[iy + 1, ix])
            d = np.float32(boxes[iy + 1, ix + 1])
            upper = a + fx * (b - a)
            lower = c + fx * (d - c)
            target[j] = upper + fy * (lower - upper)
    sums[:] = 0
    dx = rows[0]
    dy = rows[1]
    for i in range(20):
        top = patch[i]
        bottom = patch[i + 1]
        for j in range(20):
            falling = bottom[j + 1] - top[j]
            rising = bottom[j] - top[j + 1]
            dx[j] = falling - rising
            dy[j] = falling + rising
        _accumulate(dx, dy, weights[i], sums)
        if i % 5 == 4:
            _close_band(sums, weights, out[16 * (i // 5) : 16 * (i // 5) + 16])
    _normalise(out)


@njit
def describe_level(
    integral: NDArray[np.int32],
    boxes: NDArray[np.uint16],
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
    boxes : ndarray uint16
        From `box_sums`; not read when `upright`.
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
    line = np.empty(_SCRATCH, np.int32)
    lattice = np.empty((_LATTICE, _LATTICE), np.int32)
    coarse = np.empty((LINES, LINES), np.int32)
    bins = np.empty((2, 72), np.float32)
    patch = np.empty((21, 21), np.float32)
    rows = np.empty((2, 20), np.float32)
    sums = np.empty((4, 20), np.float32)
    for i in order:
        x = float(centres[i, 0])
        y = float(centres[i, 1])
        scale = float(scales[i])
        if upright:
            describe_upright(integral, x, y, scale, window, line, lattice, rows, sums, out[i])
            continue
        if assign:
            angles[i] = orientation(integral, x, y, scale, samples, line, coarse, bins)
        describe_rotated(boxes, x, y, scale, float(angles[i]), window, patch, rows, sums, out[i])
