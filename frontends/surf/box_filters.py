"""The box filters of the fast Hessian (Bay et al., eqs. 9 and 10), and one response of them.

A filter of side L = 3 l has lobes of l x 5/9 L for Dxx and Dyy and l x l for Dxy. Responses
are in OpenCV's unit, means over the lobes of Dxx, so that thresholds carry over:
``det = Dxx Dyy - (0.9 Dxy)^2``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import njit
from frontends.surf.integral import FRACTION_BITS


@njit
def lobe_wing(lobe: int) -> int:
    """Half of a second-derivative lobe's long side, which is 5/9 L rounded to odd.

    5, 9, 11, 15 for L = 9, 15, 21, 27, as in OpenCV: the shape stays that of the 9 x 9 filter.
    """
    return 5 * lobe // 6


@njit
def weight_xy(lobe: int) -> np.float32:
    """Weight of Dxy in the determinant (the 0.9 of eq. 10), for lobe means.

    The paper's 0.9 is for sums, and a Dxy lobe of the 9 x 9 filter has 3/5 of the area of a Dxx
    lobe: 0.54 for means. There it makes the determinant turn with the image: on isotropic
    texture, w Dxy then varies as much as (Dxx - Dyy) / 2, which is Dxy turned by 45 degrees.
    Keeping that property for the larger filters, whose Dxy lobes lie relatively closer, takes
    0.55, 0.59, 0.61, 0.63, 0.64 for L = 9 .. 33 on texture with power 1 / f^2, which this fits.
    OpenCV puts 0.9 on the means; that costs 3 to 10 % of the matches on low-texture ground.
    """
    return np.float32(0.66) - np.float32(0.33) / np.float32(lobe)


@njit
def response_at(
    ring: NDArray[np.int32], mask: int, row: int, column: int, lobe: int
) -> tuple[np.float32, np.float32]:
    """Evaluate determinant (eq. 10) and trace of one filter at one pixel.

    Parameters
    ----------
    ring : ndarray int32
        Rows of an integral image in grey*4, row r at r & mask.
    mask : int
    row, column : int
        Pixel in the ring's coordinates.
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
    # Sums wrap modulo 2^32, which the cast of each result undoes. Unsigned indices: signed ones
    # get a test for negative values.
    y0, y1 = np.uint64((row - half) & mask), np.uint64((row - inner) & mask)
    y2, y3 = np.uint64((row + inner + 1) & mask), np.uint64((row + half + 1) & mask)
    x0, x1 = np.uint64(column - wing), np.uint64(column + wing + 1)
    dyy = np.int32(
        (ring[y3, x1] - ring[y3, x0])
        - (ring[y0, x1] - ring[y0, x0])
        + 3 * ((ring[y1, x1] - ring[y1, x0]) - (ring[y2, x1] - ring[y2, x0]))
    )
    y0, y1 = np.uint64((row - wing) & mask), np.uint64((row + wing + 1) & mask)
    x0, x1 = np.uint64(column - half), np.uint64(column - inner)
    x2, x3 = np.uint64(column + inner + 1), np.uint64(column + half + 1)
    dxx = np.int32(
        (ring[y1, x3] - ring[y0, x3])
        - (ring[y1, x0] - ring[y0, x0])
        + 3 * ((ring[y1, x1] - ring[y0, x1]) - (ring[y1, x2] - ring[y0, x2]))
    )
    y0, y1 = np.uint64((row - lobe) & mask), np.uint64(row & mask)
    y2, y3 = np.uint64((row + 1) & mask), np.uint64((row + lobe + 1) & mask)
    x0, x1 = np.uint64(column - lobe), np.uint64(column)
    x2, x3 = np.uint64(column + 1), np.uint64(column + lobe + 1)
    left = (ring[y1, x1] - ring[y1, x0]) - (ring[y0, x1] - ring[y0, x0])
    left -= (ring[y3, x1] - ring[y3, x0]) - (ring[y2, x1] - ring[y2, x0])
    right = (ring[y1, x3] - ring[y1, x2]) - (ring[y0, x3] - ring[y0, x2])
    right -= (ring[y3, x3] - ring[y3, x2]) - (ring[y2, x3] - ring[y2, x2])
    dxy = np.int32(left - right)
    scale = np.float32(1.0 / ((1 << FRACTION_BITS) * lobe * (2 * wing + 1)))
    scale_xy = np.float32(1.0 / ((1 << FRACTION_BITS) * lobe * lobe))
    xx = scale * np.float32(dxx)
    yy = scale * np.float32(dyy)
    xy = scale_xy * np.float32(dxy)
    xy *= weight_xy(lobe)
    return xx * yy - xy * xy, xx + yy
