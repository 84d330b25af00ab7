"""The sums of `frontends.reprojection` in compiled code.

Over the blocks of `frontends.whitening`; all follow from ``M = P^T S^-1 P`` and
``q = P^T S^-1 r`` of the single landmarks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit
from frontends.whitening import (
    BLOCK,
    DISTANCE,
    INVERSE,
    MATRIX,
    RESIDUAL,
    SCRATCH,
    STRIDE,
    VECTOR,
    WEIGHT,
    weigh,
    whiten,
)

FloatArray = NDArray[np.float64]
_u64 = np.uint64  # signed indices get a test for negative values in the loop


@njit
def sum_block(
    data: FloatArray, first: int, scratch: FloatArray, sums: FloatArray, gradient: FloatArray
) -> None:
    """Add one block to the lower triangle of the 6 x 6 matrix and to the gradient."""
    start = _u64(first * STRIDE)
    g0 = g1 = g2 = g3 = g4 = g5 = 0.0
    t0 = t1 = t2 = t3 = t4 = t5 = 0.0
    for j in range(_u64(BLOCK)):
        x, y = data[start + j], data[start + j + _u64(BLOCK)]
        z = data[start + j + _u64(2 * BLOCK)]
        q0, q1 = scratch[j + _u64(VECTOR)], scratch[j + _u64(VECTOR + BLOCK)]
        q2 = scratch[j + _u64(VECTOR + 2 * BLOCK)]
        g0 += y * q2 - z * q1
        g1 += z * q0 - x * q2
        g2 += x * q1 - y * q0
        g3 += q0
        g4 += q1
        g5 += q2
        t0 += scratch[j + _u64(MATRIX)]
        t1 += scratch[j + _u64(MATRIX + BLOCK)]
        t2 += scratch[j + _u64(MATRIX + 2 * BLOCK)]
        t3 += scratch[j + _u64(MATRIX + 3 * BLOCK)]
        t4 += scratch[j + _u64(MATRIX + 4 * BLOCK)]
        t5 += scratch[j + _u64(MATRIX + 5 * BLOCK)]
    for k, value in enumerate((g0, g1, g2, g3, g4, g5)):
        gradient[k] += value
    sums[3, 3] += t0
    sums[4, 3] += t1
    sums[5, 3] += t2
    sums[4, 4] += t3
    sums[5, 4] += t4
    sums[5, 5] += t5
    c00 = c01 = c02 = c10 = c11 = c12 = c20 = c21 = c22 = 0.0
    r00 = r10 = r20 = r11 = r21 = r22 = 0.0
    for j in range(_u64(BLOCK)):
        x, y = data[start + j], data[start + j + _u64(BLOCK)]
        z = data[start + j + _u64(2 * BLOCK)]
        xx, xy = scratch[j + _u64(MATRIX)], scratch[j + _u64(MATRIX + BLOCK)]
        xz, yy = scratch[j + _u64(MATRIX + 2 * BLOCK)], scratch[j + _u64(MATRIX + 3 * BLOCK)]
        yz, zz = scratch[j + _u64(MATRIX + 4 * BLOCK)], scratch[j + _u64(MATRIX + 5 * BLOCK)]
        # B = [X]x M, then [X]x M [X]x^T, whose columns are X x (rows of B)
        b00, b01, b02 = y * xz - z * xy, y * yz - z * yy, y * zz - z * yz
        b10, b11, b12 = z * xx - x * xz, z * xy - x * yz, z * xz - x * zz
        b20, b21, b22 = x * xy - y * xx, x * yy - y * xy, x * yz - y * xz
        c00 += b00
        c01 += b01
        c02 += b02
        c10 += b10
        c11 += b11
        c12 += b12
        c20 += b20
        c21 += b21
        c22 += b22
        r00 += y * b02 - z * b01
        r10 += z * b00 - x * b02
        r20 += x * b01 - y * b00
        r11 += z * b10 - x * b12
        r21 += x * b11 - y * b10
        r22 += x * b21 - y * b20
    sums[0, 0] += r00
    sums[1, 0] += r10
    sums[2, 0] += r20
    sums[1, 1] += r11
    sums[2, 1] += r21
    sums[2, 2] += r22
    for k, row in enumerate(((c00, c10, c20), (c01, c11, c21), (c02, c12, c22))):
        sums[3 + k, 0] += row[0]
        sums[3 + k, 1] += row[1]
        sums[3 + k, 2] += row[2]


@njit
def _sum_terms(
    data: FloatArray, terms: FloatArray, count: int, first: int, scratch: FloatArray,
    sums: FloatArray, gradient: FloatArray,
) -> None:  # fmt: skip
    """Add one block's share of the K further unknowns."""
    extra = terms.shape[2]
    e = np.zeros((extra, 3))
    for j in range(min(BLOCK, count - first * BLOCK)):
        landmark = first * BLOCK + j
        x, y = data[first * STRIDE + j], data[first * STRIDE + BLOCK + j]
        z = data[first * STRIDE + 2 * BLOCK + j]
        for k in range(extra):
            for i in range(3):
                e[k, i] = terms[landmark, 3, k] if i == 2 else 0.0
                for a in range(3):
                    e[k, i] += scratch[(3 * i + a) * BLOCK + j] * terms[landmark, a, k]
        for k in range(extra):
            h0 = h1 = h2 = 0.0
            for i in range(3):
                inverse = scratch[INVERSE + i * BLOCK + j]
                residual = scratch[RESIDUAL + i * BLOCK + j]
                gradient[6 + k] += scratch[WEIGHT + BLOCK + j] * inverse * residual * e[k, i]
                weighted = scratch[WEIGHT + j] * inverse * e[k, i]
                h0 += weighted * scratch[3 * i * BLOCK + j]
                h1 += weighted * scratch[(3 * i + 1) * BLOCK + j]
                h2 += weighted * scratch[(3 * i + 2) * BLOCK + j]
                for m in range(k + 1):
                    sums[6 + k, 6 + m] += weighted * e[m, i]
            sums[6 + k, 0] += y * h2 - z * h1
            sums[6 + k, 1] += z * h0 - x * h2
            sums[6 + k, 2] += x * h1 - y * h0
            sums[6 + k, 3] += h0
            sums[6 + k, 4] += h1
            sums[6 + k, 5] += h2


