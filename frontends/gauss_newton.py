"""Gauss-Newton on the normal equations of the motion between two stereo frames."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit
from frontends.normal_equations import sum_block
from frontends.whitening import BLOCK, SCRATCH, weigh, whiten

FloatArray = NDArray[np.float64]

#: A Gauss-Newton step beyond this (rad, m) comes from a singular system.
_LARGEST_STEP = 1e3
#: Pivots below this share of the diagonal are rounding.
_LEAST_PIVOT = 1e-14
#: Converged: the squared length of the step in sigmas of the motion.
_LEAST_STEP2 = 1e-8
_SMALL_ANGLE_RAD = 1e-4


@njit
def _cholesky_solve(matrix: FloatArray, x: FloatArray) -> bool:
    """Replace x by the solution, the lower triangle by its factor; False where singular."""
    for a in range(6):
        least = _LEAST_PIVOT * matrix[a, a]
        for b in range(a + 1):
            entry = matrix[a, b]
            for c in range(b):
                entry -= matrix[a, c] * matrix[b, c]
            if b < a:
                matrix[a, b] = entry / matrix[b, b]
            elif entry <= least:
                return False
            else:
                matrix[a, a] = math.sqrt(entry)
    for a in range(6):
        for b in range(a):
            x[a] -= matrix[a, b] * x[b]
        x[a] /= matrix[a, a]
    for a in range(5, -1, -1):
        for b in range(a + 1, 6):
            x[a] -= matrix[b, a] * x[b]
        x[a] /= matrix[a, a]
    return True


@njit
def _moved(motion: FloatArray, step: FloatArray) -> FloatArray:
    """``motion @ se3_exp(step)``."""
    angle2 = step[0] ** 2 + step[1] ** 2 + step[2] ** 2
    angle = math.sqrt(angle2)
    if angle < _SMALL_ANGLE_RAD:
        a, b, c = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle2
        c = (angle - math.sin(angle)) / (angle2 * angle)
    k = np.zeros((3, 3))
    k[0, 1], k[0, 2], k[1, 2] = -step[2], step[1], -step[0]
    k[1, 0], k[2, 0], k[2, 1] = step[2], -step[1], step[0]
    result = np.zeros((4, 4))
    turn, shift = np.zeros((3, 3)), np.zeros(3)
    for i in range(3):
        for j in range(3):
            square = 0.0
            for m in range(3):
                square += k[i, m] * k[m, j]
            one = 1.0 if i == j else 0.0
            turn[i, j] = one + a * k[i, j] + b * square
            shift[i] += (one + b * k[i, j] + c * square) * step[3 + j]
    for i in range(3):
        result[i, 3] = motion[i, 3]
        for j in range(3):
            result[i, 3] += motion[i, j] * shift[j]
            for m in range(3):
                result[i, j] += motion[i, m] * turn[m, j]
    result[3, 3] = 1.0
    return result


@kernel
def gauss_newton(
    camera: FloatArray, motion: FloatArray, data: FloatArray, among: FloatArray,
    per_kernel2: float, iterations: int,
) -> FloatArray:  # fmt: skip
    """Motion (4, 4) after at most so many steps; as it is where the system is singular."""
    scratch = np.zeros(SCRATCH)
    sums, gradient, step = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    for _ in range(iterations):
        sums[:] = 0.0
        gradient[:] = 0.0
        for block in range(len(among) // BLOCK):
            whiten(camera, motion, data, block, scratch)
            weigh(among, block, per_kernel2, 1.0, 0.0, scratch)
            sum_block(data, block, scratch, sums, gradient)
        step[:] = gradient
        if not _cholesky_solve(sums, step):
            break
        length2 = largest = 0.0
        for k in range(6):
            length2 += gradient[k] * step[k]
            largest = max(largest, abs(step[k]))
        if largest > _LARGEST_STEP:
            break
        motion = _moved(motion, step)
        if length2 < _LEAST_STEP2:
            break
    return motion
