"""From two calibrated cameras with lenses to one rectified pair: the maps and the images.

The rectified axes: x along the baseline, z the mean viewing direction across it. The
rectified image keeps the size of the originals and shows the largest rectangle, about the
middle, that both eyes fill: no black margins, whose edges would pass for landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.cahv import CahvCamera
from frontends.camera import StereoCamera
from frontends.distortion import CentralCamera, Lens, LensCamera
from frontends.errors import InputError
from frontends.geometry import inverse, is_rigid, pose
from frontends.measurements import Image

FloatArray = NDArray[np.float64]

#: Points along an image side at which the rectified field is measured.
_SIDE_POINTS = 33
#: Viewing directions further from the normal of the baseline are no stereo pair, cos 60 deg.
_MOST_ALONG = 0.5
#: Poses nearer to a pure shift along x (share of the baseline) need no rectification.
_ALIGNED = 1e-6
#: Maps of OpenCV's remap address pixels by 16 bits.
_MAX_SIDE = 32_000


@dataclass(frozen=True, slots=True)
class StereoCalibration:
    """Two cameras with lenses and their relative pose.

    Attributes
    ----------
    left, right
        The cameras, in their own axes.
    left_T_right
        (4, 4) pose of the right camera in the left one's axes, m.

    Raises
    ------
    InputError
        When the pose is not rigid, or the right camera is not to the right.
    """

    left: CentralCamera
    right: CentralCamera
    left_T_right: FloatArray

    def __post_init__(self) -> None:
        if not is_rigid(self.left_T_right, 1e-3):
            raise InputError(
                "is not a rigid transform", source="calibration", field="pose of the right camera"
            )
        x, y, z = self.left_T_right[:3, 3]
        baseline = float(np.linalg.norm(self.left_T_right[:3, 3]))
        if not 1e-6 < baseline < 1e4:
            raise InputError(
                f"is {baseline:.3g} m",
                source="calibration",
                field="baseline",
                remedy="check that the translation is in metres, and which cameras are meant",
            )
        if abs(x) < max(abs(y), abs(z)):
            raise InputError(
                f"the right camera lies at ({x:.3f}, {y:.3f}, {z:.3f}) m of the left one: not "
                "beside it",
                source="calibration",
                field="baseline",
                remedy="only pairs side by side can be rectified along image rows",
            )
        if x < 0.0:
            raise InputError(
                f"the right camera lies {-x:.3f} m to the left of the left one",
                source="calibration",
                field="baseline",
                remedy="exchange the two cameras",
            )

    @property
    def baseline_m(self) -> float:
        """Distance between the projection centres, m."""
        return float(np.linalg.norm(self.left_T_right[:3, 3]))

    @classmethod
    def of_cahv(cls, left: CahvCamera, right: CahvCamera) -> StereoCalibration:
        """Calibration from two models in one reference frame."""
        left_T_right = inverse(left.reference_T_camera()) @ right.reference_T_camera()
        return cls(left.in_own_axes(), right.in_own_axes(), left_T_right)

    @classmethod
    def of_rectified(cls, camera: StereoCamera) -> StereoCalibration:
        """Calibration of a pair that is rectified already."""
        eye = LensCamera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        return cls(eye, eye, pose(np.eye(3), [camera.baseline_m, 0.0, 0.0]))

    def rectified_camera(self) -> StereoCamera | None:
        """The pair's camera where its images are rectified already, else None."""
        left, right = self.left, self.right
        if not isinstance(left, LensCamera) or left.lens is not Lens.NONE or left != right:
            return None
        aligned = pose(np.eye(3), [self.baseline_m, 0.0, 0.0])
        if np.abs(self.left_T_right - aligned).max() > _ALIGNED * self.baseline_m:
            return None
        return StereoCamera(
            left.width, left.height, left.fx, left.fy, left.cx, left.cy, self.baseline_m
        )


@dataclass(frozen=True, slots=True)
class StereoRectifier:
    """Turns the two images of a calibrated pair into a rectified one.

    Attributes
    ----------
    camera
        The rectified pair.
    left_T_rectified
        (4, 4) rectified left axes in the left camera's: a pure rotation.
    left_map, right_map
        (height, width, 2) float32: where each rectified pixel comes from.
    """

    camera: StereoCamera
    left_T_rectified: FloatArray
    left_map: NDArray[np.float32] = field(repr=False)
    right_map: NDArray[np.float32] = field(repr=False)

    def rectify(self, left: Image, right: Image) -> tuple[Image, Image]:
        """Both images, resampled (Lanczos over 8x8 pixels: linear would blur half a pixel)."""
        return self._remap(left, self.left_map), self._remap(right, self.right_map)

    def linear_pair(self, reference_T_left: FloatArray) -> tuple[CahvCamera, CahvCamera]:
        """CAHV models of the rectified images in the frame that the left camera is known in.

        Parameters
        ----------
        reference_T_left
            (4, 4) pose of the original left camera.
        """
        camera, left = self.camera, reference_T_left @ self.left_T_rectified
        right = left @ pose(np.eye(3), [camera.baseline_m, 0.0, 0.0])
        first, second = (
            CahvCamera.linear(
                (camera.width, camera.height),
                eye,
                (camera.fx, camera.fy),
                (camera.cx, camera.cy),
            )
            for eye in (left, right)
        )
        return first, second

    @staticmethod
    def _remap(image: Image, source: NDArray[np.float32]) -> Image:
        u, v = source[..., 0], source[..., 1]
        found = cv2.remap(image, u, v, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found, dtype=np.uint8)


