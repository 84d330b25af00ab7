"""Cameras with lens distortion: rays to pixels and back.

Axes: x right, y down, z forward, the projection centre at the origin. Every model here maps
directions, not points: it has one centre. Pixel centres lie at integers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.errors import InputError

FloatArray = NDArray[np.float64]

_INVERSE_STEPS = 200
_INVERSE_TOLERANCE_PX = 1e-9
#: A pixel whose ray projects further away than this has none.
_INVERTED_PX = 1e-3
_COEFFICIENT_COUNTS = {"none": (0,), "radtan": (4, 5, 8, 12, 14), "equidistant": (4,)}


class CentralCamera(Protocol):
    """A camera with one projection centre, whatever its lens."""

    @property
    def width(self) -> int:
        """Image width, px."""
        ...

    @property
    def height(self) -> int:
        """Image height, px."""
        ...

    @property
    def focal_px(self) -> float:
        """Pixels a radian near the optical axis."""
        ...

    def project(self, directions: FloatArray) -> FloatArray:
        """Pixels (N, 2) of directions (N, 3) in camera axes; NaN behind the camera."""
        ...

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Directions (N, 3) of pixels (N, 2), unit length, camera axes."""
        ...


class Lens(StrEnum):
    """Distortion models, by the names that ROS and Kalibr use."""

    NONE = "none"
    RADTAN = "radtan"
    EQUIDISTANT = "equidistant"


@dataclass(frozen=True, slots=True)
class LensCamera:
    """A pinhole camera with a distorting lens.

    Attributes
    ----------
    width, height
        Image size, px.
    fx, fy, cx, cy
        Focal lengths and principal point, px.
    lens
        `RADTAN` is Brown-Conrady in OpenCV's order (k1, k2, p1, p2[, k3[, k4, k5, k6 ...]]);
        `EQUIDISTANT` is Kannala-Brandt (k1, k2, k3, k4), OpenCV's fisheye.
    coefficients
        As many as the lens takes.

    Raises
    ------
    InputError
        When a value is not finite, a size or focal length is not positive, or the number
        of coefficients is none that the lens takes.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    lens: Lens = Lens.NONE
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("width", "height", "fx", "fy", "cx", "cy"):
            value = getattr(self, name)
            if not math.isfinite(value) or (name not in ("cx", "cy") and value <= 0):
                raise InputError(
                    f"is {value}", source="camera", field=name, remedy="give a positive number"
                )
        allowed = _COEFFICIENT_COUNTS[self.lens]
        if len(self.coefficients) not in allowed or not np.isfinite(self.coefficients).all():
            raise InputError(
                f"are {self.coefficients}",
                source="camera",
                field="distortion coefficients",
                remedy=f"{self.lens} takes {' or '.join(map(str, allowed))} finite numbers",
            )

    @property
    def focal_px(self) -> float:
        """Mean of the two focal lengths, px."""
        return 0.5 * (self.fx + self.fy)

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, directions: FloatArray) -> FloatArray:
        """Pixels (N, 2) of directions (N, 3) in camera axes; NaN behind the camera."""
        pixels = np.full((len(directions), 2), np.nan)
        ahead = directions[:, 2] > 1e-9 * np.linalg.norm(directions, axis=1)
        if not ahead.any():
            return pixels
        points = np.ascontiguousarray(directions[ahead] / directions[ahead, 2:])[:, None]
        zero = np.zeros(3)
        if self.lens is Lens.EQUIDISTANT:
            found, _ = cv2.fisheye.projectPoints(
                points, zero, zero, self.matrix, np.array(self.coefficients)
            )
        else:
            found, _ = cv2.projectPoints(
                points, zero, zero, self.matrix, np.array(self.coefficients or (0.0,) * 4)
            )
        pixels[ahead] = found[:, 0]
        return pixels

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Directions (N, 3) of pixels (N, 2), unit length, camera axes.

        OpenCV's inverse is the start; steps of ``(pixel - project(ray)) / f`` finish it.

        Raises
        ------
        InputError
            When some pixel has no ray: the lens model folds over inside the image.
        """
        points = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        flat = (points[:, 0] - [self.cx, self.cy]) / [self.fx, self.fy]
        if len(points) and self.lens is not Lens.NONE:
            undistort = (
                cv2.fisheye.undistortPoints
                if self.lens is Lens.EQUIDISTANT
                else cv2.undistortPoints
            )
            start = undistort(points, self.matrix, np.array(self.coefficients))
            flat = np.asarray(start, dtype=np.float64)[:, 0]
        rays = np.column_stack([flat, np.ones(len(flat))])
        for _ in range(_INVERSE_STEPS):
            missed = points[:, 0] - self.project(rays)
            if not (np.abs(missed) > _INVERSE_TOLERANCE_PX).any():
                break
            rays[:, :2] += missed / [self.fx, self.fy]
        # written so that NaN is no success
        if not (np.abs(missed) < _INVERTED_PX).all():
            raise InputError(
                "do not reach the image's corners: the lens model folds over before",
                source="camera",
                field="distortion coefficients",
                remedy="check their order (k1 k2 p1 p2 k3), and that they are of this camera",
            )
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
