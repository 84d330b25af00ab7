"""Align a patch of the left image with the right one: position, slopes, gain and bias.

The compiled part of `frontends.disparity`, where the model is described. Arrays are flat with
constant offsets: with an array of two dimensions the compiler cannot tell that what is written is
not what is read next, and gives up on SIMD.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit
from frontends.measurements import Image

FloatArray = NDArray[np.float64]
Floats = NDArray[np.float32]
_f32 = np.float32
_u64 = np.uint64

_SIDE = 16  # patch, px; its centre lies between pixels
_AREA = _SIDE * _SIDE
_MIDDLE = 0.5 * (_SIDE - 1)
_HALF = 0.5 * _SIDE  # unit of the offsets within a patch, px
_WINDOW_SIGMA_PX = 6.0
#: Columns of the right image that a slanting patch may cover: the smallest image that is used.
SPAN = 40
#: Those that a patch which hardly slants covers.
_NARROW = 24
#: Unknowns: disparity, its change along u and v over `_HALF`, vertical shift, gain, bias.
_UNKNOWNS = 6
#: Cubic convolution; -0.6 has a fifth of the bias between pixels that -0.5 (Catmull-Rom) has.
_CUBIC = _f32(-0.6)
_ITERATIONS = 6
#: Converged: the disparity's last step, and half the vertical, a third of the patch edge's, px.
_STEP_PX = 0.03
#: Else the last step must be below this share of sigma, and is added to it in squares.
_LAST_STEP_SIGMAS = 0.5
#: Weak priors hold what the texture does not show (at a noise of 4.5 grey levels): slopes
#: 0 +- 0.2, vertical shift 0 +- 0.5 px.
_PRIOR = np.array([0.0, 20.0 / (0.2 * _HALF) ** 2, 20.0 / (0.2 * _HALF) ** 2, 80.0, 0.0, 0.0])
_STEEPEST = 0.6 * _HALF
_LARGEST_VERTICAL_PX = 1.0
_LEAST_GAIN, _LARGEST_GAIN = 0.2, 5.0
#: Largest share of the right patch's variance that the model leaves unexplained.
_UNEXPLAINED = 0.4
#: After so many steps, a match that leaves this share unexplained is a wrong one.
_PATIENCE, _HOPELESS = 2, 0.8
#: Variance of a central difference, over that of a residual (left plus interpolated right).
_GRADIENT_NOISE = 0.3
#: Largest ratio of the information along u to what of it is not the noise's own gradient.
_LARGEST_INFLATION = 3.0
#: Model error (curvature, interpolation), px: added in squares to every sigma.
_MODEL_SIGMA_PX = 0.006


def _patch() -> Floats:
    """Weights of a patch's pixels, and their offsets along u and along v, in `_HALF`; flat."""
    row, column = (grid.ravel() for grid in np.mgrid[:_SIDE, :_SIDE].astype(np.float64))
    i, j = column - _MIDDLE, row - _MIDDLE
    weight = np.exp(-0.5 * (i * i + j * j) / _WINDOW_SIGMA_PX**2)
    return np.concatenate([weight, i / _HALF, j / _HALF]).astype(np.float32)


PATCH = _patch()
_WEIGHT = float(PATCH[:_AREA].sum())
#: Variance of a weighted estimate over the inverse of its normal matrix, for like residuals.
_WEIGHT_RATIO = float((PATCH[:_AREA].astype(np.float64) ** 2).sum()) / _WEIGHT
#: Residuals that count, less the unknowns: as a share of the weight.
_FREEDOM = _WEIGHT - _UNKNOWNS * _WEIGHT_RATIO


