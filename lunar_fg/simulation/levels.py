"""The ground as nested grids: fine along the drive, coarse to the horizon, without seams."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lunar_fg.simulation.terrain import Extent, GridFrame, Terrain

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Node spacings, m; each divides the one before.
SPACINGS_M = (8.0, 1.0, 0.2, 0.05)
#: Ground that is meshed at each spacing but the first: distance from the drive, m.
_FINE_M = 9.0
_MIDDLE_M = 250.0
_FADE_CELLS = 8.0


@dataclass(frozen=True, slots=True)
class Level:
    """One grid of the ground.

    Attributes
    ----------
    frame
        Its nodes.
    height
        (rows, columns) float64, m.
    shading
        (rows, columns, 3) float32: slope to east, slope to north, albedo factor.
    cells
        (rows - 1, columns - 1): which cells are ground; the others belong to a finer or a
        coarser level.
    """

    frame: GridFrame
    height: FloatArray
    shading: NDArray[np.float32]
    cells: Mask

    def at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height at points by bilinear interpolation (at the edge outside), m."""
        return _bilinear(self.frame, self.height, x, y)

    def mesh(self, middle: FloatArray) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Vertices relative to `middle`, (V, 3), and triangles, (F, 3), of its cells."""
        rows, columns = self.height.shape
        south, west = np.nonzero(self.cells)
        a = (south * columns + west).astype(np.int64)
        corners = np.stack([a, a + 1, a + columns, a + columns + 1], axis=1)
        used = np.zeros(rows * columns, dtype=np.bool_)
        used[corners.ravel()] = True
        new_index = np.cumsum(used, dtype=np.int64) - 1
        i, j = np.divmod(np.nonzero(used)[0], columns)
        vertices = np.empty((len(i), 3), dtype=np.float32)
        vertices[:, 0] = self.frame.x0 + self.frame.spacing_m * j - middle[0]
        vertices[:, 1] = self.frame.y0 + self.frame.spacing_m * i - middle[1]
        vertices[:, 2] = self.height[i, j] - middle[2]
        c = new_index[corners].astype(np.int32)
        triangles = np.concatenate([c[:, [0, 1, 2]], c[:, [1, 3, 2]]])
        return vertices, triangles


def make_levels(terrain: Terrain, drive: FloatArray, near: Extent) -> tuple[Level, ...]:
    """Grids of the ground around a drive, coarsest first.

    Parameters
    ----------
    terrain
        The ground.
    drive
        (N, 2) points of the drive, m, closer together than the fine ground is wide.
    near
        Extent of the orbital map: meshed at the second finest spacing.
    """
    west, south, east, north = near
    middle = (west - _MIDDLE_M, south - _MIDDLE_M, east + _MIDDLE_M, north + _MIDDLE_M)
    reach = _FINE_M + SPACINGS_M[2]
    low, high = drive.min(axis=0) - reach, drive.max(axis=0) + reach
    along = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    levels: list[Level] = []
    frame = _inside(terrain.extent, SPACINGS_M[0])
    everything = np.ones((frame.rows - 1, frame.columns - 1), dtype=np.bool_)
    levels.append(_level(terrain, frame, everything, None))
    for spacing, extent in zip(SPACINGS_M[1:], (middle, near, along), strict=True):
        parent = levels[-1]
        taken = _cells_within(parent.frame, extent) & parent.cells
        if extent is along:
            taken &= _cells_near(parent.frame, drive, _FINE_M)
        levels[-1] = Level(parent.frame, parent.height, parent.shading, parent.cells & ~taken)
        frame, cells = _refined(parent.frame, taken, spacing)
        levels.append(_level(terrain, frame, cells, parent))
    return tuple(levels)


def _level(terrain: Terrain, frame: GridFrame, cells: Mask, parent: Level | None) -> Level:
    height = terrain.height(frame)
    if parent is not None:
        # towards the border the relief becomes the parent's own facets, so no gap opens
        padded = np.pad(cells, 1).astype(np.uint8)
        depth = cv2.distanceTransform(padded, cv2.DIST_L2, 3)
        node_depth = np.minimum(
            np.minimum(depth[:-1, :-1], depth[1:, :-1]), np.minimum(depth[:-1, 1:], depth[1:, 1:])
        )
        share = np.clip(node_depth / _FADE_CELLS, 0.0, 1.0)
        share = share * share * (3.0 - 2.0 * share)
        x, y = frame.nodes()
        height = share * height + (1.0 - share) * _on_facets(parent, x, y)
    to_north, to_east = np.gradient(height, frame.spacing_m)
    shading = np.stack([to_east, to_north, terrain.albedo(frame)], axis=2).astype(np.float32)
    return Level(frame, height, shading, cells)


def _inside(extent: Extent, spacing: float) -> GridFrame:
    x0, y0 = (float(np.ceil(value / spacing) * spacing) for value in extent[:2])
    columns, rows = (
        int(np.floor((extent[k + 2] - start) / spacing)) + 1 for k, start in enumerate((x0, y0))
    )
    return GridFrame(x0, y0, spacing, rows, columns)


def _cells_within(frame: GridFrame, extent: Extent) -> Mask:
    x = frame.x0 + frame.spacing_m * (np.arange(frame.columns - 1) + 0.5)
    y = frame.y0 + frame.spacing_m * (np.arange(frame.rows - 1) + 0.5)
    return np.asarray(
        ((y >= extent[1]) & (y <= extent[3]))[:, None]
        & ((x >= extent[0]) & (x <= extent[2]))[None, :]
    )


def _cells_near(frame: GridFrame, drive: FloatArray, distance: float) -> Mask:
    away = np.ones((frame.rows - 1, frame.columns - 1), dtype=np.uint8)
    j, i = np.floor((drive - [frame.x0, frame.y0]) / frame.spacing_m).astype(int).T
    away[np.clip(i, 0, frame.rows - 2), np.clip(j, 0, frame.columns - 2)] = 0
    return np.asarray(cv2.distanceTransform(away, cv2.DIST_L2, 5) * frame.spacing_m <= distance)


def _refined(parent: GridFrame, taken: Mask, spacing: float) -> tuple[GridFrame, Mask]:
    """Finer grid over the bounding box of the taken cells, and its own cells."""
    ratio = round(parent.spacing_m / spacing)
    rows, columns = np.nonzero(taken.any(axis=1))[0], np.nonzero(taken.any(axis=0))[0]
    part = taken[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    frame = GridFrame(
        parent.x0 + parent.spacing_m * float(columns[0]),
        parent.y0 + parent.spacing_m * float(rows[0]),
        spacing,
        part.shape[0] * ratio + 1,
        part.shape[1] * ratio + 1,
    )
    return frame, part.repeat(ratio, axis=0).repeat(ratio, axis=1)


def _split(
    frame: GridFrame, x: FloatArray, y: FloatArray
) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray, FloatArray]:
    u = np.clip((x - frame.x0) / frame.spacing_m, 0.0, frame.columns - 1.0)
    v = np.clip((y - frame.y0) / frame.spacing_m, 0.0, frame.rows - 1.0)
    j = np.minimum(u.astype(np.int64), frame.columns - 2)
    i = np.minimum(v.astype(np.int64), frame.rows - 2)
    return i, j, u - j, v - i


def _bilinear(frame: GridFrame, field: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    i, j, u, v = _split(frame, x, y)
    south = field[i, j] + u * (field[i, j + 1] - field[i, j])
    north = field[i + 1, j] + u * (field[i + 1, j + 1] - field[i + 1, j])
    return np.asarray(south + v * (north - south))


def _on_facets(parent: Level, x: FloatArray, y: FloatArray) -> FloatArray:
    """Height on the parent's triangles: south-west and north-east of each cell's diagonal."""
    i, j, u, v = _split(parent.frame, x, y)
    h = parent.height
    sw, se, nw, ne = h[i, j], h[i, j + 1], h[i + 1, j], h[i + 1, j + 1]
    lower = sw + u * (se - sw) + v * (nw - sw)
    upper = ne + (1.0 - u) * (nw - ne) + (1.0 - v) * (se - ne)
    return np.where(u + v <= 1.0, lower, upper)
