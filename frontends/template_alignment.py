"""Align the patch around a landmark with a later image: position, affine warp, gain and bias.

The compiled part of `frontends.templates`, where the model is described. Arrays are flat, see
`frontends.patch_sampling`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.cholesky import factorise, solve
from frontends.jit import kernel, njit
from frontends.measurements import Image
from frontends.patch_sampling import AREA, HALF, MIDDLE, SIDE
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
_i32 = np.int32
_u64 = np.uint64

#: Side of a template: a patch and one pixel more all around it, for its gradients.
TEMPLATE_SIDE = SIDE + 2
#: Unknowns: shift along u and its change along u and v over `HALF`, the same along v, gain, bias.
_UNKNOWNS = 8
_U, _V, _GAIN, _BIAS = 0, 3, 6, 7
_MOVES = 6
_ITERATIONS = 6
#: Converged: the last step of the position and an eighth of that of the patch's edge, px.
_STEP_PX = 0.05
#: A step goes no farther than this, px.
_LONGEST_STEP_PX = 1.0
#: Weak priors hold what the texture does not show (at a noise of 4.5 grey levels): the warp
#: changes by 0 +- 0.1 from where it is expected, the position by 0 +- 2 px.
_WARPS, _SHIFTS = 20.0 / (0.1 * HALF) ** 2, 20.0 / 2.0**2
_PRIOR = np.array([_SHIFTS, _WARPS, _WARPS, _SHIFTS, _WARPS, _WARPS, 0.0, 0.0])
#: Steps before a patch is given up as hopeless.
_PATIENCE = 3
#: Residuals that count, less the unknowns: as a share of the weight.
_FREEDOM = WEIGHT - _UNKNOWNS * WEIGHT_RATIO
_LEAST_DETERMINANT = 0.3
_LEAST_DENOMINATOR = 0.5
#: Largest side of what a warped patch covers, px.
_REGION = 56


@kernel
def cut_all(image: Image, corner: NDArray[np.int64], pixels: NDArray[np.uint8]) -> None:
    """Copy N templates from their first columns and rows `corner` (N, 2), all in the image."""
    for n in range(len(corner)):
        for j in range(TEMPLATE_SIDE):
            row = image[corner[n, 1] + j]
            first, out = _u64(corner[n, 0]), _u64(j * TEMPLATE_SIDE)
            for i in range(_u64(TEMPLATE_SIDE)):
                pixels[n, out + i] = row[first + i]


@njit
def _differentiate(template: NDArray[np.uint8], grid: Floats, J: Floats) -> np.float32:
    """Columns of the Jacobian of a template; its mean grey level."""
    along_v, grey = _u64(_V * AREA), _u64(_GAIN * AREA)
    side, one = _u64(TEMPLATE_SIDE), _u64(1)
    for j in range(_u64(SIDE)):
        first, k = (j + one) * side + one, j * _u64(SIDE)
        for i in range(_u64(SIDE)):
            here = first + i
            J[k + i] = _f32(0.5) * (_f32(template[here + one]) - _f32(template[here - one]))
            J[along_v + k + i] = _f32(0.5) * (
                _f32(template[here + side]) - _f32(template[here - side])
            )
            J[grey + k + i] = _f32(template[here])
    mean = _f32(0)
    for p in range(_u64(AREA)):
        mean += grid[p] * J[grey + p]
    mean /= _f32(WEIGHT)
    for p in range(_u64(AREA)):
        J[_u64(AREA) + p] = J[p] * grid[_u64(AREA) + p]
        J[_u64(2 * AREA) + p] = J[p] * grid[_u64(2 * AREA) + p]
        J[along_v + _u64(AREA) + p] = J[along_v + p] * grid[_u64(AREA) + p]
        J[along_v + _u64(2 * AREA) + p] = J[along_v + p] * grid[_u64(2 * AREA) + p]
        J[grey + p] -= mean
    return mean


@njit
def _normal_matrix(WJ: Floats, J: Floats, normal: FloatArray) -> None:
    """Lower triangle of the scalar products of the weighted columns with the plain ones."""
    for a in range(_UNKNOWNS):
        for b in range(a + 1):
            first, second = _u64(a * AREA), _u64(b * AREA)
            total = _f32(0)
            for p in range(_u64(AREA)):
                total += WJ[first + p] * J[second + p]
            normal[a, b] = total


@njit
def _sample(
    pixels: NDArray[np.uint8], height: int, width: int, u: float, v: float, A: FloatArray,
    bend: FloatArray, mean: np.float32, region: Floats, R: Floats,
) -> bool:  # fmt: skip
    """Patch R of an image, warped around u, v, less `mean`; False where it leaves the image.

    Bilinear: the Jacobian is the template's, so what the interpolation blurs moves nothing.
    """
    least = 1.0 - MIDDLE * (abs(bend[0]) + abs(bend[1]))
    if least < _LEAST_DENOMINATOR:
        return False
    reach_u = MIDDLE * (abs(A[0, 0]) + abs(A[0, 1])) / least + 1.0
    reach_v = MIDDLE * (abs(A[1, 0]) + abs(A[1, 1])) / least + 1.0
    if min(u - reach_u, v - reach_v) < 0 or u + reach_u + 2 > width or v + reach_v + 2 > height:
        return False
    columns, lines = int(2.0 * reach_u) + 2, int(2.0 * reach_v) + 2
    if max(columns, lines) > _REGION:
        return False
    # from a corner of the image on, so that all is positive and truncation rounds down
    base_u, base_v = int(u - reach_u), int(v - reach_v)
    u0, v0 = _f32(u - base_u), _f32(v - base_v)
    for j in range(lines):
        source, out = _u64((base_v + j) * width + base_u), _u64(j * _REGION)
        for i in range(_u64(columns)):
            region[out + i] = _f32(pixels[source + i]) - mean
    uu, uv, vu, vv = _f32(A[0, 0]), _f32(A[0, 1]), _f32(A[1, 0]), _f32(A[1, 1])
    bend_u, bend_v = _f32(bend[0]), _f32(bend[1])
    stride = _i32(_REGION)
    for j in range(SIDE):
        q = _f32(j) - _f32(MIDDLE)
        row_u, row_v, row_w = uv * q, vv * q, _f32(1) + bend_v * q
        out = _u64(j * SIDE)
        for i in range(_u64(SIDE)):
            p = _f32(i) - _f32(MIDDLE)
            nearer = _f32(1) / (row_w + bend_u * p)
            x, y = u0 + (row_u + uu * p) * nearer, v0 + (row_v + vu * p) * nearer
            column, line = _i32(x), _i32(y)
            x, y = x - _f32(column), y - _f32(line)
            k = _u64(line * stride + column)
            t0, t1 = region[k], region[k + _u64(1)]
            b0, b1 = region[k + _u64(_REGION)], region[k + _u64(_REGION) + _u64(1)]
            top, bottom = t0 + x * (t1 - t0), b0 + x * (b1 - b0)
            R[out + i] = top + y * (bottom - top)
    return True


@njit
def _compose(A: FloatArray, x: FloatArray) -> bool:
    """Undo a warp of the template in front of A: what lies at ``p + D p + d`` belongs at p.

    False where D folds the patch.
    """
    uu, uv = 1.0 + x[_U + 1] / HALF, x[_U + 2] / HALF
    vu, vv = x[_V + 1] / HALF, 1.0 + x[_V + 2] / HALF
    determinant = uu * vv - uv * vu
    if determinant < _LEAST_DETERMINANT:
        return False
    for row in range(2):
        a, b = A[row, 0], A[row, 1]
        A[row, 0] = (a * vv - b * vu) / determinant
        A[row, 1] = (b * uu - a * uv) / determinant
    return True


@njit
def _variance(normal: FloatArray, offset: FloatArray, x: FloatArray, y: FloatArray) -> float:
    """Largest variance of a coordinate of the landmark, px^2 for a pixel's noise of 1."""
    largest = 0.0
    for axis in range(2):
        y[:] = 0.0
        first = axis * _V
        y[first], y[first + 1], y[first + 2] = 1.0, offset[0] / HALF, offset[1] / HALF
        x[:] = y
        solve(normal, x)
        total = 0.0
        for a in range(_MOVES):
            total += x[a] * y[a]
        largest = max(largest, total)
    return largest


