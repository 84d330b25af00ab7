"""What the rover saw of the ground, laid out like a piece of the map."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.absolute.bending import Strip, bending
from frontends.geometry import yaw_pitch_roll
from frontends.terrain import Grid, TerrainMap, without_rocks

FloatArray = NDArray[np.float64]
Layer = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: Rocks are filtered on cells of at most this side, m.
_FINE_M = 0.125
#: Share of a map cell's fine cells that must be ground for the cell to count.
_LEAST_GROUND = 0.2


@dataclass(frozen=True, slots=True)
class ReliefPatch:
    """Relief and image around an anchor keyframe, in map axes by the poses it was made with.

    Only the relative poses of the keyframes matter: a fix says where the anchor really is,
    and the patch moves with it.

    Attributes
    ----------
    frame
        The anchor.
    x_m, y_m, yaw_rad, z_m
        The anchor's pose that the patch was laid out by.
    grid
        Cells of the map's size.
    height_m
        Ground without rocks, map frame; NaN where unknown.
    ortho
        Grey level; NaN where unknown.
    sigma_m
        1-sigma of the heights, median.
    bending
        (3, 3) covariance of the anchor's x, y and yaw by what the path between the keyframes is
        wrong by, map axes.
    """

    frame: int
    x_m: float
    y_m: float
    yaw_rad: float
    z_m: float
    grid: Grid
    height_m: Layer
    ortho: Layer
    sigma_m: float
    bending: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))

    @property
    def mask(self) -> Mask:
        """Where the ground is known."""
        return np.asarray(np.isfinite(self.height_m))

    @property
    def area_m2(self) -> float:
        """Known ground."""
        return float(np.count_nonzero(self.mask)) * self.grid.cell_m**2

    @property
    def relief_m(self) -> float:
        """RMS height about a plane: what there is to recognise."""
        rows, columns = np.nonzero(self.mask)
        if len(rows) < 10:
            return 0.0
        heights = self.height_m[rows, columns].astype(np.float64)
        plane = np.stack([rows, columns, np.ones(len(rows))], axis=1).astype(np.float64)
        fit, *_ = np.linalg.lstsq(plane, heights, rcond=None)
        return float(np.std(heights - plane @ fit))


def make_patch(
    terrain: TerrainMap,
    map_T_rover: Mapping[int, FloatArray],
    frame: int,
    cell_m: float,
    motions: Sequence[FloatArray] | None = None,
) -> ReliefPatch | None:
    """Lay out the ground that some keyframes saw.

    Parameters
    ----------
    terrain
        Their points.
    map_T_rover
        Poses of the keyframes to use, the anchor's among them.
    frame
        The anchor.
    cell_m
        Cells of the map that it will be compared with.
    motions
        Covariances (3, 3) of x, y and yaw of the motion from each of these keyframes to the next
        one, in the level axes of the former; None: the path is taken as exact.

    Returns
    -------
    ReliefPatch or None
        None when the keyframes saw nothing.
    """
    factor = max(1, math.ceil(cell_m / _FINE_M))
    bounds = terrain.bounds_m(map_T_rover)
    if bounds is None:
        return None
    grid = Grid.covering(bounds, cell_m)
    fine = terrain.rasterise(map_T_rover, cell_m / factor, _inset(grid))
    if fine is None:
        return None
    ground = without_rocks(fine)
    weight = _blocks(ground.astype(np.float32), factor)
    known = weight >= _LEAST_GROUND
    share = np.where(known, weight, 1.0)

    def reduced(values: Layer) -> Layer:
        mean = _blocks(np.where(ground, values, 0.0).astype(np.float32), factor) / share
        return np.where(known, mean, np.nan).astype(np.float32)

    pose = map_T_rover[frame]
    return ReliefPatch(
        frame,
        float(pose[0, 3]),
        float(pose[1, 3]),
        yaw_pitch_roll(pose)[0],
        float(pose[2, 3]),
        grid,
        reduced(fine.height_m),
        reduced(fine.ortho),
        float(np.median(fine.sigma_m[ground])) if ground.any() else float("nan"),
        np.zeros((3, 3)) if motions is None else _bending(terrain, map_T_rover, frame, motions),
    )


def _bending(
    terrain: TerrainMap,
    map_T_rover: Mapping[int, FloatArray],
    anchor: int,
    motions: Sequence[FloatArray],
) -> FloatArray:
    """What the motions' errors do to the place of a patch, see `bending`."""
    frames = sorted(map_T_rover)
    xyyaw, ground, spread, weight = [], [], [], []
    for frame in frames:
        pose = map_T_rover[frame]
        points = terrain.points(frame).points if frame in terrain.frames else np.zeros((0, 3))
        places = points @ pose[:2, :3].T + pose[:2, 3]
        middle = places.mean(axis=0) if len(places) else pose[:2, 3]
        xyyaw.append([pose[0, 3], pose[1, 3], yaw_pitch_roll(pose)[0]])
        ground.append(middle)
        spread.append(np.sum((places - middle) ** 2) / max(len(places), 1))
        weight.append(float(len(places)))
    strip = Strip(np.array(xyyaw), np.array(ground), np.array(spread), np.array(weight), motions)
    return bending(strip, frames.index(anchor))


def _inset(grid: Grid) -> tuple[float, float, float, float]:
    """Bounds a hair inside: rounding must not add a row of cells."""
    west, south, east, north = grid.bounds_m
    hair = 1e-6 * grid.cell_m
    return west + hair, south + hair, east - hair, north - hair


def _blocks(values: Layer, factor: int) -> Layer:
    rows, columns = values.shape[0] // factor, values.shape[1] // factor
    size = (columns, rows)
    cut = np.ascontiguousarray(values[: rows * factor, : columns * factor], dtype=np.float32)
    return np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
