"""Block-mean pyramid and padded integral images (Bay et al., eq. 8).

Octave k of the detector uses the same box filters as octave 0 on the image of the means of
2^k x 2^k blocks: every memory access then has unit stride. Levels above 0 keep two fractional
bits (grey value times 4), and every integral image is in that unit.

The integral images are padded by `PAD` replicated pixels on each side, so that neither the
detector nor the descriptors need a special case at the border. They wrap modulo 2^32, which
is harmless: the sum over any box below 2^31 is exact.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit

LANES = 64  # row lengths of hot loops are multiples of this: no scalar remainder after SIMD
PAD = 56  # >= 10 * sqrt(2) * 3.6 + 3: the widest rotated descriptor window, in pixels
_LEAD = 8  # columns from one running sum to the next
FRACTION_BITS = 2  # integral images hold sums of grey * 2**FRACTION_BITS


@njit
def padded_length(length: int) -> int:
    """Round a row length up to a multiple of `LANES`."""
    return (length + LANES - 1) // LANES * LANES


@kernel
def halve(image: NDArray[Any], shift: int, out: NDArray[np.uint16]) -> None:
    """Means of 2x2 blocks in grey*4, rounded.

    Parameters
    ----------
    image : ndarray (H, W) uint8 or uint16
    shift : int
        0 makes grey*4 from uint8 grey (the sum of four), 2 keeps the unit (their mean).
    out : ndarray (H // 2, W // 2) uint16
    """
    one = np.uint64(1)
    two = np.uint64(2)
    for y in range(out.shape[0]):
        top = 2 * y
        # constant shifts: a variable one would be done in 64-bit lanes
        if shift == 0:
            for x in range(np.uint64(out.shape[1])):
                left = np.int32(image[top, two * x]) + np.int32(image[top + 1, two * x])
                right = np.int32(image[top, two * x + one]) + np.int32(
                    image[top + 1, two * x + one]
                )
                out[y, x] = np.uint16(left + right)
        else:
            for x in range(np.uint64(out.shape[1])):
                left = np.int32(image[top, two * x]) + np.int32(image[top + 1, two * x])
                right = np.int32(image[top, two * x + one]) + np.int32(
                    image[top + 1, two * x + one]
                )
                out[y, x] = np.uint16(np.int32(left + right + 2) >> 2)


@kernel
def integrate(image: NDArray[Any], shift: int, out: NDArray[np.int32]) -> None:
    """Integral image (eq. 8) of the image padded by `PAD` replicated pixels.

    ``out[y, x]`` is the sum over rows < y and columns < x of the padded image times
    2**shift, modulo 2**32.

    Parameters
    ----------
    image : ndarray (H, W) uint8 or uint16
    shift : int
        2 for uint8 grey, 0 for a level that is already in grey*4.
    out : ndarray (H + 2 PAD + 1, >= W + 2 PAD + 1) int32
        Columns beyond W + 2 PAD + 1 hold nothing of use.
    """
    h, w = image.shape
    columns = np.uint64(out.shape[1])
    # The running sum of a row, eight columns at a time: sums over windows of 2 and of 4 pixels
    # first, then each column from the one eight before. `_LEAD` zeros precede each line.
    pixels = np.zeros(out.shape[1] + _LEAD, np.uint16)
    windows = np.zeros(out.shape[1] + _LEAD, np.uint16)
    sums = np.zeros(out.shape[1] + _LEAD, np.int32)
    lead = np.uint64(_LEAD)
    factor = np.uint16(1 << shift)
    back1, back2, back4 = np.uint64(_LEAD - 1), np.uint64(_LEAD - 2), np.uint64(_LEAD - 4)
    middle = np.uint64(_LEAD + PAD)
    out[0, :] = 0
    target = 0
    for y in range(h):
        pixels[_LEAD : _LEAD + PAD] = np.uint16(image[y, 0]) * factor
        for x in range(np.uint64(w)):
            pixels[middle + x] = np.uint16(np.uint16(image[y, x]) * factor)
        pixels[_LEAD + PAD + w :] = np.uint16(image[y, w - 1]) * factor
        for x in range(columns):
            windows[x + lead] = np.uint16(pixels[x + lead] + pixels[x + back1])
        for x in range(columns):
            pixels[x + lead] = np.uint16(windows[x + lead] + windows[x + back2])
        for x in range(columns):
            four = np.int32(pixels[x + lead]) + np.int32(pixels[x + back4])
            sums[x + lead] = np.int32(sums[x] + four)
        copies = 1
        if y == 0:
            copies += PAD
        if y == h - 1:
            copies += PAD
        for _ in range(copies):
            for x in range(columns):
                out[target + 1, x] = np.int32(out[target, x] + sums[x + back1])
            target += 1


def integral_shape(height: int, width: int) -> tuple[int, int]:
    """Shape of the padded integral image of a level; its columns are rounded up for SIMD.

    Returns
    -------
    (H + 2 PAD + 1, N), N >= W + 2 PAD + 1 + `LANES`
    """
    return height + 2 * PAD + 1, int(padded_length(width + 2 * PAD + 1 + LANES))


def integral_image(
    image: NDArray[np.uint8] | NDArray[np.uint16], out: NDArray[np.int32] | None = None
) -> NDArray[np.int32]:
    """Make the padded integral image of one pyramid level.

    Parameters
    ----------
    image : ndarray (H, W) uint8 or uint16
        Grey values, or grey*4 for a uint16 level.
    out : ndarray int32, optional
        Of `integral_shape`.

    Returns
    -------
    ndarray of `integral_shape`, int32
        Sums of grey*4, modulo 2**32; columns beyond W + 2 PAD + 1 hold nothing of use.
    """
    if out is None:
        out = np.empty(integral_shape(*image.shape), np.int32)
    integrate(image, FRACTION_BITS if image.dtype == np.uint8 else 0, out)
    return out


def half_image(
    image: NDArray[np.uint8] | NDArray[np.uint16], out: NDArray[np.uint16] | None = None
) -> NDArray[np.uint16]:
    """Next pyramid level: means of 2x2 blocks in grey*4.

    Parameters
    ----------
    image : ndarray (H, W) uint8 or uint16
    out : ndarray (H // 2, W // 2) uint16, optional

    Returns
    -------
    ndarray (H // 2, W // 2) uint16
    """
    if out is None:
        out = np.empty((image.shape[0] // 2, image.shape[1] // 2), np.uint16)
    halve(image, 0 if image.dtype == np.uint8 else 2, out)
    return out
