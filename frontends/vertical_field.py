"""The vertical offset between the images of a pair, measured on the features themselves.

The field is that of `frontends.rectification`. It is fitted to matches made without it, and again
to pairs refined on the images, which scatter less.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.detector import DescribedPair
from frontends.errors import InputError
from frontends.matching import match_descriptors
from frontends.rectification import robust_fit, vertical_basis

FloatArray = NDArray[np.float64]

#: Pairs needed before anything is concluded from them.
ENOUGH_PAIRS = 30
_PAIRS_FOR_A_FIELD = 100
#: The offset is looked for within this share of the image height.
_SEARCH = 0.05
_RATIO = 0.7


def measure_vertical(camera: StereoCamera, pair: DescribedPair, source: str) -> FloatArray | None:
    """Coefficients (6,) of ``v_left - v_right``; None where too few features match.

    Parameters
    ----------
    camera
        The rectified pair.
    pair
        Features of both images.
    source
        Names the frame in an error.

    Raises
    ------
    InputError
        When left and right look swapped.
    """
    matches = match_descriptors(pair.left_descriptors, pair.right_descriptors, ratio=_RATIO)
    uv = pair.left.xy[matches.query].astype(np.float64)
    offset = uv - pair.right.xy[matches.train]
    near = np.abs(offset[:, 1]) < _SEARCH * camera.height
    if near.sum() < ENOUGH_PAIRS:
        return None
    uv, offset = uv[near], offset[near]
    coefficients, scale = _fit(camera, uv, offset[:, 1])
    basis = vertical_basis(camera, uv[:, 0], uv[:, 1])
    disparity = offset[np.abs(offset[:, 1] - basis @ coefficients) < 3.0 * scale, 0]
    negative = float(np.mean(disparity < -1.0)) if len(disparity) else 0.0
    if len(disparity) >= ENOUGH_PAIRS and negative > 0.5:
        raise InputError(
            f"{negative:.0%} of {len(disparity)} matches have a negative disparity",
            source=source,
            remedy="left and right look swapped: exchange them",
        )
    return coefficients


def fit_vertical(camera: StereoCamera, uv: FloatArray, offset_px: FloatArray) -> FloatArray:
    """Coefficients (6,) of the field that has these offsets (N,) at left-image pixels (N, 2)."""
    return _fit(camera, uv, offset_px)[0]


def _fit(camera: StereoCamera, uv: FloatArray, offset_px: FloatArray) -> tuple[FloatArray, float]:
    """Coefficients and robust 1-sigma; few pairs tell the constant only."""
    basis = vertical_basis(camera, uv[:, 0], uv[:, 1])
    terms = basis.shape[1] if len(basis) >= _PAIRS_FOR_A_FIELD else 1
    coefficients, scale = robust_fit(basis[:, :terms], offset_px)
    return np.pad(coefficients, (0, basis.shape[1] - terms)), scale
