"""Align a patch of the left image with the right one: position, slopes, gain and bias.

The compiled part of `frontends.disparity`, where the model is described. Arrays are flat, see
`frontends.patch_sampling`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.cholesky import factorise, solve
from frontends.jit import kernel, njit
from frontends.measurements import Image
from frontends.patch_sampling import AREA, HALF, MIDDLE, SIDE, SPAN, sample
from frontends.patch_window import (
    HOPELESS,
    LARGEST_GAIN,
    LEAST_GAIN,
    UNEXPLAINED,
    WEIGHT,
    WEIGHT_RATIO,
    weigh,
)

FloatArray = NDArray[np.float64]
Floats = NDArray[np.float32]
_f32 = np.float32
_u64 = np.uint64

#: Unknowns: disparity, its change along u and v over `HALF`, vertical shift, gain, bias.
_UNKNOWNS = 6
_ITERATIONS = 6
#: Converged: the disparity's last step, and half the vertical, a third of the patch edge's, px.
_STEP_PX = 0.03
#: Else the last step must be below this share of sigma, and is added to it in squares.
_LAST_STEP_SIGMAS = 0.5
#: Weak priors hold what the texture does not show (at a noise of 4.5 grey levels): slopes
#: 0 +- 0.2, vertical shift 0 +- 0.5 px.
_PRIOR = np.array([0.0, 20.0 / (0.2 * HALF) ** 2, 20.0 / (0.2 * HALF) ** 2, 80.0, 0.0, 0.0])
_STEEPEST = 0.6 * HALF
_LARGEST_VERTICAL_PX = 1.0
#: Steps before a match is given up as hopeless.
_PATIENCE = 2
#: Variance of a central difference, over that of a residual (left plus interpolated right).
_GRADIENT_NOISE = 0.3
#: Largest ratio of the information along u to what of it is not the noise's own gradient.
_LARGEST_INFLATION = 3.0
#: Model error (curvature, interpolation), px: added in squares to every sigma.
_MODEL_SIGMA_PX = 0.006
#: Residuals that count, less the unknowns: as a share of the weight.
_FREEDOM = WEIGHT - _UNKNOWNS * WEIGHT_RATIO


@njit
def _differentiate(
    left: NDArray[np.uint8], width: int, u: int, v: int, grid: Floats, J: Floats
) -> np.float32:
    """Columns of the Jacobian of the patch whose first pixel is u, v; its mean grey level."""
    along_v, grey, row = _u64(3 * AREA), _u64(4 * AREA), _u64(width)
    for j in range(SIDE):
        first, k = _u64((v + j) * width + u), _u64(j * SIDE)
        for i in range(_u64(SIDE)):
            here = first + i
            J[k + i] = _f32(0.5) * (_f32(left[here + _u64(1)]) - _f32(left[here - _u64(1)]))
            J[along_v + k + i] = _f32(0.5) * (_f32(left[here + row]) - _f32(left[here - row]))
            J[grey + k + i] = _f32(left[here])
    mean = _f32(0)
    for p in range(_u64(AREA)):
        mean += grid[p] * J[grey + p]
    mean /= _f32(WEIGHT)
    for p in range(_u64(AREA)):
        J[_u64(AREA) + p] = J[p] * grid[_u64(AREA) + p]
        J[_u64(2 * AREA) + p] = J[p] * grid[_u64(2 * AREA) + p]
        J[grey + p] -= mean
    return mean


@njit
def _moments(R: Floats, WJ: Floats, out: FloatArray) -> None:
    """Scalar products of an image patch with the six weighted columns of the Jacobian."""
    t0 = t1 = t2 = t3 = t4 = t5 = _f32(0)
    for k in range(_u64(AREA)):
        r = R[k]
        t0 += r * WJ[k]
        t1 += r * WJ[_u64(AREA) + k]
        t2 += r * WJ[_u64(2 * AREA) + k]
        t3 += r * WJ[_u64(3 * AREA) + k]
        t4 += r * WJ[_u64(4 * AREA) + k]
        t5 += r * WJ[_u64(5 * AREA) + k]
    out[0], out[1], out[2], out[3], out[4], out[5] = t0, t1, t2, t3, t4, t5


@njit
def _normal_matrix(WJ: Floats, J: Floats, L: FloatArray) -> None:
    """Lower triangle of the scalar products of the weighted columns with the plain ones."""
    p0, p1, p2, p3, p4 = _u64(0), _u64(AREA), _u64(2 * AREA), _u64(3 * AREA), _u64(4 * AREA)
    p5 = _u64(5 * AREA)
    a0 = a1 = a2 = a3 = a4 = a5 = b1 = b2 = b3 = b4 = b5 = _f32(0)
    for k in range(_u64(AREA)):
        w, x = WJ[p0 + k], WJ[p1 + k]
        a0 += w * J[p0 + k]
        a1 += w * J[p1 + k]
        a2 += w * J[p2 + k]
        a3 += w * J[p3 + k]
        a4 += w * J[p4 + k]
        a5 += w * J[p5 + k]
        b1 += x * J[p1 + k]
        b2 += x * J[p2 + k]
        b3 += x * J[p3 + k]
        b4 += x * J[p4 + k]
        b5 += x * J[p5 + k]
    c2 = c3 = c4 = c5 = d3 = d4 = d5 = e4 = e5 = f5 = _f32(0)
    for k in range(_u64(AREA)):
        w, x, y = WJ[p2 + k], WJ[p3 + k], WJ[p4 + k]
        c2 += w * J[p2 + k]
        c3 += w * J[p3 + k]
        c4 += w * J[p4 + k]
        c5 += w * J[p5 + k]
        d3 += x * J[p3 + k]
        d4 += x * J[p4 + k]
        d5 += x * J[p5 + k]
        e4 += y * J[p4 + k]
        e5 += y * J[p5 + k]
        f5 += WJ[p5 + k]
    L[0, 0], L[1, 0], L[2, 0], L[3, 0], L[4, 0], L[5, 0] = a0, a1, a2, a3, a4, a5
    L[1, 1], L[2, 1], L[3, 1], L[4, 1], L[5, 1] = b1, b2, b3, b4, b5
    L[2, 2], L[3, 2], L[4, 2], L[5, 2] = c2, c3, c4, c5
    L[3, 3], L[4, 3], L[5, 3] = d3, d4, d5
    L[4, 4], L[5, 4], L[5, 5] = e4, e5, f5


@kernel
def refine_all(
    left: Image, right: Image, start: FloatArray, grid: Floats, result: FloatArray,
    confirmed: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Fill result from start (u, v, disparity, vertical, shift).

    The columns of `result` are disparity, sigma, vertical, the variance that the model leaves of a
    pixel of the right image, in grey levels squared (unchanged where it was not fitted), and the
    change of disparity along u and along v, px per px.
    """
    J, WJ = np.ones(_UNKNOWNS * AREA, np.float32), np.empty(_UNKNOWNS * AREA, np.float32)
    R, rows = np.empty(AREA, np.float32), np.zeros(SIDE * SPAN + SIDE, np.float32)
    L = np.zeros((_UNKNOWNS, _UNKNOWNS))
    moment, x = np.zeros(_UNKNOWNS), np.zeros(_UNKNOWNS)
    height, width = left.shape
    left_pixels, right_pixels = left.reshape(-1), right.reshape(-1)
    for n in range(len(start)):
        u = int(np.floor(start[n, 0] + 0.5 - MIDDLE))
        v = int(np.floor(start[n, 1] + 0.5 - MIDDLE))
        if min(u, v) < 1 or u + SIDE >= width or v + SIDE >= height:
            continue
        mean = _differentiate(left_pixels, width, u, v, grid, J)
        weigh(J, grid, _UNKNOWNS, WJ)
        _normal_matrix(WJ, J, L)
        if not factorise(L, _PRIOR):
            continue
        d, vertical, slope_u, slope_v, gain = start[n, 2], 0.0, 0.0, 0.0, 1.0
        inside, converged, step, unexplained, variance = True, False, 0.0, 0.0, 0.0
        for tried in range(_ITERATIONS):
            inside = sample(
                right_pixels, height, width, u + MIDDLE - d,
                v + MIDDLE - start[n, 3] - vertical, slope_u, slope_v, mean, rows, R,
            )  # fmt: skip
            if not inside:
                break
            total = _f32(0)
            for k in range(_u64(AREA)):
                total += grid[k] * R[k] * R[k]
            power = float(total)
            _moments(R, WJ, moment)
            moment[1] -= _PRIOR[1] * gain * slope_u
            moment[2] -= _PRIOR[2] * gain * slope_v
            moment[3] -= _PRIOR[3] * gain * vertical
            x[:] = moment
            solve(L, x)
            unexplained = power
            for a in range(_UNKNOWNS):
                unexplained -= moment[a] * x[a]
            variance = power - moment[5] * moment[5] / WEIGHT
            if tried >= _PATIENCE and unexplained > HOPELESS * variance:
                inside = False
                result[n, 3] = unexplained / _FREEDOM
                break
            gain = min(max(x[4], LEAST_GAIN), LARGEST_GAIN)
            stretch = (1.0 - slope_u / HALF) / gain  # a shift seen in the left image, in D
            step, rise = min(max(stretch * x[0], -1.0), 1.0), min(max(x[3] / gain, -1.0), 1.0)
            d, vertical = d + step, vertical + rise
            slope_u = min(max(slope_u + stretch * x[1], -_STEEPEST), _STEEPEST)
            slope_v = min(max(slope_v + stretch * x[2], -_STEEPEST), _STEEPEST)
            edge_step = stretch * max(abs(x[1]), abs(x[2]))
            converged = max(abs(step), abs(rise) / 2.0, edge_step / 3.0) < _STEP_PX
            if converged or abs(d - start[n, 2]) > start[n, 4] + 0.5:
                break
        if not inside:
            continue
        noise = max(unexplained, 0.0) / (_FREEDOM * gain * gain)
        result[n, 3] = noise * gain * gain
        # the feature is beside the patch's centre: d + slopes times its offset
        x[:] = 0.0
        x[0] = 1.0
        x[1] = (start[n, 0] - u - MIDDLE) / HALF
        x[2] = (start[n, 1] - v - MIDDLE) / HALF
        d += x[1] * slope_u + x[2] * slope_v
        moment[:] = x
        solve(L, x)
        spread = moment[0] * x[0] + moment[1] * x[1] + moment[2] * x[2]
        # the noise's own gradient is in the normal matrix; it tells nothing of the disparity
        signal = 1.0 - _GRADIENT_NOISE * WEIGHT * noise * spread
        if signal * _LARGEST_INFLATION < 1.0:
            continue
        variance_d = noise * WEIGHT_RATIO * spread / signal**2
        if not converged:
            converged = step * step < _LAST_STEP_SIGMAS**2 * variance_d
            variance_d += step * step
        result[n, 0] = d
        result[n, 1] = np.sqrt(variance_d + _MODEL_SIGMA_PX**2)
        result[n, 2] = vertical
        result[n, 4], result[n, 5] = slope_u / HALF, slope_v / HALF
        confirmed[n] = (
            converged
            and LEAST_GAIN < gain < LARGEST_GAIN
            and abs(d - start[n, 2]) <= start[n, 4]
            and abs(vertical) <= _LARGEST_VERTICAL_PX
            and unexplained <= UNEXPLAINED * variance
        )
