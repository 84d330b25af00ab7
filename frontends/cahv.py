"""CAHV and CAHVOR, the camera models in the labels of Mars rover images.

Yakimovsky & Cunningham (1978) for CAHV; Gennery (2006), Di & Li (2004) for CAHVOR. With
``d = P - C`` of a point P, CAHV projects to

    u = d.H / d.A,    v = d.V / d.A

H = f_h x + c_h A and V = f_v y + c_v A hold the focal lengths and the principal point.
CAHVOR moves the direction first, along its offset from the optical axis O:

    zeta = d.O,  lambda = d - zeta O,  tau = |lambda|^2 / zeta^2
    mu = r0 + r1 tau + r2 tau^2,       d' = d + mu lambda

Pixel (0, 0) is the centre of the top-left pixel. The vectors are in the axes of the label's
reference frame (for rover images: x forward, y right, z down).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from frontends.errors import InputError
from frontends.geometry import inverse, pose, transform_points

FloatArray = NDArray[np.float64]

_NEWTON_STEPS = 25
_AXIS_TOLERANCE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class CahvCamera:
    """A CAHV or CAHVOR camera in some reference frame.

    Attributes
    ----------
    width, height
        Image size, px.
    c
        (3,) projection centre, m.
    a
        (3,) unit normal of the image plane, forward.
    h, v
        (3,) horizontal and vertical vectors, px.
    o
        (3,) unit optical axis, or None for CAHV.
    r
        (3,) radial terms r0, r1, r2; zero for CAHV.

    Raises
    ------
    InputError
        When a vector is not finite, A or O is no unit vector, or the vectors make no image
        plane.
    """

    width: int
    height: int
    c: FloatArray
    a: FloatArray
    h: FloatArray
    v: FloatArray
    o: FloatArray | None = None
    r: FloatArray | None = None

    def __post_init__(self) -> None:
        for name in ("c", "a", "h", "v", "o", "r"):
            value = getattr(self, name)
            if value is not None and (np.shape(value) != (3,) or not np.isfinite(value).all()):
                raise InputError(f"is {value}", source="camera model", field=name.upper())
        for name in ("a", "o"):
            value = getattr(self, name)
            if value is not None and abs(float(np.linalg.norm(value)) - 1.0) > _AXIS_TOLERANCE:
                raise InputError(
                    f"has length {np.linalg.norm(value):.4g}, must be 1",
                    source="camera model",
                    field=name.upper(),
                    remedy="check that the label is complete",
                )
        if (self.o is None) != (self.r is None):
            raise InputError("O and R go together", source="camera model", field="O, R")
        if self.width <= 0 or self.height <= 0 or min(self.focal_h_px, self.focal_v_px) <= 1.0:
            raise InputError(
                f"{self.width}x{self.height} px, focal lengths {self.focal_h_px:.3g} and "
                f"{self.focal_v_px:.3g} px",
                source="camera model",
                field="H, V",
                remedy="check that the label is complete",
            )

    @property
    def focal_h_px(self) -> float:
        """Horizontal focal length ``|A x H|``, px."""
        return float(np.linalg.norm(np.cross(self.a, self.h)))

    @property
    def focal_v_px(self) -> float:
        """Vertical focal length ``|A x V|``, px."""
        return float(np.linalg.norm(np.cross(self.a, self.v)))

    @property
    def focal_px(self) -> float:
        """Mean of the two focal lengths, px."""
        return 0.5 * (self.focal_h_px + self.focal_v_px)

    @property
    def principal_point(self) -> tuple[float, float]:
        """``A.H`` and ``A.V``, px."""
        return float(self.a @ self.h), float(self.a @ self.v)

    @property
    def skew_rad(self) -> float:
        """By how much the angle between the image axes differs from a right one, rad.

        A linear camera that comes from a warped image may have some; a lens none.
        """
        x = self.h - (self.a @ self.h) * self.a
        y = self.v - (self.a @ self.v) * self.a
        cosine = float(x @ y / (np.linalg.norm(x) * np.linalg.norm(y)))
        return float(np.arcsin(np.clip(cosine, -1.0, 1.0)))

    def reference_T_camera(self) -> FloatArray:
        """(4, 4) pose of the camera axes (x right, y down, z forward) in the reference frame.

        z is the image plane's normal A, x the part of H across it, y completes them.
        """
        z = self.a / np.linalg.norm(self.a)
        x = self.h - (z @ self.h) * z
        x = x / np.linalg.norm(x)
        return pose(np.column_stack([x, np.cross(z, x), z]), self.c)

    def moved(self, new_T_reference: FloatArray) -> CahvCamera:
        """The same camera in another reference frame."""
        turn = new_T_reference[:3, :3]
        return replace(
            self,
            c=transform_points(new_T_reference, self.c[None])[0],
            a=turn @ self.a,
            h=turn @ self.h,
            v=turn @ self.v,
            o=None if self.o is None else turn @ self.o,
        )

    def in_own_axes(self) -> CahvCamera:
        """The camera in its own axes, with its centre at the origin."""
        return self.moved(inverse(self.reference_T_camera()))

    def project(self, directions: FloatArray) -> FloatArray:
        """Pixels (N, 2) of directions (N, 3) from the centre; NaN behind the camera."""
        bent = self._bent(directions)
        depth = bent @ self.a
        ahead = depth > 1e-9 * np.linalg.norm(directions, axis=1)
        if self.o is not None:
            ahead &= directions @ self.o > 0.0
        scale = np.where(ahead, depth, np.nan)
        return np.stack([bent @ self.h / scale, bent @ self.v / scale], axis=-1)

    def project_points(self, points: FloatArray) -> FloatArray:
        """Pixels (N, 2) of points (N, 3) in the reference frame, m."""
        return self.project(points - self.c)

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Directions (N, 3) of pixels (N, 2), unit length, in the reference frame's axes.

        CAHV: the line where the planes ``(H - u A).d = 0`` and ``(V - v A).d = 0`` meet.
        CAHVOR: that line is d'; its offset from O is ``x' = x (1 + mu(x^2))``, which Newton's
        method solves for x.
        """
        bent = np.cross(
            self.v - pixels[:, 1:] * self.a,
            self.h - pixels[:, :1] * self.a,
        )
        bent *= np.sign(bent @ self.a)[:, None]
        bent /= np.linalg.norm(bent, axis=1, keepdims=True)
        if self.o is None or self.r is None:
            return np.asarray(bent)
        zeta = bent @ self.o
        across = bent - zeta[:, None] * self.o
        length = np.linalg.norm(across, axis=1)
        wanted = length / zeta
        r0, r1, r2 = self.r
        x = wanted / (1.0 + r0)
        for _ in range(_NEWTON_STEPS):
            x2 = x * x
            value = x * (1.0 + r0 + r1 * x2 + r2 * x2 * x2) - wanted
            slope = 1.0 + r0 + 3.0 * r1 * x2 + 5.0 * r2 * x2 * x2
            step = value / np.where(np.abs(slope) > 1e-6, slope, 1e-6)
            x = x - step
            if np.max(np.abs(step), initial=0.0) < 1e-14:
                break
        unit = across / np.where(length > 0.0, length, 1.0)[:, None]
        rays = self.o + x[:, None] * unit
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    @classmethod
    def linear(
        cls,
        size: tuple[int, int],
        reference_T_camera: FloatArray,
        focal_px: tuple[float, float],
        principal_point: tuple[float, float],
    ) -> CahvCamera:
        """CAHV of a pinhole camera: ``H = f_h x + c_h z``, ``V = f_v y + c_v z``, A = z."""
        x, y, z, centre = reference_T_camera[:3].T
        return cls(
            *size,
            centre.copy(),
            z.copy(),
            focal_px[0] * x + principal_point[0] * z,
            focal_px[1] * y + principal_point[1] * z,
        )

    def _bent(self, directions: FloatArray) -> FloatArray:
        if self.o is None or self.r is None:
            return directions
        zeta = directions @ self.o
        across = directions - zeta[:, None] * self.o
        tau = np.sum(across**2, axis=1) / np.where(zeta > 0.0, zeta, np.nan) ** 2
        mu = self.r[0] + self.r[1] * tau + self.r[2] * tau**2
        return np.asarray(directions + np.nan_to_num(mu)[:, None] * across)
