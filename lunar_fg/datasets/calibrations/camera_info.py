"""ROS camera_info YAML (``camera_calibration``): one file a camera, or one document each.

``projection_matrix`` holds the rectified intrinsics and, for the right camera, ``-f B`` in
its fourth column; ``rectification_matrix`` turns the camera's axes to the rectified ones.
"""

from __future__ import annotations

import numpy as np

from frontends.distortion import Lens, LensCamera
from frontends.geometry import pose
from frontends.undistort import StereoCalibration
from lunar_fg.datasets.calibrations.values import FloatArray, Section


def camera_info(left: Section, right: Section) -> StereoCalibration:
    """Calibration from the two cameras' files.

    Raises
    ------
    InputError
        When a value is missing or wrong, or the right projection holds no baseline.
    """
    projection = right.matrix("projection_matrix", 3, 4)
    first, second = (_rotation(section) for section in (left, right))
    return from_projection(
        right, _camera(left), _camera(right), first, second, projection, "projection_matrix"
    )


def from_projection(
    section: Section,
    left: LensCamera,
    right: LensCamera,
    rectified_R_left: FloatArray,
    rectified_R_right: FloatArray,
    right_projection: FloatArray,
    field: str,
) -> StereoCalibration:
    """Calibration from ROS's rectification: rotations and the right projection (3, 4)."""
    focal, shift = right_projection[0, 0], right_projection[0, 3]
    if focal <= 0.0 or shift == 0.0:
        raise section.error(
            field,
            "holds no baseline: its fourth column is zero",
            "give the right camera's file of a stereo calibration, left first",
        )
    baseline = np.array([-shift / focal, 0.0, 0.0])
    left_T_right = pose(rectified_R_left.T @ rectified_R_right, rectified_R_left.T @ baseline)
    return StereoCalibration(left, right, left_T_right)


def lens_of(model: str, coefficients: FloatArray, section: Section, field: str) -> Lens:
    """Lens by ROS's name; without any coefficient there is none."""
    if not coefficients.any():
        return Lens.NONE
    return Section(section.source, {field: model}, section.prefix).lens(field)


def _camera(section: Section) -> LensCamera:
    coefficients = section.numbers("distortion_coefficients")
    lens = lens_of(
        section.text("distortion_model", "plumb_bob"), coefficients, section, "distortion_model"
    )
    return section.intrinsics(
        "camera_matrix",
        section.size("image_width", "image_height"),
        lens,
        coefficients if lens is not Lens.NONE else np.zeros(0),
    )


def _rotation(section: Section) -> FloatArray:
    if not section.has("rectification_matrix"):
        return np.eye(3)
    matrix = section.matrix("rectification_matrix", 3, 3)
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-3 or np.linalg.det(matrix) < 0.0:
        raise section.error("rectification_matrix", "is not a rotation")
    return matrix
