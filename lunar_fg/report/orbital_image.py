"""The part of an orbital map around a drive, as a picture that a page can hold."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.errors import InputError
from lunar_fg.georeference import Georeference, read_crs, require_same
from lunar_fg.orbital_picture import grey_levels, read_window
from lunar_fg.results import RunResults

FloatArray = NDArray[np.float64]

#: Longest side of the picture, px, and the part around the drive that it shows.
_LONGEST_PX = 1400
_THUMBNAIL_PX = 150
_MARGIN = 0.35
_LEAST_M = 10.0
#: Light of a shaded DEM: from the north-west, 45 degrees high.
_LIGHT = np.array([-0.5, 0.5, np.sqrt(0.5)])


@dataclass(frozen=True, slots=True)
class MapPicture:
    """A picture and where it lies.

    Attributes
    ----------
    uri
        JPEG as a data URI.
    x_m, y_m
        Left and right, bottom and top edge, map frame.
    what
        What it shows, for the caption.
    """

    uri: str
    x_m: tuple[float, float]
    y_m: tuple[float, float]
    what: str


def map_picture(results: RunResults, around: FloatArray) -> tuple[MapPicture | None, list[str]]:
    """Orbital image, or shaded elevation model, around positions (N, 3) of the map frame.

    Returns
    -------
    tuple
        The picture or None, and why a map that the run names could not be shown.
    """
    notes: list[str] = []
    source = results.source
    if source is None or results.georeference is None:
        return None, notes
    for path, what in ((source.ortho, "orbital image"), (source.dem, "shaded elevation model")):
        if path is None:
            continue
        try:
            return _picture(path, results.georeference, around, what), notes
        except InputError as error:
            notes.append(f"not shown: {error}")
    return None, notes


def thumbnail(
    path: Path, georeference: Georeference | None, centre: FloatArray, side_m: float
) -> str:
    """Square part of a map about a place (x, y) of the map frame, as a data URI; "" if none."""
    corners = centre[:2] + 0.5 * side_m * np.array([[-1.0, -1.0], [1.0, 1.0]])
    if georeference is not None:
        corners = georeference.to_plane(corners)
    try:
        found = read_window(path, corners[0], corners[1], _THUMBNAIL_PX, whole=True)
    except InputError:
        return ""
    return _jpeg(found[0], _THUMBNAIL_PX)


def _picture(path: Path, georeference: Georeference, around: FloatArray, what: str) -> MapPicture:
    require_same(georeference, read_crs(path), path)
    plane = georeference.to_plane(around[:, :2])
    low, high = plane.min(axis=0), plane.max(axis=0)
    margin = max(_MARGIN * float((high - low).max()), _LEAST_M)
    numbers, bounds = read_window(path, low - margin, high + margin, _LONGEST_PX)
    if what.startswith("shaded"):
        numbers = _shaded(numbers, (bounds[2] - bounds[0]) / numbers.shape[1])
    corners = georeference.to_map(np.array(bounds).reshape(2, 2))
    return MapPicture(
        _jpeg(numbers), (corners[0, 0], corners[1, 0]), (corners[0, 1], corners[1, 1]), what
    )


def _shaded(height_m: FloatArray, pixel_m: float) -> FloatArray:
    """Lambert shading of heights, rows from north to south."""
    if min(height_m.shape) < 2:
        return height_m
    south, east = np.gradient(height_m, pixel_m)
    normal = np.stack([-east, south, np.ones_like(height_m)])
    return np.asarray(np.tensordot(_LIGHT, normal / np.linalg.norm(normal, axis=0), 1))


def _jpeg(values: FloatArray, least_px: int = 0) -> str:
    pixels = grey_levels(values)
    if max(pixels.shape) < least_px:
        scale = least_px / max(pixels.shape)
        size = (round(scale * pixels.shape[1]), round(scale * pixels.shape[0]))
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    _, code = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 82])
    return "data:image/jpeg;base64," + base64.b64encode(code.tobytes()).decode()
