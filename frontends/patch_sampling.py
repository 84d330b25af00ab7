"""Patches of the right image that an image patch is compared with: moved, and slanting.

Arrays are flat with constant offsets: with an array of two dimensions the compiler cannot tell
that what is written is not what is read next, and gives up on SIMD.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import njit

Floats = NDArray[np.float32]
_f32 = np.float32
_u64 = np.uint64

SIDE = 16  # patch, px; its centre lies between pixels
AREA = SIDE * SIDE
MIDDLE = 0.5 * (SIDE - 1)
HALF = 0.5 * SIDE  # unit of the offsets within a patch, px
#: Columns of the right image that a slanting patch may cover: the smallest image that is used.
SPAN = 40
#: Those that a patch which hardly slants covers.
_NARROW = 24
#: Cubic convolution; -0.6 has a fifth of the bias between pixels that -0.5 (Catmull-Rom) has.
_CUBIC = _f32(-0.6)


@njit
def _rows_at(
    right: NDArray[np.uint8], width: int, base: int, v: float, mean: np.float32, slanting: bool,
    rows: Floats,
) -> None:  # fmt: skip
    """Rows of the right image at the patch's heights around v, from column `base` on."""
    first = int(np.floor(v - MIDDLE))
    c, f = _CUBIC, _f32(v - MIDDLE - first)
    w0 = c * f * (_f32(1) - f) * (_f32(1) - f)
    w1 = ((c + _f32(2)) * f - (c + _f32(3))) * f * f + _f32(1)
    w3 = c * f * f * (_f32(1) - f)
    w2 = _f32(1) - w0 - w1 - w3
    row = _u64(width)
    for j in range(SIDE):
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
def sample(
    right: NDArray[np.uint8], height: int, width: int, u: float, v: float, slope_u: float,
    slope_v: float, mean: np.float32, rows: Floats, R: Floats,
) -> bool:  # fmt: skip
    """Right patch R around u, v less `mean`; False where it leaves the image."""
    reach = MIDDLE / HALF * (HALF - slope_u + abs(slope_v))
    base = int(np.floor(u - reach - 0.01)) - 1
    first = int(np.floor(v - MIDDLE))
    last = u + reach + 2.01
    if min(base, first - 1) < 0 or last >= min(width, base + SPAN) or first + SIDE >= height - 1:
        return False
    base = min(base, width - SPAN)
    _rows_at(right, width, base, v, mean, last > base + _NARROW, rows)
    per_column, per_row = -slope_u / HALF, -slope_v / HALF
    for j in range(SIDE):
        # column i is at i + start + i per_column: most often in one or two whole steps from i,
        # and then its neighbours are read side by side
        start = u - base - MIDDLE * (1.0 + per_column) + per_row * (j - MIDDLE)
        drift = per_column * (SIDE - 1)
        whole = int(np.floor(start + min(drift, 0.0)))
        offset, step = _f32(start - whole), _f32(per_column)
        origin, out = _u64(j * SPAN + whole), _u64(j * SIDE)
        if offset + max(drift, 0.0) < 2.0:
            for i in range(_u64(SIDE)):
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
            for i in range(SIDE):
                place = offset + step * _f32(i)
                steps = int(np.floor(place))
                q = _u64(j * SPAN + whole + i + steps)
                R[out + _u64(i)] = _cubic(
                    rows[q - _u64(1)], rows[q], rows[q + _u64(1)], rows[q + _u64(2)],
                    place - _f32(steps),
                )  # fmt: skip
    return True
