"""The coarse relief that a terrain starts from: none, or a real elevation model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from frontends.errors import InputError

FloatArray = NDArray[np.float64]

#: Cells that a DEM needs along each side to be worth driving on.
_LEAST_CELLS = 20


@dataclass(frozen=True, slots=True)
class BaseRelief:
    """A georeferenced elevation model; the map frame's zero is at its middle.

    Attributes
    ----------
    crs
        Projected reference system, WKT.
    origin
        Map zero in that system: east, north, height, m.
    resolution_m
        Cell size.
    extent
        West, south, east, north edge that it covers, map frame, m.
    """

    crs: str
    origin: tuple[float, float, float]
    resolution_m: float
    extent: tuple[float, float, float, float]
    _spline: RectBivariateSpline

    def at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height at points inside the extent (outside: at its edge), m, by cubic spline."""
        west, south, east, north = self.extent
        inside_x, inside_y = np.clip(x, west, east), np.clip(y, south, north)
        return np.asarray(self._spline.ev(inside_y, inside_x))


def read_base_relief(path: Path) -> BaseRelief:
    """Read a DEM from a GeoTIFF.

    Raises
    ------
    InputError
        When it cannot be read, has no projected CRS, is turned, small or has gaps.
    """
    import rasterio
    from rasterio.errors import RasterioIOError

    remedy = "give a north-up elevation GeoTIFF in a projected system, e.g. a LOLA polar tile"
    try:
        with rasterio.open(path) as file:
            height = file.read(1, masked=True).astype(np.float64)
            transform, crs = file.transform, file.crs
    except RasterioIOError as error:
        raise InputError(f"cannot be read: {error}", source=path, remedy=remedy) from error
    if crs is None or not crs.is_projected:
        raise InputError("has no projected CRS", source=path, remedy=remedy)
    if transform.b or transform.d or transform.e > 0.0 or abs(transform.a + transform.e) > 1e-6:
        raise InputError("is not north-up with square cells", source=path, remedy=remedy)
    if min(height.shape) < _LEAST_CELLS:
        raise InputError(f"has only {height.shape} cells", source=path, remedy=remedy)
    if np.ma.getmaskarray(height).any() or not np.isfinite(height.data).all():
        raise InputError("has gaps", source=path, remedy=remedy)
    cell = float(transform.a)
    rows, columns = height.shape
    east = float(transform.c) + cell * (np.arange(columns) + 0.5)
    north = float(transform.f) - cell * (np.arange(rows) + 0.5)
    origin = (
        round(float(east.mean())),
        round(float(north.mean())),
        round(float(height.data[rows // 2, columns // 2])),
    )
    x, y = east - origin[0], (north - origin[1])[::-1]
    spline = RectBivariateSpline(y, x, height.data[::-1] - origin[2], kx=3, ky=3)
    extent = (float(x[0]), float(y[0]), float(x[-1]), float(y[-1]))
    return BaseRelief(crs.to_wkt(), origin, cell, extent, spline)
