"""Correlation over x, y and yaw."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.absolute.correlation import MaskedCorrelator
from frontends.terrain import Grid

FloatArray = NDArray[np.float64]
Layer = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: Yaws beside the searched ones that a peak at the edge needs for its curvature.
_LEAST_YAWS = 3


@dataclass(frozen=True, slots=True)
class Channel:
    """One way to compare: the map's image, and what a turned patch should look like.

    Attributes
    ----------
    image, mask
        (H, W) of the map window, high-passed, and where it is known.
    template
        Image and mask of the patch, turned by an angle (rad, counter-clockwise).
    weight
        Of its coefficient in the mean of all channels.
    """

    image: Layer
    mask: Mask
    template: Callable[[float], tuple[Layer, Mask]]
    weight: float = 1.0


@dataclass(frozen=True, slots=True)
class Search:
    """Where to look: half widths about the pose that the patch was laid out by."""

    half_x_m: float
    half_y_m: float
    half_yaw_rad: float


@dataclass(frozen=True, slots=True)
class Volume:
    """Coefficients over yaw and shift.

    Attributes
    ----------
    values
        (yaws, rows, columns); NaN where the map does not hold the patch.
    yaws_rad
        (yaws,), about the patch's own.
    grid
        Cell (i, j) of `values` is the anchor at that place of the map.
    """

    values: Layer
    yaws_rad: FloatArray
    grid: Grid


def yaw_steps(half_rad: float, radius_m: float, cell_m: float) -> FloatArray:
    """Angles within `half_rad` at which the patch's edge moves by a cell each."""
    step = min(cell_m / max(radius_m, cell_m), math.radians(3.0))
    count = max(math.ceil(half_rad / step), (_LEAST_YAWS - 1) // 2)
    if half_rad >= math.pi:
        return np.linspace(-np.pi, np.pi, 2 * count, endpoint=False)
    return step * np.arange(-count, count + 1, dtype=np.float64)


def correlate(
    channels: Sequence[Channel], yaws_rad: FloatArray, grid: Grid, anchor_cell: tuple[float, float]
) -> Volume:
    """Mean coefficient of the channels at every yaw and shift.

    Parameters
    ----------
    channels
        All over the same map window and patch size.
    yaws_rad
        Angles to try.
    grid
        Of the map window.
    anchor_cell
        Row and column of the anchor in the patch, fractional; patches turn about it.
    """
    shape = channels[0].template(0.0)[0].shape
    correlators = [MaskedCorrelator(c.image, c.mask, shape) for c in channels]
    weights = [channel.weight for channel in channels]
    layers = []
    for yaw in yaws_rad:
        surfaces = [
            correlator.surface(*channel.template(float(yaw)))
            for correlator, channel in zip(correlators, channels, strict=True)
        ]
        layers.append(np.average(surfaces, axis=0, weights=weights))
    values = np.stack(layers).astype(np.float32)
    row, column = anchor_cell
    x, y = grid.place(np.array(column), np.array(row))
    places = Grid(float(x), float(y), grid.cell_m, max(values.shape[1], 1), max(values.shape[2], 1))
    return Volume(values, yaws_rad, places)


def turned(values: Layer, mask: Mask, yaw_rad: float, centre: tuple[float, float]) -> tuple[
    Layer, Mask
]:  # fmt: skip
    """Turn an image counter-clockwise (north up) about (row, column); same size."""
    if yaw_rad == 0.0:
        return np.where(mask, values, 0.0).astype(np.float32), mask
    row, column = centre
    matrix = cv2.getRotationMatrix2D((column, row), math.degrees(yaw_rad), 1.0)
    size = (values.shape[1], values.shape[0])
    held = np.where(mask, values, 0.0).astype(np.float32)
    weight = cv2.warpAffine(mask.astype(np.float32), matrix, size, flags=cv2.INTER_LINEAR)
    total = cv2.warpAffine(held, matrix, size, flags=cv2.INTER_LINEAR)
    known = np.asarray(weight > 0.5)
    return np.where(known, total / np.maximum(weight, 1e-3), 0.0).astype(np.float32), known
