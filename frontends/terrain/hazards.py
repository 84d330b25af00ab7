"""Slope, roughness and obstacles of an elevation grid, for a rover of given size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Gt
from numpy.typing import NDArray
from scipy import ndimage

from frontends.terrain.map import TerrainGrid

FloatArray = NDArray[np.float64]
Layer = NDArray[np.float32]

#: Share of a footprint that must be observed for its plane to be fitted.
_LEAST_OBSERVED = 0.3


@dataclass(frozen=True, slots=True)
class RoverLimits:
    """The rover's size and what it can drive over.

    Attributes
    ----------
    length_m, width_m
        Footprint.
    max_slope_deg
        Steepest slope of the ground under the footprint.
    max_step_m
        Largest step (height range) under a wheel, within `wheel_m`.
    wheel_m
        Diameter of a wheel.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "allow_inf_nan": False}

    length_m: Annotated[float, Gt(0)] = 1.5
    width_m: Annotated[float, Gt(0)] = 1.0
    max_slope_deg: Annotated[float, Gt(0)] = 20.0
    max_step_m: Annotated[float, Gt(0)] = 0.2
    wheel_m: Annotated[float, Gt(0)] = 0.3


@dataclass(frozen=True, slots=True)
class Hazards:
    """Layers over the terrain's grid; NaN where too little was observed.

    Attributes
    ----------
    slope_deg
        Slope of the plane fitted to the footprint around a cell.
    roughness_m
        Root mean square height about that plane.
    step_m
        Highest less lowest height within a wheel's diameter.
    obstacle
        Where slope or step exceed the limits; False where unknown.
    blocked
        Where the rover's centre may not go: an obstacle lies under its footprint, in
        whatever direction it stands.
    known
        Where slope and step are known.
    """

    slope_deg: Layer
    roughness_m: Layer
    step_m: Layer
    obstacle: NDArray[np.bool_]
    blocked: NDArray[np.bool_]
    known: NDArray[np.bool_]


def find_hazards(terrain: TerrainGrid, limits: RoverLimits | None = None) -> Hazards:
    """Assess where a rover can drive.

    A plane is fitted by least squares to the observed cells in a square of the footprint's
    mean side; the step is a morphological range over a wheel.
    """
    limits = limits or RoverLimits()
    cell = terrain.grid.cell_m
    observed = terrain.observed
    size = _odd(0.5 * (limits.length_m + limits.width_m) / cell)
    slope, roughness = _planes(terrain.height_m, observed, size, cell)
    step = _steps(terrain.height_m, observed, _odd(limits.wheel_m / cell))
    known = np.isfinite(slope) & np.isfinite(step)
    with np.errstate(invalid="ignore"):
        obstacle = (slope > limits.max_slope_deg) | (step > limits.max_step_m)
    reach = round(0.5 * float(np.hypot(limits.length_m, limits.width_m)) / cell)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    blocked = ndimage.binary_dilation(obstacle, x**2 + y**2 <= reach**2)
    return Hazards(slope, roughness, step, obstacle, blocked, known)


def _odd(cells: float) -> int:
    """Nearest odd window that has a plane or a range: 3 at least."""
    return max(3, 2 * round(0.5 * (cells - 1)) + 1)


def _planes(
    height: Layer, observed: NDArray[np.bool_], size: int, cell_m: float
) -> tuple[Layer, Layer]:
    """Slope and residual of the plane fitted to the observed cells of each window.

    The sums of the normal equations over a window are box filters of the monomials; heights
    are taken from their mean first, for precision.
    """
    valid = observed.astype(np.float64)
    centre = float(height[observed].mean()) if observed.any() else 0.0
    z = np.where(observed, height, 0.0).astype(np.float64) - centre * valid
    offset = np.arange(size) - size // 2
    ones = np.ones(size)

    def window(values: FloatArray, x_power: int, y_power: int) -> FloatArray:
        along = ndimage.correlate1d(values, ones * offset**x_power, axis=1, mode="constant")
        return np.asarray(
            ndimage.correlate1d(along, ones * offset**y_power, axis=0, mode="constant")
        )

    n = window(valid, 0, 0)
    x, y = window(valid, 1, 0), window(valid, 0, 1)
    xx, xy, yy = window(valid, 2, 0), window(valid, 1, 1), window(valid, 0, 2)
    normal = np.stack(
        [np.stack([n, x, y], -1), np.stack([x, xx, xy], -1), np.stack([y, xy, yy], -1)], -2
    )
    right = np.stack([window(z, 0, 0), window(z, 1, 0), window(z, 0, 1)], -1)
    determinant = np.linalg.det(normal)
    enough = n >= max(4.0, _LEAST_OBSERVED * size**2)
    # a line of cells leaves the slope across it open
    enough &= determinant > 1e-3 * np.maximum(n, 1.0) ** 3
    solved = np.zeros_like(right)
    solved[enough] = np.linalg.solve(normal[enough], right[enough][..., None])[..., 0]
    slope = np.degrees(np.arctan(np.hypot(solved[..., 1], solved[..., 2]) / cell_m))
    squares = window(z**2, 0, 0) - np.einsum("ijk,ijk->ij", solved, right)
    rough = np.sqrt(np.maximum(squares, 0.0) / np.maximum(n, 1.0))
    return (
        np.where(enough, slope, np.nan).astype(np.float32),
        np.where(enough, rough, np.nan).astype(np.float32),
    )


def _steps(height: Layer, observed: NDArray[np.bool_], size: int) -> Layer:
    high = ndimage.maximum_filter(np.where(observed, height, -np.inf), size)
    low = ndimage.minimum_filter(np.where(observed, height, np.inf), size)
    seen = ndimage.uniform_filter(observed.astype(np.float64), size)
    step = np.where(observed & (seen >= _LEAST_OBSERVED), high, np.nan)
    step -= np.where(observed, low, 0.0)
    return np.asarray(step, dtype=np.float32)
