"""The rows around a keypoint, for descriptors that are made one after the other down an image.

Keypoints come by strip, and by row within it. The rows that a window can touch are kept in a
ring; they begin anew with each strip, and where no window touches the rows between.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from frontends.jit import njit
from frontends.surf.integral import LANES, LEAD, STRIP, append_row

REACH = 56  # >= 10 * sqrt(2) * 3.6 + 3: half of the widest rotated window, in pixels
WINDOW_ROWS = 128  # kept in a ring: a power of two, more than twice the reach
RING_COLUMNS = STRIP + 2 * REACH + LANES  # a strip, what a window reaches beyond, room to read on
LINE = LEAD + RING_COLUMNS  # of scratch lines
NOWHERE = -(1 << 30)  # far above the image: the ring has no rows yet


@njit
def strip_of(x: float) -> int:
    """First column of the ring that a keypoint at `x` needs."""
    return int(x) // STRIP * STRIP - REACH


@njit
def first_row(y: float, newest: int) -> int:
    """First row to add for a window at `y`, where the ring has rows before `newest`."""
    return max(newest, math.floor(y) - REACH)


@njit
def extend_integral(
    grey: NDArray[np.uint8],
    blocks: NDArray[np.uint16],
    left: int,
    y: float,
    newest: int,
    scratch: NDArray[np.uint16],
    sums: NDArray[np.int32],
    ring: NDArray[np.int32],
) -> int:
    """Extend the rolling integral image of a strip to what a window at row `y` touches.

    Parameters
    ----------
    grey, blocks : ndarray (H, W)
        The level; one of the two is empty, see `integral`.
    left : int
        The ring's first column, from `strip_of`.
    y : float
        Of the window's centre.
    newest : int
        Rows before it are in the ring; `NOWHERE` to begin with.
    scratch, sums : ndarray (2, LINE) uint16, (LINE,) int32
        Scratch, zeros to begin with.
    ring : ndarray (WINDOW_ROWS, RING_COLUMNS) int32
        Row r of the integral image at r % WINDOW_ROWS.

    Returns
    -------
    int
        The new `newest`.
    """
    for row in range(first_row(y, newest), math.floor(y) + REACH + 1):
        # after a gap any row may stand for the one above: only differences count
        append_row(grey, blocks, row - 1, left, scratch, sums, ring)
        newest = row + 1
    return newest
