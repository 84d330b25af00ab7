"""Motions with their covariances: one after the other, and in other axes."""

from __future__ import annotations

from frontends.geometry import adjoint, inverse
from frontends.measurements import FloatArray


def compose(
    map_T_a: FloatArray, covariance_a: FloatArray, a_T_b: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Pose of `b` and its covariance from independent ``map_T_a`` and ``a_T_b``."""
    carry = adjoint(inverse(a_T_b))
    return map_T_a @ a_T_b, carry @ covariance_a @ carry.T + covariance


def in_rover_frames(
    a_T_b: FloatArray, covariance: FloatArray, rover_T_camera: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Turn a camera motion and its covariance into the rover's."""
    rotate = adjoint(rover_T_camera)
    return rover_T_camera @ a_T_b @ inverse(rover_T_camera), rotate @ covariance @ rotate.T
