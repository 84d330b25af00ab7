"""A list of image pairs on disk, read one at a time into frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from frontends.camera import StereoCamera
from frontends.errors import InputError
from frontends.measurements import (
    Attitude,
    Image,
    StereoFrame,
    SunDirection,
    UnusableFrame,
    WheelOdometry,
)
from frontends.undistort import StereoRectifier
from lunar_fg.datasets.images import darkness, read_grey, read_header, read_peak

#: Pairs that are looked at to find how many of 16 bits are in use.
_DEPTH_SAMPLES = 5
_BIT_DEPTHS = (8, 10, 12, 14, 16)


@dataclass(frozen=True, slots=True)
class StereoPair:
    """Files and side measurements of one frame."""

    index: int
    stamp_s: float
    left: Path
    right: Path
    odometry: WheelOdometry | None = None
    attitude: Attitude | None = None


@dataclass(frozen=True, slots=True)
class StereoFiles:
    """Image pairs of one camera, in order of time.

    Attributes
    ----------
    white_level
        Value of 16-bit images that becomes 255.
    sun
        Direction to the Sun, given to every frame.
    rectifier
        For raw images: what makes them those of `camera`.
    """

    camera: StereoCamera
    pairs: tuple[StereoPair, ...]
    white_level: int = 255
    sun: SunDirection | None = None
    rectifier: StereoRectifier | None = None

    def __len__(self) -> int:
        """Count the pairs."""
        return len(self.pairs)

    def frames(self, after: int = -1) -> Iterator[StereoFrame | UnusableFrame]:
        """Read the frames above an index; one whose images cannot be used has the reason."""
        return map(self.read, (pair for pair in self.pairs if pair.index > after))

    def read(self, pair: StereoPair) -> StereoFrame | UnusableFrame:
        """Read one pair of this camera; with the reason where its images cannot be used."""
        try:
            left, right = self._read_image(pair.left), self._read_image(pair.right)
        except InputError as error:
            reason = f"{error.source}: {error.problem}"
            return UnusableFrame(pair.index, pair.stamp_s, reason, pair.odometry, pair.attitude)
        if self.rectifier is not None:
            left, right = self.rectifier.rectify(left, right)
        return StereoFrame(
            pair.index,
            pair.stamp_s,
            left,
            right,
            self.camera,
            pair.odometry,
            pair.attitude,
            self.sun,
        )

    def _read_image(self, path: Path) -> Image:
        name = short_name(path)
        try:
            image = read_grey(path, self.white_level)
        except InputError as error:
            raise InputError(error.problem, source=name) from error
        height, width = image.shape
        if (width, height) != (self.camera.width, self.camera.height):
            raise InputError(
                f"has {width}x{height} px, the calibration "
                f"{self.camera.width}x{self.camera.height}",
                source=name,
            )
        if reason := darkness(image):
            raise InputError(reason, source=name)
        return image


def short_name(path: Path) -> str:
    """Name of an image for messages, with its folder, e.g. ``left/000003.png``."""
    return f"{path.parent.name}/{path.name}"


def check_sizes(
    camera: StereoCamera, pairs: tuple[StereoPair, ...], calibration: Path, field: str
) -> None:
    """Hold the first readable pair's size against the calibration.

    Raises
    ------
    InputError
        When the sizes differ, or when no pair has readable headers.
    """
    problem = ""
    for pair in pairs:
        try:
            sizes = [(path, read_header(path).size) for path in (pair.left, pair.right)]
        except InputError as error:
            problem = problem or str(error)
            continue
        for path, (width, height) in sizes:
            if (width, height) != (camera.width, camera.height):
                raise InputError(
                    f"states {camera.width}x{camera.height} px, but {short_name(path)} has "
                    f"{width}x{height} px",
                    source=calibration,
                    field=field,
                    remedy="give the calibration of these rectified images",
                )
        return
    raise InputError(
        f"none of the {len(pairs)} image pairs can be read, the first because {problem}",
        source=calibration.parent,
        field="images",
        remedy="check that the images were copied completely",
    )


def find_white_level(pairs: tuple[StereoPair, ...]) -> tuple[int, str]:
    """Full scale of the images, and a note where it had to be inferred.

    8-bit images need none. 16-bit files often hold 10, 12 or 14 bits: the smallest
    depth that holds the brightest pixel of five pairs spread over the sequence counts,
    the same for all images, so that brightness stays comparable between them.
    """
    step = max(1, (len(pairs) - 1) // (_DEPTH_SAMPLES - 1))
    peak = 0
    for pair in pairs[::step]:
        for path in (pair.left, pair.right):
            try:
                if read_header(path).bits > 8:
                    peak = max(peak, read_peak(path))
            except InputError:
                continue  # reported when the frame is read
    if not peak:
        return 255, ""
    bits = next(bits for bits in _BIT_DEPTHS if peak < 1 << bits)
    return (1 << bits) - 1, f"images of 16 bits are read as {bits}-bit values (brightest: {peak})"
