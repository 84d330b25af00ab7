"""Correlation over x, y and yaw: surfaces, their peak to sub-pixel, its covariance."""

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

#: A second place is one outside of the best one's own peak: map pixels away.
_PEAK_PIXELS = 4.0
#: Yaws beside the searched ones that a peak at the edge needs for its curvature.
_LEAST_YAWS = 3
#: Yaws on each side of a peak that its paraboloid is fitted to: two more than define it.
_FITTED_YAWS = 2


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


@dataclass(frozen=True, slots=True)
class Peak:
    """A maximum of a `Volume`.

    Attributes
    ----------
    x_m, y_m, yaw_rad
        Of the anchor, map frame; yaw about the patch's own.
    covariance
        (3, 3) of these.
    value
        Coefficient.
    standing
        How far it stands out from all places: robust standard deviations of Fisher's z.
    second
        The same for the best place elsewhere.
    at_edge
        Whether it lies on the border of what was searched.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    covariance: FloatArray
    value: float
    standing: float
    second: float
    at_edge: bool

    @property
    def second_best_ratio(self) -> float:
        """`second` over `standing`, 0 to 1."""
        return float(np.clip(self.second / max(self.standing, 1e-9), 0.0, 1.0))

    @property
    def false_alarm(self) -> float:
        """Probability that chance alone parts the best two places so far.

        The highest of many Gaussian values exceed each other by exponential steps of mean
        1/z (extreme value theory).
        """
        gap = max(self.standing - self.second, 0.0)
        return float(math.exp(-gap * max(self.second, 1.0)))


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


def find_peak(volume: Volume, pixel: float = 1.0) -> Peak | None:
    """The best place, how far it stands out, and how well it is known.

    `pixel` is the map's own, in cells: what lies nearer together is not independent.

    With A the negative curvature of the surface at the peak and G the covariance of the
    surface's gradient away from it (what noise does to the slope), the place errs by
    ``A^-1 G A^-1``. Only the unexplained part of the image is noise at the peak:
    G is scaled by 1 - value^2. What the surface around the peak departs from a paraboloid by is
    noise of it too, and its share of the gradient's covariance is added to G: a peak among
    others as high, a few steps of yaw away, is not as sharp as its own curvature says.
    """
    values = volume.values
    if values.size == 0 or not np.isfinite(values).any():
        return None
    known = np.where(np.isfinite(values), values, -1.0)
    k, i, j = (int(n) for n in np.unravel_index(int(known.argmax()), known.shape))
    value = float(known[k, i, j])
    fisher = np.arctanh(np.clip(values[np.isfinite(values)], -0.999, 0.999))
    middle = float(np.median(fisher))
    spread = max(1.4826 * float(np.median(np.abs(fisher - middle))), 1e-6)
    elsewhere = known.copy()
    own = round(_PEAK_PIXELS * pixel)
    elsewhere[:, max(0, i - own) : i + own + 1, max(0, j - own) : j + own + 1] = -1.0
    best_elsewhere = float(elsewhere.max())
    standing = (math.atanh(min(value, 0.999)) - middle) / spread
    second = max((math.atanh(max(best_elsewhere, -0.999)) - middle) / spread, 0.0)
    yaws, rows, columns = values.shape
    at_edge = i in (0, rows - 1) or j in (0, columns - 1) or (k in (0, yaws - 1) and yaws > 3)
    k0, i0, j0 = (min(max(n, 1), size - 2) for n, size in zip((k, i, j), values.shape, strict=True))
    fit: _Paraboloid | None = None
    if min(values.shape) >= 3:
        reach = min(_FITTED_YAWS, k0, yaws - 1 - k0)
        fit = _paraboloid(values[k0 - reach : k0 + reach + 1, i0 - 1 : i0 + 2, j0 - 1 : j0 + 2])
    step = float(volume.yaws_rad[1] - volume.yaws_rad[0]) if yaws > 1 else 1.0
    # cells to map axes: x along columns, y against rows
    to_map = np.diag([volume.grid.cell_m, -volume.grid.cell_m, step])
    offset, covariance = np.zeros(3), np.full((3, 3), np.nan)
    if fit is not None:
        noise = _gradient_covariance(values, (k0, i0, j0), 2 * own) * (1.0 - value**2)
        inverse = np.linalg.inv(fit.curvature)
        offset = fit.offset
        covariance = to_map @ inverse @ (noise + fit.noise) @ inverse @ to_map
    x, y = volume.grid.place(np.array(j0 + offset[0]), np.array(i0 + offset[1]))
    yaw = float(volume.yaws_rad[k0] + step * offset[2])
    return Peak(float(x), float(y), yaw, covariance, value, standing, second, at_edge)


@dataclass(frozen=True, slots=True)
class _Paraboloid:
    """Peak offset (column, row, yaw; cells), negative curvature, and the gradient's covariance."""

    offset: FloatArray
    curvature: FloatArray
    noise: FloatArray


def _paraboloid(block: Layer) -> _Paraboloid | None:
    """Least-squares fit to an odd number of yaws, 3 rows and 3 columns; None without a peak."""
    half = block.shape[0] // 2
    block = np.where(np.isfinite(block), block, np.nanmin(block)).astype(np.float64)
    w, v, u = (a.ravel().astype(np.float64) for a in np.mgrid[-half : half + 1, -1:2, -1:2])
    terms = np.stack([np.ones(len(u)), u, v, w, u * u, v * v, w * w, u * v, u * w, v * w], axis=1)
    c, *_ = np.linalg.lstsq(terms, block.ravel(), rcond=None)
    curvature = -np.array(
        [[2 * c[4], c[7], c[8]], [c[7], 2 * c[5], c[9]], [c[8], c[9], 2 * c[6]]], dtype=np.float64
    )
    if not np.all(np.linalg.eigvalsh(curvature) > 1e-6):
        return None
    rest = block.ravel() - terms @ c
    variance = float(rest @ rest) / (len(u) - terms.shape[1])
    noise = variance * np.linalg.inv(terms.T @ terms)[1:4, 1:4]
    offset = np.clip(np.linalg.solve(curvature, c[1:4]), -1.0, 1.0)
    return _Paraboloid(offset, curvature, noise)


def _gradient_covariance(values: Layer, peak: tuple[int, int, int], own: int) -> FloatArray:
    """Covariance of the surface's gradient (column, row, yaw) away from the peak, `own` cells."""
    _, i, j = peak
    along_yaw, along_row, along_column = list(np.gradient(values.astype(np.float64)))
    away = np.isfinite(along_yaw + along_row + along_column)
    away[:, max(0, i - own) : i + own + 1, max(0, j - own) : j + own + 1] = False
    if np.count_nonzero(away) < 100:
        away = np.isfinite(along_yaw + along_row + along_column)
    samples = np.stack([along_column[away], along_row[away], along_yaw[away]])
    return np.asarray(samples @ samples.T / max(samples.shape[1], 1))