@kernel
def follow_all(
    image: Image, templates: NDArray[np.uint8], offset: FloatArray, start: FloatArray,
    warp: FloatArray, bend: FloatArray, reach: FloatArray, grid: Floats, result: FloatArray,
    found: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Align N templates with an image.

    Landmarks lie at `offset` (N, 2) from the templates' middles, are expected at `start` (N, 2)
    and are not found farther than `reach` (N,) from there, px. `warp` (N, 2, 2) is replaced where
    `found`, `bend` (N, 2) is not. The columns of `result` are u, v and 1-sigma, px.
    """
    height, width = image.shape
    pixels = image.reshape(-1)
    J, WJ = np.ones(_UNKNOWNS * AREA, np.float32), np.empty(_UNKNOWNS * AREA, np.float32)
    R, A = np.empty(AREA, np.float32), np.empty((2, 2))
    region = np.zeros(_REGION * _REGION, np.float32)
    normal = np.zeros((_UNKNOWNS, _UNKNOWNS))
    moment, x, moved = np.zeros(_UNKNOWNS), np.zeros(_UNKNOWNS), np.zeros(_MOVES)
    for n in range(len(templates)):
        mean = _differentiate(templates[n], grid, J)
        weigh(J, grid, _UNKNOWNS, WJ)
        _normal_matrix(WJ, J, normal)
        if not factorise(normal, _PRIOR):
            continue
        A[:] = warp[n]
        aside = 1.0 + bend[n, 0] * offset[n, 0] + bend[n, 1] * offset[n, 1]
        offset_u, offset_v = offset[n, 0] / aside, offset[n, 1] / aside
        u = start[n, 0] - A[0, 0] * offset_u - A[0, 1] * offset_v
        v = start[n, 1] - A[1, 0] * offset_u - A[1, 1] * offset_v
        moved[:] = 0.0
        gain, step, unexplained, variance = 1.0, 0.0, 0.0, 0.0
        converged = False
        for tried in range(_ITERATIONS):
            if not _sample(pixels, height, width, u, v, A, bend[n], mean, region, R):
                break
            total = _f32(0)
            for p in range(_u64(AREA)):
                total += grid[p] * R[p] * R[p]
            for a in range(_UNKNOWNS):
                row, product = _u64(a * AREA), _f32(0)
                for p in range(_u64(AREA)):
                    product += WJ[row + p] * R[p]
                moment[a] = product
            variance = total - moment[_BIAS] * moment[_BIAS] / WEIGHT
            for a in range(_MOVES):
                moment[a] -= _PRIOR[a] * gain * moved[a]
            x[:] = moment
            solve(normal, x)
            unexplained = float(total)
            for a in range(_UNKNOWNS):
                unexplained -= moment[a] * x[a]
            if tried >= _PATIENCE and unexplained > HOPELESS * variance:
                break
            gain = min(max(x[_GAIN], LEAST_GAIN), LARGEST_GAIN)
            step = max(abs(x[_U]), abs(x[_V])) / gain
            share = 1.0 / (gain * max(1.0, step / _LONGEST_STEP_PX))
            edge = 0.0
            for a in range(_MOVES):
                x[a] *= share
                moved[a] += x[a]
                edge = max(edge, abs(x[a]))
            if not _compose(A, x):
                break
            u -= A[0, 0] * x[_U] + A[0, 1] * x[_V]
            v -= A[1, 0] * x[_U] + A[1, 1] * x[_V]
            converged = max(step, edge / 8.0) < _STEP_PX
            if converged:
                break
        if not (converged and LEAST_GAIN < gain < LARGEST_GAIN):
            continue
        noise = max(unexplained, 0.0) / (_FREEDOM * gain * gain)
        spread = noise * WEIGHT_RATIO * _variance(normal, offset[n], x, moment)
        stretch = abs(A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0])
        result[n, 0] = u + A[0, 0] * offset_u + A[0, 1] * offset_v
        result[n, 1] = v + A[1, 0] * offset_u + A[1, 1] * offset_v
        result[n, 2] = np.sqrt(spread * stretch + step * step)
        shift = max(abs(result[n, 0] - start[n, 0]), abs(result[n, 1] - start[n, 1]))
        if unexplained <= UNEXPLAINED * variance and shift <= reach[n]:
            found[n] = True
            warp[n] = A
