"""Ways to compare a rover-made relief with a map: what is correlated with what."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.absolute.correlation import high_pass, smooth, winsorised
from frontends.absolute.patch import ReliefPatch
from frontends.absolute.search import Channel, turned
from frontends.measurements import SunDirection
from frontends.orbital import MapWindow
from frontends.photometry import shade, slopes

FloatArray = NDArray[np.float64]
Layer = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: What is kept of an image: structure below about this many map pixels (Gaussian's sigma).
_HIGH_PASS_PIXELS = 3.0
#: Elevation models are smoother than their pixels, and their errors are long.
_DEM_HIGH_PASS_PIXELS = 6.0
#: The relief is blurred like the orbital image.
_BLUR_PIXELS = 0.7


def anchor_cell(patch: ReliefPatch) -> tuple[float, float]:
    """Row and column of the anchor in the patch."""
    column, row = patch.grid.pixel(np.array(patch.x_m), np.array(patch.y_m))
    return float(row), float(column)


def padded(patch: ReliefPatch) -> tuple[Layer, Layer, Mask, tuple[float, float]]:
    """Heights, ortho, mask and anchor of a patch in a square that holds all its turns."""
    row, column = anchor_cell(patch)
    rows, columns = np.nonzero(patch.mask)
    reach = int(np.ceil(np.hypot(rows - row, columns - column).max())) + 2
    side = 2 * reach + 1
    top, left = int(np.floor(row)) - reach, int(np.floor(column)) - reach
    known = np.zeros((side, side), dtype=np.bool_)
    heights, ortho = np.zeros((2, side, side), dtype=np.float32)
    known[rows - top, columns - left] = True
    heights[known] = patch.height_m[rows, columns]
    ortho[known] = patch.ortho[rows, columns]
    return heights, ortho, known, (row - top, column - left)


def relit(
    heights: Layer, mask: Mask, cell_m: float, sun: SunDirection, pixel: float = 1.0
) -> tuple[Layer, Mask]:
    """Image of a relief under another sun, blurred like an orbital image.

    `pixel` is that image's, in cells.
    """
    ground = np.where(mask, smooth(heights, mask, _BLUR_PIXELS * pixel), np.nan)
    ground = ground.astype(np.float32)
    image = shade(ground, cell_m, sun)
    known = np.isfinite(image)
    return np.where(known, image, 0.0).astype(np.float32), known


def rendered_channels(
    patch: ReliefPatch, window: MapWindow, sun: SunDirection, pixel: float = 1.0
) -> tuple[list[Channel], tuple[float, float]]:
    """Re-lit relief against the image: brightness, and its gradient east and south.

    Parameters
    ----------
    patch, window
        What is compared, in cells of one size.
    sun
        Of the image.
    pixel
        The image's own pixel, in cells.

    Returns
    -------
    tuple
        Channels, and the anchor's row and column in their templates.
    """
    heights, _, known, centre = padded(patch)
    cell = patch.grid.cell_m
    image, mask = _image(window)
    brightness = winsorised(high_pass(image, mask, _HIGH_PASS_PIXELS * pixel), mask)

    @lru_cache(maxsize=1)  # the three channels ask for the same turn one after the other
    def template(yaw: float) -> tuple[Layer, Mask]:
        lit, seen = relit(*turned(heights, known, yaw, centre), cell, sun, pixel)
        return winsorised(high_pass(lit, seen, _HIGH_PASS_PIXELS * pixel), seen), seen

    def gradient(axis: int) -> Channel:
        def turned_gradient(yaw: float) -> tuple[Layer, Mask]:
            return _gradient(*template(yaw), axis)

        return Channel(*_gradient(brightness, mask, axis), turned_gradient)

    # brightness weighs as much as both gradients together
    return [Channel(brightness, mask, template, 2.0), gradient(1), gradient(0)], centre


def elevation_channels(
    patch: ReliefPatch, window: MapWindow, pixel: float = 1.0
) -> tuple[list[Channel], tuple[float, float]]:
    """The relief's slopes against those of the orbital elevation model; see the other."""
    heights, _, known, centre = padded(patch)
    cell = patch.grid.cell_m
    model = window.values
    mask = np.isfinite(model)

    def part(axis: int) -> Channel:
        reference = slopes(np.where(mask, model, np.nan), cell)[axis]
        seen = np.isfinite(reference)
        filled = np.nan_to_num(reference).astype(np.float32)
        image = winsorised(high_pass(filled, seen, _DEM_HIGH_PASS_PIXELS * pixel), seen)

        def template(yaw: float) -> tuple[Layer, Mask]:
            values, there = turned(heights, known, yaw, centre)
            ground = np.where(there, smooth(values, there, pixel), np.nan)
            slope = slopes(ground, cell)[axis]
            there = np.isfinite(slope)
            filled = np.nan_to_num(slope).astype(np.float32)
            filtered = high_pass(filled, there, _DEM_HIGH_PASS_PIXELS * pixel)
            return winsorised(filtered, there), there

        return Channel(image, seen, template)

    return [part(0), part(1)], centre


def _image(window: MapWindow) -> tuple[Layer, Mask]:
    mask = np.isfinite(window.values)
    return np.where(mask, window.values, 0.0).astype(np.float32), mask


def _gradient(values: Layer, mask: Mask, axis: int) -> tuple[Layer, Mask]:
    dx, dy = (1, 0) if axis == 1 else (0, 1)
    slope = cv2.Sobel(values, cv2.CV_32F, dx, dy)
    inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), dtype=np.uint8)) > 0
    return np.where(inner, slope, 0.0).astype(np.float32), inner
