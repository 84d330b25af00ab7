"""Residuals of `frontends.reprojection` and their weights, in compiled code.

Landmarks come in blocks of 64, one quantity a row of 64 numbers, at constant offsets in a flat
array: the compiler then works on several landmarks at a time. With ``P`` the derivative of the
projection by the landmark X and ``S`` the covariance of the residual r, a motion's row is
``[X x P_i, P_i]``, so that all sums follow from ``M = P^T S^-1 P`` and ``q = P^T S^-1 r``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit

FloatArray = NDArray[np.float64]
_u64 = np.uint64  # signed indices get a test for negative values in the loop

BLOCK = 64
#: Rows of a block: X (3), its covariance (6: xx, xy, xz, yy, yz, zz), u, v, disparity seen from
#: the principal point (3), their variances (2).
ROWS = 14
STRIDE = ROWS * BLOCK
#: Rows of the scratch: whitened P (9), inverse variances of the whitened residual (3), the
#: residual (3), its squared length, weights of matrix and gradient (2), M (6), q (3).
SCRATCH = 27 * BLOCK
INVERSE, RESIDUAL, DISTANCE, WEIGHT, MATRIX, VECTOR = (
    row * BLOCK for row in (9, 12, 15, 16, 18, 24)
)

#: Points nearer than this to the camera plane have no usable projection, m.
_NEAREST_M = 1e-3
#: Squared distance given to landmarks behind the camera: never an inlier, and finite, as
#: the compiled kernel's arithmetic asks for.
_FAR_OFF = 1e12
#: Least variance left after elimination, px^2: rounding must not make it negative.
_LEAST_VARIANCE = 1e-9


@njit
def whiten(
    camera: FloatArray, motion: FloatArray, data: FloatArray, first: int, scratch: FloatArray
) -> None:
    """Residuals of one block of landmarks, made independent, and their derivatives."""
    fx, fy, fb = camera[0], camera[1], camera[2]
    r00, r01, r02, tx = motion[0, 0], motion[0, 1], motion[0, 2], motion[0, 3]
    r10, r11, r12, ty = motion[1, 0], motion[1, 1], motion[1, 2], motion[1, 3]
    r20, r21, r22, tz = motion[2, 0], motion[2, 1], motion[2, 2], motion[2, 3]
    start = _u64(first * STRIDE)
    for j in range(_u64(BLOCK)):
        at = start + j
        px, py, pz = data[at], data[at + _u64(BLOCK)], data[at + _u64(2 * BLOCK)]
        x = r00 * px + r01 * py + r02 * pz + tx
        y = r10 * px + r11 * py + r12 * pz + ty
        z = r20 * px + r21 * py + r22 * pz + tz
        in_front = z >= _NEAREST_M
        inverse_z = 1.0 / (z if in_front else _NEAREST_M)
        u, v, d = fx * x * inverse_z, fy * y * inverse_z, fb * inverse_z
        f, g, h = fx * inverse_z, fy * inverse_z, inverse_z * d
        u_z, v_z = inverse_z * u, inverse_z * v
        a0, a1, a2 = f * r00 - u_z * r20, f * r01 - u_z * r21, f * r02 - u_z * r22
        b0, b1, b2 = g * r10 - v_z * r20, g * r11 - v_z * r21, g * r12 - v_z * r22
        c0, c1, c2 = -h * r20, -h * r21, -h * r22
        xx, xy = data[at + _u64(3 * BLOCK)], data[at + _u64(4 * BLOCK)]
        xz, yy = data[at + _u64(5 * BLOCK)], data[at + _u64(6 * BLOCK)]
        yz, zz = data[at + _u64(7 * BLOCK)], data[at + _u64(8 * BLOCK)]
        variance = data[at + _u64(12 * BLOCK)]
        k0, k1 = xx * a0 + xy * a1 + xz * a2, xy * a0 + yy * a1 + yz * a2
        k2 = xz * a0 + yz * a1 + zz * a2
        s00 = a0 * k0 + a1 * k1 + a2 * k2 + variance
        s01 = b0 * k0 + b1 * k1 + b2 * k2
        s02 = c0 * k0 + c1 * k1 + c2 * k2
        k0, k1 = xx * b0 + xy * b1 + xz * b2, xy * b0 + yy * b1 + yz * b2
        k2 = xz * b0 + yz * b1 + zz * b2
        s11 = b0 * k0 + b1 * k1 + b2 * k2 + variance
        s12 = c0 * k0 + c1 * k1 + c2 * k2
        k0, k1 = xx * c0 + xy * c1 + xz * c2, xy * c0 + yy * c1 + yz * c2
        k2 = xz * c0 + yz * c1 + zz * c2
        s22 = c0 * k0 + c1 * k1 + c2 * k2 + data[at + _u64(13 * BLOCK)]
        # S = L D L^T; the inverse of L makes the rows independent
        i0 = 1.0 / s00
        l10, l20 = s01 * i0, s02 * i0
        i1 = 1.0 / max(s11 - l10 * s01, _LEAST_VARIANCE)
        l21 = (s12 - l20 * s01) * i1
        i2 = 1.0 / max(s22 - l20 * s02 - l21 * (s12 - l20 * s01), _LEAST_VARIANCE)
        w0 = data[at + _u64(9 * BLOCK)] - u
        w1 = data[at + _u64(10 * BLOCK)] - v - l10 * w0
        w2 = data[at + _u64(11 * BLOCK)] - d - l20 * w0 - l21 * w1
        b0, b1, b2 = b0 - l10 * a0, b1 - l10 * a1, b2 - l10 * a2
        scratch[j] = a0
        scratch[j + _u64(BLOCK)] = a1
        scratch[j + _u64(2 * BLOCK)] = a2
        scratch[j + _u64(3 * BLOCK)] = b0
        scratch[j + _u64(4 * BLOCK)] = b1
        scratch[j + _u64(5 * BLOCK)] = b2
        scratch[j + _u64(6 * BLOCK)] = c0 - l20 * a0 - l21 * b0
        scratch[j + _u64(7 * BLOCK)] = c1 - l20 * a1 - l21 * b1
        scratch[j + _u64(8 * BLOCK)] = c2 - l20 * a2 - l21 * b2
        scratch[j + _u64(INVERSE)] = i0
        scratch[j + _u64(INVERSE + BLOCK)] = i1
        scratch[j + _u64(INVERSE + 2 * BLOCK)] = i2
        scratch[j + _u64(RESIDUAL)] = w0
        scratch[j + _u64(RESIDUAL + BLOCK)] = w1
        scratch[j + _u64(RESIDUAL + 2 * BLOCK)] = w2
        distance2 = w0 * w0 * i0 + w1 * w1 * i1 + w2 * w2 * i2
        scratch[j + _u64(DISTANCE)] = distance2 if in_front else _FAR_OFF


@njit
def weigh(
    among: FloatArray, first: int, per_kernel2: float, linear: float, square: float,
    scratch: FloatArray,
) -> None:  # fmt: skip
    """Weights, M and q of one block from what `whiten` left.

    With w the Cauchy weight and m^2 the squared distance, the matrix is summed with
    ``linear w + square w^2 m^2``.
    """
    start = _u64(first * BLOCK)
    for j in range(_u64(BLOCK)):
        distance2 = scratch[j + _u64(DISTANCE)]
        counts = among[start + j] if distance2 < _FAR_OFF else 0.0
        weight = 1.0 / (1.0 + distance2 * per_kernel2)
        in_matrix = counts * (linear * weight + square * weight * weight * distance2)
        weight *= counts
        a0, a1 = scratch[j], scratch[j + _u64(BLOCK)]
        a2, b0 = scratch[j + _u64(2 * BLOCK)], scratch[j + _u64(3 * BLOCK)]
        b1, b2 = scratch[j + _u64(4 * BLOCK)], scratch[j + _u64(5 * BLOCK)]
        c0, c1 = scratch[j + _u64(6 * BLOCK)], scratch[j + _u64(7 * BLOCK)]
        c2, i0 = scratch[j + _u64(8 * BLOCK)], scratch[j + _u64(INVERSE)]
        i1 = scratch[j + _u64(INVERSE + BLOCK)]
        i2 = scratch[j + _u64(INVERSE + 2 * BLOCK)]
        w0 = weight * i0 * scratch[j + _u64(RESIDUAL)]
        w1 = weight * i1 * scratch[j + _u64(RESIDUAL + BLOCK)]
        w2 = weight * i2 * scratch[j + _u64(RESIDUAL + 2 * BLOCK)]
        scratch[j + _u64(WEIGHT)] = in_matrix
        scratch[j + _u64(WEIGHT + BLOCK)] = weight
        scratch[j + _u64(VECTOR)] = a0 * w0 + b0 * w1 + c0 * w2
        scratch[j + _u64(VECTOR + BLOCK)] = a1 * w0 + b1 * w1 + c1 * w2
        scratch[j + _u64(VECTOR + 2 * BLOCK)] = a2 * w0 + b2 * w1 + c2 * w2
        i0, i1, i2 = in_matrix * i0, in_matrix * i1, in_matrix * i2
        scratch[j + _u64(MATRIX)] = i0 * a0 * a0 + i1 * b0 * b0 + i2 * c0 * c0
        scratch[j + _u64(MATRIX + BLOCK)] = i0 * a0 * a1 + i1 * b0 * b1 + i2 * c0 * c1
        scratch[j + _u64(MATRIX + 2 * BLOCK)] = i0 * a0 * a2 + i1 * b0 * b2 + i2 * c0 * c2
        scratch[j + _u64(MATRIX + 3 * BLOCK)] = i0 * a1 * a1 + i1 * b1 * b1 + i2 * c1 * c1
        scratch[j + _u64(MATRIX + 4 * BLOCK)] = i0 * a1 * a2 + i1 * b1 * b2 + i2 * c1 * c2
        scratch[j + _u64(MATRIX + 5 * BLOCK)] = i0 * a2 * a2 + i1 * b2 * b2 + i2 * c2 * c2


@kernel
def distances(camera: FloatArray, motion: FloatArray, data: FloatArray, chi2: FloatArray) -> None:
    """Squared Mahalanobis distances of all landmarks, 1e12 behind the camera.

    Parameters
    ----------
    camera
        (3,): fx, fy, fx * baseline.
    motion
        (4, 4) ``b_T_a``.
    data
        (B * ROWS * BLOCK,) packed landmarks.
    chi2
        (B * BLOCK,), filled.
    """
    scratch = np.zeros(SCRATCH)
    for block in range(len(chi2) // BLOCK):
        whiten(camera, motion, data, block, scratch)
        for j in range(BLOCK):
            chi2[block * BLOCK + j] = scratch[DISTANCE + j]
