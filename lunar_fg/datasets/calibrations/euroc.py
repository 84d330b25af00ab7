"""EuRoC / ASL ``sensor.yaml``, one a camera: intrinsics, lens and pose in the body."""

from __future__ import annotations

from dataclasses import dataclass

from frontends.distortion import LensCamera
from frontends.geometry import inverse
from frontends.undistort import StereoCalibration
from lunar_fg.datasets.calibrations.values import FloatArray, Section


@dataclass(frozen=True, slots=True)
class BodyCamera:
    """A camera and its pose in the body, ``body_T_camera`` (4, 4)."""

    camera: LensCamera
    body_T_camera: FloatArray


def euroc_camera(section: Section) -> BodyCamera:
    """Read one ``sensor.yaml``.

    Raises
    ------
    InputError
        When a value is missing or wrong, or the camera is not a pinhole.
    """
    model = section.text("camera_model")
    if model != "pinhole":
        raise section.error("camera_model", f"is {model[:40]!a}", "only pinhole is supported")
    camera = section.camera(
        "intrinsics",
        section.size_list("resolution"),
        section.numbers("intrinsics", 4),
        section.lens("distortion_model", "none"),
        section.numbers("distortion_coefficients"),
    )
    return BodyCamera(camera, section.transform("T_BS"))


def euroc(left: Section, right: Section) -> StereoCalibration:
    """Calibration from the two cameras' files."""
    first, second = euroc_camera(left), euroc_camera(right)
    left_T_right = inverse(first.body_T_camera) @ second.body_T_camera
    return StereoCalibration(first.camera, second.camera, left_T_right)
