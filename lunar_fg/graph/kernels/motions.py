"""Measured motions between poses, and poses after a step."""

from __future__ import annotations

import numpy as np

from frontends.jit import kernel, njit
from frontends.measurements import FloatArray, IntArray


@njit
def _cross_twice(w: FloatArray, t: FloatArray, a: float, b: float, out: FloatArray) -> None:
    """Evaluate ``t + a w x t + b w x (w x t)``."""
    x = w[1] * t[2] - w[2] * t[1]
    y = w[2] * t[0] - w[0] * t[2]
    z = w[0] * t[1] - w[1] * t[0]
    out[0] = t[0] + a * x + b * (w[1] * z - w[2] * y)
    out[1] = t[1] + a * y + b * (w[2] * x - w[0] * z)
    out[2] = t[2] + a * z + b * (w[0] * y - w[1] * x)


@kernel
def moved(poses: FloatArray, step: FloatArray) -> FloatArray:
    """Poses (n, 4, 4) after the step (6n,), each in its own axes: ``pose @ exp(xi)``."""
    result = poses.copy()
    unit, change = np.empty(3), np.empty(3)
    for k in range(len(poses)):
        w, t = step[6 * k : 6 * k + 3], step[6 * k + 3 : 6 * k + 6]
        square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
        if square < 1e-8:
            sine, half, third = 1.0 - square / 6.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
        else:
            angle = np.sqrt(square)
            sine = np.sin(angle) / angle
            half = (1.0 - np.cos(angle)) / square
            third = (1.0 - sine) / square
        _cross_twice(w, t, half, third, change)
        for i in range(3):
            for j in range(3):
                result[k, i, 3] += poses[k, i, j] * change[j]
        for c in range(3):
            unit[:] = 0.0
            unit[c] = 1.0
            _cross_twice(w, unit, sine, half, change)
            for i in range(3):
                result[k, i, c] = (
                    poses[k, i, 0] * change[0]
                    + poses[k, i, 1] * change[1]
                    + poses[k, i, 2] * change[2]
                )
    return result


@njit
def _log(transform: FloatArray, out: FloatArray) -> None:
    """Tangent vector (6,) of a rigid transform."""
    r, w, t = transform, out[:3], transform[:3, 3]
    w[0] = 0.5 * (r[2, 1] - r[1, 2])
    w[1] = 0.5 * (r[0, 2] - r[2, 0])
    w[2] = 0.5 * (r[1, 0] - r[0, 1])
    sine = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    cosine = 0.5 * (r[0, 0] + r[1, 1] + r[2, 2] - 1.0)
    angle = np.arctan2(sine, cosine)
    if sine > 1e-6:
        for i in range(3):
            w[i] *= angle / sine
    elif cosine < 0.0:
        # Half a turn: the axis is the largest column of R + I.
        best = 0
        for i in range(1, 3):
            if r[i, i] > r[best, best]:
                best = i
        norm = np.sqrt(max(2.0 * (1.0 + r[best, best]), 1e-12))
        for i in range(3):
            w[i] = angle * (r[i, best] + (1.0 if i == best else 0.0)) / norm
    square = angle * angle
    if square < 1e-8:
        curl = 1.0 / 12.0 + square / 720.0
    else:
        curl = (1.0 - 0.5 * angle * np.sin(angle) / (1.0 - np.cos(angle))) / square
    _cross_twice(w, t, -0.5, curl, out[3:])


@kernel
def add_motions(
    poses: FloatArray,
    first: IntArray,
    second: IntArray,
    b_T_a: FloatArray,
    roots: FloatArray,
    hessian: FloatArray,
    gradient: FloatArray,
) -> float:
    """Add measured motions to the normal equations; returns their cost.

    `b_T_a` (K, 4, 4) are the inverses of the measured motions between poses `first` and
    `second`, `roots` (K, 6, 6) the inverse Cholesky roots of their covariances.
    """
    cost = 0.0
    between, error, white = np.eye(4), np.eye(4), np.empty(6)
    xi, right, back = np.empty(6), np.empty((6, 6)), np.zeros((6, 6))
    by_first, by_second = np.empty((6, 6)), np.empty((6, 6))
    for k in range(len(first)):
        p, q = poses[first[k]], poses[second[k]]
        for i in range(3):
            for j in range(4):
                value = 0.0
                for n in range(3):
                    value += p[n, i] * (q[n, j] - (p[n, 3] if j == 3 else 0.0))
                between[i, j] = value
        for i in range(3):
            for j in range(4):
                value = b_T_a[k, i, 3] if j == 3 else 0.0
                for n in range(3):
                    value += b_T_a[k, i, n] * between[n, j]
                error[i, j] = value
        _log(error, xi)
        # Derivative of the logarithm to first order in the error.
        right[:] = 0.0
        for i in range(6):
            right[i, i] = 1.0
        for row, column, at in ((0, 0, 0), (3, 3, 0), (3, 0, 3)):
            right[row, column + 1] -= 0.5 * xi[at + 2]
            right[row, column + 2] += 0.5 * xi[at + 1]
            right[row + 1, column] += 0.5 * xi[at + 2]
            right[row + 1, column + 2] -= 0.5 * xi[at]
            right[row + 2, column] -= 0.5 * xi[at + 1]
            right[row + 2, column + 1] += 0.5 * xi[at]
        # Adjoint of the inverse of the motion.
        x, y, z = between[0, 3], between[1, 3], between[2, 3]
        for i in range(3):
            for j in range(3):
                back[i, j] = back[i + 3, j + 3] = between[j, i]
            back[i + 3, 0] = between[2, i] * y - between[1, i] * z
            back[i + 3, 1] = between[0, i] * z - between[2, i] * x
            back[i + 3, 2] = between[1, i] * x - between[0, i] * y
        root = roots[k]
        for i in range(6):
            white[i] = 0.0
            for j in range(6):
                white[i] += root[i, j] * xi[j]
                value = 0.0
                for n in range(6):
                    value += root[i, n] * right[n, j]
                by_second[i, j] = value
            cost += 0.5 * white[i] * white[i]
        for i in range(6):
            for j in range(6):
                value = 0.0
                for n in range(6):
                    value -= by_second[i, n] * back[n, j]
                by_first[i, j] = value
        a, b = 6 * first[k], 6 * second[k]
        for i in range(6):
            for j in range(6):
                for n in range(6):
                    hessian[a + i, a + j] += by_first[n, i] * by_first[n, j]
                    hessian[b + i, b + j] += by_second[n, i] * by_second[n, j]
                    hessian[a + i, b + j] += by_first[n, i] * by_second[n, j]
                    hessian[b + i, a + j] += by_second[n, i] * by_first[n, j]
                    if j == 0:
                        gradient[a + i] += by_first[n, i] * white[n]
                        gradient[b + i] += by_second[n, i] * white[n]
    return cost
