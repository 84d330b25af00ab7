"""How a patch of an image is weighed, and when two patches count as the same."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import njit
from frontends.patch_sampling import AREA, HALF, MIDDLE, SIDE

Floats = NDArray[np.float32]
_u64 = np.uint64

_WINDOW_SIGMA_PX = 6.0
#: Contrast of the later patch to the earlier one.
LEAST_GAIN, LARGEST_GAIN = 0.2, 5.0
#: Largest share of the later patch's variance that the model leaves unexplained.
UNEXPLAINED = 0.4
#: Patches that leave this share unexplained after a few steps are not the same.
HOPELESS = 0.8


def _patch() -> Floats:
    """Weights of a patch's pixels, and their offsets along u and along v, in `HALF`; flat."""
    row, column = (grid.ravel() for grid in np.mgrid[:SIDE, :SIDE].astype(np.float64))
    i, j = column - MIDDLE, row - MIDDLE
    weight = np.exp(-0.5 * (i * i + j * j) / _WINDOW_SIGMA_PX**2)
    return np.concatenate([weight, i / HALF, j / HALF]).astype(np.float32)


PATCH = _patch()
WEIGHT = float(PATCH[:AREA].sum())
#: Variance of a weighted estimate over the inverse of its normal matrix, for like residuals.
WEIGHT_RATIO = float((PATCH[:AREA].astype(np.float64) ** 2).sum()) / WEIGHT


@njit
def weigh(J: Floats, grid: Floats, columns: int, WJ: Floats) -> None:
    """Multiply the columns of a Jacobian, one after the other in J, by the pixels' weights."""
    for a in range(columns):
        row = _u64(a * AREA)
        for k in range(_u64(AREA)):
            WJ[row + k] = grid[k] * J[row + k]
