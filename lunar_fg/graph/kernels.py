"""The inner loops of segments and of the gate, compiled: serial, without the GIL, cached.

Poses come as inverses (``camera_T_window``), pixels as u_left, u_right, v, landmarks as unit
homogeneous points; `lens` is fx, fy, cx, cy, fx * baseline. The factors are GTSAM's
GenericStereoFactor3D with Huber's loss on whitened residuals.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from frontends.jit import kernel, njit
from frontends.measurements import FloatArray, IntArray

#: A point nearer to the camera plane than this share of its distance is not projected.
LEAST_DEPTH_SHARE = 1e-3
#: Keeps the system of a landmark without information positive.
_LEAST_GAIN = 1e-12
_BEHIND = 1e30


@njit
def _whitener(covariance: FloatArray, out: FloatArray) -> None:
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


@kernel
def whiteners(covariance: FloatArray) -> FloatArray:
    """Inverse Cholesky roots of (M, 3, 3) covariances, lower triangles by rows, (M, 6)."""
    result = np.empty((len(covariance), 6))
    for m in range(len(covariance)):
        _whitener(covariance[m], result[m])
    return result


@njit
def _basis(point: FloatArray, out: FloatArray) -> None:
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
def _local(inverse: FloatArray, point: FloatArray, out: FloatArray) -> bool:
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
def _by_point(lens: FloatArray, local: FloatArray, out: FloatArray) -> None:
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
def _residual(lens: FloatArray, local: FloatArray, uuv: FloatArray, out: FloatArray) -> None:
    z = 1.0 / local[2]
    u_left = lens[0] * local[0] * z + lens[2]
    out[0] = u_left - uuv[0]
    out[1] = u_left - lens[4] * local[3] * z - uuv[1]
    out[2] = lens[1] * local[1] * z + lens[3] - uuv[2]


@njit
def _pose_columns(rows: FloatArray, local: FloatArray, out: FloatArray) -> None:
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


@kernel
def linearise(
    lens: FloatArray,
    inverses: FloatArray,
    points: FloatArray,
    uuv: FloatArray,
    whitener: FloatArray,
    pose: IntArray,
    starts: IntArray,
    threshold: float,
) -> tuple[float, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Robust cost and the normal equations of the poses, landmarks eliminated.

    Returns
    -------
    tuple
        Cost; Hessian (6n, 6n); gradient (6n,); and to recover the landmarks: inverse roots
        (L, 6), whitened gradients (L, 3), whitened couplings (M, 3, 6).
    """
    size = 6 * len(inverses)
    count = len(starts) - 1
    hessian = np.zeros((size, size))
    gradient = np.zeros(size)
    roots = np.empty((count, 6))
    whites = np.empty((count, 3))
    couplings = np.empty((len(uuv), 3, 6))
    local, raw, white = np.empty(4), np.empty(3), np.empty(3)
    by_point, weighted = np.empty((3, 4)), np.empty((3, 4))
    by_pose, by_landmark = np.empty((3, 6)), np.empty((3, 3))
    basis, turned = np.empty((4, 3)), np.empty((4, 3))
    gain, slope = np.empty((3, 3)), np.empty(3)
    cost = 0.0
    for k in range(count):
        _basis(points[k], basis)
        gain[:] = 0.0
        slope[:] = 0.0
        for m in range(starts[k], starts[k + 1]):
            inverse = inverses[pose[m]]
            coupling = couplings[m]
            if not _local(inverse, points[k], local):
                # Pulls nothing but costs, so that no step goes there.
                coupling[:] = 0.0
                cost += 10.0 * threshold * threshold
                continue
            _residual(lens, local, uuv[m], raw)
            w = whitener[m]
            white[0] = w[0] * raw[0]
            white[1] = w[1] * raw[0] + w[2] * raw[1]
            white[2] = w[3] * raw[0] + w[4] * raw[1] + w[5] * raw[2]
            length = np.sqrt(white[0] ** 2 + white[1] ** 2 + white[2] ** 2)
            scale = 1.0
            if length <= threshold:
                cost += 0.5 * length * length
            else:
                cost += threshold * (length - 0.5 * threshold)
                scale = np.sqrt(threshold / length)
            _by_point(lens, local, by_point)
            for c in range(4):
                p, q, r = by_point[0, c], by_point[1, c], by_point[2, c]
                weighted[0, c] = scale * w[0] * p
                weighted[1, c] = scale * (w[1] * p + w[2] * q)
                weighted[2, c] = scale * (w[3] * p + w[4] * q + w[5] * r)
            for i in range(3):
                white[i] *= scale
            _pose_columns(weighted, local, by_pose)
            for c in range(3):
                for i in range(3):
                    turned[i, c] = (
                        inverse[i, 0] * basis[0, c]
                        + inverse[i, 1] * basis[1, c]
                        + inverse[i, 2] * basis[2, c]
                        + inverse[i, 3] * basis[3, c]
                    )
                turned[3, c] = basis[3, c]
            for r in range(3):
                for c in range(3):
                    by_landmark[r, c] = (
                        weighted[r, 0] * turned[0, c]
                        + weighted[r, 1] * turned[1, c]
                        + weighted[r, 2] * turned[2, c]
                        + weighted[r, 3] * turned[3, c]
                    )
            at = 6 * pose[m]
            for i in range(6):
                a0, a1, a2 = by_pose[0, i], by_pose[1, i], by_pose[2, i]
                gradient[at + i] += a0 * white[0] + a1 * white[1] + a2 * white[2]
                for j in range(i, 6):
                    hessian[at + i, at + j] += (
                        a0 * by_pose[0, j] + a1 * by_pose[1, j] + a2 * by_pose[2, j]
                    )
            for i in range(3):
                b0, b1, b2 = by_landmark[0, i], by_landmark[1, i], by_landmark[2, i]
                slope[i] += b0 * white[0] + b1 * white[1] + b2 * white[2]
                for j in range(3):
                    gain[i, j] += (
                        b0 * by_landmark[0, j] + b1 * by_landmark[1, j] + b2 * by_landmark[2, j]
                    )
                for j in range(6):
                    coupling[i, j] = b0 * by_pose[0, j] + b1 * by_pose[1, j] + b2 * by_pose[2, j]
        least = _LEAST_GAIN * (1.0 + gain[0, 0] + gain[1, 1] + gain[2, 2])
        for i in range(3):
            gain[i, i] += least
        root = roots[k]
        _whitener(gain, root)
        _lower(root, slope)
        whites[k] = slope
        for m in range(starts[k], starts[k + 1]):
            _lower_rows(root, couplings[m])
        for m in range(starts[k], starts[k + 1]):
            a, left = 6 * pose[m], couplings[m]
            for i in range(6):
                p, q, r = left[0, i], left[1, i], left[2, i]
                gradient[a + i] -= p * slope[0] + q * slope[1] + r * slope[2]
                for j in range(i, 6):
                    hessian[a + i, a + j] -= p * left[0, j] + q * left[1, j] + r * left[2, j]
            for other in range(m + 1, starts[k + 1]):
                b, right = 6 * pose[other], couplings[other]
                for i in range(6):
                    p, q, r = left[0, i], left[1, i], left[2, i]
                    for j in range(6):
                        hessian[a + i, b + j] -= p * right[0, j] + q * right[1, j] + r * right[2, j]
    for i in range(size):
        for j in range(i):
            hessian[i, j] = hessian[j, i]
    return cost, hessian, gradient, roots, whites, couplings


