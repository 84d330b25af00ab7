"""Maps of a run as files: elevation, ortho, slope, roughness and obstacles; a coloured cloud."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.transform import from_origin

from frontends.errors import InputError
from frontends.terrain import Hazards, RoverLimits, TerrainGrid, TerrainMap, find_hazards
from lunar_fg.georeference import CRS_TAG, Georeference
from lunar_fg.results import RunResults
from lunar_fg.run_folder import write_whole
from lunar_fg.terrain_points import poses_by_frame

Layer = NDArray[Any]

#: Values of the obstacle map.
FREE, OBSTACLE, BLOCKED, UNKNOWN = 0, 1, 2, 255


@dataclass(frozen=True, slots=True)
class TerrainProducts:
    """The grids of a run's ground by its trajectory as it stands."""

    terrain: TerrainGrid
    hazards: Hazards


def make_products(
    results: RunResults, terrain: TerrainMap, cell_m: float, limits: RoverLimits
) -> TerrainProducts:
    """Place what the keyframes saw by the run's trajectory and assess it.

    Raises
    ------
    InputError
        Nothing of the ground was seen.
    """
    grid = terrain.rasterise(poses_by_frame(results), cell_m)
    if grid is None:
        raise InputError(
            "dense stereo saw no ground within its useful range", source=results.folder.path,
            remedy="look at the report's matches: are the images dark, or the camera level?",
        )  # fmt: skip
    return TerrainProducts(grid, find_hazards(grid, limits))


def write_geotiffs(
    folder: Path, products: TerrainProducts, georeference: Georeference | None
) -> list[Path]:
    """Write every layer as a cloud-optimised GeoTIFF; returns their paths.

    Raises
    ------
    InputError
        A file cannot be written.
    """
    terrain, written = products.terrain, []
    west, _, _, north = terrain.grid.bounds_m
    if georeference is not None:
        ((west, north),) = georeference.to_plane(np.array([[west, north]]))
    for name, values, nodata, about in _layers(products, georeference):
        path = folder / f"{name}.tif"
        tags = {"DESCRIPTION": about, CRS_TAG: "" if georeference is None else georeference.code}
        try:
            with rasterio.open(
                path, "w", driver="COG", width=terrain.grid.columns, height=terrain.grid.rows,
                count=1, dtype=values.dtype, nodata=nodata, compress="DEFLATE",
                crs=None if georeference is None else georeference.crs.to_wkt(),
                transform=from_origin(west, north, terrain.grid.cell_m, terrain.grid.cell_m),
            ) as raster:  # fmt: skip
                raster.write(values, 1)
                raster.set_band_description(1, about)
                raster.update_tags(**tags)
        except rasterio.errors.RasterioError as error:
            raise InputError(f"cannot be written ({error})", source=path) from error
        written.append(path)
    return written


def write_ply(path: Path, products: TerrainProducts, georeference: Georeference | None) -> int:
    """Write the cells as a coloured cloud (binary PLY); returns how many there are.

    Coordinates are metres of the map frame: with the projection's large numbers, viewers
    that compute in single precision would show stripes.
    """
    terrain = products.terrain
    rows, columns = np.nonzero(terrain.observed)
    x, y = terrain.grid.place(columns.astype(float), rows.astype(float))
    cloud = np.zeros(
        len(rows),
        dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"),
               ("blue", "u1")],
    )  # fmt: skip
    cloud["x"], cloud["y"], cloud["z"] = x, y, terrain.height_m[rows, columns]
    colours = np.repeat(np.clip(terrain.ortho[rows, columns], 0, 255)[:, None], 3, axis=1)
    obstacle = products.hazards.obstacle[rows, columns]
    colours[obstacle] = 0.5 * colours[obstacle] + 0.5 * np.array([255.0, 40.0, 30.0])
    for channel, name in enumerate(("red", "green", "blue")):
        cloud[name] = colours[:, channel].astype(np.uint8)
    where = "local frame"
    if georeference is not None:
        origin = " ".join(f"{value:.3f}" for value in georeference.origin_m)
        where = f"{georeference.code or georeference.crs.name} less origin {origin}"
    head = [
        "ply", "format binary_little_endian 1.0", f"comment metres, {where}",
        "comment obstacles tinted red", f"element vertex {len(cloud)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue")), "end_header", "",
    ]  # fmt: skip
    write_whole(path, "\n".join(head).encode("ascii") + cloud.tobytes())
    return len(cloud)


def _layers(
    products: TerrainProducts, georeference: Georeference | None
) -> Iterator[tuple[str, Layer, float, str]]:
    terrain, hazards = products.terrain, products.hazards
    base = 0.0 if georeference is None else georeference.origin_m[2]
    nan = float("nan")
    yield "dem", (terrain.height_m + base).astype(np.float32), nan, "elevation, m"
    yield "sigma", terrain.sigma_m, nan, "1-sigma of the elevation, m"
    seen = terrain.observed
    grey = np.where(seen, np.clip(np.nan_to_num(terrain.ortho), 1, 255), 0).astype(np.uint8)
    yield "ortho", grey, 0, "grey level, 0 is no data"
    yield "slope", hazards.slope_deg, nan, "slope under the rover's footprint, deg"
    yield "roughness", hazards.roughness_m, nan, "rms height about the footprint's plane, m"
    yield "step", hazards.step_m, nan, "height range under a wheel, m"
    state = np.where(hazards.blocked, BLOCKED, FREE)
    state = np.where(hazards.known, state, UNKNOWN)
    state = np.where(hazards.obstacle, OBSTACLE, state).astype(np.uint8)
    about = "0 free, 1 obstacle, 2 too near to one for the rover's centre, 255 unknown"
    yield "obstacles", state, UNKNOWN, about
    yield "count", terrain.count, 0, "pixels a cell"
    yield "keyframes", terrain.keyframes, 0, "keyframes a cell"
