"""EuRoC / ASL folders: ``cam0`` and ``cam1`` with their ``sensor.yaml``, raw images.

The body frame is EuRoC's (that of its IMU), whatever its axes; ``T_BS`` places the cameras in
it. Stamps are nanoseconds; poses of ``state_groundtruth_estimate0`` are the truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from frontends.errors import InputError
from lunar_fg.datasets.base import GroundTruth
from lunar_fg.datasets.calibrations import read_calibration
from lunar_fg.datasets.calibrations.euroc import euroc_camera
from lunar_fg.datasets.calibrations.values import Section
from lunar_fg.datasets.raw_pairs import image_names
from lunar_fg.datasets.rectified import RectifiedDataset, open_rectified
from lunar_fg.datasets.stereo_files import StereoPair
from lunar_fg.datasets.strict_yaml import read_opencv_yaml
from lunar_fg.trajectory import Trajectory
from lunar_fg.trajectory_io import read_track

#: Where the two sensor.yaml are, as published and with the folders flattened.
_SENSORS = ("{}/sensor.yaml", "{}_sensor.yaml")
_TRUTH = "state_groundtruth_estimate0/data.csv"
_STAMP_DIGITS = 19


@dataclass(frozen=True, slots=True)
class EurocReader:
    """Reader of EuRoC / ASL folders."""

    format_name: str = "euroc"
    looks_for: str = "cam0/sensor.yaml and cam1/sensor.yaml, perhaps in mav0"

    def detects(self, path: Path) -> bool:
        """Whether the left camera's ``sensor.yaml`` is there."""
        return _sensors(_root(path)) is not None

    def open(self, path: Path, images_root: Path | None = None) -> RectifiedDataset:
        """Open a folder; its images are rectified as they are read.

        Raises
        ------
        InputError
            One line that names file, field, what is wrong and the remedy.
        """
        if images_root is not None:
            raise InputError(
                "an EuRoC folder holds its own images",
                source=path,
                field="images",
                remedy="leave the images folder out",
            )
        root = _root(path)
        sensors = _sensors(root)
        assert sensors is not None
        left, right = sensors
        if not right.is_file():
            raise InputError(
                "is missing", source=right, remedy="copy the right camera's folder, too"
            )
        pairs, notes = _pairs(root)
        mount = euroc_camera(Section.of(left, read_opencv_yaml(left))).body_T_camera
        return open_rectified(
            path,
            pairs,
            read_calibration((left, right)),
            left,
            rover_T_left=mount,
            ground_truth=_truth(root),
            notes=notes,
        )


def _root(path: Path) -> Path:
    return path / "mav0" if (path / "mav0").is_dir() else path


def _sensors(root: Path) -> tuple[Path, Path] | None:
    for pattern in _SENSORS:
        left, right = (root / pattern.format(name) for name in ("cam0", "cam1"))
        if left.is_file():
            return left, right
    return None


def _pairs(root: Path) -> tuple[tuple[StereoPair, ...], tuple[str, ...]]:
    """Images of equal stamps; one eye's alone cannot be used and is counted."""
    folders = []
    for name in ("cam0", "cam1"):
        inner = root / name / "data"
        folders.append(inner if inner.is_dir() else root / name)
    names = [image_names(folder) for folder in folders]
    both = [name for name in names[0] if name in set(names[1])]
    if not both:
        raise InputError(
            f"{len(names[0])} images in cam0 and {len(names[1])} in cam1 have no name in common",
            source=root,
            field="images",
            remedy="the two cameras' images pair up by their stamps: copy both",
        )
    alone = len(names[0]) + len(names[1]) - 2 * len(both)
    notes = (f"{alone} images of one eye only are left out",) if alone else ()
    return tuple(
        StereoPair(order, _stamp(root, name), folders[0] / name, folders[1] / name)
        for order, name in enumerate(both)
    ), notes


def _stamp(root: Path, name: str) -> float:
    stem = Path(name).stem
    if not (stem.isascii() and stem.isdecimal() and len(stem) <= _STAMP_DIGITS):
        raise InputError(
            f"{name[:60]!a} is no stamp in nanoseconds",
            source=root,
            field="images",
            remedy="keep EuRoC's file names",
        )
    return 1e-9 * int(stem)


def _truth(root: Path) -> GroundTruth | None:
    file = root / _TRUTH
    if not file.is_file():
        return None
    track = read_track(file)
    if isinstance(track, Trajectory):
        return GroundTruth.of_poses(track.stamp_s, track.map_T_rover)
    columns = track.position_m.shape[1]
    return GroundTruth(track.stamp_s, track.position_m, has_height=columns == 3)
