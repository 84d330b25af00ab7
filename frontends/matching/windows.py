"""Matching inside search windows: the epipolar band of a stereo pair, a predicted place.

Geometry says where a partner can lie; descriptors are compared only there. That is both
faster than a global search and less often wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit
from frontends.matching.nearest import Matches

FloatArray = NDArray[np.float64]
Descriptors = NDArray[np.float32]

#: A second-best candidate this close to the best is the same image point, found twice.
_SAME_POINT_PX = 3.0
#: Largest squared distance of two unit vectors.
_NO_MATCH = np.float32(4.0)


@dataclass(frozen=True, slots=True)
class SearchWindows:
    """Where the partner of each query feature may lie in the other image.

    Attributes
    ----------
    u, v
        (N,) centres, px.
    half_width, half_height
        Half extents, px, for all features.
    """

    u: FloatArray
    v: FloatArray
    half_width: float
    half_height: float


def match_in_windows(
    query: Descriptors,
    query_sign: NDArray[np.int8],
    windows: SearchWindows,
    train: Descriptors,
    train_sign: NDArray[np.int8],
    train_uv: FloatArray,
    *,
    ratio: float = 0.8,
    max_distance2: float = 0.5,
) -> Matches:
    """Mutually nearest descriptors within search windows.

    Parameters
    ----------
    query, train
        (N, D) and (M, D) float32 descriptors.
    query_sign, train_sign
        (N,), (M,) sign of the Laplacian: a bright blob never matches a dark one.
    windows
        Where to look for each query feature.
    train_uv
        (M, 2) positions, px.
    ratio
        Largest ratio of the distances to the nearest and the second nearest candidate
        in the window (that is another image point).
    max_distance2
        Largest squared distance; 2 is that of orthogonal unit descriptors.

    Returns
    -------
    Matches
        Sorted by query index.
    """
    if len(query) == 0 or len(train) == 0:
        nothing = np.zeros(0, dtype=np.int64)
        return Matches(nothing, nothing, np.zeros(0, dtype=np.float32), len(query))
    u, v = np.ascontiguousarray(train_uv.T, dtype=np.float64)
    axes = (windows.v, windows.half_height, v), (windows.u, windows.half_width, u)
    # listed along the axis on which a window takes in the fewer features
    first, second = sorted(axes, key=lambda axis: axis[1] / (np.ptp(axis[2]) + 1.0))
    nearest, best = _search(
        np.ascontiguousarray(query),
        query_sign,
        np.ascontiguousarray(first[0], dtype=np.float64),
        np.ascontiguousarray(second[0], dtype=np.float64),
        float(first[1]),
        float(second[1]),
        np.ascontiguousarray(train),
        train_sign,
        first[2],
        second[2],
        float(ratio**2),
        float(max_distance2),
    )
    index = np.flatnonzero(nearest >= 0)
    return Matches(index, nearest[index], best[index], len(query))


@njit
def _by_bin(
    position: NDArray[np.float64], origin: float, bins: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Features ordered by bins of a pixel, and where each bin begins (a counting sort)."""
    begin = np.zeros(bins + 1, dtype=np.int64)
    for j in range(len(position)):
        begin[int(position[j] - origin) + 1] += 1
    for k in range(bins):
        begin[k + 1] += begin[k]
    order = np.empty(len(position), dtype=np.int64)
    following = begin.copy()
    for j in range(len(position)):
        k = int(position[j] - origin)
        order[following[k]] = j
        following[k] += 1
    return order, begin


@kernel
def _search(
    query: NDArray[np.float32],
    query_sign: NDArray[np.int8],
    centre_a: NDArray[np.float64],
    centre_b: NDArray[np.float64],
    half_a: float,
    half_b: float,
    train: NDArray[np.float32],
    train_sign: NDArray[np.int8],
    train_a: NDArray[np.float64],
    train_b: NDArray[np.float64],
    ratio2: float,
    max_distance2: float,
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Nearest train row of each query, -1 where a test fails; a and b are the image axes."""
    n, m, width = query.shape[0], train.shape[0], query.shape[1]
    nearest = np.full(n, -1, dtype=np.int64)
    best = np.full(n, _NO_MATCH, dtype=np.float32)
    back = np.full(m, -1, dtype=np.int64)
    back_best = np.full(m, _NO_MATCH, dtype=np.float32)
    origin = np.floor(train_a.min())
    bins = int(train_a.max() - origin) + 1
    order, begin = _by_bin(train_a, origin, bins)
    found = np.empty(m + 1, dtype=np.int64)
    distances = np.empty(m, dtype=np.float32)
    for i in range(n):
        a, b = centre_a[i], centre_b[i]
        # written so that a place that is no number, or far outside, has no candidates
        if not (a + half_a >= origin and a - half_a < origin + bins):
            continue
        lowest = int(max(a - half_a - origin, 0.0))
        highest = int(min(a + half_a - origin, bins - 1.0))
        candidates = 0
        for k in range(begin[lowest], begin[highest + 1]):
            j = order[k]
            near = (abs(train_a[j] - a) <= half_a) & (abs(train_b[j] - b) <= half_b)
            found[candidates] = j
            candidates += int(near & (train_sign[j] == query_sign[i]))
        for k in range(candidates):
            j = found[k]
            total = np.float32(0.0)
            for c in range(width):
                difference = query[i, c] - train[j, c]
                total += difference * difference
            distances[k] = total
            if total < best[i]:
                best[i] = total
                nearest[i] = j
            if total < back_best[j]:
                back_best[j] = total
                back[j] = i
        if nearest[i] < 0:
            continue
        second = _NO_MATCH
        a, b = train_a[nearest[i]], train_b[nearest[i]]
        for k in range(candidates):
            if distances[k] < second:
                da, db = train_a[found[k]] - a, train_b[found[k]] - b
                if da * da + db * db > _SAME_POINT_PX * _SAME_POINT_PX:
                    second = distances[k]
        if best[i] > max_distance2 or best[i] > ratio2 * second:
            nearest[i] = -1
    for i in range(n):
        if nearest[i] >= 0 and back[nearest[i]] != i:
            nearest[i] = -1
    return nearest, best
