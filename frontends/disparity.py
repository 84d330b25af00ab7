"""Stereo disparities to a few hundredths of a pixel, on sloping ground, at any exposure.

Around each feature the right image is modelled as the left one, moved and re-exposed:

    right(u - D, v - V) = gain * left(u, v) + bias,   D = d + d_u (u - u0) + d_v (v - v0)

The slopes matter: on the ground D changes by baseline / height per image row, and a patch
moved as a whole is then wrong by tenths of a pixel. Least squares over a patch, with the
Jacobian taken from the left image once (inverse compositional Gauss-Newton): its noise is
independent of the right image's, so the interpolation does not pull the result to whole
pixels, and one factorisation serves all iterations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit
from frontends.measurements import Image

FloatArray = NDArray[np.float64]
Floats = NDArray[np.float32]
_f32 = np.float32

_SIDE = 16  # patch, px; its centre lies between pixels
_AREA = _SIDE * _SIDE
_MIDDLE = 0.5 * (_SIDE - 1)
_HALF = 0.5 * _SIDE  # unit of the offsets within a patch, px
_WINDOW_SIGMA_PX = 6.0
_SPAN = 36  # columns of the right image that a slanting patch may cover
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
#: Variance of a central difference, over that of a residual (left plus interpolated right).
_GRADIENT_NOISE = 0.3
#: Largest ratio of the information along u to what of it is not the noise's own gradient.
_LARGEST_INFLATION = 3.0
#: Model error (curvature, interpolation), px: added in squares to every sigma.
_MODEL_SIGMA_PX = 0.006


@dataclass(frozen=True, slots=True)
class RefinedDisparities:
    """Disparities of N features after refinement; those not confirmed are as they came.

    Attributes
    ----------
    disparity_px
        (N,) at the features' positions in the left image.
    sigma_px
        (N,) 1-sigma: from the patch's texture and from what its model leaves of it;
        infinite where not confirmed.
    vertical_px
        (N,) ``v_left - v_right`` that remains beyond the expected one.
    confirmed
        (N,) bool.
    """

    disparity_px: FloatArray
    sigma_px: FloatArray
    vertical_px: FloatArray
    confirmed: NDArray[np.bool_]

    def select(self, keep: NDArray[np.bool_]) -> RefinedDisparities:
        """The features at a mask."""
        return RefinedDisparities(
            self.disparity_px[keep],
            self.sigma_px[keep],
            self.vertical_px[keep],
            self.confirmed[keep],
        )


def refine_disparities(
    left: Image,
    right: Image,
    left_uv: FloatArray,
    disparity_px: FloatArray,
    vertical_px: FloatArray,
    max_shift_px: FloatArray,
) -> RefinedDisparities:
    """Refine disparities known to a pixel or two.

    Not confirmed are features whose patch leaves an image, does not converge, moves too
    far, has too little texture along u or does not look alike in the two images.

    Parameters
    ----------
    left, right
        (H, W) uint8, rectified but for a smooth vertical offset.
    left_uv
        (N, 2) features in the left image, px.
    disparity_px
        (N,) where to start.
    vertical_px
        (N,) expected ``v_left - v_right``.
    max_shift_px
        (N,) largest change of the disparity.
    """
    if left.shape != right.shape or left.dtype != np.uint8 or right.dtype != np.uint8:
        raise ValueError(f"two uint8 images of one size, not {left.shape} and {right.shape}")
    n = len(left_uv)
    start = np.stack(
        [left_uv[:, 0], left_uv[:, 1], disparity_px, vertical_px, max_shift_px], axis=-1
    ).astype(np.float64)
    # the kernel's arithmetic knows no NaN: such features are put outside of the image
    unknown = ~np.isfinite(start).all(axis=1) | (np.abs(start) > 1e6).any(axis=1)
    start[unknown] = -1e3
    result = np.zeros((n, 3))
    confirmed = np.zeros(n, dtype=np.bool_)
    if min(left.shape) >= _SPAN:
        images = np.ascontiguousarray(left), np.ascontiguousarray(right)
        _refine_all(*images, start, *_PATCH, result, confirmed)
    return RefinedDisparities(
        np.where(confirmed, result[:, 0], disparity_px),
        np.where(confirmed, result[:, 1], np.inf),
        result[:, 2],
        confirmed,
    )


def _patch() -> tuple[Floats, NDArray[np.int32]]:
    """Weights and offsets (units of `_HALF`) of a patch's pixels, start of each one's row."""
    row, column = (grid.ravel() for grid in np.mgrid[:_SIDE, :_SIDE].astype(np.float64))
    i, j = column - _MIDDLE, row - _MIDDLE
    weight = np.exp(-0.5 * (i * i + j * j) / _WINDOW_SIGMA_PX**2)
    grid = np.stack([weight, i / _HALF, j / _HALF]).astype(np.float32)
    return grid, (row * _SPAN).astype(np.int32)


_PATCH = _patch()
_WEIGHT = float(_PATCH[0][0].sum())
#: Variance of a weighted estimate over the inverse of its normal matrix, for like residuals.
_WEIGHT_RATIO = float((_PATCH[0][0].astype(np.float64) ** 2).sum()) / _WEIGHT
#: Residuals that count, less the unknowns: as a share of the weight.
_FREEDOM = _WEIGHT - _UNKNOWNS * _WEIGHT_RATIO


@njit
def _differentiate(left: Image, u: int, v: int, grid: Floats, J: Floats) -> np.float32:
    """Columns of the Jacobian of the patch whose first pixel is u, v; its mean grey level."""
    for j in range(_SIDE):
        above, below = left[v + j - 1, u : u + _SIDE], left[v + j + 1, u : u + _SIDE]
        here = left[v + j, u - 1 : u + _SIDE + 1]
        k = j * _SIDE
        along_u, along_v, grey = J[0, k : k + _SIDE], J[3, k : k + _SIDE], J[4, k : k + _SIDE]
        for i in range(_SIDE):
            along_u[i] = _f32(0.5) * (_f32(here[i + 2]) - _f32(here[i]))
            along_v[i] = _f32(0.5) * (_f32(below[i]) - _f32(above[i]))
            grey[i] = _f32(here[i + 1])
    mean = _f32(0)
    for k in range(_AREA):
        mean += grid[0, k] * J[4, k]
    mean /= _f32(_WEIGHT)
    for k in range(_AREA):
        J[1, k] = J[0, k] * grid[1, k]
        J[2, k] = J[0, k] * grid[2, k]
        J[4, k] -= mean
    return mean


@njit
def _factorise(J: Floats, weight: Floats, WJ: Floats, L: FloatArray) -> bool:
    """Weighted Jacobian and the Cholesky factor (inverse diagonal) of the normal matrix."""
    for a in range(_UNKNOWNS):
        weighted, column = WJ[a], J[a]
        for k in range(_AREA):
            weighted[k] = weight[k] * column[k]
        for b in range(a + 1):
            other, total = J[b], _f32(0)
            for k in range(_AREA):
                total += weighted[k] * other[k]
            L[a, b] = total
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
def _sample(
    right: Image, u: float, v: float, slope_u: float, slope_v: float, mean: np.float32,
    grid: Floats, row: NDArray[np.int32], rows: Floats, index: NDArray[np.int32],
    part: Floats, R: Floats,
) -> bool:  # fmt: skip
    """Right patch R around u, v less `mean`; False where it leaves the image."""
    height, width = right.shape
    reach = _MIDDLE / _HALF * (_HALF - slope_u + abs(slope_v))
    base = int(np.floor(u - reach - 0.01)) - 1
    first = int(np.floor(v - _MIDDLE))
    last = u + reach + 2.01
    if min(base, first - 1) < 0 or last >= min(width, base + _SPAN) or first + _SIDE >= height - 1:
        return False
    base = min(base, width - _SPAN)
    c, f = _CUBIC, _f32(v - _MIDDLE - first)
    w0 = c * f * (_f32(1) - f) * (_f32(1) - f)
    w1 = ((c + _f32(2)) * f - (c + _f32(3))) * f * f + _f32(1)
    w3 = c * f * f * (_f32(1) - f)
    w2 = _f32(1) - w0 - w1 - w3
    for j in range(_SIDE):
        r = first + j
        a, b = right[r - 1, base : base + _SPAN], right[r, base : base + _SPAN]
        d, e = right[r + 1, base : base + _SPAN], right[r + 2, base : base + _SPAN]
        out = rows[j * _SPAN : (j + 1) * _SPAN]
        for k in range(_SPAN):
            out[k] = w0 * _f32(a[k]) + w1 * _f32(b[k]) + w2 * _f32(d[k]) + w3 * _f32(e[k]) - mean
    origin, per_u, per_v = _f32(u - base), _f32(_HALF - slope_u), _f32(slope_v)
    for k in range(_AREA):
        place = origin + per_u * grid[1, k] - per_v * grid[2, k]
        whole = np.int32(place)
        index[k], part[k] = row[k] + whole, place - _f32(whole)
    one, two = np.uint64(1), np.uint64(2)
    for k in range(_AREA):
        q, f = np.uint64(index[k]), part[k]  # unsigned: numba need not look for negative ones
        p0, p1, p2, p3 = rows[q - one], rows[q], rows[q + one], rows[q + two]
        cubic = (c + _f32(2)) * (p1 - p2) + c * (p0 - p3)
        square = (_f32(2) * c + _f32(3)) * p2 - _f32(2) * c * p0 - (c + _f32(3)) * p1 + c * p3
        R[k] = p1 + f * (c * (p0 - p2) + f * (square + f * cubic))
    return True


@kernel
def _refine_all(
    left: Image, right: Image, start: FloatArray, grid: Floats, row: NDArray[np.int32],
    result: FloatArray, confirmed: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Fill result (disparity, sigma, vertical) from start (u, v, disparity, vertical, shift)."""
    J = np.ones((_UNKNOWNS, _AREA), np.float32)
    WJ, R = np.empty_like(J), np.empty(_AREA, np.float32)
    rows, part = np.empty(_SIDE * _SPAN, np.float32), np.empty(_AREA, np.float32)
    index = np.empty(_AREA, np.int32)
    L = np.zeros((_UNKNOWNS, _UNKNOWNS))
    moment, x = np.zeros(_UNKNOWNS), np.zeros(_UNKNOWNS)
    height, width = left.shape
    weight = grid[0]
    for n in range(len(start)):
        u = int(np.floor(start[n, 0] + 0.5 - _MIDDLE))
        v = int(np.floor(start[n, 1] + 0.5 - _MIDDLE))
        if min(u, v) < 1 or u + _SIDE >= width or v + _SIDE >= height:
            continue
        mean = _differentiate(left, u, v, grid, J)
        if not _factorise(J, weight, WJ, L):
            continue
        d, vertical, slope_u, slope_v, gain = start[n, 2], 0.0, 0.0, 0.0, 1.0
        inside, converged, step, power = True, False, 0.0, 0.0
        for _ in range(_ITERATIONS):
            inside = _sample(
                right, u + _MIDDLE - d, v + _MIDDLE - start[n, 3] - vertical, slope_u, slope_v,
                mean, grid, row, rows, index, part, R,
            )  # fmt: skip
            if not inside:
                break
            power = 0.0
            for k in range(_AREA):
                power += weight[k] * R[k] * R[k]
            for a in range(_UNKNOWNS):
                weighted, total = WJ[a], _f32(0)
                for k in range(_AREA):
                    total += weighted[k] * R[k]
                moment[a] = total
            moment[1] -= _PRIOR[1] * gain * slope_u
            moment[2] -= _PRIOR[2] * gain * slope_v
            moment[3] -= _PRIOR[3] * gain * vertical
            x[:] = moment
            _solve(L, x)
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
        unexplained, variance = power, power - moment[5] * moment[5] / _WEIGHT
        for a in range(_UNKNOWNS):
            unexplained -= moment[a] * x[a]
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