@njit
def _lower(root: FloatArray, vector: FloatArray) -> None:
    """Multiply a vector (3,) by a lower triangle, in place."""
    a, b, c = vector[0], vector[1], vector[2]
    vector[0] = root[0] * a
    vector[1] = root[1] * a + root[2] * b
    vector[2] = root[3] * a + root[4] * b + root[5] * c


@njit
def _lower_rows(root: FloatArray, matrix: FloatArray) -> None:
    """Multiply a matrix (3, 6) by a lower triangle, in place."""
    for j in range(6):
        a, b, c = matrix[0, j], matrix[1, j], matrix[2, j]
        matrix[0, j] = root[0] * a
        matrix[1, j] = root[1] * a + root[2] * b
        matrix[2, j] = root[3] * a + root[4] * b + root[5] * c


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


@kernel
def stepped(
    points: FloatArray,
    step: FloatArray,
    pose: IntArray,
    starts: IntArray,
    roots: FloatArray,
    whites: FloatArray,
    couplings: FloatArray,
    stretch: float,
) -> FloatArray:
    """Landmarks (L, 4) after `stretch` times the step that goes with the poses' (6n,)."""
    result = np.empty_like(points)
    basis, toward, tangent = np.empty((4, 3)), np.empty(3), np.empty(3)
    for k in range(len(points)):
        for i in range(3):
            toward[i] = whites[k, i]
        for m in range(starts[k], starts[k + 1]):
            at = 6 * pose[m]
            for i in range(3):
                for j in range(6):
                    toward[i] += couplings[m, i, j] * step[at + j]
        root = roots[k]
        tangent[0] = root[0] * toward[0] + root[1] * toward[1] + root[3] * toward[2]
        tangent[1] = root[2] * toward[1] + root[4] * toward[2]
        tangent[2] = root[5] * toward[2]
        _basis(points[k], basis)
        square = 0.0
        for i in range(4):
            moved = points[k, i]
            for j in range(3):
                moved -= stretch * basis[i, j] * tangent[j]
            result[k, i] = moved
            square += moved * moved
        norm = 1.0 / np.sqrt(square)
        for i in range(4):
            result[k, i] *= norm
    return result


