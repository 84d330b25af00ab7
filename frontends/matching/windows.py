"""Matching inside search windows: the epipolar band of a stereo pair, a predicted place.

Geometry says where a partner can lie; descriptors are compared only there. That is both
faster than a global search and less often wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel
from frontends.matching.nearest import Matches

FloatArray = NDArray[np.float64]
Descriptors = NDArray[np.float32]

#: A second-best candidate this close to the best is the same image point, found twice.
_SAME_POINT_PX = 3.0


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
    order = np.argsort(train_uv[:, 1], kind="stable")
    nearest, best = _search(
        np.ascontiguousarray(query),
        query_sign,
        np.ascontiguousarray(windows.u, dtype=np.float64),
        np.ascontiguousarray(windows.v, dtype=np.float64),
        float(windows.half_width),
        float(windows.half_height),
        np.ascontiguousarray(train[order]),
        train_sign[order],
        np.ascontiguousarray(train_uv[order], dtype=np.float64),
        float(ratio**2),
        float(max_distance2),
    )
    index = np.flatnonzero(nearest >= 0)
    return Matches(index, order[nearest[index]].astype(np.int64), best[index], len(query))


@kernel
def _search(
    query: NDArray[np.float32],
    query_sign: NDArray[np.int8],
    centre_u: NDArray[np.float64],
    centre_v: NDArray[np.float64],
    half_width: float,
    half_height: float,
    train: NDArray[np.float32],
    train_sign: NDArray[np.int8],
    train_uv: NDArray[np.float64],
    ratio2: float,
    max_distance2: float,
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Nearest train row (sorted by v) of each query, -1 where a test fails."""
    n, m, width = query.shape[0], train.shape[0], query.shape[1]
    nearest = np.full(n, -1, dtype=np.int64)
    best = np.full(n, np.float32(4.0), dtype=np.float32)
    back = np.full(m, -1, dtype=np.int64)
    back_best = np.full(m, np.float32(4.0), dtype=np.float32)
    train_v = train_uv[:, 1].copy()
    distances = np.empty(m, dtype=np.float32)
    for i in range(n):
        first = np.searchsorted(train_v, centre_v[i] - half_height)
        last = first
        while last < m and train_v[last] <= centre_v[i] + half_height:
            distances[last] = np.float32(4.0)
            du = train_uv[last, 0] - centre_u[i]
            if abs(du) <= half_width and train_sign[last] == query_sign[i]:
                total = np.float32(0.0)
                for k in range(width):
                    difference = query[i, k] - train[last, k]
                    total += difference * difference
                distances[last] = total
                if total < best[i]:
                    best[i] = total
                    nearest[i] = last
                if total < back_best[last]:
                    back_best[last] = total
                    back[last] = i
            last += 1
        if nearest[i] < 0:
            continue
        second = np.float32(4.0)
        u, v = train_uv[nearest[i], 0], train_uv[nearest[i], 1]
        for j in range(first, last):
            if distances[j] < second:
                du, dv = train_uv[j, 0] - u, train_uv[j, 1] - v
                if du * du + dv * dv > _SAME_POINT_PX * _SAME_POINT_PX:
                    second = distances[j]
        if best[i] > max_distance2 or best[i] > ratio2 * second:
            nearest[i] = -1
    for i in range(n):
        if nearest[i] >= 0 and back[nearest[i]] != i:
            nearest[i] = -1
    return nearest, best
