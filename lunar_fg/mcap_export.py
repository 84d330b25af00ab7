"""A run as an MCAP recording that Foxglove and ROS 2 open, through rosbags (extra ``bags``).

Frames: ``map`` (east, north, up), ``rover`` (forward, left, up) and ``left_camera`` (right,
down, forward), as ROS wants its map, base and optical frames.

=============  ====================================  =========================================
topic          type                                  content
=============  ====================================  =========================================
``/tf``        tf2_msgs/TFMessage                    map from rover, each keyframe
``/tf_static`` tf2_msgs/TFMessage                    rover from left_camera
``/pose``      geometry_msgs/PoseWithCovarianceStamped  the same pose, covariance in map axes
``/path``      nav_msgs/Path                         the whole trajectory
``/landmarks`` sensor_msgs/PointCloud2               stereo landmarks of each keyframe, map
=============  ====================================  =========================================
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from frontends.errors import DependencyError, InputError
from frontends.geometry import transform_points
from lunar_fg.log import TraverseLog
from lunar_fg.run_folder import RunFolder

FloatArray = NDArray[np.float64]

MAP, ROVER, CAMERA = "map", "rover", "left_camera"
_FLOAT32 = 7
_POINT_BYTES = 12


def export_mcap(folder: RunFolder, target: Path) -> tuple[Path, ...]:
    """Poses, transforms and landmarks of a run; smoothed where the run was.

    Raises
    ------
    InputError
        When the run has no poses, or the file cannot be written.
    DependencyError
        When rosbags is not installed.
    """
    try:
        from rosbags import rosbag2
    except ImportError as error:
        raise DependencyError(
            "writing recordings needs rosbags: pip install 'lunar-fg[bags]'"
        ) from error
    with TraverseLog.open(folder.database_path) as log:
        mount, keyframes = log.header().rover_T_camera, log.keyframes()
    trajectory = folder.read_trajectory()
    if not len(trajectory):
        raise InputError("holds no poses", source=folder.path)
    clouds = {round(k.stamp_s, 6): k.observations for k in keyframes if k.observations is not None}
    with tempfile.TemporaryDirectory(dir=target.parent) as scratch:
        bag = Path(scratch) / "run"
        with rosbag2.Writer(bag, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
            messages = _Messages(writer)
            first = float(trajectory.stamp_s[0])
            messages.transform("/tf_static", first, ROVER, CAMERA, mount)
            for row, (stamp, pose) in enumerate(
                zip(trajectory.stamp_s.tolist(), trajectory.map_T_rover, strict=True)
            ):
                messages.transform("/tf", stamp, MAP, ROVER, pose)
                if trajectory.covariance is not None:
                    messages.pose("/pose", stamp, pose, trajectory.covariance[row])
                seen = clouds.get(round(stamp, 6))
                if seen is not None:
                    points = transform_points(pose @ mount, seen.points_cam)
                    messages.cloud("/landmarks", stamp, points)
            messages.path("/path", trajectory.stamp_s.tolist(), trajectory.map_T_rover)
        made = next(bag.glob("*.mcap"))
        try:
            shutil.move(made, target)
        except OSError as error:
            raise InputError(f"cannot be written: {error.strerror}", source=target) from error
    return (target,)


class _Messages:
    """Makes standard ROS 2 messages and writes them."""

    def __init__(self, writer: Any) -> None:
        from rosbags.typesys import Stores, get_typestore

        self._writer = writer
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._connections: dict[str, Any] = {}

    def transform(
        self, topic: str, stamp: float, parent: str, child: str, parent_T_child: FloatArray
    ) -> None:
        stamped = self._type("geometry_msgs/msg/TransformStamped")(
            self._header(stamp, parent),
            child,
            self._type("geometry_msgs/msg/Transform")(
                self._type("geometry_msgs/msg/Vector3")(*map(float, parent_T_child[:3, 3])),
                self._quaternion(parent_T_child),
            ),
        )
        self._write(topic, "tf2_msgs/msg/TFMessage", stamp, [stamped])

    def pose(
        self, topic: str, stamp: float, map_T_rover: FloatArray, covariance: FloatArray
    ) -> None:
        turn = np.kron(np.eye(2), map_T_rover[:3, :3])
        order = [3, 4, 5, 0, 1, 2]  # ROS: position first, about the axes of the parent frame
        in_map = (turn @ covariance @ turn.T)[np.ix_(order, order)]
        body = self._type("geometry_msgs/msg/PoseWithCovariance")(
            self._pose(map_T_rover), in_map.ravel()
        )
        kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
        self._write(topic, kind, stamp, self._header(stamp, MAP), body)

    def path(self, topic: str, stamps: list[float], map_T_rover: FloatArray) -> None:
        stamped = self._type("geometry_msgs/msg/PoseStamped")
        poses = [
            stamped(self._header(stamp, MAP), self._pose(pose))
            for stamp, pose in zip(stamps, map_T_rover, strict=True)
        ]
        self._write(topic, "nav_msgs/msg/Path", stamps[-1], self._header(stamps[-1], MAP), poses)

    def cloud(self, topic: str, stamp: float, points: FloatArray) -> None:
        field = self._type("sensor_msgs/msg/PointField")
        fields = [field(name, 4 * k, _FLOAT32, 1) for k, name in enumerate("xyz")]
        data = np.ascontiguousarray(points, dtype="<f4").view(np.uint8).ravel()
        self._write(
            topic, "sensor_msgs/msg/PointCloud2", stamp, self._header(stamp, MAP),
            1, len(points), fields, False, _POINT_BYTES, len(data), data, True,
        )  # fmt: skip

    def _pose(self, transform: FloatArray) -> Any:
        point = self._type("geometry_msgs/msg/Point")(*map(float, transform[:3, 3]))
        return self._type("geometry_msgs/msg/Pose")(point, self._quaternion(transform))

    def _quaternion(self, transform: FloatArray) -> Any:
        values = Rotation.from_matrix(transform[:3, :3]).as_quat(canonical=True)
        return self._type("geometry_msgs/msg/Quaternion")(*map(float, values))

    def _header(self, stamp: float, frame: str) -> Any:
        nanoseconds = _nanoseconds(stamp)
        time = self._type("builtin_interfaces/msg/Time")(nanoseconds // 10**9, nanoseconds % 10**9)
        return self._type("std_msgs/msg/Header")(time, frame)

    def _type(self, name: str) -> Any:
        return self._store.types[name]

    def _write(self, topic: str, kind: str, stamp: float, *fields: Any) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._store
            )
        data = self._store.serialize_cdr(self._type(kind)(*fields), kind)
        self._writer.write(self._connections[topic], _nanoseconds(stamp), data)


def _nanoseconds(stamp_s: float) -> int:
    # a dataset that counts from zero, or below, still needs a time that ROS can hold
    return max(0, round(1e9 * stamp_s))
