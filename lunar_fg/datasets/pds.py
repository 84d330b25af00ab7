"""Folders of Mars rover stereo images with labels: each pair rectified from its own labels.

A mast turns, so the camera's place in the rover changes from pair to pair, while the graph
knows one. The run therefore follows a body that is fixed to the camera: the rover as it stood
at the first pair, carried along by the camera. Label poses are converted to that body, so
prediction and attitude fit whatever the mast does; where it never turns, the body is the rover.

The labels' rover poses are the rover's own dead reckoning, not truth: their differences become
wheel odometry within a site, their roll and pitch the attitude.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from frontends.cahv import CahvCamera
from frontends.camera import StereoCamera
from frontends.errors import InputError
from frontends.geometry import inverse, so3_log, yaw_pitch_roll
from frontends.measurements import (
    Attitude,
    Image,
    StartPrior,
    StereoFrame,
    UnusableFrame,
    WheelOdometry,
)
from frontends.undistort import StereoCalibration, rectifier_of
from lunar_fg.datasets.base import FloatArray, GroundTruth, MapReference, OrbitalFiles
from lunar_fg.datasets.images import darkness
from lunar_fg.datasets.label_text import is_label
from lunar_fg.datasets.pds_image import read_rover_image
from lunar_fg.datasets.pds_label import RoverLabel, read_label

SUFFIXES = (".img", ".lbl", ".vic")
_MOST_FILES = 20_000
#: Left and right are exposed at once; read out one after the other.
_PAIR_WINDOW_S = 5.0
#: Baselines of one rig agree to this share, through the labels' six digits.
_BASELINE_TOLERANCE = 0.02
#: 1-sigma of a rover's roll and pitch by its IMU, and of its heading with and without the Sun
#: (Ali et al. 2005: tilt well below a degree, heading 2 to 3 degrees by the Sun).
_SIGMA_TILT_RAD = 0.01
_SIGMA_HEADING_RAD = {True: 0.04, False: 0.1}


@dataclass(frozen=True, slots=True)
class LabelledPair:
    """Labels of one stereo pair."""

    left: RoverLabel
    right: RoverLabel

    def cameras(self) -> tuple[CahvCamera, CahvCamera]:
        """Both models; `read_label` and `_pairs` made sure that they are there."""
        assert self.left.camera is not None
        assert self.right.camera is not None
        return self.left.camera, self.right.camera

    def calibration(self) -> StereoCalibration:
        """Stereo calibration by the labels."""
        return StereoCalibration.of_cahv(*self.cameras())


@dataclass(frozen=True, slots=True)
class PdsDataset:
    """Labelled pairs in order of time; see `lunar_fg.datasets.base.Dataset`.

    Attributes
    ----------
    pairs
        With sol, site and drive in their labels.
    """

    name: str
    path: Path
    pairs: tuple[LabelledPair, ...]
    camera: StereoCamera
    rover_T_camera: FloatArray
    start: StartPrior
    notes: tuple[str, ...]
    ground_truth: GroundTruth | None = None
    map_reference: MapReference | None = None
    orbital: OrbitalFiles | None = None

    def __len__(self) -> int:
        """Count the pairs."""
        return len(self.pairs)

    def frames(self, after: int = -1) -> Iterator[StereoFrame | UnusableFrame]:
        """Read and rectify the pairs above an index in order, one at a time."""
        for index in range(after + 1, len(self.pairs)):
            yield self._frame(index)

    def _frame(self, index: int) -> StereoFrame | UnusableFrame:
        pair = self.pairs[index]
        odometry, attitude = self._odometry(index), self._attitude(index)
        try:
            left, right = self._images(pair)
        except InputError as error:
            reason = f"{pair.left.identity}, {Path(str(error.source)).name}: {error.problem}"
            return UnusableFrame(index, pair.left.clock_s, reason, odometry, attitude)
        return StereoFrame(
            index, pair.left.clock_s, left, right, self.camera, odometry, attitude, pair.left.sun
        )

    def _images(self, pair: LabelledPair) -> tuple[Image, Image]:
        raw = []
        for label in (pair.left, pair.right):
            image, _ = read_rover_image(label)
            if reason := darkness(image):
                raise InputError(reason, source=label.image)
            raw.append(image)
        calibration = pair.calibration()
        change = abs(calibration.baseline_m / self.camera.baseline_m - 1.0)
        if change > _BASELINE_TOLERANCE:
            raise InputError(
                f"its baseline is {calibration.baseline_m:.4f} m, the first pair's "
                f"{self.camera.baseline_m:.4f} m: another rig",
                source=pair.left.image,
            )
        return rectifier_of(calibration, self.camera).rectify(*raw)

    def _body_pose(self, index: int) -> FloatArray | None:
        """``site_T_body`` by the label: the first pair's rover, carried by the camera."""
        label = self.pairs[index].left
        mount = label.rover_T_camera()
        if label.site_T_rover is None or mount is None:
            return None
        first = self.pairs[0].left.rover_T_camera()
        assert first is not None
        return np.asarray(label.site_T_rover @ mount @ inverse(first))

    def _odometry(self, index: int) -> WheelOdometry | None:
        if index == 0 or self.pairs[index - 1].left.site != self.pairs[index].left.site:
            return None
        before, now = self._body_pose(index - 1), self._body_pose(index)
        if before is None or now is None:
            return None
        motion = inverse(before) @ now
        # the mean of both attitudes' planes: half of the turn lies before the way, half after
        turn = so3_log(motion[:3, :3])
        yaw = float(turn[2])
        x, y = (float(value) for value in motion[:2, 3])
        return WheelOdometry(x, y, yaw)

    def _attitude(self, index: int) -> Attitude | None:
        body = self._body_pose(index)
        if body is None:
            return None
        yaw, pitch, roll = yaw_pitch_roll(body)
        heading = _SIGMA_HEADING_RAD[self.pairs[index].left.fine_attitude]
        return Attitude(roll, pitch, yaw, _SIGMA_TILT_RAD, heading)