@njit
def _differentiate(
    left: NDArray[np.uint8], width: int, u: int, v: int, grid: Floats, J: Floats
) -> np.float32:
    """Columns of the Jacobian of the patch whose first pixel is u, v; its mean grey level."""
    along_v, grey, row = _u64(3 * _AREA), _u64(4 * _AREA), _u64(width)
    for j in range(_SIDE):
        first, k = _u64((v + j) * width + u), _u64(j * _SIDE)
        for i in range(_u64(_SIDE)):
            here = first + i
            J[k + i] = _f32(0.5) * (_f32(left[here + _u64(1)]) - _f32(left[here - _u64(1)]))
            J[along_v + k + i] = _f32(0.5) * (_f32(left[here + row]) - _f32(left[here - row]))
            J[grey + k + i] = _f32(left[here])
    mean = _f32(0)
    for p in range(_u64(_AREA)):
        mean += grid[p] * J[grey + p]
    mean /= _f32(_WEIGHT)
    for p in range(_u64(_AREA)):
        J[_u64(_AREA) + p] = J[p] * grid[_u64(_AREA) + p]
        J[_u64(2 * _AREA) + p] = J[p] * grid[_u64(2 * _AREA) + p]
        J[grey + p] -= mean
    return mean


@njit
def _moments(R: Floats, WJ: Floats, out: FloatArray) -> None:
    """Scalar products of an image patch with the six weighted columns of the Jacobian."""
    t0 = t1 = t2 = t3 = t4 = t5 = _f32(0)
    for k in range(_u64(_AREA)):
        r = R[k]
        t0 += r * WJ[k]
        t1 += r * WJ[_u64(_AREA) + k]
        t2 += r * WJ[_u64(2 * _AREA) + k]
        t3 += r * WJ[_u64(3 * _AREA) + k]
        t4 += r * WJ[_u64(4 * _AREA) + k]
        t5 += r * WJ[_u64(5 * _AREA) + k]
    out[0], out[1], out[2], out[3], out[4], out[5] = t0, t1, t2, t3, t4, t5


@njit
def _normal_matrix(WJ: Floats, J: Floats, L: FloatArray) -> None:
    """Lower triangle of the scalar products of the weighted columns with the plain ones."""
    p0, p1, p2, p3, p4 = _u64(0), _u64(_AREA), _u64(2 * _AREA), _u64(3 * _AREA), _u64(4 * _AREA)
    p5 = _u64(5 * _AREA)
    a0 = a1 = a2 = a3 = a4 = a5 = b1 = b2 = b3 = b4 = b5 = _f32(0)
    for k in range(_u64(_AREA)):
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
    for k in range(_u64(_AREA)):
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


@njit
def _factorise(J: Floats, grid: Floats, WJ: Floats, L: FloatArray) -> bool:
    """Weighted Jacobian and the Cholesky factor (inverse diagonal) of the normal matrix."""
    for a in range(_UNKNOWNS):
        row = _u64(a * _AREA)
        for k in range(_u64(_AREA)):
            WJ[row + k] = grid[k] * J[row + k]
    _normal_matrix(WJ, J, L)
    for a in range(_UNKNOWNS):
        L[a, a] += _PRIOR[a]
        least = 1e-6 * L[a, a] + 1e-6
        for b in range(a + 1):
            entry = L[a, b]
            for c in range(b):
                entry -= L[a, c] * L[b, c]
            if b < a:
                L[a, b] = entry * L[b, b]
            elif entry <= least:
                return False
            else:
                L[a, a] = 1.0 / np.sqrt(entry)
    return True


@njit
def _solve(L: FloatArray, x: FloatArray) -> None:
    """Replace x by the solution of the normal equations."""
    for a in range(_UNKNOWNS):
        for b in range(a):
            x[a] -= L[a, b] * x[b]
        x[a] *= L[a, a]
    for a in range(_UNKNOWNS - 1, -1, -1):
        for b in range(a + 1, _UNKNOWNS):
            x[a] -= L[b, a] * x[b]
        x[a] *= L[a, a]


