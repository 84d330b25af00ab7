"""The rectified stereo camera: projection and triangulation (paper, eqs. 1 to 5)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from frontends.errors import InputError

FloatArray = NDArray[np.float64]

#: Camera axes (x right, y down, z forward) turned to rover axes (x forward, y left, z up).
ROVER_R_CAMERA: tuple[tuple[float, ...], ...] = (
    (0.0, 0.0, 1.0),
    (-1.0, 0.0, 0.0),
    (0.0, -1.0, 0.0),
)


def level_rover_T_camera() -> FloatArray:
    """``rover_T_camera`` of a level camera at the rover's origin that looks forward."""
    transform = np.eye(4)
    transform[:3, :3] = ROVER_R_CAMERA
    return transform


@dataclass(frozen=True, slots=True)
class StereoCamera:
    """A rectified pair: equal cameras, parallel axes, the right one at +x.

    Pixel centres lie at integers: (0, 0) is the centre of the top-left pixel.

    Attributes
    ----------
    width, height
        Image size, px.
    fx, fy, cx, cy
        Focal lengths and principal point, px.
    baseline_m
        Distance between the two optical centres, m.

    Raises
    ------
    InputError
        When a value is not finite, a size or focal length or baseline is not positive.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    baseline_m: float

    def __post_init__(self) -> None:
        for name in ("width", "height", "fx", "fy", "cx", "cy", "baseline_m"):
            value = getattr(self, name)
            if not isinstance(value, Real) or not math.isfinite(value):
                raise InputError(f"is {value}", source="camera", field=name, remedy="give a number")
            if name not in ("cx", "cy") and value <= 0:
                raise InputError(
                    f"is {value}, must be positive",
                    source="camera",
                    field=name,
                    remedy="check units and sign; the baseline is in metres",
                )

    def depth(self, disparity_px: FloatArray) -> FloatArray:
        """Z = B f / D (eq. 3), m; (N,) -> (N,)."""
        return np.asarray(self.baseline_m * self.fx / disparity_px)

    def triangulate(
        self, u_left: FloatArray, v: FloatArray, disparity_px: FloatArray
    ) -> FloatArray:
        """Points in left-camera axes from pixels and disparities (eqs. 1 to 3).

        X = B x1 / D, Y = B y1 / D (fx / fy), Z = B f / D with x1, y1 from the
        principal point.

        Parameters
        ----------
        u_left, v
            Left image coordinates, px, (N,).
        disparity_px
            ``u_left - u_right`` > 0, px, (N,).

        Returns
        -------
        FloatArray
            (N, 3), m.
        """
        z = self.depth(disparity_px)
        x = (u_left - self.cx) * z / self.fx
        y = (v - self.cy) * z / self.fy
        return np.stack([x, y, z], axis=-1)

    def triangulation_covariance(
        self,
        u_left: FloatArray,
        v: FloatArray,
        disparity_px: FloatArray,
        sigma_px: FloatArray,
        sigma_disparity_px: FloatArray,
    ) -> FloatArray:
        """First-order covariance of `triangulate`, (N, 3, 3), m^2.

        The localisation error `sigma_px` (both axes of the left image) and the
        disparity error are independent; both are 1-sigma, px, (N,).
        """
        z = self.depth(disparity_px)
        ray = np.stack([(u_left - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones_like(z)], -1)
        along = ray * (z * sigma_disparity_px / disparity_px)[:, None]
        covariance = along[:, :, None] * along[:, None, :]
        covariance[:, 0, 0] += (z * sigma_px / self.fx) ** 2
        covariance[:, 1, 1] += (z * sigma_px / self.fy) ** 2
        return np.asarray(covariance)

    def project(self, points_cam: FloatArray) -> FloatArray:
        """Left u, right u, common v of points in left-camera axes (eqs. 4, 5).

        Parameters
        ----------
        points_cam
            (N, 3), m, with positive z.

        Returns
        -------
        FloatArray
            (N, 3): u_left, u_right, v, px.
        """
        x, y, z = points_cam[:, 0], points_cam[:, 1], points_cam[:, 2]
        u_left = self.fx * x / z + self.cx
        v = self.fy * y / z + self.cy
        return np.stack([u_left, u_left - self.fx * self.baseline_m / z, v], axis=-1)

    def contains(self, u: FloatArray, v: FloatArray, border_px: float = 0.0) -> NDArray[np.bool_]:
        """Whether pixels lie inside the image by at least `border_px`; (N,)."""
        return np.asarray(
            (u >= border_px)
            & (v >= border_px)
            & (u <= self.width - 1 - border_px)
            & (v <= self.height - 1 - border_px)
        )
