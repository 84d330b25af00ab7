"""Maps from orbit: ortho image and elevation model, read by windows in the local map frame."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.enums import Resampling
from rasterio.errors import CRSError, RasterioError
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT

from frontends.errors import InputError
from frontends.measurements import SunDirection
from frontends.raster_formats import driver_of
from frontends.terrain.grid import Grid

Layer = NDArray[np.float32]

#: Names under which makers of maps state the light, lower case without separators.
_AZIMUTH_TAGS = ("sunazimuthdeg", "sunazimuth", "subsolarazimuth", "solarazimuth")
_ELEVATION_TAGS = ("sunelevationdeg", "sunelevation", "solarelevation")
_INCIDENCE_TAGS = ("incidenceangle", "solarincidence", "incidence")


@dataclass(frozen=True, slots=True)
class MapWindow:
    """A part of a map.

    Attributes
    ----------
    grid
        Where its cells lie, local map frame.
    values
        (rows, columns): grey level in the file's unit, or height in m, map frame; NaN
        outside of the map and where the file has no data.
    """

    grid: Grid
    values: Layer


@dataclass(frozen=True, slots=True)
class Raster:
    """One band of a georeferenced file, read in the local map frame.

    Anything that GDAL reads; blocks and overviews are used, so a window of a large file
    costs what the window costs. Files in another CRS are warped as they are read.

    Attributes
    ----------
    path
        The file.
    crs
        Of the map frame; None: the file's own.
    origin_m
        East, north and height of the map frame's zero in that CRS.
    gsd_m
        Ground distance of the file's pixels, in the map frame.
    bounds_m
        Extent in the map frame: x and y from, x and y to.
    tags
        What the file says of itself.
    """

    path: Path
    crs: CRS | None
    origin_m: tuple[float, float, float]
    gsd_m: float
    bounds_m: tuple[float, float, float, float]
    tags: dict[str, str]

    @classmethod
    def open(
        cls,
        path: Path | str,
        crs: str | None = None,
        origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> Raster:
        """Check that a file is a map and find out where it lies.

        Parameters
        ----------
        path
            GeoTIFF, ISIS cube, ...
        crs
            CRS of the map frame as code or WKT; the file's own by default.
        origin_m
            Map frame's zero in that CRS.

        Raises
        ------
        InputError
            When the file cannot be read, lies nowhere, or cannot be brought to the CRS.
        """
        path = Path(path)
        try:
            target = None if crs is None else CRS.from_user_input(crs)
        except (CRSError, ValueError) as error:
            raise InputError(f"{crs!r} is not a CRS", source="map", field="crs") from error
        try:
            with rasterio.open(path, driver=driver_of(path)) as source:
                if source.count < 1 or source.transform.is_identity:
                    raise InputError(
                        "says nowhere where it lies",
                        source=path,
                        field="transform",
                        remedy="georeference it: gdal_translate -a_srs CRS -a_ullr W N E S",
                    )
                tags = {str(k): str(v) for k, v in {**source.tags(), **source.tags(1)}.items()}
                with _in_crs(source, target) as warped:
                    gsd = math.sqrt(abs(warped.transform.determinant))
                    box = warped.bounds
        except (RasterioError, CRSError) as error:
            problem = f"cannot be read as a map: {' '.join(str(error).split())}"
            raise InputError(problem, source=path, remedy="gdalinfo tells more") from error
        east, north, _ = origin_m
        bounds = (box.left - east, box.bottom - north, box.right - east, box.top - north)
        return cls(path, target, origin_m, gsd, bounds, tags)

    def covers(self, x_m: float, y_m: float) -> bool:
        """Whether a place lies within the file."""
        west, south, east, north = self.bounds_m
        return west <= x_m <= east and south <= y_m <= north

    def window(
        self, bounds_m: tuple[float, float, float, float], cell_m: float | None = None
    ) -> MapWindow:
        """Read a part of the file.

        Parameters
        ----------
        bounds_m
            x and y from, x and y to, map frame; may reach beyond the file.
        cell_m
            Cells to read it in: averaged where coarser than the file, interpolated
            where finer; the file's own by default.

        Raises
        ------
        InputError
            When the file cannot be read, or the window is empty.
        """
        return self.on(Grid.covering(bounds_m, cell_m or self.gsd_m))

    def on(self, grid: Grid) -> MapWindow:
        """Read the file at the cells of a grid."""
        east, north, _ = self.origin_m
        west, _, _, top = grid.bounds_m
        transform = Affine(grid.cell_m, 0.0, west + east, 0.0, -grid.cell_m, top + north)
        how = Resampling.average if grid.cell_m > 1.5 * self.gsd_m else Resampling.bilinear
        try:
            with (
                _at_scale(self.path, grid.cell_m / self.gsd_m) as source,
                WarpedVRT(
                    source,
                    src_crs=source.crs or _LOCAL,
                    crs=self.crs or source.crs or _LOCAL,
                    transform=transform,
                    width=grid.columns,
                    height=grid.rows,
                    resampling=how,
                    dtype="float32",
                    src_nodata=source.nodata,
                    nodata=float("nan"),
                    add_alpha=False,
                ) as vrt,
            ):
                values = vrt.read(1).astype(np.float32)
                valid = np.isfinite(values)
                if source.nodata is None:
                    valid &= self._inside(grid)
                scale, offset = float(source.scales[0]), float(source.offsets[0])
        except (RasterioError, CRSError) as error:
            problem = f"cannot be read: {' '.join(str(error).split())}"
            raise InputError(problem, source=self.path) from error
        values = values * np.float32(scale) + np.float32(offset)
        return MapWindow(grid, np.where(valid, values, np.float32("nan")))

    def _inside(self, grid: Grid) -> NDArray[np.bool_]:
        """Cells within the file's bounds: without a no-data value the warp fills with zeros."""
        x, y = grid.centres()
        west, south, east, north = self.bounds_m
        return np.asarray(
            ((y >= south) & (y <= north))[:, None] & ((x >= west) & (x <= east))[None, :]
        )


