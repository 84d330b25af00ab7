"""What is left of the geometry between the two cameras after rectification.

A rectified pair should have ``v_left == v_right`` and a disparity that is the depth's
alone. Public and flight sequences miss both by fractions of a pixel to several pixels
(a principal point that moved, a decentred lens). Two smooth fields describe it:

* vertical: ``v_left - v_right = a0 + a1 x + a2 y + a3 x y + a4 x^2 + a5 y^2``, seen in any
  single pair;
* disparity: ``D = D_true + d0 + d1 x^2 + d2 y^2``, seen in the motion between pairs only
  (`frontends.disparity_check`);

with x, y the image position in the units of the focal length, from the principal point.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.measurements import StereoObservations

FloatArray = NDArray[np.float64]

VERTICAL_TERMS = 6
DISPARITY_TERMS = 3


@dataclass(frozen=True, slots=True)
class RectificationError:
    """The two residual fields of a rectified pair, px.

    Attributes
    ----------
    vertical_px
        (6,) coefficients a0..a5.
    disparity_px
        (3,) coefficients d0..d2; zero where nothing significant was found.
    """

    vertical_px: FloatArray = field(default_factory=lambda: np.zeros(VERTICAL_TERMS))
    disparity_px: FloatArray = field(default_factory=lambda: np.zeros(DISPARITY_TERMS))

    def vertical_at(self, camera: StereoCamera, u: FloatArray, v: FloatArray) -> FloatArray:
        """``v_left - v_right`` to expect at left-image pixels, px, (N,)."""
        return np.asarray(vertical_basis(camera, u, v) @ self.vertical_px)

    def disparity_at(self, camera: StereoCamera, u: FloatArray, v: FloatArray) -> FloatArray:
        """Disparity error to expect at left-image pixels, px, (N,)."""
        return np.asarray(disparity_basis(camera, u, v) @ self.disparity_px)

    def correct(
        self, camera: StereoCamera, observations: StereoObservations, max_depth_sigma: float
    ) -> StereoObservations:
        """Observations with the disparity error removed and the points triangulated anew.

        What is out of the useful range then (`within_range`) is dropped.
        """
        disparity = observations.disparity_px - self.disparity_at(
            camera, observations.u_left, observations.v
        )
        keep = within_range(disparity, observations.sigma_disparity_px, max_depth_sigma)
        kept = observations.select(keep)
        return observe(
            camera,
            kept.landmark_id,
            kept.u_left,
            kept.v,
            disparity[keep],
            kept.sigma_px,
            kept.sigma_disparity_px,
        )


def vertical_basis(camera: StereoCamera, u: FloatArray, v: FloatArray) -> FloatArray:
    """Terms 1, x, y, x y, x^2, y^2 of the vertical field, (N, 6)."""
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return np.stack([np.ones_like(x), x, y, x * y, x**2, y**2], axis=-1)


def disparity_basis(camera: StereoCamera, u: FloatArray, v: FloatArray) -> FloatArray:
    """Terms 1, x^2, y^2 of the disparity field, (N, 3)."""
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return np.stack([np.ones_like(x), x**2, y**2], axis=-1)


def observe(
    camera: StereoCamera,
    landmark_id: NDArray[np.int64],
    u_left: FloatArray,
    v: FloatArray,
    disparity_px: FloatArray,
    sigma_px: FloatArray,
    sigma_disparity_px: FloatArray,
) -> StereoObservations:
    """Stereo observations with triangulated points and their covariance (eqs. 1 to 3)."""
    return StereoObservations(
        landmark_id,
        u_left,
        u_left - disparity_px,
        v,
        sigma_px,
        sigma_disparity_px,
        camera.triangulate(u_left, v, disparity_px),
        camera.triangulation_covariance(u_left, v, disparity_px, sigma_px, sigma_disparity_px),
    )


def within_range(
    disparity_px: FloatArray, sigma_disparity_px: FloatArray, max_depth_sigma: float
) -> NDArray[np.bool_]:
    """Whether depths are known to a share `max_depth_sigma` of themselves (1-sigma), (N,)."""
    return np.asarray(disparity_px * max_depth_sigma > sigma_disparity_px)


def robust_fit(
    basis: FloatArray, values: FloatArray, *, iterations: int = 10
) -> tuple[FloatArray, float]:
    """Coefficients and robust 1-sigma residual of ``basis @ c = values``.

    Iteratively re-weighted with a Cauchy kernel on residuals scaled by their median
    absolute deviation: up to 40 % of the values may be wrong when they scatter, about 20 %
    when they all err to one side. Terms that the values do not tell stay zero.
    """
    coefficients = np.zeros(basis.shape[1])
    coefficients[0] = np.median(values)
    scale = 1.0
    for _ in range(iterations):
        residual = values - basis @ coefficients
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-3)
        weight = 1.0 / (1.0 + (residual / (2.0 * scale)) ** 2)
        normal = basis.T @ (weight[:, None] * basis)
        step, *_ = np.linalg.lstsq(normal, basis.T @ (weight * residual), rcond=1e-9)
        coefficients = coefficients + step
    return coefficients, scale
