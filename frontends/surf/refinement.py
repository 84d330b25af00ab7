"""Candidates against their outer layer, and their sub-pixel position and size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import njit
from frontends.surf.box_filters import response_at


@njit
def refine(
    ring: NDArray[np.int32],
    mask: int,
    row: int,
    column: int,
    lobe: int,
    layer: int,
    cube: NDArray[np.float32],
    out: NDArray[np.float32],
    target: int,
) -> bool:
    """Check one candidate against its outer layer and interpolate it (3-D quadratic).

    Parameters
    ----------
    ring : ndarray int32
        Rows of the integral image in grey*4, row r at r & mask.
    mask : int
    row, column : int
        The candidate, in the ring's coordinates.
    lobe : int
        l of the lower dense layer of the pair.
    layer : int
        0 or 1: which of them it is in.
    cube : ndarray (3, 3, 3) float32
        Responses of the neighbours by layer, row, column: those of the dense layers come in,
        those of the outer one (the first for layer 0, else the last) are filled in.
    out : ndarray (N, >= 5) float32
    target : int
        Row of `out` to write: x, y beside the candidate, size (side L of the filter), response,
        trace; in pixels of this level.

    Returns
    -------
    bool
        False where the outer layer is as high or the maximum lies outside the neighbourhood.
    """
    outer = 0 if layer == 0 else 2
    value = cube[1, 1, 1]
    outer_lobe = lobe - 2 if layer == 0 else lobe + 4
    for step in range(9):
        # from the centre outwards (4, 5, 3, 6 ..): it decides most often
        k = 4 + (step + 1) // 2 * (1 if step % 2 == 1 else -1)
        det, _ = response_at(ring, mask, row + k // 3 - 1, column + k % 3 - 1, outer_lobe)
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
    _, trace = response_at(ring, mask, row, column, centre_lobe)
    out[target, 0] = dx
    out[target, 1] = dy
    out[target, 2] = 3 * centre_lobe + 6 * ds
    out[target, 3] = value
    out[target, 4] = trace
    return True
