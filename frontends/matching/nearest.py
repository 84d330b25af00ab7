"""Nearest neighbours among all descriptors (paper, eq. 12), ratio and mutual tests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from frontends.errors import InputError

Descriptors = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Matches:
    """Pairs of features.

    Attributes
    ----------
    query, train
        (M,) indices into the first and the second feature set.
    distance2
        (M,) squared descriptor distances (eq. 12).
    candidates
        How many query features were tried.
    """

    query: NDArray[np.int64]
    train: NDArray[np.int64]
    distance2: NDArray[np.float32]
    candidates: int

    def __len__(self) -> int:
        return len(self.query)

    def select(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> Matches:
        """The matches at a mask or an index array."""
        return Matches(self.query[keep], self.train[keep], self.distance2[keep], self.candidates)


def match_descriptors(
    query: Descriptors,
    train: Descriptors,
    *,
    ratio: float = 0.8,
    mutual: bool = True,
    method: Literal["kd-tree", "brute"] = "brute",
) -> Matches:
    """Match two descriptor sets without any knowledge of the geometry.

    Parameters
    ----------
    query, train
        (N, D) and (M, D) float32 descriptors.
    ratio
        A match is kept when its distance is below `ratio` times the distance to the
        second nearest; 1 turns the test off.
    mutual
        Keep only pairs that are each other's nearest.
    method
        ``"kd-tree"`` is the paper's search, exact; ``"brute"`` gives the same pairs by
        one matrix product, which is faster at 64 dimensions.

    Returns
    -------
    Matches
        Sorted by query index.

    Raises
    ------
    InputError
        When the sets do not have the same width, or the ratio is outside (0, 1].
    """
    if query.ndim != 2 or train.ndim != 2 or query.shape[1] != train.shape[1]:
        raise InputError(
            f"descriptor sets of shapes {query.shape} and {train.shape} cannot be compared",
            source="match_descriptors",
        )
    if not 0.0 < ratio <= 1.0:
        raise InputError(f"is {ratio}, must lie in (0, 1]", source="matching", field="ratio")
    if len(query) == 0 or len(train) < 2:
        empty = np.zeros(0, dtype=np.int64)
        return Matches(empty, empty, np.zeros(0, dtype=np.float32), len(query))
    search = _by_tree if method == "kd-tree" else _by_product
    nearest, best, second, back = search(query, train)
    keep = best <= ratio**2 * second
    if mutual:
        keep &= back[nearest] == np.arange(len(query))
    index = np.flatnonzero(keep)
    return Matches(index, nearest[index], best[index].astype(np.float32), len(query))


#: Nearest of each query, squared distances to it and to the second nearest, and the nearest
#: query of each train descriptor.
_Neighbours = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]


def _by_tree(query: Descriptors, train: Descriptors) -> _Neighbours:
    found = cKDTree(train).query(query, k=2)
    distance, index = np.asarray(found[0]), np.asarray(found[1])
    back = np.asarray(cKDTree(query).query(train, k=1)[1], dtype=np.int64)
    nearest = np.asarray(index[:, 0], dtype=np.int64)
    return nearest, distance[:, 0] ** 2, distance[:, 1] ** 2, back


def _by_product(query: Descriptors, train: Descriptors) -> _Neighbours:
    distance2 = query @ train.T
    distance2 *= -2.0
    distance2 += np.einsum("nd,nd->n", query, query)[:, None]
    distance2 += np.einsum("nd,nd->n", train, train)
    back = distance2.argmin(axis=0)
    rows = np.arange(len(query))
    nearest = distance2.argmin(axis=1)
    best = distance2[rows, nearest].astype(np.float64)
    distance2[rows, nearest] = np.inf
    second = distance2.min(axis=1).astype(np.float64)
    return nearest, np.maximum(best, 0.0), np.maximum(second, 0.0), back
