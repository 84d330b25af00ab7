"""The normal equations of a window's poses, its landmarks eliminated, and the step back.

The factors are GTSAM's GenericStereoFactor3D with Huber's loss on whitened residuals.
"""

from __future__ import annotations

import numpy as np

from frontends.jit import kernel
from frontends.measurements import FloatArray, IntArray
from lunar_fg.graph.kernels.projection import (
    pixel_residual,
    pixels_by_point,
    pose_columns,
    tangent_basis,
    times_lower,
    times_lower_rows,
    to_camera,
    whitener_of,
)

#: Keeps the system of a landmark without information positive.
_LEAST_GAIN = 1e-12


@kernel
def whiteners(covariance: FloatArray) -> FloatArray:
    """Inverse Cholesky roots of (M, 3, 3) covariances, lower triangles by rows, (M, 6)."""
    result = np.empty((len(covariance), 6))
    for m in range(len(covariance)):
        whitener_of(covariance[m], result[m])
    return result


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
        tangent_basis(points[k], basis)
        gain[:] = 0.0
        slope[:] = 0.0
        for m in range(starts[k], starts[k + 1]):
            inverse = inverses[pose[m]]
            coupling = couplings[m]
            if not to_camera(inverse, points[k], local):
                # Pulls nothing but costs, so that no step goes there.
                coupling[:] = 0.0
                cost += 10.0 * threshold * threshold
                continue
            pixel_residual(lens, local, uuv[m], raw)
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
            pixels_by_point(lens, local, by_point)
            for c in range(4):
                p, q, r = by_point[0, c], by_point[1, c], by_point[2, c]
                weighted[0, c] = scale * w[0] * p
                weighted[1, c] = scale * (w[1] * p + w[2] * q)
                weighted[2, c] = scale * (w[3] * p + w[4] * q + w[5] * r)
            for i in range(3):
                white[i] *= scale
            pose_columns(weighted, local, by_pose)
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
        whitener_of(gain, root)
        times_lower(root, slope)
        whites[k] = slope
        for m in range(starts[k], starts[k + 1]):
            times_lower_rows(root, couplings[m])
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
        tangent_basis(points[k], basis)
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
def step_of(
    hessian: FloatArray, gradient: FloatArray, damping: float
) -> tuple[bool, FloatArray, float]:
    """Step (6n,) of all poses but the first, and its squared length in sigmas.

    False where the system is not positive. The damping is a share of the diagonal.
    """
    n = len(gradient)
    root, step = np.zeros((n, n)), np.zeros(n)
    for i in range(6, n):
        for j in range(6, i + 1):
            value = hessian[i, j]
            if i == j:
                value *= 1.0 + damping
            for k in range(6, j):
                value -= root[i, k] * root[j, k]
            if i == j:
                if not value > 1e-14 * abs(hessian[i, i]):
                    return False, step, 0.0
                root[i, i] = np.sqrt(value)
            else:
                root[i, j] = value / root[j, j]
        value = -gradient[i]
        for k in range(6, i):
            value -= root[i, k] * step[k]
        step[i] = value / root[i, i]
    for i in range(n - 1, 5, -1):
        step[i] /= root[i, i]
        for k in range(6, i):
            step[k] -= root[i, k] * step[i]
    square = 0.0
    for i in range(6, n):
        for j in range(6, n):
            square += step[i] * hessian[i, j] * step[j]
    return True, step, square


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
