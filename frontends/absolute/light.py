"""The sun of an orbital image, where nobody states it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frontends.absolute.correlation import high_pass
from frontends.measurements import SunDirection
from frontends.photometry import slopes

Layer = NDArray[np.float32]

#: What is assumed of the elevation: low enough for shading, as maps for drivers are.
_ELEVATION_DEG = 35.0
_CELLS = 6.0
#: Cells that share one error: image and model are smooth over about so many.
_CELLS_ALIKE = 30.0


@dataclass(frozen=True, slots=True)
class SunEstimate:
    """Azimuth of the light; its elevation is only assumed.

    Attributes
    ----------
    sun
        Azimuth found, elevation assumed.
    sigma_deg
        1-sigma of the azimuth.
    correlation
        Of the image with the model lit from there.
    """

    sun: SunDirection
    sigma_deg: float
    correlation: float


def estimate_sun(image: Layer, height_m: Layer, cell_m: float) -> SunEstimate | None:
    """Find the light's azimuth from an image and the elevation model below it.

    Slopes towards the light are bright: the image is fitted, to first order, by the slopes
    east and north; the direction of the fit is the light's.

    Parameters
    ----------
    image, height_m
        On the same cells, NaN where unknown.
    cell_m
        Their side.

    Returns
    -------
    SunEstimate or None
        None where image and model have nothing in common (below four sigma).
    """
    east, north = slopes(height_m, cell_m)
    mask = np.isfinite(image) & np.isfinite(east) & np.isfinite(north)
    if np.count_nonzero(mask) < 500:
        return None

    def prepared(values: Layer) -> NDArray[np.float64]:
        held = np.where(mask, values, 0.0).astype(np.float32)
        return high_pass(held, mask, _CELLS)[mask].astype(np.float64)

    towards = np.stack([prepared(np.asarray(-east)), prepared(np.asarray(-north))], axis=1)
    bright = prepared(image)
    fit, *_ = np.linalg.lstsq(towards, bright, rcond=None)
    model = towards @ fit
    rest = bright - model
    variance = float(rest @ rest) / len(bright) * _CELLS_ALIKE
    covariance = variance * np.linalg.inv(towards.T @ towards)
    length2 = float(fit @ fit)
    across = np.array([fit[1], -fit[0]]) / max(length2, 1e-30)
    sigma = math.degrees(math.sqrt(float(across @ covariance @ across)))
    if length2 <= 0.0 or sigma > math.degrees(0.25):
        return None
    azimuth = math.degrees(math.atan2(fit[0], fit[1])) % 360.0
    correlation = float(np.corrcoef(model, bright)[0, 1])
    return SunEstimate(SunDirection(azimuth, _ELEVATION_DEG), sigma, correlation)
