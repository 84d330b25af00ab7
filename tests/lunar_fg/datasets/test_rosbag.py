"""ROS recordings, written here from the real EuRoC images with their real calibration."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from dataset_files import refusal_of
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore
from typer.testing import CliRunner

from frontends.errors import InputError
from frontends.geometry import inverse
from frontends.measurements import StereoFrame, UnusableFrame
from lunar_fg.cli import app
from lunar_fg.datasets import open_dataset
from lunar_fg.datasets.calibrations import read_calibration

KINDS = ("ros1", "sqlite3", "mcap")
FRAMES = 4


class Recorder:
    """Writes messages of either ROS; stamps in nanoseconds."""

    def __init__(self, path: Path, kind: str) -> None:
        self.ros1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            self.writer = rosbag1.Writer(path)
        else:
            plugin = rosbag2.StoragePlugin[kind.upper()]
            self.writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        self.writer.open()
        self.connections: dict[str, object] = {}

    def type(self, name: str):
        return self.store.types[name]

    def header(self, stamp: int):
        time = self.type("builtin_interfaces/msg/Time")(sec=stamp // 10**9, nanosec=stamp % 10**9)
        head = self.type("std_msgs/msg/Header")
        extra = {"seq": 0} if self.ros1 else {}
        return head(stamp=time, frame_id="camera", **extra)

    def write(self, topic: str, name: str, stamp: int, **fields) -> None:
        message = self.type(name)(header=self.header(stamp), **fields)
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        serialise = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], stamp, serialise(message, name))


def write_image(to: Recorder, topic: str, stamp: int, image: np.ndarray, how: str) -> None:
    if how == "compressed":
        data = cv2.imencode(".png", image)[1]
        to.write(f"{topic}/compressed", "sensor_msgs/msg/CompressedImage", stamp,
                 format="png", data=np.asarray(data, np.uint8).ravel())  # fmt: skip
        return
    pixels = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if how == "bgr8" else image
    to.write(topic, "sensor_msgs/msg/Image", stamp, height=image.shape[0], width=image.shape[1],
             encoding=how, is_bigendian=0, step=pixels.strides[0], data=pixels.ravel())  # fmt: skip


def write_info(to: Recorder, topic: str, stamp: int, eye, rectification, projection) -> None:
    names = "DKRP" if to.ros1 else "dkrp"
    values = (np.array(eye.coefficients), eye.matrix.ravel(), rectification, projection)
    region = to.type("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
    to.write(topic, "sensor_msgs/msg/CameraInfo", stamp, height=eye.height, width=eye.width,
             distortion_model="plumb_bob", binning_x=0, binning_y=0, roi=region,
             **{name: np.asarray(value, float).ravel()
                for name, value in zip(names, values, strict=True)})  # fmt: skip


def record(
    path: Path, source: Path, kind: str, how: str = "mono8", *, delay: int = 0, info: bool = True
) -> Path:
    """Four frames of EuRoC, right images `delay` ns late, with wheels and attitude."""
    pair = read_calibration([source / "cam0_sensor.yaml"])
    right_T_left = inverse(pair.left_T_right)
    r1, r2, p1, p2 = cv2.stereoRectify(
        pair.left.matrix, np.array(pair.left.coefficients), pair.right.matrix,
        np.array(pair.right.coefficients), (752, 480), right_T_left[:3, :3],
        right_T_left[:3, 3:], alpha=0,
    )[:4]  # fmt: skip
    to = Recorder(path, kind)
    names = sorted(file.name for file in (source / "cam0").iterdir())[:FRAMES]
    vector = to.type("geometry_msgs/msg/Vector3")
    quaternion = to.type("geometry_msgs/msg/Quaternion")
    point, pose = (to.type(f"geometry_msgs/msg/{name}") for name in ("Point", "Pose"))
    for number, name in enumerate(names):
        stamp = int(Path(name).stem)
        for eye, folder, late in (("left", "cam0", 0), ("right", "cam1", delay)):
            image = cv2.imread(str(source / folder / name), cv2.IMREAD_GRAYSCALE)
            write_image(to, f"/stereo/{eye}/image_raw", stamp + late, image, how)
        if info:
            for eye, camera, turn, projection in (
                ("left", pair.left, r1, p1), ("right", pair.right, r2, p2),
            ):  # fmt: skip
                write_info(to, f"/stereo/{eye}/camera_info", stamp, camera, turn, projection)
        turned = quaternion(x=0.0, y=0.0, z=np.sin(0.05 * number), w=np.cos(0.05 * number))
        zero9, zero36 = np.zeros(9), np.zeros(36)
        to.write("/imu", "sensor_msgs/msg/Imu", stamp, orientation=turned,
                 orientation_covariance=zero9, angular_velocity=vector(0.0, 0.0, 0.0),
                 angular_velocity_covariance=zero9, linear_acceleration=vector(0.0, 0.0, 9.8),
                 linear_acceleration_covariance=zero9)  # fmt: skip
        place = pose(
            position=point(0.2 * number, 0.0, 0.0), orientation=quaternion(0.0, 0.0, 0.0, 1.0)
        )
        twist = to.type("geometry_msgs/msg/Twist")(vector(0.0, 0, 0), vector(0.0, 0, 0))
        to.write("/odom", "nav_msgs/msg/Odometry", stamp, child_frame_id="base",
                 pose=to.type("geometry_msgs/msg/PoseWithCovariance")(place, zero36),
                 twist=to.type("geometry_msgs/msg/TwistWithCovariance")(twist, zero36))  # fmt: skip
    to.writer.close()
    return path


def path_of(tmp_path: Path, kind: str) -> Path:
    return tmp_path / ("run.bag" if kind == "ros1" else "run")


@pytest.fixture
def euroc(shared_data: Path) -> Path:
    return shared_data / "euroc-v101-still"


@pytest.mark.parametrize(
    ("kind", "how"), [("ros1", "mono8"), ("sqlite3", "bgr8"), ("mcap", "compressed")]
)
def test_a_recording_gives_what_the_folder_gives(euroc, tmp_path, kind: str, how: str) -> None:
    path = record(path_of(tmp_path, kind), euroc, kind, how)
    dataset, folder = open_dataset(path), open_dataset(euroc)
    assert len(dataset) == FRAMES
    assert dataset.camera.baseline_m == pytest.approx(folder.camera.baseline_m, abs=1e-6)
    assert dataset.camera.fx == pytest.approx(folder.camera.fx, rel=1e-6)
    first = next(iter(dataset.frames()))
    expected = next(iter(folder.frames()))
    assert isinstance(first, StereoFrame)
    assert isinstance(expected, StereoFrame)
    assert first.stamp_s == pytest.approx(expected.stamp_s, abs=1e-6)
    assert np.abs(first.left.astype(int) - expected.left).max() <= 1
    assert any("/stereo/left/image_raw" in note for note in dataset.notes)
    assert not any("calibration check" in note for note in dataset.notes)


def test_wheels_and_attitude_come_along(euroc: Path, tmp_path: Path) -> None:
    frames = list(open_dataset(record(tmp_path / "run", euroc, "mcap")).frames())
    assert frames[0].odometry is None
    assert frames[1].odometry is not None
    assert frames[1].odometry.d_forward_m == pytest.approx(0.2, abs=1e-6)
    assert frames[2].attitude is not None
    assert frames[2].attitude.yaw_rad == pytest.approx(0.2, abs=1e-6)
    assert frames[2].attitude.sigma_rp_rad > 0.0
    assert [frame.index for frame in open_dataset(tmp_path / "run").frames(after=1)] == [2, 3]


@pytest.mark.parametrize(("delay", "paired"), [(4_000_000, True), (40_000_000, False)])
def test_synchronisation_has_a_tolerance(euroc, tmp_path, delay: int, paired: bool) -> None:
    path = record(tmp_path / "run.bag", euroc, "ros1", delay=delay)
    frames = list(open_dataset(path).frames())
    assert len(frames) == FRAMES
    if paired:
        assert all(isinstance(frame, StereoFrame) for frame in frames)
    else:
        assert all(isinstance(frame, UnusableFrame) for frame in frames)
        assert "no right image within 10 ms" in frames[0].reason


def test_topics_by_name(euroc: Path, tmp_path: Path) -> None:
    path = record(tmp_path / "run.bag", euroc, "ros1")
    names = ["/stereo/left/image_raw", "/stereo/right/image_raw"]
    assert len(open_dataset(path, topics=names)) == FRAMES
    with pytest.raises(InputError, match=r"there are: /imu \(Imu, 4\), /odom") as caught:
        open_dataset(path, topics=["/a", "/b"])
    assert "/stereo/left/camera_info (CameraInfo, 4)" in str(caught.value)


def test_a_calibration_file_instead_of_camera_info(euroc: Path, tmp_path: Path) -> None:
    path = record(tmp_path / "run.bag", euroc, "ros1", info=False)
    with pytest.raises(InputError, match="no camera_info"):
        open_dataset(path)
    dataset = open_dataset(path, calibration=[euroc / "cam0_sensor.yaml"])
    assert isinstance(next(iter(dataset.frames())), StereoFrame)


def test_one_command_runs_a_recording(euroc: Path, tmp_path: Path) -> None:
    path = record(tmp_path / "run.bag", euroc, "ros1", "compressed")
    result = CliRunner().invoke(app, ["run", str(path), "-o", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    assert (tmp_path / "out" / "trajectory.tum").is_file()


@pytest.mark.parametrize("kind", KINDS)
def test_truncated_and_damaged_recordings(euroc: Path, tmp_path: Path, kind: str) -> None:
    whole = record(path_of(tmp_path, kind), euroc, kind)
    file = whole if whole.is_file() else next(f for f in whole.iterdir() if f.suffix != ".yaml")
    data = file.read_bytes()
    rng = np.random.default_rng(0)
    said = []
    for share in (0.0, 0.01, 0.6):
        file.write_bytes(data[: int(share * len(data))])
        said.append(refusal_of(lambda path: list(open_dataset(path).frames()), whole))
    for _ in range(2):
        broken = bytearray(data)
        for place in rng.integers(0, min(len(data), 4000), 20):
            broken[place] ^= int(rng.integers(1, 256))
        file.write_bytes(bytes(broken))
        said.append(refusal_of(lambda path: list(open_dataset(path).frames()), whole))
    assert said[0]
    assert said[1]
    assert all("\n" not in text for text in said)


def test_hostile_metadata(euroc: Path, tmp_path: Path) -> None:
    path = record(tmp_path / "run", euroc, "sqlite3")
    metadata = path / "metadata.yaml"
    text = metadata.read_text()
    name = next(file.name for file in path.iterdir() if file.suffix == ".db3")
    shutil.move(path / name, tmp_path / name)
    for old, new, part in (
        (name, f"../{name}", "not the name of a file"),
        ("rosbag2_bagfile_information:", "a: &a [1]\nb: *a\nc:", "aliases"),
        ("compression_format: ''", "compression_format: zstd", "compressed as a whole"),
    ):
        assert old in text
        metadata.write_text(text.replace(old, new))
        assert part in refusal_of(open_dataset, path)


def test_images_that_lie_about_their_size(tmp_path: Path) -> None:
    to = Recorder(tmp_path / "run.bag", "ros1")
    for eye in ("left", "right"):
        to.write(f"/{eye}/image", "sensor_msgs/msg/Image", 10**9, height=2**31, width=2**31,
                 encoding="mono8", is_bigendian=0, step=4, data=np.zeros(16, np.uint8))  # fmt: skip
    to.writer.close()
    source = tmp_path / "camera.yaml"
    source.write_text(
        "schema: lunar-fg/traverse/1\ncamera: {width: 64, height: 48, fx: 50, fy: 50, cx: 31.5, "
        "cy: 23.5, baseline_m: 0.1}\n"
    )
    frames = list(open_dataset(tmp_path / "run.bag", calibration=[source]).frames())
    assert isinstance(frames[0], UnusableFrame)
    assert "holds 16 bytes" in frames[0].reason
