"""Matches that are neighbours in one image are neighbours in the other.

An epipolar line cannot tell where on it a match belongs, but its neighbours can. A wrong match
lands among matches that have nothing to do with those around it in the first image; those that both
of its neighbourhoods share by chance are few (hypergeometric). Neighbours are the ``sqrt(M)``
nearest matches, so that the test needs no distance and holds for any turn and scale; counting
common neighbours is the idea of grid-based motion statistics (Bian et al., CVPR 2017).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import hypergeom

FloatArray = NDArray[np.float64]

#: Probability that a match in a place of chance has as many common neighbours as are asked for.
_CHANCE = 0.01
#: Of fewer matches, neighbourhoods are too small to tell chance from sense.
_FEWEST = 40


def among_neighbours(first_xy: FloatArray, second_xy: FloatArray) -> NDArray[np.bool_]:
    """Which matches share more neighbours in both images than chance explains.

    Parameters
    ----------
    first_xy, second_xy
        (M, 2) matched pixels, most of them right.

    Returns
    -------
    (M,) bool
        True for all where there are fewer than 40 matches.
    """
    count = len(first_xy)
    if count < _FEWEST:
        return np.ones(count, dtype=np.bool_)
    around = round(np.sqrt(count))
    near_first, near_second = (_nearest(xy, around) for xy in (first_xy, second_xy))
    # each match's neighbours as numbers of their own, so that one search finds all common ones
    own = np.arange(count)[:, None] * count
    common = np.isin(near_first + own, near_second + own).sum(axis=1)
    return np.asarray(common > hypergeom.isf(_CHANCE, count - 1, around, around))


def _nearest(xy: FloatArray, around: int) -> NDArray[np.intp]:
    """Numbers of the nearest other points (M, around)."""
    _, found = cKDTree(xy).query(xy, around + 1)
    return np.asarray(found)[:, 1:]
