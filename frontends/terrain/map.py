"""Elevation and ortho grids from the points of many keyframes, placed by their poses.

Each keyframe's points stay in the rover's axes of that keyframe. A grid is made on demand
from the poses as they stand then, so a corrected trajectory gives a corrected map, and
nothing is smeared.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frontends.errors import InputError
from frontends.geometry import transform_points
from frontends.terrain.dense import SurfacePoints
from frontends.terrain.grid import Grid

FloatArray = NDArray[np.float64]
Layer = NDArray[np.float32]

#: Least 1-sigma of a height, m: below it the pose and the cell's own relief rule.
_LEAST_SIGMA_M = 0.005


@dataclass(frozen=True, slots=True)
class TerrainGrid:
    """Layers over one `Grid`; cells without observation hold NaN, or 0 in `count`.

    Attributes
    ----------
    grid
        Where the cells lie.
    height_m
        Elevation model, map frame.
    sigma_m
        1-sigma of the height, from the stereo noise and from how far the keyframes
        disagree; the error of the trajectory as a whole is not in it.
    ortho
        Grey level, 0 to 255.
    count
        Pixels that a cell is made from.
    keyframes
        Keyframes that saw the cell.
    """

    grid: Grid
    height_m: Layer
    sigma_m: Layer
    ortho: Layer
    count: NDArray[np.int32]
    keyframes: NDArray[np.int32]

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Where there is a height."""
        return np.asarray(self.count > 0)

    @property
    def observed_m2(self) -> float:
        """Area that was observed."""
        return float(np.count_nonzero(self.count)) * self.grid.cell_m**2


class TerrainMap:
    """Keeps the points of keyframes and makes grids of them."""

    def __init__(self) -> None:
        self._points: dict[int, SurfacePoints] = {}

    def __len__(self) -> int:
        return len(self._points)

    @property
    def frames(self) -> tuple[int, ...]:
        """Keyframes that the map holds points of, in order."""
        return tuple(sorted(self._points))

    def add(self, points: SurfacePoints) -> None:
        """Take in what a keyframe saw; an earlier version of the same keyframe goes."""
        if not (np.isfinite(points.points).all() and (points.sigma_m > 0).all()):
            raise InputError(
                "points must be finite and their sigmas positive",
                source=f"keyframe {points.frame}",
                field="surface points",
            )
        self._points[points.frame] = points

    def replace(self, points: Iterable[SurfacePoints]) -> None:
        """Let go of all points and keep these: they were corrected."""
        self._points = {}
        for item in points:
            self.add(item)

    def points(self, frame: int) -> SurfacePoints:
        """Points of one keyframe."""
        return self._points[frame]

    def bounds_m(
        self, map_T_rover: Mapping[int, FloatArray]
    ) -> tuple[float, float, float, float] | None:
        """Extent (x and y from, x and y to) of the keyframes that have a pose; None if empty."""
        lows, highs = [], []
        for _, placed in self._placed(map_T_rover):
            if len(placed):
                lows.append(placed[:, :2].min(axis=0))
                highs.append(placed[:, :2].max(axis=0))
        if not lows:
            return None
        low, high = np.min(lows, axis=0), np.max(highs, axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def rasterise(
        self,
        map_T_rover: Mapping[int, FloatArray],
        cell_m: float,
        bounds_m: tuple[float, float, float, float] | None = None,
    ) -> TerrainGrid | None:
        """Grid of the ground by these poses.

        Parameters
        ----------
        map_T_rover
            (4, 4) pose by keyframe; keyframes without one are left out, so this also
            chooses a part of the traverse. Any frame may take the place of the map.
        cell_m
            Side of a cell.
        bounds_m
            Extent; all there is by default.

        Returns
        -------
        TerrainGrid or None
            None when no point lies within.
        """
        bounds = bounds_m or self.bounds_m(map_T_rover)
        if bounds is None:
            return None
        grid = Grid.covering(bounds, cell_m)
        cells = grid.rows * grid.columns
        total = _Sums(cells)
        for points, placed in self._placed(map_T_rover):
            column, row = grid.pixel(placed[:, 0], placed[:, 1])
            column, row = np.rint(column), np.rint(row)
            inside = (column >= 0) & (column < grid.columns) & (row >= 0) & (row < grid.rows)
            if inside.any():
                index = (row[inside] * grid.columns + column[inside]).astype(np.int64)
                total.add(index, placed[inside, 2], points, inside)
        return total.grid(grid) if total.any else None

    def _placed(
        self, map_T_rover: Mapping[int, FloatArray]
    ) -> Iterable[tuple[SurfacePoints, FloatArray]]:
        for frame in self.frames:
            pose = map_T_rover.get(frame)
            if pose is not None:
                points = self._points[frame]
                yield points, transform_points(pose, points.points.astype(np.float64))


class _Sums:
    """Running sums a cell.

    Points of one keyframe in one cell share their errors: they count as one height with
    their mean sigma. Different keyframes are independent.
    """

    def __init__(self, cells: int) -> None:
        self._weight, self._height, self._square, self._grey = np.zeros((4, cells))
        self._count, self._keyframes = np.zeros((2, cells), dtype=np.int32)

    @property
    def any(self) -> bool:
        return bool(self._count.any())

    def add(
        self,
        index: NDArray[np.int64],
        height: FloatArray,
        points: SurfacePoints,
        inside: NDArray[np.bool_],
    ) -> None:
        cells, member = np.unique(index, return_inverse=True)
        pixels = points.count[inside].astype(np.float64)
        n = np.bincount(member, pixels)
        z = np.bincount(member, pixels * height) / n
        sigma = np.bincount(member, pixels * points.sigma_m[inside]) / n
        weight = 1.0 / (sigma**2 + _LEAST_SIGMA_M**2)
        self._weight[cells] += weight
        self._height[cells] += weight * z
        self._square[cells] += weight * z**2
        self._grey[cells] += weight * np.bincount(member, pixels * points.grey[inside]) / n
        self._count[cells] += n.astype(np.int32)
        self._keyframes[cells] += 1

    def grid(self, grid: Grid) -> TerrainGrid:
        seen = self._count > 0
        weight = np.where(seen, self._weight, np.nan)
        height = self._height / weight
        # the keyframes' disagreement beyond their sigmas, by its chi-square
        chi2 = np.maximum(self._square - weight * height**2, 0.0)
        excess = np.maximum(chi2 / np.maximum(self._keyframes - 1, 1), 1.0)

        def layer(values: FloatArray) -> Layer:
            return values.reshape(grid.shape).astype(np.float32)

        return TerrainGrid(
            grid,
            layer(height),
            layer(np.sqrt(excess / weight)),
            layer(self._grey / weight),
            self._count.reshape(grid.shape),
            self._keyframes.reshape(grid.shape),
        )
