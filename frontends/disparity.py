"""Stereo disparities to a few hundredths of a pixel, on sloping ground, at any exposure.

Around each feature the right image is modelled as the left one, moved and re-exposed:

    right(u - D, v - V) = gain * left(u, v) + bias,   D = d + d_u (u - u0) + d_v (v - v0)

The slopes matter: on the ground D changes by baseline / height per image row, and a patch
moved as a whole is then wrong by tenths of a pixel. Least squares over a patch, with the
Jacobian taken from the left image once (inverse compositional Gauss-Newton): its noise is
independent of the right image's, so the interpolation does not pull the result to whole
pixels, and one factorisation serves all iterations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frontends.measurements import Image
from frontends.patch_alignment import refine_all
from frontends.patch_sampling import SPAN
from frontends.patch_window import PATCH
from frontends.rows import selected_rows

FloatArray = NDArray[np.float64]

#: Confirmed features that tell how much patches of the same ground differ in these images.
_ENOUGH_CONFIRMED = 30
#: Contradicted: patches that differ more than this share of the confirmed ones.
_USUAL_SHARE = 0.99


@dataclass(frozen=True, slots=True)
class RefinedDisparities:
    """Disparities of N features after refinement; those not confirmed are as they came.

    Attributes
    ----------
    disparity_px
        (N,) at the features' positions in the left image.
    sigma_px
        (N,) 1-sigma: from the patch's texture and from what its model leaves of it;
        infinite where not confirmed.
    vertical_px
        (N,) ``v_left - v_right`` that remains beyond the expected one.
    confirmed
        (N,) bool.
    contradicted
        (N,) bool: the patches differ by far more than those of confirmed features do. Most
        such features are wrong matches; others that are not confirmed lack texture.
    slope
        (N, 2) change of the disparity along u and along v, px per px; 0 where not confirmed.
    """

    disparity_px: FloatArray
    sigma_px: FloatArray
    vertical_px: FloatArray
    confirmed: NDArray[np.bool_]
    contradicted: NDArray[np.bool_]
    slope: FloatArray

    def select(self, keep: NDArray[np.bool_]) -> RefinedDisparities:
        """The features at a mask."""
        return selected_rows(self, keep)


def refine_disparities(
    left: Image,
    right: Image,
    left_uv: FloatArray,
    disparity_px: FloatArray,
    vertical_px: FloatArray,
    max_shift_px: FloatArray,
) -> RefinedDisparities:
    """Refine disparities known to a pixel or two.

    Not confirmed are features whose patch leaves an image, does not converge, moves too
    far, has too little texture along u or does not look alike in the two images.

    Parameters
    ----------
    left, right
        (H, W) uint8, rectified but for a smooth vertical offset.
    left_uv
        (N, 2) features in the left image, px.
    disparity_px
        (N,) where to start.
    vertical_px
        (N,) expected ``v_left - v_right``.
    max_shift_px
        (N,) largest change of the disparity.
    """
    if left.shape != right.shape or left.dtype != np.uint8 or right.dtype != np.uint8:
        raise ValueError(f"two uint8 images of one size, not {left.shape} and {right.shape}")
    n = len(left_uv)
    start = np.stack(
        [left_uv[:, 0], left_uv[:, 1], disparity_px, vertical_px, max_shift_px], axis=-1
    ).astype(np.float64)
    # the kernel's arithmetic knows no NaN: such features are put outside of the image
    unknown = ~np.isfinite(start).all(axis=1) | (np.abs(start) > 1e6).any(axis=1)
    start[unknown] = -1e3
    result = np.zeros((n, 6))
    confirmed = np.zeros(n, dtype=np.bool_)
    if min(left.shape) >= SPAN:
        images = np.ascontiguousarray(left), np.ascontiguousarray(right)
        refine_all(*images, start, PATCH, result, confirmed)
    return RefinedDisparities(
        np.where(confirmed, result[:, 0], disparity_px),
        np.where(confirmed, result[:, 1], np.inf),
        result[:, 2],
        confirmed,
        _contradicted(result[:, 3], confirmed),
        np.where(confirmed[:, None], result[:, 4:6], 0.0),
    )


def _contradicted(residual: FloatArray, confirmed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Patches not confirmed that differ more than most of the confirmed ones."""
    if confirmed.sum() < _ENOUGH_CONFIRMED:
        return np.zeros(len(residual), dtype=np.bool_)
    usual = np.quantile(residual[confirmed], _USUAL_SHARE)
    return ~confirmed & (residual > usual)
