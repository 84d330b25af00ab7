"""Squared lengths in sigmas, and a filter forward along a planar path behind such a gate."""

from __future__ import annotations

import numpy as np

from frontends.jit import kernel, njit
from frontends.measurements import FloatArray, IntArray


@njit
def _solve(matrix: FloatArray, vector: FloatArray, out: FloatArray) -> None:
    """Solve a symmetric positive definite system of three."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    # Scaled to ones on the diagonal: metres and radians are far apart. A variance that rounding
    # has made negative counts by its size.
    p, q, r = np.sqrt(abs(a)), np.sqrt(abs(d)), np.sqrt(abs(f))
    b, c, e = b / (p * q), c / (p * r), e / (q * r)
    x, y, z = vector[0] / p, vector[1] / q, vector[2] / r
    det = 1.0 - e * e - b * (b - c * e) + c * (b * e - c)
    out[0] = ((1.0 - e * e) * x + (c * e - b) * y + (b * e - c) * z) / (det * p)
    out[1] = ((c * e - b) * x + (1.0 - c * c) * y + (b * c - e) * z) / (det * q)
    out[2] = ((b * e - c) * x + (b * c - e) * y + (1.0 - b * b) * z) / (det * r)


@njit
def _carry(here: FloatArray, spread: FloatArray, motion: FloatArray, noise: FloatArray) -> None:
    """Go on by a motion, in place."""
    cosine, sine = np.cos(here[2]), np.sin(here[2])
    dx = cosine * motion[0] - sine * motion[1]
    dy = sine * motion[0] + cosine * motion[1]
    by_here, by_motion = np.eye(3), np.eye(3)
    by_here[0, 2], by_here[1, 2] = -dy, dx
    by_motion[0, 0], by_motion[0, 1], by_motion[1, 0], by_motion[1, 1] = cosine, -sine, sine, cosine
    total = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                for n in range(3):
                    total[i, j] += by_here[i, k] * spread[k, n] * by_here[j, n]
                    total[i, j] += by_motion[i, k] * noise[k, n] * by_motion[j, n]
    here[0] += dx
    here[1] += dy
    here[2] += motion[2]
    spread[:] = total


@kernel
def squared_lengths(off: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squared Mahalanobis lengths (C,) of vectors (C, 3), covariances (C, 3, 3) positive."""
    result, weighed = np.empty(len(off)), np.empty(3)
    for c in range(len(off)):
        _solve(covariance[c], off[c], weighed)
        result[c] = off[c, 0] * weighed[0] + off[c, 1] * weighed[1] + off[c, 2] * weighed[2]
    return result


@kernel
def gated(
    values: FloatArray,
    covariances: FloatArray,
    steps: int,
    order: IntArray,
    first: IntArray,
    station: IntArray,
    forced: IntArray,
    barrier: float,
) -> IntArray:
    """Of each group the claim that is taken in, counted within the group; -1 for none.

    `values` (n, 3) and `covariances` (n, 3, 3) are of the start, of `steps` motions, and of
    all claims; group g has the claims ``first[g]`` to ``first[g + 1]``. `order` names the
    groups by their `station`; `forced` says which claim of a group is taken anyway, -1 for none,
    or -2 where the gate decides.
    """
    chosen = np.full(len(first) - 1, -1)
    here, spread = values[0].copy(), covariances[0].copy()
    off, weighed, total, gain = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    at = 0
    for g in order:
        while at < station[g]:
            at += 1
            _carry(here, spread, values[at], covariances[at])
        least = barrier
        choice = forced[g]
        for c in range(first[g], first[g + 1]):
            if forced[g] != -2:
                break
            place = 1 + steps + c
            for i in range(3):
                off[i] = values[place, i] - here[i]
            off[2] = np.arctan2(np.sin(off[2]), np.cos(off[2]))
            total[:] = spread + covariances[place]
            _solve(total, off, weighed)
            square = off[0] * weighed[0] + off[1] * weighed[1] + off[2] * weighed[2]
            if square <= least:
                least = square
                choice = c - first[g]
        if choice < 0:
            continue
        chosen[g] = choice
        place = 1 + steps + first[g] + choice
        for i in range(3):
            off[i] = values[place, i] - here[i]
        off[2] = np.arctan2(np.sin(off[2]), np.cos(off[2]))
        total[:] = spread + covariances[place]
        for i in range(3):
            _solve(total, spread[i], gain[i])
        for i in range(3):
            for j in range(3):
                here[i] += gain[i, j] * off[j]
                total[i, j] = spread[i, j]
                for k in range(3):
                    total[i, j] -= gain[i, k] * spread[k, j]
        for i in range(3):
            for j in range(3):
                spread[i, j] = 0.5 * (total[i, j] + total[j, i])
    return chosen
