"""Dominant orientation (Bay et al., section on orientation assignment).

Haar responses of side 4s on a grid of pitch s within 6s of the keypoint, Gaussian-weighted;
the 60-degree sector with the longest sum vector gives the angle.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from frontends.surf._jit import njit
from frontends.surf.lattice import sample_lattice

LINES = 17  # lattice lines: samples at -6 .. 6, wavelets reaching 2 further
_BINS = 72  # 5 degrees each
_SECTOR = 12  # bins in 60 degrees
_SIGMA = 2.5  # of the weights, in s


def sample_weights() -> NDArray[np.float32]:
    """Gaussian weights of the 13 x 13 samples, zero beyond the radius of 6.

    Returns
    -------
    ndarray (13, 13) float32
    """
    axis = np.arange(-6, 7)
    squared = axis[:, None] ** 2 + axis[None, :] ** 2
    weights = np.exp(squared / (-2 * _SIGMA**2)) * (squared < 36)
    return np.ascontiguousarray(weights, dtype=np.float32)


@njit
def _angle_bin(dx: float, dy: float) -> int:
    """Bin of atan2(dy, dx): a cubic in min/max, good to 0.3 degrees."""
    ax = abs(dx)
    ay = abs(dy)
    largest = max(ax, ay)
    if largest == 0:
        return 0
    ratio = min(ax, ay) / largest
    square = ratio * ratio
    turn = ratio * (0.15915 + square * (-0.0514 + square * 0.0177))
    if ay > ax:
        turn = 0.25 - turn
    if dx < 0:
        turn = 0.5 - turn
    if dy < 0:
        turn = 1.0 - turn
    return min(int(turn * _BINS), _BINS - 1)


@njit
def orientation(
    integral: NDArray[np.int32],
    x: float,
    y: float,
    scale: float,
    weights: NDArray[np.float32],
    line: NDArray[np.int32],
    lattice: NDArray[np.int32],
    bins: NDArray[np.float32],
) -> float:
    """Dominant orientation at one keypoint.

    Parameters
    ----------
    integral : ndarray int32
        Padded integral image.
    x, y : float
        Centre, in pixel edges of the padded image.
    scale : float
        s in pixels.
    weights : ndarray (13, 13) float32
        From `sample_weights`.
    line : ndarray int32
        Scratch, see `sample_lattice`.
    lattice : ndarray (17, 17) int32
        Scratch.
    bins : ndarray (2, 72) float32
        Scratch.

    Returns
    -------
    float
        Radians in [0, 2 pi), from the x axis towards the y axis (down).
    """
    sample_lattice(integral, x, y, scale, line, lattice)
    bins[:] = 0
    for i in range(13):
        top = lattice[i]
        middle = lattice[i + 2]
        bottom = lattice[i + 4]
        for j in range(13):
            weight = weights[i, j]
            if weight == 0:
                continue
            left = np.int32(bottom[j] - top[j])
            centre = np.int32(bottom[j + 2] - top[j + 2])
            right = np.int32(bottom[j + 4] - top[j + 4])
            dx = weight * np.float32(np.int32(right - 2 * centre + left))
            upper = middle[j + 4] - middle[j] - top[j + 4] + top[j]
            lower = bottom[j + 4] - bottom[j] - middle[j + 4] + middle[j]
            dy = weight * np.float32(np.int32(lower - upper))
            k = _angle_bin(dx, dy)
            bins[0, k] += dx
            bins[1, k] += dy
    best = np.float32(-1)
    best_x = np.float32(1)
    best_y = np.float32(0)
    for start in range(_BINS):
        sum_x = np.float32(0)
        sum_y = np.float32(0)
        for step in range(_SECTOR):
            k = start + step
            if k >= _BINS:
                k -= _BINS
            sum_x += bins[0, k]
            sum_y += bins[1, k]
        length = sum_x * sum_x + sum_y * sum_y
        if length > best:
            best = length
            best_x = sum_x
            best_y = sum_y
    angle = math.atan2(best_y, best_x)
    return angle if angle >= 0 else angle + 2 * math.pi
