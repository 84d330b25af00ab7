"""Rocks out of a stereo relief: their seen faces alone would mislead a comparison.

From the ground only the near faces of rocks are seen, from orbit their tops and shadows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel
from frontends.terrain.map import TerrainGrid

#: Heights kept, against the local median (m): below it, above it.
BELOW_M, ABOVE_M = -0.08, 0.04
_WINDOW_M = 1.0
#: Cells of a window that must be observed for its median to count.
_LEAST_SHARE = 0.15


def without_rocks(
    terrain: TerrainGrid, below_m: float = BELOW_M, above_m: float = ABOVE_M
) -> NDArray[np.bool_]:
    """Tell which observed cells are ground: near the median of the metre around them.

    Parameters
    ----------
    terrain
        Cells of at most 0.25 m; rocks are lost in coarser ones.
    below_m, above_m
        Limits of the height less the local median, m.

    Returns
    -------
    NDArray[np.bool_]
        (rows, columns); False where nothing was observed.
    """
    half = max(1, round(0.5 * _WINDOW_M / terrain.grid.cell_m))
    observed = terrain.observed
    heights = np.where(observed, terrain.height_m, 0.0).astype(np.float32)
    local = np.zeros_like(heights)
    _median(heights, observed, half, round(_LEAST_SHARE * (2 * half + 1) ** 2), local)
    difference = heights - local
    return np.asarray(observed & (difference >= below_m) & (difference <= above_m))


@kernel
def _median(
    values: NDArray[np.float32],
    valid: NDArray[np.bool_],
    half: int,
    least: int,
    out: NDArray[np.float32],
) -> None:
    """Median of the valid values in a square window; 1e9 where there are too few."""
    rows, columns = values.shape
    window = np.empty((2 * half + 1) ** 2, np.float32)
    for i in range(rows):
        for j in range(columns):
            if not valid[i, j]:
                continue
            count = 0
            for a in range(max(0, i - half), min(rows, i + half + 1)):
                for b in range(max(0, j - half), min(columns, j + half + 1)):
                    if valid[a, b]:
                        window[count] = values[a, b]
                        count += 1
            out[i, j] = np.float32(1e9) if count < least else np.median(window[:count])