@njit
def _rows_at(
    right: NDArray[np.uint8], width: int, base: int, v: float, mean: np.float32, slanting: bool,
    rows: Floats,
) -> None:  # fmt: skip
    """Rows of the right image at the patch's heights around v, from column `base` on."""
    first = int(np.floor(v - _MIDDLE))
    c, f = _CUBIC, _f32(v - _MIDDLE - first)
    w0 = c * f * (_f32(1) - f) * (_f32(1) - f)
    w1 = ((c + _f32(2)) * f - (c + _f32(3))) * f * f + _f32(1)
    w3 = c * f * f * (_f32(1) - f)
    w2 = _f32(1) - w0 - w1 - w3
    row = _u64(width)
    for j in range(_SIDE):
        start, out = _u64((first + j) * width + base), _u64(j * SPAN)
        for k in range(_u64(_NARROW)):
            x = start + k
            outer = w0 * _f32(right[x - row]) + w3 * _f32(right[x + row + row])
            rows[out + k] = outer + w1 * _f32(right[x]) + w2 * _f32(right[x + row]) - mean
        if not slanting:
            continue
        for k in range(_u64(SPAN - _NARROW)):
            x = start + _u64(_NARROW) + k
            outer = w0 * _f32(right[x - row]) + w3 * _f32(right[x + row + row])
            inner = w1 * _f32(right[x]) + w2 * _f32(right[x + row])
            rows[out + _u64(_NARROW) + k] = outer + inner - mean


@njit
def _cubic(
    p0: np.float32, p1: np.float32, p2: np.float32, p3: np.float32, f: np.float32
) -> np.float32:
    """Value at a share f of the way from p1 to p2."""
    c = _CUBIC
    cubic = (c + _f32(2)) * (p1 - p2) + c * (p0 - p3)
    square = (_f32(2) * c + _f32(3)) * p2 - _f32(2) * c * p0 - (c + _f32(3)) * p1 + c * p3
    return p1 + f * (c * (p0 - p2) + f * (square + f * cubic))


@njit
def _sample(
    right: NDArray[np.uint8], height: int, width: int, u: float, v: float, slope_u: float,
    slope_v: float, mean: np.float32, rows: Floats, R: Floats,
) -> bool:  # fmt: skip
    """Right patch R around u, v less `mean`; False where it leaves the image."""
    reach = _MIDDLE / _HALF * (_HALF - slope_u + abs(slope_v))
    base = int(np.floor(u - reach - 0.01)) - 1
    first = int(np.floor(v - _MIDDLE))
    last = u + reach + 2.01
    if min(base, first - 1) < 0 or last >= min(width, base + SPAN) or first + _SIDE >= height - 1:
        return False
    base = min(base, width - SPAN)
    _rows_at(right, width, base, v, mean, last > base + _NARROW, rows)
    per_column, per_row = -slope_u / _HALF, -slope_v / _HALF
    for j in range(_SIDE):
        # column i is at i + start + i per_column: most often in one or two whole steps from i,
        # and then its neighbours are read side by side
        start = u - base - _MIDDLE * (1.0 + per_column) + per_row * (j - _MIDDLE)
        drift = per_column * (_SIDE - 1)
        whole = int(np.floor(start + min(drift, 0.0)))
        offset, step = _f32(start - whole), _f32(per_column)
        origin, out = _u64(j * SPAN + whole), _u64(j * _SIDE)
        if offset + max(drift, 0.0) < 2.0:
            for i in range(_u64(_SIDE)):
                place, q = offset + step * _f32(i), origin + i
                # all five first: a load on a condition would be done one at a time
                t0, t1, t2 = rows[q - _u64(1)], rows[q], rows[q + _u64(1)]
                t3, t4 = rows[q + _u64(2)], rows[q + _u64(3)]
                beyond = place >= _f32(1)
                p0, p1 = t1 if beyond else t0, t2 if beyond else t1
                p2, p3 = t3 if beyond else t2, t4 if beyond else t3
                f = place - _f32(1) if beyond else place
                R[out + i] = _cubic(p0, p1, p2, p3, f)
        else:
            for i in range(_SIDE):
                place = offset + step * _f32(i)
                steps = int(np.floor(place))
                q = _u64(j * SPAN + whole + i + steps)
                R[out + _u64(i)] = _cubic(
                    rows[q - _u64(1)], rows[q], rows[q + _u64(1)], rows[q + _u64(2)],
                    place - _f32(steps),
                )  # fmt: skip
    return True


