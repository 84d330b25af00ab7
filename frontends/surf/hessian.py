"""Fast-Hessian detector (Bay et al., eqs. 9 and 10) on one pyramid level.

A filter of side L = 3 l has lobes of l x 5/9 L for Dxx and Dyy and l x l for Dxy. Responses
are in OpenCV's unit, means over the lobes of Dxx, so that thresholds carry over:
``det = Dxx Dyy - (0.9 Dxy)^2``.

Two neighbouring layers (lobes l and l + 2) are evaluated densely, a row at a time, in 16-bit
integers: an integral image modulo 2^16 still gives every sum that fits 16 bits exactly, at twice
the SIMD width; larger filters use the integral image shifted right until their sums fit. The
layers below and above are evaluated only where a candidate beats its dense neighbours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.surf._jit import kernel, njit
from frontends.surf.integral import FRACTION_BITS, PAD, padded_length

# (0.9 Dxy)^2 of eq. 10, for lobe means: the paper's 0.9 is for sums, and a Dxy lobe has 3/5 of
# the area of a Dxx lobe. OpenCV puts 0.9 on the means, which costs 3 to 10 % of the matches on
# low-texture ground (benchmarks/surf_quality.py).
WEIGHT2 = np.float32((0.9 * 3 / 5) ** 2)
_RING = 64  # integral rows kept in 16 bits: a power of two, more than the tallest filter
NEIGHBOURS = 18  # dense responses stored with a candidate: 2 layers x 3 x 3


@njit
def lobe_wing(lobe: int) -> int:
    """Half of a second-derivative lobe's long side, which is 5/9 L rounded to odd.

    5, 9, 11, 15 for L = 9, 15, 21, 27, as in OpenCV: the shape stays that of the 9 x 9 filter.
    """
    return 5 * lobe // 6


@njit
def lobe_shift(lobe: int) -> int:
    """Bits to drop from sums of 8-bit grey so that the responses of a filter fit 16 bits."""
    largest = 2 * lobe * (2 * lobe_wing(lobe) + 1) * 255
    shift = 0
    while largest >> shift > 32767:
        shift += 1
    return shift


@njit
def _narrow(
    integral: NDArray[np.int32],
    row: int,
    n: int,
    shift0: int,
    shift1: int,
    rings: NDArray[np.int16],
    slot: int,
) -> None:
    """Copy one row of the integral, cut to 16 bits, into both rings."""
    first = np.uint64(PAD)
    if shift0 == 2 and shift1 == 3:
        # the usual case with constants: a variable shift would be done in 64-bit lanes
        for x in range(np.uint64(n)):
            rings[0, slot, x] = np.int16(integral[row, first + x] >> 2)
            rings[1, slot, x] = np.int16(integral[row, first + x] >> 3)
        return
    for x in range(np.uint64(n)):
        value = integral[row, first + x]
        rings[0, slot, x] = np.int16(value >> shift0)
        rings[1, slot, x] = np.int16(value >> shift1)


# In the next three, the arguments ya.. are rows and xa.. column offsets of the cumulative
# edges a <= b <= c <= d. Rows are passed as indices because slices cost a reference count each,
# and indices are unsigned because signed ones get a test for negative values in the loop.


@njit
def _second_difference(
    source: NDArray[np.int16],
    rows: tuple[int, int, int, int],
    columns: tuple[int, int, int, int],
    work: NDArray[np.int16],
    target: int,
    n: int,
) -> None:
    """Sum of the outer lobes minus twice the middle one."""
    ya, yb, yc, yd = rows
    xa, xb = np.uint64(columns[0]), np.uint64(columns[1])
    xc, xd = np.uint64(columns[2]), np.uint64(columns[3])
    for x in range(np.uint64(n)):
        work[target, x] = np.int16(
            source[yd, x + xd] - source[ya, x + xa] + 3 * (source[yb, x + xb] - source[yc, x + xc])
        )


@njit
def _difference(
    source: NDArray[np.int16],
    rows: tuple[int, int],
    columns: tuple[int, int],
    work: NDArray[np.int16],
    target: int,
    n: int,
) -> None:
    """Sum between two edges."""
    ya, yb = rows
    xa, xb = np.uint64(columns[0]), np.uint64(columns[1])
    for x in range(np.uint64(n)):
        work[target, x] = np.int16(source[yb, x + xb] - source[ya, x + xa])


@njit
def _lobe_difference(
    source: NDArray[np.int16],
    rows: tuple[int, int, int, int],
    columns: tuple[int, int, int, int],
    work: NDArray[np.int16],
    target: int,
    n: int,
) -> None:
    """First lobe minus second lobe."""
    ya, yb, yc, yd = rows
    xa, xb = np.uint64(columns[0]), np.uint64(columns[1])
    xc, xd = np.uint64(columns[2]), np.uint64(columns[3])
    for x in range(np.uint64(n)):
        work[target, x] = np.int16(
            (source[yb, x + xb] - source[ya, x + xa]) - (source[yd, x + xd] - source[yc, x + xc])
        )


@njit
def _determinant(
    work: NDArray[np.int16],
    scale: np.float32,
    scale_xy: np.float32,
    out: NDArray[np.float32],
    layer: int,
    slot: int,
    n: int,
) -> None:
    for x in range(np.uint64(n)):
        xy = np.float32(work[5, x])
        out[layer, slot, x] = scale * (
            np.float32(work[3, x]) * np.float32(work[4, x])
        ) - scale_xy * (xy * xy)


@njit
def dense_row(
    ring: NDArray[np.int16],
    y: int,
    lobe: int,
    margin: int,
    n: int,
    shift: int,
    work: NDArray[np.int16],
    out: NDArray[np.float32],
    layer: int,
    slot: int,
) -> None:
    """Responses of one filter along image row `y`, for columns margin <= x < margin + n.

    Parameters
    ----------
    ring : ndarray (64, >= n + 2 margin + 1) int16
        Integral rows modulo 2^16, row r of the image's integral at r % 64.
    y : int
        Image row.
    lobe : int
        l = L / 3 of the filter.
    margin : int
        Columns left out on the left, at least the half filter.
    n : int
        Columns, a multiple of `LANES`; those beyond the image get nothing of use.
    shift : int
        Bits dropped in `ring`.
    work : ndarray (6, as `ring`) int16
        Scratch rows.
    out : ndarray (2, 4, >= n) float32
        Written at [layer, slot, x - margin].
    """
    half = lobe + lobe // 2  # the filter covers y - half .. y + half
    inner = lobe // 2
    wing = lobe_wing(lobe)  # a lobe's long side covers y - wing .. y + wing
    mask = _RING - 1
    reach = n + padded_length(2 * margin + 1)
    tall = (-half, -inner, inner + 1, half + 1)
    cross = (-lobe, 0, 1, lobe + 1)

    still = (0, 0, 0, 0)
    rows = (
        (y + tall[0]) & mask,
        (y + tall[1]) & mask,
        (y + tall[2]) & mask,
        (y + tall[3]) & mask,
    )
    _second_difference(ring, rows, still, work, 0, reach)
    _difference(ring, ((y - wing) & mask, (y + wing + 1) & mask), (0, 0), work, 1, reach)
    rows = (
        (y + cross[0]) & mask,
        y & mask,
        (y + 1) & mask,
        (y + cross[3]) & mask,
    )
    _lobe_difference(ring, rows, still, work, 2, reach)

    columns = (margin + tall[0], margin + tall[1], margin + tall[2], margin + tall[3])
    _second_difference(work, (1, 1, 1, 1), columns, work, 3, n)
    _difference(work, (0, 0), (margin - wing, margin + wing + 1), work, 4, n)
    columns = (margin + cross[0], margin, margin + 1, margin + cross[3])
    _lobe_difference(work, (2, 2, 2, 2), columns, work, 5, n)

    unit = np.float32(1 << shift)
    area = np.float32(lobe * (2 * wing + 1))
    area_xy = np.float32(lobe * lobe)
    _determinant(
        work,
        (unit / area) * (unit / area),
        WEIGHT2 * (unit / area_xy) * (unit / area_xy),
        out,
        layer,
        slot,
        n,
    )


@njit
def _best_of_layers(
    dense: NDArray[np.float32], slot: int, best: NDArray[np.float32], n: int
) -> None:
    for x in range(np.uint64(n)):
        a = dense[0, slot, x]
        b = dense[1, slot, x]
        best[slot, x] = a if a > b else b


@njit
def _flag_maxima(
    best: NDArray[np.float32],
    centre: int,
    least: np.float32,
    column: NDArray[np.float32],
    flags: NDArray[np.uint8],
    n: int,
) -> None:
    """Flag where row `centre` reaches `least` and the maximum of its 3 x 3 neighbourhood.

    ``flags[x]`` is for column x + 1 of `best`.
    """
    above = (centre - 1) & 3
    middle = centre & 3
    below = (centre + 1) & 3
    for x in range(np.uint64(n)):
        top = best[above, x] if best[above, x] > best[middle, x] else best[middle, x]
        column[x] = top if top > best[below, x] else best[below, x]
    one = np.uint64(1)
    two = np.uint64(2)
    for x in range(np.uint64(n)):
        top = column[x] if column[x] > column[x + one] else column[x + one]
        top = top if top > column[x + two] else column[x + two]
        top = top if top > least else least
        flags[x] = best[middle, x + one] >= top


@njit
def _first_of_ties(dense: NDArray[np.float32], layer: int, centre: int, k: int) -> bool:
    """Whether no neighbour before (layer, centre, k) in scan order is as high."""
    value = dense[layer, centre & 3, k]
    for other in range(layer + 1):
        for row in range(centre - 1, centre + 2):
            for col in range(k - 1, k + 2):
                if other == layer and row == centre and col == k:
                    return True
                if dense[other, row & 3, col] >= value:
                    return False
    return True


@njit
def _store_candidate(
    dense: NDArray[np.float32],
    centre: int,
    k: int,
    margin: int,
    h: int,
    w: int,
    single: bool,
    count: int,
    positions: NDArray[np.int32],
    neighbours: NDArray[np.float32],
    responses: NDArray[np.float32],
) -> int:
    """Check a flagged maximum at column `k` of `dense` and store it; 1 if it is one, else 0."""
    x = k + margin
    layer = 0 if dense[0, centre & 3, k] >= dense[1, centre & 3, k] else 1
    if layer == 1 and single:
        return 0
    edge = margin + 1 + 3 * layer  # the filter one layer up must fit, and one pixel more
    if centre < edge or centre >= h - edge or x < edge or x >= w - edge:
        return 0
    if not _first_of_ties(dense, layer, centre, k):
        return 0
    if count < positions.shape[0]:
        positions[count, 0] = layer
        positions[count, 1] = centre
        positions[count, 2] = x
        responses[count] = dense[layer, centre & 3, k]
        i = 0
        for other in range(2):
            for row in range(centre - 1, centre + 2):
                for col in range(k - 1, k + 2):
                    neighbours[count, i] = dense[other, row & 3, col]
                    i += 1
    return 1


@kernel
def detect_pair(
    integral: NDArray[np.int32],
    w: int,
    lobe: int,
    threshold: np.float32,
    single: bool,
    positions: NDArray[np.int32],
    neighbours: NDArray[np.float32],
    responses: NDArray[np.float32],
) -> int:
    """Candidates of two dense layers: maxima of their 3x3 neighbours in both.

    Ties go to the first in (layer, row, column) order, so that exactly one response of a
    symmetric structure survives.

    Parameters
    ----------
    integral : ndarray (H + 2 PAD + 1, N) int32
        Padded integral image in grey*4, from `integral_image`.
    w : int
        Width W of the level.
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
    responses : ndarray (C,) float32
        Out: its own response.

    Returns
    -------
    int
        Number of candidates; above C, only C were stored.
    """
    h = integral.shape[0] - 2 * PAD - 1
    lobes = (lobe, lobe + 2)
    margin = lobes[1] + lobes[1] // 2  # half of the upper filter
    shifts = (lobe_shift(lobe), lobe_shift(lobe + 2))
    if h <= 2 * margin + 2 or w <= 2 * margin + 2:
        return 0

    n = padded_length(w - 2 * margin)  # columns evaluated
    reach = n + padded_length(2 * margin + 1)  # integral columns they need
    available = min(reach, integral.shape[1] - PAD)
    rings = np.zeros((2, _RING, reach), np.int16)
    work = np.zeros((6, reach), np.int16)
    dense = np.zeros((2, 4, n), np.float32)  # the last rows of each layer's responses
    best = np.zeros((4, n + 2), np.float32)  # and of the larger of the two
    column = np.zeros(n + 2, np.float32)
    flag_words = np.zeros(n // 8, np.uint64)
    flags = flag_words.view(np.uint8)
    above = np.nextafter(threshold, np.float32(np.inf))
    drop0 = FRACTION_BITS + shifts[0]
    drop1 = FRACTION_BITS + shifts[1]
    mask = _RING - 1
    count = 0

    for y in range(2 * margin + 1):
        _narrow(integral, PAD + y, available, drop0, drop1, rings, y & mask)
    for y in range(margin, h - margin):
        newest = y + margin + 1
        _narrow(integral, PAD + newest, available, drop0, drop1, rings, newest & mask)
        slot = y & 3
        dense_row(rings[0], y, lobes[0], margin, n, shifts[0], work, dense, 0, slot)
        dense_row(rings[1], y, lobes[1], margin, n, shifts[1], work, dense, 1, slot)
        _best_of_layers(dense, slot, best, n)
        centre = y - 1
        if centre <= margin:
            continue
        _flag_maxima(best, centre, above, column, flags, n)
        for block in range(0, flag_words.size, 8):
            together = np.uint64(0)
            for word in range(8):
                together |= flag_words[np.uint64(block + word)]
            if together == 0:
                continue
            for flag in range(8 * block, 8 * block + 64):
                if flags[np.uint64(flag)] == 0:
                    continue
                count += _store_candidate(
                    dense,
                    centre,
                    flag + 1,
                    margin,
                    h,
                    w,
                    single,
                    count,
                    positions,
                    neighbours,
                    responses,
                )
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
    wing = lobe_wing(lobe)
    # Sums wrap modulo 2^32, which the cast of each result undoes. Unsigned indices: see above.
    y0, y1 = np.uint64(row - half), np.uint64(row - inner)
    y2, y3 = np.uint64(row + inner + 1), np.uint64(row + half + 1)
    x0, x1 = np.uint64(column - wing), np.uint64(column + wing + 1)
    dyy = np.int32(
        (integral[y3, x1] - integral[y3, x0])
        - (integral[y0, x1] - integral[y0, x0])
        + 3 * ((integral[y1, x1] - integral[y1, x0]) - (integral[y2, x1] - integral[y2, x0]))
    )
    y0, y1 = np.uint64(row - wing), np.uint64(row + wing + 1)
    x0, x1 = np.uint64(column - half), np.uint64(column - inner)
    x2, x3 = np.uint64(column + inner + 1), np.uint64(column + half + 1)
    dxx = np.int32(
        (integral[y1, x3] - integral[y0, x3])
        - (integral[y1, x0] - integral[y0, x0])
        + 3 * ((integral[y1, x1] - integral[y0, x1]) - (integral[y1, x2] - integral[y0, x2]))
    )
    y0, y1 = np.uint64(row - lobe), np.uint64(row)
    y2, y3 = np.uint64(row + 1), np.uint64(row + lobe + 1)
    x0, x1 = np.uint64(column - lobe), np.uint64(column)
    x2, x3 = np.uint64(column + 1), np.uint64(column + lobe + 1)
    left = (integral[y1, x1] - integral[y1, x0]) - (integral[y0, x1] - integral[y0, x0])
    left -= (integral[y3, x1] - integral[y3, x0]) - (integral[y2, x1] - integral[y2, x0])
    right = (integral[y1, x3] - integral[y1, x2]) - (integral[y0, x3] - integral[y0, x2])
    right -= (integral[y3, x3] - integral[y3, x2]) - (integral[y2, x3] - integral[y2, x2])
    dxy = np.int32(left - right)
    scale = np.float32(1.0 / ((1 << FRACTION_BITS) * lobe * (2 * wing + 1)))
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
    cube: NDArray[np.float32],
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
    cube : ndarray (3, 3, 3) float32
        Scratch.
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
    outer = 0 if layer == 0 else 2
    k = 0
    for i in range(2):
        for j in range(3):
            for m in range(3):
                cube[i + 1 - layer, j, m] = dense[k]
                k += 1
    value = cube[1, 1, 1]
    outer_lobe = lobe - 2 if layer == 0 else lobe + 4
    for step in range(9):
        # from the centre outwards (4, 5, 3, 6 ..): it decides most often
        k = 4 + (step + 1) // 2 * (1 if step % 2 == 1 else -1)
        det, _ = response_at(integral, row + k // 3 - 1, col + k % 3 - 1, outer_lobe)
        if det >= value:
            return False
        cube[outer, k // 3, k % 3] = det

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


@kernel
def refine_all(
    integral: NDArray[np.int32],
    lobe: int,
    positions: NDArray[np.int32],
    neighbours: NDArray[np.float32],
    chosen: NDArray[np.int64],
    out: NDArray[np.float32],
) -> int:
    """Refine the candidates `chosen`, in that order; see `refine`.

    Parameters
    ----------
    out : ndarray (len(chosen), 5) float32
        Filled from the top.

    Returns
    -------
    int
        Rows of `out` filled.
    """
    cube = np.empty((3, 3, 3), np.float32)
    kept = 0
    for i in chosen:
        if refine(integral, lobe, positions[i], neighbours[i], cube, out[kept]):
            kept += 1
    return kept
