"""ROS messages to what the datasets give: grey images, calibrated cameras, wheels, attitude.

Messages are the plain objects that rosbags deserialises; every size in them is checked
against the bytes that are there before anything is made of it.
"""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from frontends.distortion import Lens, LensCamera
from frontends.errors import InputError
from frontends.measurements import Image
from frontends.undistort import StereoCalibration
from lunar_fg.datasets.calibrations.camera_info import from_projection, lens_of
from lunar_fg.datasets.calibrations.values import FloatArray, Section
from lunar_fg.datasets.images import MAX_PIXELS, decode_grey
from lunar_fg.datasets.tables import AttitudeTable, OdometryTable

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
ODOMETRY = "nav_msgs/msg/Odometry"
IMU = "sensor_msgs/msg/Imu"

#: 1-sigma of an IMU's attitude where the message states none, rad: roll and pitch, yaw.
_DEFAULT_SIGMAS = (0.02, 0.1)
#: Encodings: bytes a pixel, and the conversion to grey (None: grey already).
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "mono8": (1, None),
    "8UC1": (1, None),
    "mono16": (2, None),
    "16UC1": (2, None),
    "bgr8": (3, cv2.COLOR_BGR2GRAY),
    "8UC3": (3, cv2.COLOR_BGR2GRAY),
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2GRAY),
}
_WHITE_16 = 65535


def header_stamp(raw: bytes | memoryview) -> float:
    """Stamp of a message that begins with a header, s, without deserialising the rest.

    ROS 1 has the sequence number, ROS 2 the encapsulation in the first four bytes.
    """
    if len(raw) < 12:
        raise InputError("is cut off", source="message")
    seconds, nanoseconds = struct.unpack_from("<iI", raw, 4)
    return float(seconds + 1e-9 * nanoseconds)


def grey_image(message: Any, kind: str, source: str) -> Image:
    """Grey image of an Image or CompressedImage message, (height, width) uint8.

    Raises
    ------
    InputError
        When the sizes do not fit the data, or the encoding is not known.
    """
    if kind == COMPRESSED:
        return decode_grey(bytes(message.data), source, _WHITE_16)
    height, width, step = int(message.height), int(message.width), int(message.step)
    encoding = str(message.encoding)
    if encoding not in _ENCODINGS:
        raise InputError(
            f"has encoding {encoding[:40]!a}", source=source, field="encoding",
            remedy=f"known: {', '.join(_ENCODINGS)}",
        )  # fmt: skip
    size, conversion = _ENCODINGS[encoding]
    data = np.asarray(message.data, dtype=np.uint8).ravel()
    if not 0 < width * height <= MAX_PIXELS or step < width * size or len(data) < step * height:
        raise InputError(
            f"states {width}x{height} px and rows of {step} bytes, but holds {len(data)} bytes",
            source=source,
        )
    rows = data[: step * height].reshape(height, step)[:, : width * size]
    if size == 2:
        wide = np.ascontiguousarray(rows).view(">u2" if message.is_bigendian else "<u2")
        return np.asarray(wide >> 8, dtype=np.uint8)
    if conversion is None:
        return np.ascontiguousarray(rows)
    shape = (height, width) if size == 1 else (height, width, size)
    pixels = np.ascontiguousarray(rows).reshape(shape)
    return np.asarray(cv2.cvtColor(pixels, conversion), dtype=np.uint8)


def calibration_of(left: Any, right: Any, source: Section, *, rectified: bool) -> StereoCalibration:
    """Calibration of two CameraInfo messages.

    Parameters
    ----------
    rectified
        The images are rectified already: projection matrices only.

    Raises
    ------
    InputError
        When a matrix is wrong or holds no baseline.
    """
    cameras = [_camera(message, source, rectified) for message in (left, right)]
    turns = [
        np.eye(3) if rectified else _rotation(message.R if hasattr(message, "R") else message.r)
        for message in (left, right)
    ]
    projection = _values(right, "P", 12).reshape(3, 4)
    return from_projection(source, cameras[0], cameras[1], turns[0], turns[1], projection, "P")


