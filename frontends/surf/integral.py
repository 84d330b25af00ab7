"""Block-mean pyramid and rolling integral images (Bay et al., eq. 8).

Octave k of the detector uses the same box filters as octave 0 on the image of the means of
2^k x 2^k blocks: every memory access then has unit stride. Levels above 0 keep two fractional
bits (grey value times 4), and every sum is in that unit.

No integral image is ever stored whole: the detector and the descriptors go down the image, and
keep the last rows of it in a ring, which stays in the cache. Wide images are worked through in
vertical strips for the same reason. Border pixels continue outside, so that the descriptors need
no special case there. Sums wrap modulo 2^32, which is harmless: the sum over any box below 2^31
is exact.

A level comes to the kernels as two arrays, of which one is empty: `grey`, uint8, or `blocks`,
uint16. One type of arguments means one compiled kernel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit

LANES = 64  # row lengths of hot loops are multiples of this: no scalar remainder after SIMD
STRIP = 512  # columns worked through at a time
LEAD = 8  # pixels from one running sum to the next
FRACTION_BITS = 2  # sums are of grey * 2**FRACTION_BITS


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


@njit
def level_shape(grey: NDArray[np.uint8], blocks: NDArray[np.uint16]) -> tuple[int, int]:
    """Height and width of a level."""
    return max(grey.shape[0], blocks.shape[0]), max(grey.shape[1], blocks.shape[1])


@njit
def load_row(
    grey: NDArray[np.uint8],
    blocks: NDArray[np.uint16],
    y: int,
    first: int,
    columns: int,
    pixels: NDArray[np.uint16],
) -> None:
    """Pixels first .. first + columns - 1 of row `y` in grey*4, from ``pixels[LEAD]`` on.

    The pixels at the border continue outside of the image.
    """
    height, width = level_shape(grey, blocks)
    row = np.uint64(min(max(y, 0), height - 1))
    begin = max(first, 0)
    count = max(min(first + columns, width) - begin, 0)
    target, source = np.uint64(LEAD + begin - first), np.uint64(begin)
    if blocks.size > 0:
        for x in range(np.uint64(count)):
            pixels[target + x] = blocks[row, source + x]
    else:
        for x in range(np.uint64(count)):
            pixels[target + x] = np.uint16(np.uint16(grey[row, source + x]) << FRACTION_BITS)
    before, after = pixels[target], pixels[np.uint64(LEAD + begin - first + count - 1)]
    for x in range(np.uint64(begin - first)):
        pixels[np.uint64(LEAD) + x] = before
    target += np.uint64(count)
    for x in range(np.uint64(columns - (begin - first) - count)):
        pixels[target + x] = after


@njit
def append_row(
    grey: NDArray[np.uint8],
    blocks: NDArray[np.uint16],
    y: int,
    first: int,
    scratch: NDArray[np.uint16],
    sums: NDArray[np.int32],
    ring: NDArray[np.int32],
) -> None:
    """Make row y + 1 of a strip's rolling integral image from row y.

    Parameters
    ----------
    grey, blocks : ndarray (H, W)
        The level; one of the two is empty.
    y : int
        Pixel row.
    first : int
        Column of the image at which the strip begins.
    scratch, sums : ndarray (2, N + LEAD) uint16, (N + LEAD,) int32
        Scratch, zeros to begin with.
    ring : ndarray (R, N) int32
        Row r at r % R, a power of two: the sums of the rows above and of the columns of the strip
        to the left. N is a multiple of 8.
    """
    columns = ring.shape[1]
    pixels, windows = scratch[0], scratch[1]
    load_row(grey, blocks, y, first, columns, pixels)
    # running sums, eight columns at a time: sums over windows of 2, 4 and 8 pixels first, then
    # each column from the one eight before
    n, lead = np.uint64(columns), np.uint64(LEAD)
    back1, back2, back4 = np.uint64(LEAD - 1), np.uint64(LEAD - 2), np.uint64(LEAD - 4)
    for x in range(n):
        windows[x + lead] = np.uint16(pixels[x + lead] + pixels[x + back1])
    for x in range(n):
        pixels[x + lead] = np.uint16(windows[x + lead] + windows[x + back2])
    for x in range(n):
        windows[x + lead] = np.uint16(pixels[x + lead] + pixels[x + back4])
    for x in range(n):
        sums[x + lead] = np.int32(sums[x] + np.int32(windows[x + lead]))
    mask = ring.shape[0] - 1
    above, below = np.uint64(y & mask), np.uint64((y + 1) & mask)
    for x in range(n):
        ring[below, x] = np.int32(ring[above, x] + sums[x + back1])


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
