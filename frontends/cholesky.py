"""Cholesky factor of a few unknowns' normal matrix, for kernels that solve thousands of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import njit

FloatArray = NDArray[np.float64]


@njit
def factorise(lower: FloatArray, prior: FloatArray) -> bool:
    """Replace the lower triangle of a normal matrix, with `prior` added on its diagonal.

    Its Cholesky factor takes its place, with the inverse of the diagonal; False where the matrix
    is not positive definite.
    """
    for a in range(len(prior)):
        lower[a, a] += prior[a]
        least = 1e-6 * lower[a, a] + 1e-6
        for b in range(a + 1):
            entry = lower[a, b]
            for c in range(b):
                entry -= lower[a, c] * lower[b, c]
            if b < a:
                lower[a, b] = entry * lower[b, b]
            elif entry <= least:
                return False
            else:
                lower[a, a] = 1.0 / np.sqrt(entry)
    return True


@njit
def solve(lower: FloatArray, x: FloatArray) -> None:
    """Replace x by the solution of the normal equations whose factor is given."""
    unknowns = len(x)
    for a in range(unknowns):
        for b in range(a):
            x[a] -= lower[a, b] * x[b]
        x[a] *= lower[a, a]
    for a in range(unknowns - 1, -1, -1):
        for b in range(a + 1, unknowns):
            x[a] -= lower[b, a] * x[b]
        x[a] *= lower[a, a]
