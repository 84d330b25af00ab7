"""Rigid transforms as 4x4 matrices, in GTSAM's conventions.

Tangent vectors are ordered rotation, then translation, and perturb on the right:
``a_T_b @ se3_exp(xi)`` moves the pose in the axes of `b`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

_SMALL_ANGLE_RAD = 1e-6


def skew(v: ArrayLike) -> FloatArray:
    """Matrix of the cross product, ``skew(v) @ w == cross(v, w)``; (3,) -> (3, 3)."""
    x, y, z = np.asarray(v, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


_LAST_ROW = (0.0, 0.0, 0.0, 1.0)


def pose(rotation: ArrayLike, translation: ArrayLike) -> FloatArray:
    """4x4 transform from a (3, 3) rotation and a (3,) translation in metres."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def inverse(a_T_b: FloatArray) -> FloatArray:
    """``b_T_a`` of a rigid ``a_T_b``; (4, 4) or (..., 4, 4)."""
    result = np.zeros_like(a_T_b)
    rotation_t = np.swapaxes(a_T_b[..., :3, :3], -1, -2)
    result[..., :3, :3] = rotation_t
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation_t, a_T_b[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def transform_points(a_T_b: FloatArray, points_b: FloatArray) -> FloatArray:
    """Coordinates in `a` of points given in `b`; (N, 3) metres -> (N, 3) metres."""
    return np.asarray(points_b @ a_T_b[:3, :3].T + a_T_b[:3, 3])


def so3_exp(omega: ArrayLike) -> FloatArray:
    """Rotation matrix of a rotation vector in radians (Rodrigues); (3,) -> (3, 3)."""
    omega = np.asarray(omega, dtype=np.float64)
    angle = float(np.linalg.norm(omega))
    k = skew(omega)
    if angle < _SMALL_ANGLE_RAD:
        return np.asarray(np.eye(3) + k + 0.5 * k @ k)
    a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
    return np.asarray(np.eye(3) + a * k + b * k @ k)


def so3_log(rotation: FloatArray) -> FloatArray:
    """Rotation vector in radians of a rotation matrix; (3, 3) -> (3,).

    By the quaternion, whose largest component is found first (Shepperd 1978): exact at all
    angles, half a turn among them.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.asarray(rotation).tolist()
    w, x, y, z = max(
        (1.0 + xx + yy + zz, zy - yz, xz - zx, yx - xy),
        (zy - yz, 1.0 + xx - yy - zz, xy + yx, xz + zx),
        (xz - zx, xy + yx, 1.0 - xx + yy - zz, yz + zy),
        (yx - xy, xz + zx, yz + zy, 1.0 - xx - yy + zz),
        key=lambda q: math.hypot(*q),
    )
    sine = math.hypot(x, y, z)  # of half the angle, and w its cosine, but for a common factor
    share = math.copysign(2.0 * math.atan2(sine, abs(w)) / sine, w) if sine > 0.0 else 0.0
    return np.array([share * x, share * y, share * z])


def _left_jacobian(omega: FloatArray) -> FloatArray:
    angle = float(np.linalg.norm(omega))
    k = skew(omega)
    if angle < _SMALL_ANGLE_RAD:
        return np.asarray(np.eye(3) + 0.5 * k + k @ k / 6.0)
    a = (1.0 - np.cos(angle)) / angle**2
    b = (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + a * k + b * k @ k)


def se3_exp(xi: ArrayLike) -> FloatArray:
    """Transform of a tangent vector (rotation rad, translation m); (6,) -> (4, 4)."""
    xi = np.asarray(xi, dtype=np.float64)
    return pose(so3_exp(xi[:3]), _left_jacobian(xi[:3]) @ xi[3:])


def se3_log(transform: FloatArray) -> FloatArray:
    """Tangent vector (rotation rad, translation m) of a transform; (4, 4) -> (6,)."""
    omega = so3_log(transform[:3, :3])
    translation = np.linalg.solve(_left_jacobian(omega), transform[:3, 3])
    return np.concatenate([omega, translation])


def adjoint(a_T_b: FloatArray) -> FloatArray:
    """Map a tangent vector of frame `b` to frame `a`; (4, 4) -> (6, 6)."""
    rotation = a_T_b[:3, :3]
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = rotation
    result[3:, :3] = skew(a_T_b[:3, 3]) @ rotation
    return result


def is_rigid(transform: FloatArray, tolerance: float = 1e-4) -> bool:
    """Whether a finite 4x4 array is a rigid transform (orthonormal, right-handed)."""
    transform = np.asarray(transform, dtype=np.float64)
    if transform.shape != (4, 4) or not np.isfinite(transform).all():
        return False
    # Plain numbers: each call on so small an array costs more than all of these.
    (a, b, c, _), (d, e, f, _), (g, h, i, _), last = transform.tolist()
    off = max(
        abs(a * a + b * b + c * c - 1.0),
        abs(d * d + e * e + f * f - 1.0),
        abs(g * g + h * h + i * i - 1.0),
        abs(a * d + b * e + c * f),
        abs(a * g + b * h + c * i),
        abs(d * g + e * h + f * i),
        *(abs(x - y) for x, y in zip(last, _LAST_ROW, strict=True)),
    )
    right_handed = a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) > 0.0
    return bool(off < tolerance and right_handed)


def yaw_pitch_roll(a_T_b: FloatArray) -> tuple[float, float, float]:
    """Yaw, pitch, roll in radians with ``R = Rz(yaw) Ry(pitch) Rx(roll)`` (z up)."""
    rotation = a_T_b[:3, :3]
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    pitch = -np.arcsin(np.clip(rotation[2, 0], -1.0, 1.0))
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    return float(yaw), float(pitch), float(roll)
