"""Pictures to look at and to match: photographs, and products of planetary archives.

Unlike the frames of a dataset they may be in colour, of any size and of any bit depth.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.errors import InputError
from frontends.measurements import Image
from lunar_fg.datasets.images import MAX_PIXELS, SUFFIXES, read_grey

Picture = NDArray[np.uint8]

#: The level that becomes white: specular glints and hot pixels are brighter than the scene.
_WHITE_PERCENTILE = 99.9


def read_picture(path: Path) -> Picture:
    """Read a picture as (H, W, 3) uint8, BGR.

    Parameters
    ----------
    path
        PNG, JPEG, PGM or PPM; anything else as far as GDAL reads it (PDS3, PDS4, VICAR,
        ISIS cubes, GeoTIFF), the first band or the first three. More than 8 bits are
        scaled so that the 99.9th percentile becomes white.

    Raises
    ------
    InputError
        When the file is missing, unknown, truncated, corrupt or too large.
    """
    if path.suffix.lower() not in SUFFIXES:
        return _bgr(_read_raster(path))
    read_grey(path, 65535)  # checks the file from end to end, which OpenCV does not
    # colour is asked for as it is: pixels stay where they are stored, no EXIF turn
    stored = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    return _bgr(_to_8_bits(np.atleast_3d(np.asarray(stored))[..., :3], None))


def grey(picture: Picture) -> Image:
    """Grey of a picture, (H, W) uint8."""
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def write_picture(path: Path, picture: Picture) -> None:
    """Write a picture; the suffix names the format."""
    try:
        written = cv2.imwrite(str(path), picture)
    except cv2.error:
        written = False
    if not written:
        raise InputError(
            "cannot be written", source=path, remedy="name an existing folder and a .png file"
        )


def _read_raster(path: Path) -> Picture:
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path) as dataset:
                if dataset.width * dataset.height > MAX_PIXELS:
                    raise InputError(
                        f"has {dataset.width}x{dataset.height} px; the limit is "
                        f"{MAX_PIXELS} pixels",
                        source=path,
                    )
                bands = [1, 2, 3] if dataset.count >= 3 else [1]
                stored, nodata = dataset.read(bands), dataset.nodata
    except RasterioError as error:
        raise InputError(
            "cannot be read as an image",
            source=path,
            remedy="PNG, JPEG, PGM, PPM, or a raster that GDAL knows (PDS, VICAR, GeoTIFF)",
        ) from error
    # bands of a raster are red, green, blue
    return _to_8_bits(np.moveaxis(stored, 0, -1)[..., ::-1], nodata)


def _to_8_bits(stored: NDArray[Any], nodata: float | None) -> Picture:
    if stored.dtype == np.uint8:
        return np.ascontiguousarray(stored)
    values = stored.astype(np.float64)
    known = np.isfinite(values)
    if nodata is not None:
        known &= values != nodata
    if not known.any():
        return np.zeros(stored.shape, np.uint8)
    white = max(float(np.percentile(values[known], _WHITE_PERCENTILE)), 1e-12)
    levels = np.rint(np.where(known, values, 0.0) * (255.0 / white))
    return np.ascontiguousarray(np.clip(levels, 0, 255).astype(np.uint8))


def _bgr(picture: Picture) -> Picture:
    if picture.shape[2] != 3:
        picture = np.repeat(picture[..., :1], 3, axis=2)
    return np.ascontiguousarray(picture)