@dataclass(frozen=True, slots=True)
class PdsReader:
    """Reader of folders of labelled rover images."""

    format_name: str = "pds"
    looks_for: str = "PDS3 or VICAR rover images, *.IMG or *.LBL"

    def detects(self, path: Path) -> bool:
        """Whether there is a file with such a label."""
        return any(is_label(file) for file in _files(path))

    def open(self, path: Path, images_root: Path | None = None) -> PdsDataset:
        """Open a folder; pairs are found by eye, site, drive and spacecraft clock.

        Raises
        ------
        InputError
            When there are no pairs with camera models; the text says what there is.
        """
        if images_root is not None:
            raise InputError(
                "archive images lie beside their labels", source=path, field="images",
                remedy="leave the images folder out",
            )  # fmt: skip
        pairs, notes = _pairs(path)
        first = pairs[0]
        rectifier = rectifier_of(first.calibration())
        mount = first.left.rover_T_camera()
        assert mount is not None
        dataset = PdsDataset(
            name=path.resolve().name,
            path=path,
            pairs=pairs,
            camera=rectifier.camera,
            rover_T_camera=mount @ rectifier.left_T_rectified,
            start=StartPrior(),
            notes=(*notes, *_notes(pairs)),
        )
        start = dataset._body_pose(0)
        return dataset if start is None else replace(dataset, start=StartPrior(start))


def _files(path: Path) -> list[Path]:
    names = sorted(name for name in os.listdir(path) if name.lower().endswith(SUFFIXES))
    if len(names) > _MOST_FILES:
        raise InputError(f"holds more than {_MOST_FILES} images", source=path)
    return [path / name for name in names]


def _pairs(path: Path) -> tuple[tuple[LabelledPair, ...], tuple[str, ...]]:
    labels: dict[Path, RoverLabel] = {}
    problems: list[str] = []
    for file in _files(path):
        if not is_label(file):
            continue
        try:
            label = read_label(file)
        except InputError as error:
            problems.append(str(error))
            continue
        labels.setdefault(label.image, label)
    usable = [label for label in labels.values() if label.camera is not None]
    pairs, alone = _match_eyes(usable)
    if not pairs:
        eyes = ", ".join(f"{label.image.name} ({label.eye or 'no eye'})" for label in usable[:4])
        raise InputError(
            "holds no stereo pairs" + (f": {eyes}" if eyes else "")
            + (f"; {problems[0]}" if problems else ""),
            source=path,
            field="images",
            remedy="left and right of one exposure, of the same kind, with a camera model each",
        )  # fmt: skip
    notes = tuple(f"left out: {problem}" for problem in problems[:5])
    if alone:
        notes = (*notes, f"{alone} images without a partner are left out")
    return tuple(pairs), notes


def _match_eyes(labels: list[RoverLabel]) -> tuple[list[LabelledPair], int]:
    """Pairs in order of the clock; each image at most once."""
    rights = sorted((label for label in labels if label.eye == "right"), key=_clock)
    pairs: list[LabelledPair] = []
    for left in sorted((label for label in labels if label.eye == "left"), key=_clock):
        partners = [label for label in rights if _belong(left, label)]
        if not partners:
            continue
        right = min(partners, key=lambda label: abs(label.clock_s - left.clock_s))
        if pairs and left.clock_s <= pairs[-1].left.clock_s:
            continue  # the same exposure in another version
        rights.remove(right)
        pairs.append(LabelledPair(left, right))
    return pairs, len(labels) - 2 * len(pairs)


def _belong(left: RoverLabel, right: RoverLabel) -> bool:
    return (
        abs(left.clock_s - right.clock_s) <= _PAIR_WINDOW_S
        and (left.instrument, left.site, left.drive, left.linearised)
        == (right.instrument, right.site, right.drive, right.linearised)
        and (left.width, left.height) == (right.width, right.height)
    )


def _clock(label: RoverLabel) -> float:
    return label.clock_s


def _notes(pairs: tuple[LabelledPair, ...]) -> Iterator[str]:
    first, last = pairs[0].left, pairs[-1].left
    yield f"labels: {len(pairs)} pairs from {first.identity} to {last.identity}"
    if any(pair.left.companded for pair in pairs):
        yield "companded 8-bit images are taken as they are: their square-root scale is kept"
    mounts = [pair.left.rover_T_camera() for pair in pairs]
    turned = [mount for mount in mounts if mount is not None and mounts[0] is not None
              and np.abs(mount - mounts[0]).max() > 1e-3]  # fmt: skip
    if turned:
        yield (
            f"the mast turned before {len(turned)} of the pairs: poses are of a rover fixed to "
            "the camera as at the first pair"
        )
    if len({pair.left.site for pair in pairs}) > 1:
        yield "several sites: no odometry across their borders, the map is the first one's"