@kernel
def distances(
    lens: FloatArray,
    old_uuv: FloatArray,
    old_covariance: FloatArray,
    new_uuv: FloatArray,
    new_covariance: FloatArray,
    age: IntArray,
    inverses: FloatArray,
    covariances: FloatArray,
) -> FloatArray:
    """Squared Mahalanobis distances of new sightings from what old ones predict, (M,).

    `inverses` (A, 4, 4) and `covariances` (A, 6, 6) are of the motion over each age.
    """
    result = np.empty(len(age))
    point, local, raw = np.empty(4), np.empty(4), np.empty(3)
    by_point, by_pose = np.empty((3, 4)), np.empty((3, 6))
    by_pixel, total, white = np.empty((3, 3)), np.empty((3, 3)), np.empty(6)
    for m in range(len(age)):
        inverse, covariance = inverses[age[m]], covariances[age[m]]
        point[0] = (old_uuv[m, 0] - lens[2]) / lens[0]
        point[1] = (old_uuv[m, 2] - lens[3]) / lens[1]
        point[2] = 1.0
        point[3] = (old_uuv[m, 0] - old_uuv[m, 1]) / lens[4]
        if not _local(inverse, point, local):
            result[m] = _BEHIND
            continue
        _by_point(lens, local, by_point)
        _pose_columns(by_point, local, by_pose)
        for r in range(3):
            a, b, c = by_point[r, 0], by_point[r, 1], by_point[r, 2]
            x = a * inverse[0, 0] + b * inverse[1, 0] + c * inverse[2, 0]
            y = a * inverse[0, 1] + b * inverse[1, 1] + c * inverse[2, 1]
            w = (a * inverse[0, 3] + b * inverse[1, 3] + c * inverse[2, 3] + by_point[r, 3]) / lens[
                4
            ]
            by_pixel[r, 0] = x / lens[0] + w
            by_pixel[r, 1] = -w
            by_pixel[r, 2] = y / lens[1]
        for r in range(3):
            for c in range(r + 1):
                value = new_covariance[m, r, c]
                for i in range(3):
                    for j in range(3):
                        value += by_pixel[r, i] * old_covariance[m, i, j] * by_pixel[c, j]
                for i in range(6):
                    for j in range(6):
                        value += by_pose[r, i] * covariance[i, j] * by_pose[c, j]
                total[r, c] = value
        _whitener(total, white)
        _residual(lens, local, new_uuv[m], raw)
        _lower(white, raw)
        result[m] = raw[0] ** 2 + raw[1] ** 2 + raw[2] ** 2
    return result


@kernel
def inverse_positive(matrix: FloatArray) -> tuple[bool, FloatArray]:
    """Inverse of a symmetric matrix, and whether it is positive definite.

    Small enough that BLAS would spend more on its threads than on the work.
    """
    n = len(matrix)
    root = np.zeros((n, n))
    result = np.zeros((n, n))
    for j in range(n):
        for i in range(j, n):
            value = matrix[i, j]
            for k in range(j):
                value -= root[i, k] * root[j, k]
            if i == j:
                if not value > 1e-14 * abs(matrix[j, j]):
                    return False, result
                root[j, j] = np.sqrt(value)
            else:
                root[i, j] = value / root[j, j]
    # Rows of `upper` are columns of the root's inverse.
    upper = np.zeros((n, n))
    for c in range(n):
        upper[c, c] = 1.0 / root[c, c]
        for i in range(c + 1, n):
            value = 0.0
            for k in range(c, i):
                value -= root[i, k] * upper[c, k]
            upper[c, i] = value / root[i, i]
    for i in range(n):
        for j in range(i + 1):
            value = 0.0
            for k in range(i, n):
                value += upper[i, k] * upper[j, k]
            result[i, j] = result[j, i] = value
    return True, result


@cache
def warm() -> None:
    """Load or compile all kernels now (once a process), not in the middle of a run."""
    one, pixels = np.eye(4)[None], np.array([[20.0, 10.0, 5.0], [20.0, 10.0, 5.0]])
    lens = np.array([100.0, 100.0, 10.0, 10.0, 10.0])
    white = whiteners(np.stack([np.eye(3)] * 2))
    none, starts = np.zeros(2, dtype=np.int64), np.array([0, 2])
    points = np.array([[0.0, 0.0, 1.0, 0.0]])
    _, hessian, gradient, *landmarks = linearise(
        lens, one, points, pixels, white, none, starts, 2.0
    )
    stepped(points, gradient, none, starts, landmarks[0], landmarks[1], landmarks[2], 1.0)
    moved(one, gradient)
    add_motions(one, none, none, one, hessian[None] + np.eye(6), hessian, gradient)
    inverse_positive(hessian + np.eye(6))
    noise = np.stack([np.eye(3)] * 2)
    distances(lens, pixels, noise, pixels, noise, none, one, hessian[None])