def rectifier_of(
    calibration: StereoCalibration, target: StereoCamera | None = None
) -> StereoRectifier:
    """Rectification of a pair.

    Parameters
    ----------
    calibration
        The two cameras.
    target
        Intrinsics that the rectified pair must have, where several pairs of one rig (a mast
        that turns) shall share them; chosen from the fields of view by default. Its
        baseline is replaced by the calibration's.

    Raises
    ------
    InputError
        When the two fields of view have no rectangle in common.
    """
    left_R_rectified = _axes(calibration)
    right_R_rectified = calibration.left_T_right[:3, :3].T @ left_R_rectified
    camera = target or _intrinsics(calibration, left_R_rectified, right_R_rectified)
    if max(camera.width, camera.height) > _MAX_SIDE:
        raise InputError(
            f"is {camera.width}x{camera.height} px",
            source="calibration",
            field="image size",
            remedy=f"at most {_MAX_SIDE} px a side can be rectified",
        )
    return StereoRectifier(
        camera,
        pose(left_R_rectified, np.zeros(3)),
        _map(camera, calibration.left, left_R_rectified),
        _map(camera, calibration.right, right_R_rectified),
    )


def _axes(calibration: StereoCalibration) -> FloatArray:
    """Rectified axes as columns, in the left camera's axes."""
    x = calibration.left_T_right[:3, 3] / calibration.baseline_m
    forward = np.array([0.0, 0.0, 1.0]) + calibration.left_T_right[:3, 2]
    across = forward - (forward @ x) * x
    if np.linalg.norm(across) < _MOST_ALONG * np.linalg.norm(forward) or forward[2] <= 0.0:
        raise InputError(
            "the cameras look along the baseline, or away from each other",
            source="calibration",
            field="pose of the right camera",
            remedy="check the pose's direction: it must map right-camera to left-camera axes",
        )
    z = across / np.linalg.norm(across)
    return np.column_stack([x, np.cross(z, x), z])


def _intrinsics(
    calibration: StereoCalibration, left_R: FloatArray, right_R: FloatArray
) -> StereoCamera:
    """Square pixels on the largest rectangle that both eyes fill, at the originals' size."""
    left, right = calibration.left, calibration.right
    if (left.width, left.height) != (right.width, right.height):
        raise InputError(
            f"is {left.width}x{left.height} px left and {right.width}x{right.height} px right",
            source="calibration",
            field="image size",
            remedy="both eyes must have the same",
        )
    boxes = np.array([_inner_box(left, left_R), _inner_box(right, right_R)])
    low, high = boxes[:, :2].max(axis=0), boxes[:, 2:].min(axis=0)
    if (high - low <= 0.0).any():
        raise InputError(
            "the two eyes' rectified fields of view have nothing in common",
            source="calibration",
            field="pose of the right camera",
            remedy="check the pose, and that both cameras are of one rig",
        )
    middle = 0.5 * (low + high)
    focal = float(max((left.width - 1.0) / (high[0] - low[0]),
                      (left.height - 1.0) / (high[1] - low[1])))  # fmt: skip
    return StereoCamera(
        left.width,
        left.height,
        focal,
        focal,
        0.5 * (left.width - 1.0) - focal * float(middle[0]),
        0.5 * (left.height - 1.0) - focal * float(middle[1]),
        calibration.baseline_m,
    )


def _inner_box(camera: CentralCamera, camera_R_rectified: FloatArray) -> FloatArray:
    """Largest upright rectangle x0, y0, x1, y1 (z = 1) inside the rectified image's sides."""
    u = np.linspace(0.0, camera.width - 1.0, _SIDE_POINTS)
    v = np.linspace(0.0, camera.height - 1.0, _SIDE_POINTS)
    sides = (
        np.column_stack([np.zeros_like(v), v]),
        np.column_stack([u, np.zeros_like(u)]),
        np.column_stack([np.full_like(v, camera.width - 1.0), v]),
        np.column_stack([u, np.full_like(u, camera.height - 1.0)]),
    )
    limits = []
    for number, pixels in enumerate(sides):
        rays = camera.rays(pixels) @ camera_R_rectified
        if not (rays[:, 2] > 1e-3).all():
            raise InputError(
                "the field of view reaches 90 degrees from the rectified axis",
                source="calibration",
                field="distortion coefficients",
                remedy="check the lens model; wider lenses cannot be rectified to a plane",
            )
        values = rays[:, number % 2] / rays[:, 2]
        limits.append(values.max() if number < 2 else values.min())
    return np.array(limits)


def _map(
    camera: StereoCamera, source: CentralCamera, source_R_rectified: FloatArray
) -> NDArray[np.float32]:
    u, v = np.meshgrid(
        (np.arange(camera.width) - camera.cx) / camera.fx,
        (np.arange(camera.height) - camera.cy) / camera.fy,
    )
    rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=-1)
    pixels = source.project(rays @ source_R_rectified.T)
    # remap reads outside pixels as border; NaN would be undefined
    found = np.nan_to_num(pixels, nan=-1e4).astype(np.float32)
    return found.reshape(camera.height, camera.width, 2)
