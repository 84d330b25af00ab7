"""Kalibr's camchain.yaml: ``cam0`` and ``cam1``, pinhole with radtan or equidistant lenses."""

from __future__ import annotations

from frontends.distortion import LensCamera
from frontends.geometry import inverse
from frontends.undistort import StereoCalibration
from lunar_fg.datasets.calibrations.values import Section


def kalibr(chain: Section) -> StereoCalibration:
    """Calibration of the first two cameras; ``T_cn_cnm1`` maps cam0 to cam1 axes.

    Raises
    ------
    InputError
        When a value is missing or wrong, or a camera is not a pinhole.
    """
    second = chain.section("cam1")
    cam1_T_cam0 = second.transform("T_cn_cnm1")
    left, right = _camera(chain.section("cam0")), _camera(second)
    return StereoCalibration(left, right, inverse(cam1_T_cam0))


def _camera(section: Section) -> LensCamera:
    model = section.text("camera_model")
    if model != "pinhole":
        raise section.error(
            "camera_model", f"is {model[:40]!a}", "only pinhole is supported: calibrate with it"
        )
    return section.camera(
        "intrinsics",
        section.size_list("resolution"),
        section.numbers("intrinsics", 4),
        section.lens("distortion_model"),
        section.numbers("distortion_coeffs"),
    )