@kernel
def refine_all(
    left: Image, right: Image, start: FloatArray, grid: Floats, result: FloatArray,
    confirmed: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Fill result (disparity, sigma, vertical) from start (u, v, disparity, vertical, shift)."""
    J, WJ = np.ones(_UNKNOWNS * _AREA, np.float32), np.empty(_UNKNOWNS * _AREA, np.float32)
    R, rows = np.empty(_AREA, np.float32), np.zeros(_SIDE * SPAN + _SIDE, np.float32)
    L = np.zeros((_UNKNOWNS, _UNKNOWNS))
    moment, x = np.zeros(_UNKNOWNS), np.zeros(_UNKNOWNS)
    height, width = left.shape
    left_pixels, right_pixels = left.reshape(-1), right.reshape(-1)
    for n in range(len(start)):
        u = int(np.floor(start[n, 0] + 0.5 - _MIDDLE))
        v = int(np.floor(start[n, 1] + 0.5 - _MIDDLE))
        if min(u, v) < 1 or u + _SIDE >= width or v + _SIDE >= height:
            continue
        mean = _differentiate(left_pixels, width, u, v, grid, J)
        if not _factorise(J, grid, WJ, L):
            continue
        d, vertical, slope_u, slope_v, gain = start[n, 2], 0.0, 0.0, 0.0, 1.0
        inside, converged, step, unexplained, variance = True, False, 0.0, 0.0, 0.0
        for tried in range(_ITERATIONS):
            inside = _sample(
                right_pixels, height, width, u + _MIDDLE - d,
                v + _MIDDLE - start[n, 3] - vertical, slope_u, slope_v, mean, rows, R,
            )  # fmt: skip
            if not inside:
                break
            total = _f32(0)
            for k in range(_u64(_AREA)):
                total += grid[k] * R[k] * R[k]
            power = float(total)
            _moments(R, WJ, moment)
            moment[1] -= _PRIOR[1] * gain * slope_u
            moment[2] -= _PRIOR[2] * gain * slope_v
            moment[3] -= _PRIOR[3] * gain * vertical
            x[:] = moment
            _solve(L, x)
            unexplained = power
            for a in range(_UNKNOWNS):
                unexplained -= moment[a] * x[a]
            variance = power - moment[5] * moment[5] / _WEIGHT
            if tried >= _PATIENCE and unexplained > _HOPELESS * variance:
                inside = False
                break
            gain = min(max(x[4], _LEAST_GAIN), _LARGEST_GAIN)
            stretch = (1.0 - slope_u / _HALF) / gain  # a shift seen in the left image, in D
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
        # the feature is beside the patch's centre: d + slopes times its offset
        x[:] = 0.0
        x[0] = 1.0
        x[1] = (start[n, 0] - u - _MIDDLE) / _HALF
        x[2] = (start[n, 1] - v - _MIDDLE) / _HALF
        d += x[1] * slope_u + x[2] * slope_v
        moment[:] = x
        _solve(L, x)
        spread = moment[0] * x[0] + moment[1] * x[1] + moment[2] * x[2]
        # the noise's own gradient is in the normal matrix; it tells nothing of the disparity
        signal = 1.0 - _GRADIENT_NOISE * _WEIGHT * noise * spread
        if signal * _LARGEST_INFLATION < 1.0:
            continue
        variance_d = noise * _WEIGHT_RATIO * spread / signal**2
        if not converged:
            converged = step * step < _LAST_STEP_SIGMAS**2 * variance_d
            variance_d += step * step
        result[n, 0] = d
        result[n, 1] = np.sqrt(variance_d + _MODEL_SIGMA_PX**2)
        result[n, 2] = vertical
        confirmed[n] = (
            converged
            and _LEAST_GAIN < gain < _LARGEST_GAIN
            and abs(d - start[n, 2]) <= start[n, 4]
            and abs(vertical) <= _LARGEST_VERTICAL_PX
            and unexplained <= _UNEXPLAINED * variance
        )
