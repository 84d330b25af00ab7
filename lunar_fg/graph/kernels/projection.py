"""Projection of homogeneous landmarks into the stereo camera, and small dense algebra.

Poses come as inverses (``camera_T_window``), pixels as u_left, u_right, v, landmarks as unit
homogeneous points; `lens` is fx, fy, cx, cy, fx * baseline.
"""

from __future__ import annotations

import numpy as np

from frontends.jit import njit
from frontends.measurements import FloatArray

#: A point nearer to the camera plane than this share of its distance is not projected.
LEAST_DEPTH_SHARE = 1e-3


@njit
def whitener_of(covariance: FloatArray, out: FloatArray) -> None:
    """Inverse of the lower Cholesky root of a 3x3 matrix: w00 w10 w11 w20 w21 w22."""
    l00 = np.sqrt(covariance[0, 0])
    l10 = covariance[1, 0] / l00
    l20 = covariance[2, 0] / l00
    l11 = np.sqrt(max(covariance[1, 1] - l10 * l10, 1e-18 * covariance[1, 1]))
    l21 = (covariance[2, 1] - l20 * l10) / l11
    l22 = np.sqrt(max(covariance[2, 2] - l20 * l20 - l21 * l21, 1e-18 * covariance[2, 2]))
    out[0] = 1.0 / l00
    out[2] = 1.0 / l11
    out[5] = 1.0 / l22
    out[1] = -l10 * out[0] * out[2]
    out[4] = -l21 * out[2] * out[5]
    out[3] = -(l20 * out[0] + l21 * out[1]) * out[5]


@njit
def tangent_basis(point: FloatArray, out: FloatArray) -> None:
    """Three unit directions orthogonal to a unit 4-vector (Householder), (4, 3)."""
    sign = 1.0 if point[3] >= 0.0 else -1.0
    last = point[3] + sign
    square = point[0] * point[0] + point[1] * point[1] + point[2] * point[2] + last * last
    scale = 2.0 / square
    for j in range(3):
        for i in range(3):
            out[i, j] = -scale * point[i] * point[j]
        out[3, j] = -scale * last * point[j]
        out[j, j] += 1.0


@njit
def to_camera(inverse: FloatArray, point: FloatArray, out: FloatArray) -> bool:
    """Move a homogeneous point into a camera; False where it is not in front of it."""
    for i in range(3):
        out[i] = (
            inverse[i, 0] * point[0]
            + inverse[i, 1] * point[1]
            + inverse[i, 2] * point[2]
            + inverse[i, 3] * point[3]
        )
    out[3] = point[3]
    norm = np.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    return bool(out[2] > LEAST_DEPTH_SHARE * norm)


@njit
def pixels_by_point(lens: FloatArray, local: FloatArray, out: FloatArray) -> None:
    """Derivative of the three pixels by the homogeneous point, (3, 4)."""
    x, y, w, z = local[0], local[1], local[3], 1.0 / local[2]
    out[:] = 0.0
    out[0, 0] = out[1, 0] = lens[0] * z
    out[0, 2] = -lens[0] * x * z * z
    out[1, 2] = out[0, 2] + lens[4] * w * z * z
    out[1, 3] = -lens[4] * z
    out[2, 1] = lens[1] * z
    out[2, 2] = -lens[1] * y * z * z


@njit
def pixel_residual(lens: FloatArray, local: FloatArray, uuv: FloatArray, out: FloatArray) -> None:
    """Projected less measured pixels, (3,)."""
    z = 1.0 / local[2]
    u_left = lens[0] * local[0] * z + lens[2]
    out[0] = u_left - uuv[0]
    out[1] = u_left - lens[4] * local[3] * z - uuv[1]
    out[2] = lens[1] * local[1] * z + lens[3] - uuv[2]


@njit
def pose_columns(rows: FloatArray, local: FloatArray, out: FloatArray) -> None:
    """Derivatives (r, 4) by the point in the camera to ones by the camera's pose, (r, 6)."""
    x, y, z, w = local[0], local[1], local[2], local[3]
    for r in range(rows.shape[0]):
        a, b, c = rows[r, 0], rows[r, 1], rows[r, 2]
        out[r, 0] = b * z - c * y
        out[r, 1] = c * x - a * z
        out[r, 2] = a * y - b * x
        out[r, 3] = -w * a
        out[r, 4] = -w * b
        out[r, 5] = -w * c


@njit
def times_lower(root: FloatArray, vector: FloatArray) -> None:
    """Multiply a vector (3,) by a lower triangle, in place."""
    a, b, c = vector[0], vector[1], vector[2]
    vector[0] = root[0] * a
    vector[1] = root[1] * a + root[2] * b
    vector[2] = root[3] * a + root[4] * b + root[5] * c


@njit
def times_lower_rows(root: FloatArray, matrix: FloatArray) -> None:
    """Multiply a matrix (3, 6) by a lower triangle, in place."""
    for j in range(6):
        a, b, c = matrix[0, j], matrix[1, j], matrix[2, j]
        matrix[0, j] = root[0] * a
        matrix[1, j] = root[1] * a + root[2] * b
        matrix[2, j] = root[3] * a + root[4] * b + root[5] * c
