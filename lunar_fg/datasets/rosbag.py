"""Stereo sequences out of ROS recordings: topics, time synchronisation, wheels, attitude.

Every image of the left topic is a frame; the right image nearest in time belongs to it when
it is at most `SYNC_TOLERANCE_S` away, otherwise the frame is unusable and says so. A first
pass reads stamps, wheels and attitude; images are decoded one pair at a time.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from frontends.calibration_check import check_calibration
from frontends.camera import StereoCamera, level_rover_T_camera
from frontends.errors import InputError
from frontends.measurements import (
    Attitude,
    Image,
    StartPrior,
    StereoFrame,
    UnusableFrame,
    WheelOdometry,
)
from frontends.undistort import StereoCalibration, StereoRectifier, rectifier_of
from lunar_fg.datasets.association import attitude_at_frames, odometry_between_frames
from lunar_fg.datasets.bag_file import BagFile, Topic, find_bag
from lunar_fg.datasets.base import FloatArray, GroundTruth, MapReference, OrbitalFiles
from lunar_fg.datasets.calibrations import read_calibration
from lunar_fg.datasets.calibrations.values import Section
from lunar_fg.datasets.images import darkness
from lunar_fg.datasets.ros_messages import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    IMU,
    ODOMETRY,
    attitude_table,
    calibration_of,
    grey_image,
    header_stamp,
    odometry_table,
)

SYNC_TOLERANCE_S = 0.01
#: Messages of one eye held back while waiting for the other's.
_LONGEST_QUEUE = 50
_EYES = (
    ("left", "right"),
    ("cam0", "cam1"),
    ("camera0", "camera1"),
    ("infra1", "infra2"),
    ("image_0", "image_1"),
)
_CHECKED_FRAMES = 2


@dataclass(frozen=True, slots=True)
class BagDataset:
    """A stereo recording; see `lunar_fg.datasets.base.Dataset`.

    Attributes
    ----------
    topics
        Of the left and the right images.
    stamps_s
        (N,) of the left images that follow one another in time.
    """

    name: str
    path: Path
    bag: BagFile
    topics: tuple[Topic, Topic]
    stamps_s: FloatArray
    camera: StereoCamera
    rectifier: StereoRectifier | None
    wheels: tuple[WheelOdometry | None, ...]
    attitudes: tuple[Attitude | None, ...]
    rover_T_camera: FloatArray
    notes: tuple[str, ...]
    start: StartPrior
    ground_truth: GroundTruth | None = None
    map_reference: MapReference | None = None
    orbital: OrbitalFiles | None = None

    def __len__(self) -> int:
        """Count the left images."""
        return len(self.stamps_s)

    def frames(self, after: int = -1) -> Iterator[StereoFrame | UnusableFrame]:
        """Read the frames above an index in order, one at a time."""
        index = 0
        for left, right in self._pairs():
            if index >= len(self) or header_stamp(left) != self.stamps_s[index]:
                continue  # repeats or goes back in time
            if index > after:
                yield self._frame(index, left, right)
            index += 1

    def _pairs(self) -> Iterator[tuple[bytes, bytes | None]]:
        """Left messages, each with the right one nearest in time, where there is one."""
        lefts: deque[bytes] = deque()
        rights: deque[bytes] = deque()
        for topic, data in self.bag.raw({topic.name for topic in self.topics}):
            (lefts if topic == self.topics[0].name else rights).append(data)
            if len(rights) > _LONGEST_QUEUE:
                rights.popleft()
            while lefts and (
                len(lefts) > _LONGEST_QUEUE
                or (rights and header_stamp(rights[-1]) >= header_stamp(lefts[0]))
            ):
                yield _take_nearest(lefts, rights)
        while lefts:
            yield _take_nearest(lefts, rights)

    def _frame(self, index: int, left: bytes, right: bytes | None) -> StereoFrame | UnusableFrame:
        stamp = float(self.stamps_s[index])
        sensors = self.wheels[index], self.attitudes[index]
        try:
            if right is None:
                raise InputError(
                    f"no right image within {1e3 * SYNC_TOLERANCE_S:.0f} ms",
                    source=self.topics[1].name,
                )
            images = self._image(left, 0), self._image(right, 1)
        except InputError as error:
            return UnusableFrame(index, stamp, f"{error.source}: {error.problem}", *sensors)
        if self.rectifier is not None:
            images = self.rectifier.rectify(*images)
        return StereoFrame(index, stamp, *images, self.camera, *sensors)

    def _image(self, data: bytes, eye: int) -> Image:
        topic = self.topics[eye]
        image = grey_image(self.bag.decode(data, topic.kind), topic.kind, topic.name)
        if image.shape != (self.camera.height, self.camera.width):
            raise InputError(
                f"has {image.shape[1]}x{image.shape[0]} px, the calibration "
                f"{self.camera.width}x{self.camera.height}",
                source=topic.name,
            )
        if reason := darkness(image):
            raise InputError(reason, source=topic.name)
        return image


@dataclass(frozen=True, slots=True)
class BagReader:
    """Reader of ROS 1 and ROS 2 recordings."""

    format_name: str = "rosbag"
    looks_for: str = "a ROS recording: metadata.yaml, or one .bag, .mcap or .db3 file"

    def detects(self, path: Path) -> bool:
        """Whether there is a recording."""
        return find_bag(path) is not None

    def open(
        self,
        path: Path,
        images_root: Path | None = None,
        topics: Sequence[str] = (),
        calibration: Sequence[Path] = (),
    ) -> BagDataset:
        """Open a recording.

        Parameters
        ----------
        path
            The recording.
        images_root
            Not used by this format.
        topics
            Left and right image topic; found by their names by default.
        calibration
            Files that replace the recorded camera_info.

        Raises
        ------
        InputError
            When there is no stereo pair of topics, or no calibration; the text lists the
            topics that there are.
        """
        bag = find_bag(path)
        if bag is None or images_root is not None:
            raise InputError(
                "is no single recording" if bag is None else "a recording holds its own images",
                source=path, field="dataset", remedy="give the .bag or .mcap file alone",
            )  # fmt: skip
        known = bag.topics()
        left, right, chosen = _choose(known, topics, path)
        pair = _calibration(bag, known, (left, right), calibration)
        rectifier = None if pair.rectified_camera() is not None else rectifier_of(pair)
        camera = pair.rectified_camera() or (None if rectifier is None else rectifier.camera)
        assert camera is not None
        stamps, wheels, attitudes, said = _first_pass(bag, known, left)
        if not len(stamps):
            raise InputError("holds no images", source=path, field=left.name)
        dataset = BagDataset(
            path.resolve().stem, path, bag, (left, right), stamps, camera, rectifier,
            wheels, attitudes, level_rover_T_camera(), (*chosen, *said), StartPrior(),
        )  # fmt: skip
        usable = (f for f in itertools.islice(dataset.frames(), 20) if isinstance(f, StereoFrame))
        check = check_calibration(camera, itertools.islice(usable, _CHECKED_FRAMES))
        findings = tuple(f"calibration check: {finding}" for finding in check.findings)
        return replace(dataset, notes=(*dataset.notes, *findings))


def _choose(
    known: Sequence[Topic], asked: Sequence[str], path: Path
) -> tuple[Topic, Topic, tuple[str, ...]]:
    """Left and right image topic, and what to say of the choice."""
    images = [topic for topic in known if topic.kind in (IMAGE, COMPRESSED) and topic.count]
    listed = ", ".join(f"{t.name} ({t.kind.rpartition('/')[2]}, {t.count})" for t in known[:30])
    by_name = {topic.name: topic for topic in images}
    if asked:
        if len(asked) != 2 or not all(name in by_name for name in asked):
            raise InputError(
                f"{', '.join(asked)[:200]} are no two image topics with messages",
                source=path, field="topics", remedy=f"there are: {listed}",
            )  # fmt: skip
        return by_name[asked[0]], by_name[asked[1]], ()
    pairs = [
        (topic, by_name[partner])
        for topic in images
        for left, right in _EYES
        if left in topic.name and (partner := topic.name.replace(left, right)) in by_name
        and by_name[partner].kind == topic.kind
    ]  # fmt: skip
    if not pairs:
        raise InputError(
            "holds no two image topics called left and right (or cam0 and cam1)",
            source=path,
            field="topics",
            remedy=f"give --topic twice; there are: {listed or 'none'}",
        )
    # rectified before raw, whole before compressed, many before few
    best = max(pairs, key=lambda p: ("rect" in p[0].name, p[0].kind == IMAGE, p[0].count))
    others = [t.name for t in images if t not in best]
    said = f"topics: {best[0].name} and {best[1].name}, synchronised to {SYNC_TOLERANCE_S:g} s"
    return *best, (said + (f"; not used: {', '.join(others[:10])}" if others else ""),)


def _calibration(
    bag: BagFile, known: Sequence[Topic], images: tuple[Topic, Topic], files: Sequence[Path]
) -> StereoCalibration:
    if files:
        return read_calibration(files)
    infos = []
    for topic in images:
        info = _info_topic(topic.name, known)
        if info is None:
            raise InputError(
                f"has no camera_info for {topic.name}",
                source=bag.path,
                field="calibration",
                remedy="give --calibration FILE",
            )
        infos.append(info)
    first: dict[str, bytes] = {}
    for name, data in bag.raw(set(infos)):
        first.setdefault(name, data)
        if len(first) == len(set(infos)):
            break
    left, right = (bag.decode(first[name], CAMERA_INFO) for name in infos)
    return calibration_of(
        left, right, Section(bag.path, {}, "camera_info."), rectified="rect" in images[0].name
    )


def _info_topic(image: str, known: Sequence[Topic]) -> str | None:
    """camera_info topic beside an image topic, or the only one of its eye."""
    names = [topic.name for topic in known if topic.kind == CAMERA_INFO and topic.count]
    parts = image.split("/")
    for end in range(len(parts) - 1, 0, -1):
        name = "/".join([*parts[:end], "camera_info"])
        if name in names:
            return name
    for left, right in _EYES:
        eye = next((eye for eye in (left, right) if eye in image), None)
        found = [name for name in names if eye is not None and eye in name]
        if len(found) == 1:
            return found[0]
    return None


def _first_pass(
    bag: BagFile, known: Sequence[Topic], left: Topic
) -> tuple[
    FloatArray, tuple[WheelOdometry | None, ...], tuple[Attitude | None, ...], tuple[str, ...]
]:
    """Stamps of the frames, and what wheels and IMU say at them."""
    wheels, imu = (
        next((t.name for t in known if t.kind == kind and t.count), "") for kind in (ODOMETRY, IMU)
    )
    stamps: list[float] = []
    sensed: dict[str, tuple[list[float], list[object]]] = {wheels: ([], []), imu: ([], [])}
    repeated = 0
    for topic, data in bag.raw({left.name, *filter(None, (wheels, imu))}):
        stamp = header_stamp(data)
        if topic == left.name:
            if stamps and stamp <= stamps[-1]:
                repeated += 1
            else:
                stamps.append(stamp)
        else:
            sensed[topic][0].append(stamp)
            sensed[topic][1].append(bag.decode(data, ODOMETRY if topic == wheels else IMU))
    frames = np.array(stamps)
    none: tuple[None, ...] = (None,) * len(stamps)
    odometry = odometry_table(*sensed[wheels]) if wheels else None
    attitude = attitude_table(*sensed[imu]) if imu else None
    said = []
    if repeated:
        said.append(f"{repeated} left images repeat a time or go back: left out")
    if odometry is not None:
        said.append(f"wheels: {wheels}")
    if attitude is not None:
        said.append(f"attitude: {imu}, whose axes are taken to be the rover's")
    return (
        frames,
        none if odometry is None else odometry_between_frames(frames, odometry),
        none if attitude is None else attitude_at_frames(frames, attitude),
        tuple(said),
    )


def _take_nearest(lefts: deque[bytes], rights: deque[bytes]) -> tuple[bytes, bytes | None]:
    """Take the oldest left message and its right one; older right ones are dropped."""
    left = lefts.popleft()
    stamp = header_stamp(left)
    while rights and header_stamp(rights[0]) < stamp - SYNC_TOLERANCE_S:
        rights.popleft()
    near = [data for data in rights if abs(header_stamp(data) - stamp) <= SYNC_TOLERANCE_S]
    if not near:
        return left, None
    best = min(near, key=lambda data: abs(header_stamp(data) - stamp))
    while rights and rights[0] is not best:
        rights.popleft()
    rights.popleft()
    return left, best
