"""Sequences of raw stereo images, rectified as they are read."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from frontends.calibration_check import check_calibration
from frontends.camera import StereoCamera, level_rover_T_camera
from frontends.measurements import StartPrior, StereoFrame, UnusableFrame
from frontends.undistort import StereoCalibration, rectifier_of
from lunar_fg.datasets.base import FloatArray, GroundTruth, MapReference, OrbitalFiles
from lunar_fg.datasets.stereo_files import StereoFiles, StereoPair, check_sizes, find_white_level

#: Pairs, spread over the sequence, on which a calibration is checked.
_CHECKED_PAIRS = 3


@dataclass(frozen=True, slots=True)
class RectifiedDataset:
    """Raw pairs with their calibration; see `lunar_fg.datasets.base.Dataset`."""

    name: str
    path: Path
    files: StereoFiles
    rover_T_camera: FloatArray
    ground_truth: GroundTruth | None
    notes: tuple[str, ...]
    start: StartPrior
    map_reference: MapReference | None = None
    orbital: OrbitalFiles | None = None

    @property
    def camera(self) -> StereoCamera:
        """The pair after rectification."""
        return self.files.camera

    def __len__(self) -> int:
        """Count the frames, usable or not."""
        return len(self.files)

    def frames(self, after: int = -1) -> Iterator[StereoFrame | UnusableFrame]:
        """Read and rectify the frames above an index in order, one at a time."""
        return self.files.frames(after)


def open_rectified(
    path: Path,
    pairs: tuple[StereoPair, ...],
    calibration: StereoCalibration,
    source: Path,
    *,
    rover_T_left: FloatArray | None = None,
    ground_truth: GroundTruth | None = None,
    notes: tuple[str, ...] = (),
) -> RectifiedDataset:
    """Put raw pairs and their calibration together, and check one on the other.

    Parameters
    ----------
    path
        What was opened.
    pairs
        The images.
    calibration, source
        Of the pair, and the file that it came from.
    rover_T_left
        (4, 4) pose of the raw left camera; level and looking forward where not known.
    ground_truth, notes
        For the dataset; findings of the check are added to the notes.

    Raises
    ------
    InputError
        When the images do not have the calibration's size, or cannot be rectified.
    """
    camera = calibration.rectified_camera()
    rectifier = None if camera is not None else rectifier_of(calibration)
    if rectifier is not None:
        camera = rectifier.camera
    assert camera is not None
    check_sizes(camera, pairs, source, "image size")
    white_level, note = find_white_level(pairs)
    files = StereoFiles(camera, pairs, white_level, rectifier=rectifier)
    if rover_T_left is None:
        # the mount is not known: the rectified camera, not the raw one, is taken as level
        rover_T_camera = level_rover_T_camera()
    else:
        turn = np.eye(4) if rectifier is None else rectifier.left_T_rectified
        rover_T_camera = rover_T_left @ turn
    if rectifier is not None:
        notes = (*notes, f"rectified by {source.name}: f {camera.fx:.1f} px, baseline "
                         f"{camera.baseline_m:.4f} m")  # fmt: skip
    return RectifiedDataset(
        name=path.resolve().name,
        path=path,
        files=files,
        rover_T_camera=rover_T_camera,
        ground_truth=ground_truth,
        notes=(*notes, *([note] if note else []), *calibration_findings(files)),
        start=StartPrior(),
    )


def calibration_findings(files: StereoFiles) -> tuple[str, ...]:
    """What the check of a calibration on some of its images says, for the notes."""
    step = max(1, len(files.pairs) // _CHECKED_PAIRS)
    some = replace(files, pairs=files.pairs[::step][:_CHECKED_PAIRS])
    usable = (frame for frame in some.frames() if isinstance(frame, StereoFrame))
    check = check_calibration(files.camera, itertools.islice(usable, _CHECKED_PAIRS))
    return tuple(f"calibration check: {finding}" for finding in check.findings)
