"""The fast-Hessian detector over all octaves: candidates, the strongest refined first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.surf.checks import LEAST_SIDE
from frontends.surf.keypoints import Keypoints
from frontends.surf.maxima import NEIGHBOURS, detect_pair
from frontends.surf.pyramid import Pyramid
from frontends.surf.refinement import refine_all

_BEYOND = float(np.finfo(np.float32).max)  # the kernels' arithmetic knows no infinity
_BASE_LOBE = 5  # of the lowest layer that can hold a maximum (filter 15); 9 lies below it


class _Candidates:
    """Candidates of one pair of layers."""

    def __init__(
        self, pyramid: Pyramid, octave: int, lobe: int, threshold: float, single: bool
    ) -> None:
        self._integral = pyramid.integral(octave)
        self._octave = octave
        self._lobe = lobe
        width = pyramid.shape(octave)[1]
        capacity = self._integral.size // 32 + 64
        while True:
            shape = (capacity, NEIGHBOURS)
            name = (octave, lobe)
            buffers = pyramid.buffers
            positions = buffers.get("positions", *name, shape=(capacity, 3), dtype=np.int32)
            neighbours = buffers.get("neighbours", *name, shape=shape, dtype=np.float32)
            responses = buffers.get("responses", *name, shape=(capacity,), dtype=np.float32)
            count = detect_pair(
                self._integral,
                width,
                lobe,
                np.float32(threshold),
                single,
                positions,
                neighbours,
                responses,
            )
            if count <= capacity:
                break
            capacity = count
        self._positions = positions
        self._neighbours = neighbours
        self.responses = responses[:count]

    def refine(self, least: float, above: float, rows: NDArray[np.float32], first: int) -> int:
        """Refine the candidates with least <= response < above into `rows`, from `first` on.

        Returns
        -------
        int
            Row after the last one filled; see `refine_all` for the columns.
        """
        return refine_all(
            self._integral,
            self._lobe,
            self._positions,
            self._neighbours,
            self.responses,
            np.float32(least),
            np.float32(above),
            self._octave,
            rows,
            first,
        )


def detect(
    pyramid: Pyramid,
    octaves: int,
    layers: int,
    threshold: float,
    wanted: int | None,
    mask: NDArray[np.bool_] | None,
    guess: float = 0.0,
) -> Keypoints:
    """Keypoints of one image, strongest first, all at angle 0.

    Parameters
    ----------
    pyramid : Pyramid
    octaves, layers : int
        Octaves, and layers an octave that can hold a maximum.
    threshold : float
        Least response.
    wanted : int, optional
        Keep the strongest.
    mask : ndarray (H, W) bool, optional
        Where keypoints are allowed.
    guess : float
        A response that the weakest of the `wanted` may reach. It saves work if so, and an image
        is looked through twice if not; the result is the same.
    """
    rows = np.empty((0, 6), np.float32)
    if wanted is not None and guess > threshold:
        rows = _strongest(_candidates(pyramid, octaves, layers, guess), wanted, mask)
    if wanted is None or len(rows) < wanted:
        rows = _strongest(_candidates(pyramid, octaves, layers, threshold), wanted, mask)
    rows = rows[_falling(rows[:, 3])[:wanted]]
    return Keypoints(
        rows[:, :2],
        rows[:, 2],
        np.zeros(len(rows), np.float32),
        rows[:, 3],
        rows[:, 5].astype(np.int32),
        np.sign(rows[:, 4]).astype(np.int8),
    )


def _strongest(
    pairs: list[_Candidates], wanted: int | None, mask: NDArray[np.bool_] | None
) -> NDArray[np.float32]:
    """Refined keypoints, among them the `wanted` strongest: rows as `refine_all` gives them."""
    total = sum(pair.responses.size for pair in pairs)
    rows = np.empty((total + 1, 6), np.float32)
    if total == 0:
        return rows[:0]
    responses = np.concatenate([pair.responses for pair in pairs])
    # Only the strongest candidates need refining. About half of them survive it; should
    # fewer do, the next share follows, so the result is the same as without this shortcut.
    batch = total if wanted is None else int(2.2 * wanted) + 64
    above = _BEYOND
    count = 0
    while True:
        least = -_BEYOND
        if batch < total:
            least = float(np.partition(responses, total - batch)[-batch])
        for pair in pairs:
            count = pair.refine(least, above, rows, count)
        found = rows[:count]
        if mask is not None:
            column = np.rint(found[:, 0]).astype(np.intp)
            line = np.rint(found[:, 1]).astype(np.intp)
            found = found[mask[line, column]]
        if least == -_BEYOND or (wanted is not None and len(found) >= wanted):
            return found
        above = least
        batch *= 2


def _falling(values: NDArray[np.float32]) -> NDArray[np.intp]:
    """Order of falling positive values; equal ones stay as they are, whatever the sort.

    One sort of integers, value above index, which numpy does ten times as fast as a stable
    sort of indices.
    """
    high = ~np.ascontiguousarray(values).view(np.uint32)
    keys = (high.astype(np.uint64) << np.uint64(32)) | np.arange(len(values), dtype=np.uint64)
    keys.sort()
    return (keys & np.uint64(0xFFFFFFFF)).astype(np.intp)


def _candidates(pyramid: Pyramid, octaves: int, layers: int, threshold: float) -> list[_Candidates]:
    """Candidates of each pair of layers of each octave."""
    found: list[_Candidates] = []
    for octave in range(octaves):
        if min(pyramid.shape(octave)) < LEAST_SIDE:
            break
        for first in range(0, layers, 2):
            single = first + 1 == layers
            lobe = _BASE_LOBE + 2 * first
            found.append(_Candidates(pyramid, octave, lobe, threshold, single))
    return found