def _at_scale(path: Path, ratio: float) -> Any:
    """Open the coarsest overview that is still finer than `ratio` pixels a cell, or the file.

    The warper itself reads full resolution: a survey of a large map would read all of it.
    """
    source = rasterio.open(path, driver=driver_of(path))
    levels = [k for k, factor in enumerate(source.overviews(1)) if factor <= ratio]
    if not levels:
        return source
    source.close()
    return rasterio.open(path, driver=driver_of(path), OVERVIEW_LEVEL=levels[-1])


#: Files without a CRS, read as they are: any projected CRS will do.
_LOCAL = CRS.from_wkt(
    'LOCAL_CS["local",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
)


def _in_crs(source: Any, target: CRS | None) -> AbstractContextManager[Any]:
    """Give the file in the target CRS, as it is where that is its own."""
    if target is None or source.crs is None or source.crs == target:
        return source  # type: ignore[no-any-return]
    return WarpedVRT(source, crs=target)  # type: ignore[no-any-return]


@dataclass(frozen=True, slots=True)
class OrbitalMap:
    """What is known of a place from orbit.

    Attributes
    ----------
    ortho
        Image from above, where there is one.
    dem
        Elevation model, where there is one; heights are the file's less the origin's.
    sun
        Light of the ortho image; None: unknown.
    """

    ortho: Raster | None
    dem: Raster | None = None
    sun: SunDirection | None = None

    @classmethod
    def open(
        cls,
        ortho: Path | str | None,
        dem: Path | str | None = None,
        *,
        crs: str | None = None,
        origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
        sun: SunDirection | None = None,
    ) -> OrbitalMap:
        """Open the files; the sun comes from the ortho's tags where it is not given.

        Raises
        ------
        InputError
            See `Raster.open`; also when neither file is given.
        """
        if ortho is None and dem is None:
            raise InputError(
                "is neither an image nor an elevation model", source="orbital map",
                remedy="give --map, --dem or both",
            )  # fmt: skip
        image = None if ortho is None else Raster.open(ortho, crs, origin_m)
        heights = None if dem is None else Raster.open(dem, crs, origin_m)
        if sun is None and image is not None:
            sun = sun_of_tags(image.tags)
        return cls(image, heights, sun)

    @property
    def gsd_m(self) -> float:
        """Ground distance of the finest layer's pixels."""
        layer = self.ortho or self.dem
        assert layer is not None
        return layer.gsd_m

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """Extent of the finest layer, map frame."""
        layer = self.ortho or self.dem
        assert layer is not None
        return layer.bounds_m

    def height(
        self, bounds_m: tuple[float, float, float, float], cell_m: float | None = None
    ) -> MapWindow | None:
        """Elevations of a window, m, map frame; None without a DEM."""
        return None if self.dem is None else self._less_origin(self.dem.window(bounds_m, cell_m))

    def height_on(self, grid: Grid) -> MapWindow | None:
        """Elevations at the cells of a grid, m, map frame; None without a DEM."""
        return None if self.dem is None else self._less_origin(self.dem.on(grid))

    def _less_origin(self, window: MapWindow) -> MapWindow:
        assert self.dem is not None
        return MapWindow(window.grid, window.values - np.float32(self.dem.origin_m[2]))


def sun_of_tags(tags: dict[str, str]) -> SunDirection | None:
    """Light of an image by the tags of its file, where they name azimuth and elevation."""
    plain = {key.lower().replace("_", "").replace(" ", ""): text for key, text in tags.items()}

    def number(names: tuple[str, ...]) -> float | None:
        for name in names:
            try:
                value = float(plain.get(name, ""))
            except ValueError:
                continue
            if math.isfinite(value):
                return value
        return None

    azimuth, elevation = number(_AZIMUTH_TAGS), number(_ELEVATION_TAGS)
    incidence = number(_INCIDENCE_TAGS)
    if elevation is None and incidence is not None:
        elevation = 90.0 - incidence
    if azimuth is None or elevation is None:
        return None
    return SunDirection(azimuth, elevation)
