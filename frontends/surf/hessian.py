"""Fast-Hessian detector (Bay et al., eqs. 9 and 10) on one pyramid level.

A filter of side L = 3 l has lobes of l x (2 l - 1) for Dxx and Dyy and l x l for Dxy. Responses
are lobe means, as in OpenCV, so that thresholds carry over:
``det = Dxx Dyy - (0.9 Dxy)^2``.

Two neighbouring layers (lobes l and l + 2) are evaluated densely, a row at a time, in 16-bit
integers: an integral image modulo 2^16 still gives every sum that fits 16 bits exactly, at twice
the SIMD width; larger filters use the integral image shifted right until their sums fit. The
layers below and above are evaluated only where a candidate beats its dense neighbours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.surf._jit import njit
from frontends.surf.integral import FRACTION_BITS, PAD

WEIGHT2 = np.float32(0.81)  # 0.9^2, eq. 10
_RING = 64  # integral rows kept in 16 bits: a power of two, more than the tallest filter
NEIGHBOURS = 18  # dense responses stored with a candidate: 2 layers x 3 x 3


@njit
def lobe_shift(lobe: int) -> int:
    """Bits to drop from sums of 8-bit grey so that the responses of a filter fit 16 bits."""
    largest = 2 * lobe * (2 * lobe - 1) * 255
    shift = 0
    while largest >> shift > 32767:
        shift += 1
    return shift


@njit
def _narrow(row: NDArray[np.int32], shift: int, out: NDArray[np.int16]) -> None:
    for x in range(out.size):
        out[x] = np.int16(row[x] >> shift)


@njit
def _narrow_both(
    row: NDArray[np.int32], shifts: tuple[int, int], slot: int, rings: NDArray[np.int16]
) -> None:
    _narrow(row, FRACTION_BITS + shifts[0], rings[0, slot])
    _narrow(row, FRACTION_BITS + shifts[1], rings[1, slot])


@njit
def _second_difference(
    a: NDArray[np.int16],
    b: NDArray[np.int16],
    c: NDArray[np.int16],
    d: NDArray[np.int16],
    out: NDArray[np.int16],
) -> None:
    """Sum of the outer lobes minus twice the middle one, from the four cumulative edges."""
    for x in range(out.size):
        out[x] = np.int16(d[x] - a[x] + 3 * (b[x] - c[x]))


@njit
def _difference(a: NDArray[np.int16], b: NDArray[np.int16], out: NDArray[np.int16]) -> None:
    for x in range(out.size):
        out[x] = np.int16(b[x] - a[x])


@njit
def _lobe_difference(
    a: NDArray[np.int16],
    b: NDArray[np.int16],
    c: NDArray[np.int16],
    d: NDArray[np.int16],
    out: NDArray[np.int16],
) -> None:
    """First lobe minus second lobe, from the four cumulative edges."""
    for x in range(out.size):
        out[x] = np.int16((b[x] - a[x]) - (d[x] - c[x]))


@njit
def _determinant(
    dxx: NDArray[np.int16],
    dyy: NDArray[np.int16],
    dxy: NDArray[np.int16],
    scale: np.float32,
    scale_xy: np.float32,
    out: NDArray[np.float32],
) -> None:
    for x in range(out.size):
        xy = np.float32(dxy[x])
        out[x] = scale * (np.float32(dxx[x]) * np.float32(dyy[x])) - scale_xy * (xy * xy)


@njit
def dense_row(
    ring: NDArray[np.int16],
    y: int,
    lobe: int,
    margin: int,
    shift: int,
    work: NDArray[np.int16],
    out: NDArray[np.float32],
) -> None:
    """Responses of one filter along image row `y`, for columns margin <= x < W - margin.

    Parameters
    ----------
    ring : ndarray (64, W + 1) int16
        Integral rows modulo 2^16, row r of the image's integral at r % 64.
    y : int
        Image row.
    lobe : int
        l = L / 3 of the filter.
    margin : int
        Columns left out on each side, at least the half filter.
    shift : int
        Bits dropped in `ring`.
    work : ndarray (6, W + 1) int16
        Scratch rows.
    out : ndarray (W,) float32
        Written inside the margins only.
    """
    half = lobe + lobe // 2  # the filter covers y - half .. y + half
    inner = lobe // 2
    wing = lobe - 1  # a lobe's long side covers y - wing .. y + wing
    mask = _RING - 1
    n = out.size - 2 * margin

    rows_yy = work[0]
    rows_xx = work[1]
    rows_xy = work[2]
    _second_difference(
        ring[(y - half) & mask],
        ring[(y - inner) & mask],
        ring[(y + inner + 1) & mask],
        ring[(y + half + 1) & mask],
        rows_yy,
    )
    _difference(ring[(y - wing) & mask], ring[(y + wing + 1) & mask], rows_xx)
    _lobe_difference(
        ring[(y - lobe) & mask],
        ring[y & mask],
        ring[(y + 1) & mask],
        ring[(y + lobe + 1) & mask],
        rows_xy,
    )

    dxx = work[3][:n]
    dyy = work[4][:n]
    dxy = work[5][:n]
    _difference(rows_yy[margin - wing :], rows_yy[margin + wing + 1 :], dyy)
    _second_difference(
        rows_xx[margin - half :],
        rows_xx[margin - inner :],
        rows_xx[margin + inner + 1 :],
        rows_xx[margin + half + 1 :],
        dxx,
    )
    _lobe_difference(
        rows_xy[margin - lobe :],
        rows_xy[margin:],
        rows_xy[margin + 1 :],
        rows_xy[margin + lobe + 1 :],
        dxy,
    )
    unit = np.float32(1 << shift)
    area = np.float32(lobe * (2 * lobe - 1))
    area_xy = np.float32(lobe * lobe)
    _determinant(
        dxx,
        dyy,
        dxy,
        (unit / area) * (unit / area),
        WEIGHT2 * (unit / area_xy) * (unit / area_xy),
        out[margin : margin + n],
    )


@njit
def _maximum(a: NDArray[np.float32], b: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    for x in range(out.size):
        out[x] = a[x] if a[x] > b[x] else b[x]


@njit
def _flag_maxima(
    centre: NDArray[np.float32],
    column: NDArray[np.float32],
    threshold: np.float32,
    out: NDArray[np.uint8],
) -> None:
    """Flag where `centre` tops `threshold` and the 3-wide maximum of `column`."""
    left = column[:-2]
    middle = column[1:-1]
    right = column[2:]
    for x in range(out.size):
        c = centre[x]
        out[x] = (c > threshold) & (c >= left[x]) & (c >= middle[x]) & (c >= right[x])


@njit
def detect_pair(
    integral: NDArray[np.int32],
    lobe: int,
    threshold: np.float32,
    single: bool,
    positions: NDArray[np.int32],
    neighbours: NDArray[np.float32],
) -> int:
    """Candidates of two dense layers: maxima of their 3x3 neighbours in both.

    Ties go to the first in (layer, row, column) order, so that exactly one response of a
    symmetric structure survives.

    Parameters
    ----------
    integral : ndarray (H + 2 PAD + 1, W + 2 PAD + 1) int32
        Padded integral image in grey*4.
    lobe : int
        l of the lower layer; the upper one has l + 2.
    threshold : float
        Least response.
    single : bool
        True: only maxima in the lower layer are wanted.
    positions : ndarray (C, 3) int32
        Out: layer (0 or 1), row, column of each candidate, in image pixels.
    neighbours : ndarray (C, 18) float32
        Out: its dense responses, [layer][row - 1 .. row + 1][column - 1 .. column + 1].

    Returns
    -------
    int
        Number of candidates; above C, only C were stored.
    """
    h = integral.shape[0] - 2 * PAD - 1
    w = integral.shape[1] - 2 * PAD - 1
    lobes = (lobe, lobe + 2)
    margin = lobes[1] + lobes[1] // 2  # half of the upper filter
    shifts = (lobe_shift(lobe), lobe_shift(lobe + 2))
    # a maximum also needs the filter one layer up, and one pixel on each side
    margins = (margin + 1, margin + 4)
    if h <= 2 * margins[0] or w <= 2 * margins[0]:
        return 0

    rings = np.empty((2, _RING, w + 1), np.int16)
    work = np.empty((6, w + 1), np.int16)
    dense = np.empty((2, 4, w), np.float32)  # the last rows of each layer's responses
    best = np.empty((4, w), np.float32)  # and of the larger of the two
    column = np.empty(w, np.float32)
    flag_words = np.zeros((w + 7) // 8, np.uint64)
    flags = flag_words.view(np.uint8)
    inside = w - 2 * margins[0]
    capacity = positions.shape[0]
    count = 0

    mask = _RING - 1
    for y in range(2 * margin + 1):
        _narrow_both(integral[PAD + y][PAD:], shifts, y & mask, rings)
    for y in range(margin, h - margin):
        below = y + margin + 1
        _narrow_both(integral[PAD + below][PAD:], shifts, below & mask, rings)
        slot = y & 3
        dense_row(rings[0], y, lobes[0], margin, shifts[0], work, dense[0, slot])
        dense_row(rings[1], y, lobes[1], margin, shifts[1], work, dense[1, slot])
        _maximum(
            dense[0, slot][margin : w - margin],
            dense[1, slot][margin : w - margin],
            best[slot][margin : w - margin],
        )
        centre = y - 1
        if centre <= margin:
            continue
        a = best[(centre - 1) & 3][margin : w - margin]
        b = best[centre & 3][margin : w - margin]
        c = best[(centre + 1) & 3][margin : w - margin]
        tops = column[: w - 2 * margin]
        for x in range(tops.size):
            top = a[x] if a[x] > b[x] else b[x]
            tops[x] = top if top > c[x] else c[x]
        _flag_maxima(best[centre & 3][margins[0] : w - margins[0]], tops, threshold, flags[:inside])
        for word in range(flag_words.size):
            if flag_words[word] == 0:
                continue
            for x in range(8 * word + margins[0], min(8 * word + 8 + margins[0], w - margins[0])):
                if flags[x - margins[0]] == 0:
                    continue
                mid = centre & 3
                layer = 0 if dense[0, mid, x] >= dense[1, mid, x] else 1
                if layer == 1 and single:
                    continue
                edge = margins[layer]
                if centre < edge or centre >= h - edge or x < edge or x >= w - edge:
                    continue
                value = dense[layer, mid, x]
                first = True
                maximal = True
                for other in range(2):
                    for row in range(-1, 2):
                        for col in range(-1, 2):
                            if other == layer and row == 0 and col == 0:
                                first = False
                            elif first and dense[other, (centre + row) & 3, x + col] >= value:
                                maximal = False
                if not maximal:
                    continue
                if count < capacity:
                    positions[count, 0] = layer
                    positions[count, 1] = centre
                    positions[count, 2] = x
                    k = 0
                    for other in range(2):
                        for row in range(-1, 2):
                            for col in range(-1, 2):
                                neighbours[count, k] = dense[other, (centre + row) & 3, x + col]
                                k += 1
                count += 1
    return count


@njit
def response_at(
    integral: NDArray[np.int32], row: int, column: int, lobe: int
) -> tuple[np.float32, np.float32]:
    """Evaluate determinant (eq. 10) and trace of one filter at one pixel.

    Parameters
    ----------
    integral : ndarray int32
        Padded integral image in grey*4.
    row, column : int
        Pixel in padded coordinates.
    lobe : int
        l = L / 3.

    Returns
    -------
    det, trace : float32
        In grey^2 and grey, of lobe means.
    """
    half = lobe + lobe // 2
    inner = lobe // 2
    wing = lobe - 1
    # The second differences mod 2^32 are exact, as int32 wrap-around is.
    a = integral[row - half]
    b = integral[row - inner]
    c = integral[row + inner + 1]
    d = integral[row + half + 1]
    x0 = column - wing
    x1 = column + wing + 1
    dyy = np.int32((d[x1] - d[x0]) - (a[x1] - a[x0]) + 3 * ((b[x1] - b[x0]) - (c[x1] - c[x0])))
    a = integral[row - wing]
    b = integral[row + wing + 1]
    x0 = column - half
    x1 = column - inner
    x2 = column + inner + 1
    x3 = column + half + 1
    dxx = np.int32((b[x3] - a[x3]) - (b[x0] - a[x0]) + 3 * ((b[x1] - a[x1]) - (b[x2] - a[x2])))
    a = integral[row - lobe]
    b = integral[row]
    c = integral[row + 1]
    d = integral[row + lobe + 1]
    x0 = column - lobe
    x1 = column
    x2 = column + 1
    x3 = column + lobe + 1
    top = (b[x1] - b[x0]) - (a[x1] - a[x0]) - (b[x3] - b[x2]) + (a[x3] - a[x2])
    bottom = (d[x1] - d[x0]) - (c[x1] - c[x0]) - (d[x3] - d[x2]) + (c[x3] - c[x2])
    dxy = np.int32(top - bottom)
    scale = np.float32(1.0 / ((1 << FRACTION_BITS) * lobe * (2 * lobe - 1)))
    scale_xy = np.float32(1.0 / ((1 << FRACTION_BITS) * lobe * lobe))
    xx = scale * np.float32(dxx)
    yy = scale * np.float32(dyy)
    xy = scale_xy * np.float32(dxy)
    return xx * yy - WEIGHT2 * xy * xy, xx + yy


@njit
def refine(
    integral: NDArray[np.int32],
    lobe: int,
    position: NDArray[np.int32],
    dense: NDArray[np.float32],
    out: NDArray[np.float32],
) -> bool:
    """Check one candidate against its outer layer and interpolate it (3-D quadratic).

    Parameters
    ----------
    integral : ndarray int32
        Padded integral image in grey*4.
    lobe : int
        l of the lower dense layer of the pair.
    position : ndarray (3,) int32
    dense : ndarray (18,) float32
        As stored by `detect_pair`.
    out : ndarray (5,) float32
        x, y (pixels of this level), size (side L of the filter), response, trace.

    Returns
    -------
    bool
        False where the outer layer is as high or the maximum lies outside the neighbourhood.
    """
    layer = position[0]
    row = position[1] + PAD
    col = position[2] + PAD
    cube = np.empty((3, 3, 3), np.float32)
    outer = 0 if layer == 0 else 2
    k = 0
    for i in range(2):
        for j in range(3):
            for m in range(3):
                cube[i + 1 - layer, j, m] = dense[k]
                k += 1
    value = cube[1, 1, 1]
    outer_lobe = lobe - 2 if layer == 0 else lobe + 4
    for j in range(3):
        for m in range(3):
            det, _ = response_at(integral, row + j - 1, col + m - 1, outer_lobe)
            if det >= value:
                return False
            cube[outer, j, m] = det

    gx = np.float32(0.5) * (cube[1, 1, 2] - cube[1, 1, 0])
    gy = np.float32(0.5) * (cube[1, 2, 1] - cube[1, 0, 1])
    gs = np.float32(0.5) * (cube[2, 1, 1] - cube[0, 1, 1])
    two = np.float32(2)
    quarter = np.float32(0.25)
    xx = cube[1, 1, 0] - two * value + cube[1, 1, 2]
    yy = cube[1, 0, 1] - two * value + cube[1, 2, 1]
    ss = cube[0, 1, 1] - two * value + cube[2, 1, 1]
    xy = quarter * (cube[1, 0, 0] + cube[1, 2, 2] - cube[1, 0, 2] - cube[1, 2, 0])
    xs = quarter * (cube[0, 1, 0] + cube[2, 1, 2] - cube[0, 1, 2] - cube[2, 1, 0])
    ys = quarter * (cube[0, 0, 1] + cube[2, 2, 1] - cube[0, 2, 1] - cube[2, 0, 1])
    # Cramer's rule for H d = -g
    c00 = yy * ss - ys * ys
    c01 = xs * ys - xy * ss
    c02 = xy * ys - yy * xs
    det = xx * c00 + xy * c01 + xs * c02
    if det == 0:
        return False
    c11 = xx * ss - xs * xs
    c12 = xy * xs - xx * ys
    c22 = xx * yy - xy * xy
    dx = -(c00 * gx + c01 * gy + c02 * gs) / det
    dy = -(c01 * gx + c11 * gy + c12 * gs) / det
    ds = -(c02 * gx + c12 * gy + c22 * gs) / det
    if not (abs(dx) <= 1 and abs(dy) <= 1 and abs(ds) <= 1):
        return False
    centre_lobe = lobe + 2 * layer
    _, trace = response_at(integral, row, col, centre_lobe)
    out[0] = position[2] + dx
    out[1] = position[1] + dy
    out[2] = 3 * centre_lobe + 6 * ds
    out[3] = value
    out[4] = trace
    return True


@njit
def refine_all(
    integral: NDArray[np.int32],
    lobe: int,
    positions: NDArray[np.int32],
    neighbours: NDArray[np.float32],
    count: int,
    out: NDArray[np.float32],
) -> int:
    """Refine the first `count` candidates; see `refine`.

    Parameters
    ----------
    out : ndarray (count, 5) float32
        Filled from the top.

    Returns
    -------
    int
        Rows of `out` filled.
    """
    kept = 0
    for i in range(count):
        if refine(integral, lobe, positions[i], neighbours[i], out[kept]):
            kept += 1
    return kept