@kernel
def normal_equations(
    camera: FloatArray, motion: FloatArray, data: FloatArray, terms: FloatArray,
    among: FloatArray, per_kernel2: float, linear: float, square: float, chi2: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Matrix (6+K, 6+K) and gradient (6+K,), summed over the landmarks.

    Parameters
    ----------
    camera, motion, data, chi2
        As in `distances`.
    terms
        (N, 4, K): derivative of X and of the disparity by K more unknowns; K may be 0.
    among
        (B * BLOCK,): 1 for landmarks that count, 0 for others.
    per_kernel2
        Inverse square of the Cauchy kernel's scale.
    linear, square
        The matrix is summed with ``linear w + square w^2 m^2``, m^2 being `chi2`.
    """
    size = 6 + terms.shape[2]
    sums, gradient = np.zeros((size, size)), np.zeros(size)
    scratch = np.zeros(SCRATCH)
    for block in range(len(chi2) // BLOCK):
        whiten(camera, motion, data, block, scratch)
        weigh(among, block, per_kernel2, linear, square, scratch)
        sum_block(data, block, scratch, sums, gradient)
        if size > 6:
            _sum_terms(data, terms, len(terms), block, scratch, sums, gradient)
        for j in range(BLOCK):
            chi2[block * BLOCK + j] = scratch[DISTANCE + j]
    for k in range(size):
        for m in range(k):
            sums[m, k] = sums[k, m]
    return sums, gradient
