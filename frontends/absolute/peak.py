"""The peak of a correlation volume: its place to sub-pixel, and how well that is known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frontends.absolute.search import Volume

FloatArray = NDArray[np.float64]
Layer = NDArray[np.float32]

#: A second place is one outside of the best one's own peak: map pixels away.
_PEAK_PIXELS = 4.0
#: Yaws on each side of a peak that its paraboloid is fitted to: two more than define it.
_FITTED_YAWS = 2
#: Fewer gradients away from the peak are no sample of what noise makes: all are taken then.
_LEAST_AWAY = 100


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


def find_peak(volume: Volume, pixel: float = 1.0) -> Peak | None:
    """The best place, how far it stands out, and how well it is known.

    `pixel` is the map's own, in cells: what lies nearer together is not independent.

    A paraboloid is fitted to the values around the highest one. With A its negative curvature
    and G the covariance of the gradient that the same fit has away from the peak, where there is
    nothing but noise, the place errs by ``A^-1 G A^-1``. Only the unexplained part of the image
    is noise at the peak: G is scaled by 1 - value^2. What the yaws around the peak depart from
    the paraboloid by is noise, too, and is added to G: a peak among others as high, a few steps
    of yaw away, is not as sharp as its own curvature says.
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
    reach = min(_FITTED_YAWS, k0, yaws - 1 - k0)
    fit: _Paraboloid | None = None
    if min(values.shape) >= 3:
        fit = _paraboloid(values[k0 - reach : k0 + reach + 1, i0 - 1 : i0 + 2, j0 - 1 : j0 + 2])
    step = float(volume.yaws_rad[1] - volume.yaws_rad[0]) if yaws > 1 else 1.0
    # cells to map axes: x along columns, y against rows
    to_map = np.diag([volume.grid.cell_m, -volume.grid.cell_m, step])
    offset, covariance = np.zeros(3), np.full((3, 3), np.nan)
    if fit is not None:
        noise = _gradient_covariance(values, (i0, j0), 2 * own, reach) * (1.0 - value**2)
        inverse = np.linalg.inv(fit.curvature)
        offset = fit.offset
        noise[2, 2] += fit.roughness
        covariance = to_map @ inverse @ noise @ inverse @ to_map
    x, y = volume.grid.place(np.array(j0 + offset[0]), np.array(i0 + offset[1]))
    yaw = float(volume.yaws_rad[k0] + step * offset[2])
    return Peak(float(x), float(y), yaw, covariance, value, standing, second, at_edge)


@dataclass(frozen=True, slots=True)
class _Paraboloid:
    """Peak offset (column, row, yaw; cells), negative curvature, roughness along yaw.

    The latter is the variance of the gradient along yaw that the departures of the yaws' means
    from the paraboloid make: one yaw's surface is higher or lower as a whole, since its template
    is another one.
    """

    offset: FloatArray
    curvature: FloatArray
    roughness: float


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
    offset = np.clip(np.linalg.solve(curvature, c[1:4]), -1.0, 1.0)
    rest = (block.ravel() - terms @ c).reshape(block.shape).mean(axis=(1, 2))
    steps = np.arange(-half, half + 1)
    free = len(steps) - 3
    # of so few departures the mean square is mostly too small: nu - 2/3 makes its median right
    variance = float(rest @ rest) / (free - 2.0 / 3.0) if free > 0 else 0.0
    roughness = variance / float(steps @ steps)
    return _Paraboloid(offset, curvature, roughness)


def _gradient_covariance(values: Layer, peak: tuple[int, int], own: int, reach: int) -> FloatArray:
    """Covariance of the fitted gradient (column, row, yaw) more than `own` cells from the peak."""
    gradients = _fitted_gradients(values.astype(np.float64), reach)
    known = np.asarray(np.isfinite(gradients).all(axis=0))
    # the blocks' middles begin a cell inside
    i, j = peak[0] - 1, peak[1] - 1
    away = known.copy()
    away[:, max(0, i - own) : i + own + 1, max(0, j - own) : j + own + 1] = False
    if np.count_nonzero(away) < _LEAST_AWAY:
        away = known
    samples = gradients[:, away]
    return np.asarray(samples @ samples.T / max(samples.shape[1], 1))


def _fitted_gradients(values: FloatArray, reach: int) -> FloatArray:
    """Gradient (3; column, row, yaw) that `_paraboloid` has in every block of the volume.

    In a block that is symmetric about its middle the linear terms are orthogonal to all others,
    so that each is a weighted sum of the block: the coordinate's own, over its sum of squares.
    """
    size = 2 * reach + 1
    layers = np.lib.stride_tricks.sliding_window_view(values, size, axis=0)
    steps = np.arange(-reach, reach + 1, dtype=np.float64)
    mean, along_yaw = layers.mean(axis=-1), layers @ (steps / np.sum(steps**2))

    def mean_rows(a: FloatArray) -> FloatArray:
        return (a[:, :-2] + a[:, 1:-1] + a[:, 2:]) / 3.0

    def mean_columns(a: FloatArray) -> FloatArray:
        return (a[:, :, :-2] + a[:, :, 1:-1] + a[:, :, 2:]) / 3.0

    along_column = mean_rows(mean[:, :, 2:] - mean[:, :, :-2]) / 2.0
    along_row = mean_columns(mean[:, 2:] - mean[:, :-2]) / 2.0
    return np.stack([along_column, along_row, mean_rows(mean_columns(along_yaw))])
