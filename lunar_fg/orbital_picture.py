"""Windows of a map as grey pictures in the map frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.windows import Window, from_bounds

from frontends.errors import InputError
from lunar_fg.georeference import Georeference, read_crs, require_same

FloatArray = NDArray[np.float64]

_LONGEST_PX = 1400
_NO_DATA_GREY = 200.0


@dataclass(frozen=True, slots=True, eq=False)
class MapGrey:
    """A grey picture and where it lies.

    Attributes
    ----------
    pixels
        (H, W) uint8, row 0 in the north.
    x_m, y_m
        Left and right, bottom and top edge, map frame.
    """

    pixels: NDArray[np.uint8]
    x_m: tuple[float, float]
    y_m: tuple[float, float]


def map_grey(path: Path, georeference: Georeference, low: FloatArray, high: FloatArray) -> MapGrey:
    """Window of a map between two corners (x, y) of the map frame.

    Raises
    ------
    InputError
        The map cannot be read, is of another body or projection, or does not reach there.
    """
    require_same(georeference, read_crs(path), path)
    plane = georeference.to_plane(np.array([low, high]))
    values, bounds = read_window(path, plane[0], plane[1], _LONGEST_PX)
    corners = georeference.to_map(np.array(bounds).reshape(2, 2))
    return MapGrey(
        grey_levels(values), (corners[0, 0], corners[1, 0]), (corners[0, 1], corners[1, 1])
    )


def read_window(
    path: Path, low: FloatArray, high: FloatArray, longest_px: int, *, whole: bool = False
) -> tuple[FloatArray, tuple[float, float, float, float]]:
    """Values of a map between two corners of its plane, NaN without data; and their bounds.

    With `whole`, what lies beyond the map's edge is there too, as NaN.

    Raises
    ------
    InputError
        The map cannot be read, is not north-up, or has nothing there.
    """
    try:
        with rasterio.open(path) as raster:
            if raster.transform.b or raster.transform.d:
                raise InputError("is not north-up", source=path, remedy="gdalwarp makes it so")
            box = from_bounds(*low, *high, raster.transform).round_offsets().round_lengths()
            try:
                window = box.intersection(Window(0, 0, raster.width, raster.height))
            except rasterio.errors.WindowError as error:
                raise InputError("does not reach the drive", source=path) from error
            window = box if whole else window
            shrink = min(1.0, longest_px / max(window.width, window.height, 1))
            shape = max(1, round(window.height * shrink)), max(1, round(window.width * shrink))
            values = raster.read(1, window=window, out_shape=shape, masked=True, boundless=whole)
            bounds = raster.window_bounds(window)
    except rasterio.errors.RasterioError as error:
        raise InputError(f"cannot be read ({error})", source=path) from error
    numbers = values.astype(np.float64).filled(np.nan)
    if not np.isfinite(numbers).any():
        raise InputError("has no data around the drive", source=path)
    return numbers, bounds


def grey_levels(values: FloatArray) -> NDArray[np.uint8]:
    """Values stretched to 0..255 between their 1 % and 99 %; NaN is light grey."""
    low, high = np.nanpercentile(values, [1.0, 99.0])
    grey = np.clip((values - low) / max(float(high - low), 1e-12), 0.0, 1.0)
    return np.asarray(np.nan_to_num(255.0 * grey, nan=_NO_DATA_GREY), dtype=np.uint8)
