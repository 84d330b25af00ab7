"""The fast-Hessian detector over all octaves: candidates, the strongest refined first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.surf.checks import LEAST_SIDE
from frontends.surf.keypoints import Keypoints
from frontends.surf.maxima import NEIGHBOURS, detect_pair
from frontends.surf.pyramid import Pyramid
from frontends.surf.refinement import refine_all

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

    def refined(self, least: float, above: float) -> NDArray[np.float32]:
        """Refine the candidates with least <= response < above.

        Returns
        -------
        ndarray (M, 6) float32
            x, y, size (pixels of the image), response, trace, octave of those that hold.
        """
        chosen = np.flatnonzero((self.responses >= least) & (self.responses < above))
        rows = np.empty((len(chosen) + 1, 5), np.float32)
        kept = refine_all(
            self._integral, self._lobe, self._positions, self._neighbours, chosen, rows
        )
        out = np.empty((kept, 6), np.float32)
        out[:, :5] = rows[:kept]
        out[:, 5] = self._octave
        block = np.float32(1 << self._octave)
        # the centre of block i is at pixel (i + 1/2) block - 1/2
        out[:, :2] = (out[:, :2] + np.float32(0.5)) * block - np.float32(0.5)
        out[:, 2] *= block
        return out


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
    # equal responses stay in scan order: the result does not depend on the sort
    rows = rows[np.argsort(-rows[:, 3], kind="stable")[:wanted]]
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
    """Refined keypoints, among them the `wanted` strongest: rows of `_Candidates.refined`."""
    rows = np.empty((0, 6), np.float32)
    if not pairs:
        return rows
    responses = np.concatenate([pair.responses for pair in pairs])
    # Only the strongest candidates need refining. About half of them survive it; should
    # fewer do, the next share follows, so the result is the same as without this shortcut.
    batch = responses.size if wanted is None else int(2.2 * wanted) + 64
    above = np.inf
    while True:
        least = -np.inf
        if batch < responses.size:
            least = float(np.partition(responses, responses.size - batch)[-batch])
        fresh = [pair.refined(least, above) for pair in pairs]
        rows = np.concatenate([rows, *fresh])
        if mask is not None:
            column = np.rint(rows[:, 0]).astype(np.intp)
            line = np.rint(rows[:, 1]).astype(np.intp)
            rows = rows[mask[line, column]]
        if least == -np.inf or (wanted is not None and len(rows) >= wanted):
            return rows
        above = least
        batch *= 2


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
