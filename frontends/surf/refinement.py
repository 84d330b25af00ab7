"""Candidates against their outer layer, and their sub-pixel position and size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit
from frontends.surf.box_filters import response_at
from frontends.surf.integral import PAD


@njit
def refine(
    integral: NDArray[np.int32],
    lobe: int,
    positions: NDArray[np.int32],
    neighbours: NDArray[np.float32],
    which: int,
    cube: NDArray[np.float32],
    out: NDArray[np.float32],
    target: int,
) -> bool:
    """Check one candidate against its outer layer and interpolate it (3-D quadratic).

    Parameters
    ----------
    integral : ndarray int32
        Padded integral image in grey*4.
    lobe : int
        l of the lower dense layer of the pair.
    positions, neighbours : ndarray
        As stored by `detect_pair`; whole, because a slice costs a reference count.
    which : int
        Row of them.
    cube : ndarray (3, 3, 3) float32
        Scratch.
    out : ndarray (N, >= 5) float32
    target : int
        Row of `out` to write: x, y (pixels of this level), size (side L of the filter),
        response, trace.

    Returns
    -------
    bool
        False where the outer layer is as high or the maximum lies outside the neighbourhood.
    """
    layer = int(positions[which, 0])
    row = int(positions[which, 1]) + PAD
    col = int(positions[which, 2]) + PAD
    outer = 0 if layer == 0 else 2
    k = 0
    for i in range(2):
        for j in range(3):
            for m in range(3):
                cube[i + 1 - layer, j, m] = neighbours[which, k]
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
    out[target, 0] = np.float32(col - PAD) + dx
    out[target, 1] = np.float32(row - PAD) + dy
    out[target, 2] = 3 * centre_lobe + 6 * ds
    out[target, 3] = value
    out[target, 4] = trace
    return True


@kernel
def refine_all(
    integral: NDArray[np.int32],
    lobe: int,
    positions: NDArray[np.int32],
    neighbours: NDArray[np.float32],
    responses: NDArray[np.float32],
    least: np.float32,
    above: np.float32,
    octave: int,
    out: NDArray[np.float32],
    first: int,
) -> int:
    """Refine the candidates with least <= response < above; see `refine`.

    Parameters
    ----------
    responses : ndarray (C,) float32
        Of the candidates in `positions` and `neighbours`.
    octave : int
        The level's blocks have 2^octave x 2^octave pixels.
    out : ndarray (N, 6) float32
        x, y, size (pixels of the image), response, trace, octave, in the order of the candidates.
    first : int
        Row of `out` to begin at; as many as there are candidates must follow.

    Returns
    -------
    int
        Row after the last one filled.
    """
    cube = np.empty((3, 3, 3), np.float32)
    block = np.float32(1 << octave)
    half = np.float32(0.5)
    kept = first
    for i in range(responses.size):
        if responses[i] < least or responses[i] >= above:
            continue
        if refine(integral, lobe, positions, neighbours, i, cube, out, kept):
            # the centre of block i is at pixel (i + 1/2) block - 1/2
            out[kept, 0] = (out[kept, 0] + half) * block - half
            out[kept, 1] = (out[kept, 1] + half) * block - half
            out[kept, 2] *= block
            out[kept, 5] = np.float32(octave)
            kept += 1
    return kept
