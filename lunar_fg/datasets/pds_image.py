"""Pixels of archive images (PDS3, VICAR) as 8-bit grey, with missing data filled in.

12-bit images are brought to 8 bits by a square root, as the rovers themselves do before they
send: shot noise then has the same size at every brightness, dark slopes keep their texture,
and products that were companded on board look the same as those that were not.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from frontends.errors import InputError
from frontends.measurements import Image
from lunar_fg.datasets.pds_label import RoverLabel

#: Images with more missing data than this cannot be used.
MAX_MISSING_SHARE = 0.5


def read_pixels(label: RoverLabel) -> NDArray[np.float32]:
    """Samples as they are stored, (height, width), missing ones NaN.

    Raises
    ------
    InputError
        When the file is not what its label says, or is cut off.
    """
    path = label.image
    needed = label.width * label.height * (1 if label.bits <= 8 else 2)
    if path.stat().st_size < needed:
        raise InputError(
            f"is cut off: {path.stat().st_size} bytes, its pixels alone take {needed}", source=path
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            # one driver, named: a file cannot make GDAL open others, or the network
            with rasterio.open(label.path.resolve(), driver=label.driver) as source:
                if (source.width, source.height) != (label.width, label.height):
                    raise InputError(
                        f"holds {source.width}x{source.height} px, its label says "
                        f"{label.width}x{label.height}",
                        source=path,
                    )
                pixels = source.read(1).astype(np.float32)
    except (RasterioError, OSError) as error:
        raise InputError(
            f"cannot be read: {' '.join(str(error).split())[:150]}",
            source=path,
            remedy="fetch the product again",
        ) from error
    for value in label.missing:
        pixels[pixels == np.float32(value)] = np.nan
    return np.asarray(pixels)


def read_rover_image(label: RoverLabel) -> tuple[Image, float]:
    """Grey image (height, width), and the share of pixels that were missing.

    Missing pixels take the mean of what is around them: a hole with sharp edges would give
    landmarks that are none.

    Raises
    ------
    InputError
        As `read_pixels`; and when more than half of the pixels are missing.
    """
    pixels = read_pixels(label)
    hole = ~np.isfinite(pixels)
    share = float(hole.mean())
    if share > MAX_MISSING_SHARE:
        raise InputError(f"{share:.0%} of its pixels are missing", source=label.image)
    if label.bits > 8:
        white = float((1 << label.bits) - 1)
        pixels = 255.0 * np.sqrt(np.clip(pixels, 0.0, white) / white)
    if share > 0.0:
        pixels = _filled(pixels, hole)
    return np.clip(np.rint(pixels), 0, 255).astype(np.uint8), share


def read_archive_grey(path: Path) -> Image:
    """Grey image of a file with a label, for commands that take any image."""
    from lunar_fg.datasets.pds_label import read_label

    return read_rover_image(read_label(path))[0]


def _filled(pixels: NDArray[np.float32], hole: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Fill holes from their surroundings, coarse to fine (a pyramid of weighted means)."""
    weight = (~hole).astype(np.float32)
    value = np.where(hole, np.float32(0.0), pixels).astype(np.float32)
    if hole.all() or min(pixels.shape) < 2:
        return value
    height, width = pixels.shape
    half = (max(1, width // 2), max(1, height // 2))
    coarse_weight = cv2.resize(weight, half, interpolation=cv2.INTER_AREA)
    coarse = cv2.resize(value * weight, half, interpolation=cv2.INTER_AREA)
    coarse = np.where(coarse_weight > 0.0, coarse / np.maximum(coarse_weight, 1e-6), 0.0)
    below = coarse_weight <= 0.0
    if below.any():
        coarse = _filled(coarse.astype(np.float32), below)
    fine = cv2.resize(coarse.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(hole, fine, pixels).astype(np.float32)
