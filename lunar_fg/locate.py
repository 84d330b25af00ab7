"""Fixes of a finished run on an orbital map, with or without trust in its trajectory."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from frontends.absolute import (
    AbsoluteAdjustment,
    AbsoluteConfig,
    Adjustment,
    Search,
    locate_everywhere,
    make_patch,
)
from frontends.errors import InputError
from frontends.measurements import FloatArray, SunDirection
from frontends.orbital import OrbitalMap
from frontends.terrain import TerrainMap
from lunar_fg.graph.planar import planar_of
from lunar_fg.orbital_files import with_sun
from lunar_fg.results import RunResults
from lunar_fg.terrain_points import POINTS, measure_points, poses_by_frame, read_points

#: Spacing of the keyframes whose ground is measured, m.
_SPACING_M = 0.8


def map_of(
    results: RunResults, ortho: Path | None, dem: Path | None, sun: SunDirection | None
) -> OrbitalMap:
    """Open the map to locate a run on: the files given, else those of the run.

    Raises
    ------
    InputError
        When there are none, or they cannot be read.
    """
    source = results.source
    if ortho is None and dem is None and source is not None:
        ortho, dem = source.ortho, source.dem
    reference = None if source is None else source.map_reference
    crs, origin = (None, (0.0, 0.0, 0.0)) if reference is None else (
        reference.crs, reference.origin_m
    )  # fmt: skip
    orbital = OrbitalMap.open(ortho, dem, crs=crs, origin_m=origin, sun=sun)
    x, y = (float(v) for v in results.trajectory.map_T_rover[0, :2, 3])
    return with_sun(orbital, x, y)


def ground_of(results: RunResults, on_frame: Callable[[], None] | None = None) -> TerrainMap:
    """Ground that a run saw: what `lunar-fg map` kept, else measured anew."""
    kept = results.folder.path / "map" / POINTS
    points = read_points(kept) if kept.is_file() else measure_points(results, _SPACING_M, on_frame)
    if not points:
        raise InputError("has no frame that could be used", source=results.folder.path)
    terrain = TerrainMap()
    terrain.replace(points)
    return terrain


def locate(
    results: RunResults,
    terrain: TerrainMap,
    orbital: OrbitalMap,
    config: AbsoluteConfig | None = None,
    everywhere: tuple[float, float] | None = None,
) -> Iterator[Adjustment]:
    """Locate the ground of each stretch of a run.

    Parameters
    ----------
    results, terrain
        The run and its ground.
    orbital
        The map.
    config
        Settings.
    everywhere
        Half width of the search (m) and of the yaw (rad), instead of the trajectory's own
        uncertainty: for a rover that is lost.

    Yields
    ------
    Adjustment
        One a stretch; its ground is in no other.
    """
    adjustment = AbsoluteAdjustment(orbital, config)
    poses = poses_by_frame(results)
    rows = {frame: row for row, frame in enumerate(poses)}
    for stretch in _stretches({k: poses[k] for k in terrain.frames if k in poses},
                              adjustment.length_m):  # fmt: skip
        anchor = stretch[len(stretch) // 2]
        own = {frame: poses[frame] for frame in stretch}
        patch = make_patch(terrain, own, anchor, adjustment.cell_m)
        if everywhere is not None and patch is not None:
            half, yaw = everywhere
            coarse = make_patch(terrain, own, anchor, adjustment.coarse_cell_m)
            yield locate_everywhere(adjustment, patch, coarse or patch, Search(half, half, yaw))
        else:
            covariance = results.trajectory.covariance
            sigma = np.array([2.0, 2.0, math.radians(1.0)])
            if covariance is not None:
                planar = planar_of(poses[anchor], covariance[rows[anchor]])
                sigma = np.sqrt(np.maximum(np.diag(planar.covariance), 0.0))
            x, y, yaw = np.array([3.0, 3.0, math.radians(2.0)]) + 3.4 * sigma
            search = Search(min(float(x), 40.0), min(float(y), 40.0), min(float(yaw), math.pi))
            yield adjustment.locate(patch, anchor, search)


def _stretches(poses: dict[int, FloatArray], length_m: float) -> list[list[int]]:
    """Keyframes in stretches of a length; a short rest joins the last one."""
    stretches: list[list[int]] = [[]]
    driven, last = 0.0, None
    for frame, pose in poses.items():
        if last is not None:
            driven += float(np.linalg.norm(pose[:2, 3] - last))
        last = pose[:2, 3]
        if driven > length_m:
            stretches.append([])
            driven = 0.0
        stretches[-1].append(frame)
    if len(stretches) > 1 and driven < 0.5 * length_m:
        stretches[-2].extend(stretches.pop())
    return [stretch for stretch in stretches if len(stretch) >= 2]