def odometry_table(stamps: list[float], messages: list[Any]) -> OdometryTable | None:
    """Increments in the plane between consecutive odometry poses."""
    order = _increasing(stamps)
    if len(order) < 2:
        return None
    poses = [messages[k].pose.pose for k in order]
    turns = Rotation.from_quat([_quaternion(pose.orientation) for pose in poses])
    places = np.array([[p.position.x, p.position.y, p.position.z] for p in poses], dtype=float)
    steps = turns[:-1].inv().apply(np.diff(places, axis=0))
    yaw = (turns[:-1].inv() * turns[1:]).as_rotvec()[:, 2]
    increments = np.vstack([np.zeros(3), np.column_stack([steps[:, :2], yaw])])
    if not np.isfinite(increments).all():
        return None
    return OdometryTable(np.array([stamps[k] for k in order]), increments)


def attitude_table(stamps: list[float], messages: list[Any]) -> AttitudeTable | None:
    """Roll, pitch, yaw of IMU orientations, whose axes are taken to be the rover's."""
    usable = [
        k for k in _increasing(stamps)
        if float(messages[k].orientation_covariance[0]) >= 0.0
        and np.isfinite(_quaternion(messages[k].orientation)).all()
        and np.linalg.norm(_quaternion(messages[k].orientation)) > 0.5
    ]  # fmt: skip
    if not usable:
        return None
    turns = Rotation.from_quat([_quaternion(messages[k].orientation) for k in usable])
    angles = turns.as_euler("ZYX")[:, ::-1]
    variances = np.array([np.diag(np.reshape(messages[k].orientation_covariance, (3, 3)))
                          for k in usable])  # fmt: skip
    stated = np.sqrt(np.column_stack([variances[:, :2].max(axis=1), variances[:, 2]]))
    sigmas = np.where(stated > 0.0, stated, _DEFAULT_SIGMAS)
    return AttitudeTable(np.array([stamps[k] for k in usable]), angles, sigmas)


def _camera(message: Any, source: Section, rectified: bool) -> LensCamera:
    size = int(message.width), int(message.height)
    if not (0 < size[0] <= 32_000 and 0 < size[1] <= 32_000):
        raise source.error("width, height", f"are {size[0]}x{size[1]}")
    matrix = _values(message, "P", 12).reshape(3, 4)[:, :3] if rectified else None
    if matrix is None:
        matrix = _values(message, "K", 9).reshape(3, 3)
    coefficients = np.zeros(0) if rectified else _distortion(message)
    lens = lens_of(str(message.distortion_model) or "plumb_bob", coefficients, source, "model")
    if lens is Lens.NONE:
        coefficients = np.zeros(0)
    return source.camera("K", size, matrix[[0, 1, 0, 1], [0, 1, 2, 2]], lens, coefficients)


def _distortion(message: Any) -> FloatArray:
    found = np.asarray(getattr(message, "D", getattr(message, "d", ())), dtype=np.float64).ravel()
    return found[:14]


def _values(message: Any, name: str, count: int) -> FloatArray:
    """Return a matrix of a CameraInfo: upper-case names in ROS 1, lower-case in ROS 2."""
    value = getattr(message, name, None)
    if value is None:
        value = getattr(message, name.lower())
    found = np.asarray(value, dtype=np.float64).ravel()
    if len(found) != count or not np.isfinite(found).all():
        raise InputError(f"has no {count} finite values", source="camera_info", field=name)
    return found


def _rotation(values: Any) -> FloatArray:
    matrix = np.asarray(values, dtype=np.float64).reshape(3, 3)
    if not matrix.any():
        return np.eye(3)
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-3:
        raise InputError("is not a rotation", source="camera_info", field="R")
    return matrix


def _quaternion(orientation: Any) -> NDArray[np.float64]:
    return np.array([orientation.x, orientation.y, orientation.z, orientation.w], dtype=float)


def _increasing(stamps: list[float]) -> list[int]:
    """Rows whose stamp is later than all before."""
    latest, rows = -np.inf, []
    for row, stamp in enumerate(stamps):
        if stamp > latest:
            latest = stamp
            rows.append(row)
    return rows
