"""The folder format: ``traverse.yaml`` and tables beside the images (docs/formats.md)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from frontends.camera import StereoCamera
from frontends.errors import InputError
from frontends.measurements import StartPrior, StereoFrame, UnusableFrame
from lunar_fg.datasets.association import attitude_at_frames, odometry_between_frames
from lunar_fg.datasets.base import FloatArray, GroundTruth, MapReference, OrbitalFiles
from lunar_fg.datasets.image_pairs import pair_by_name
from lunar_fg.datasets.schema import MapModel, OrbitalModel, Traverse, nearest_known, read_traverse
from lunar_fg.datasets.stereo_files import StereoFiles, StereoPair, check_sizes, find_white_level
from lunar_fg.datasets.tables import (
    FrameRow,
    read_attitude_csv,
    read_frames_csv,
    read_odometry_csv,
    read_position_csv,
    read_tum,
)

TRAVERSE = "traverse.yaml"
FRAMES = "frames.csv"
ODOMETRY = "odometry.csv"
ATTITUDE = "attitude.csv"
TRUTH_POSES = "ground_truth.tum"
TRUTH_POSITIONS = "ground_truth_position.csv"
_FILES = (TRAVERSE, FRAMES, ODOMETRY, ATTITUDE, TRUTH_POSES, TRUTH_POSITIONS)


@dataclass(frozen=True, slots=True)
class FolderDataset:
    """An opened folder; see `lunar_fg.datasets.base.Dataset` for the attributes."""

    name: str
    path: Path
    files: StereoFiles
    rover_T_camera: FloatArray
    start: StartPrior
    ground_truth: GroundTruth | None
    map_reference: MapReference | None
    orbital: OrbitalFiles | None
    notes: tuple[str, ...]

    @property
    def camera(self) -> StereoCamera:
        """The rectified pair."""
        return self.files.camera

    def __len__(self) -> int:
        """Count the frames, usable or not."""
        return len(self.files)

    def frames(self, after: int = -1) -> Iterator[StereoFrame | UnusableFrame]:
        """Read the frames with an index above `after` in order, one at a time."""
        return self.files.frames(after)


@dataclass(frozen=True, slots=True)
class FolderReader:
    """Reader of the folder format."""

    format_name: str = "folder"
    looks_for: str = f"{TRAVERSE} beside {FRAMES}"

    def detects(self, path: Path) -> bool:
        """Whether there is a ``traverse.yaml``."""
        return (path / TRAVERSE).is_file()

    def open(
        self, path: Path, images_root: Path | None = None, traverse_file: Path | None = None
    ) -> FolderDataset:
        """Open a folder and check all that can be checked without decoding images.

        Parameters
        ----------
        path
            Folder of the tables and, as a rule, of the ``traverse.yaml``.
        images_root
            Folder that the paths in frames.csv are relative to; default `path`.
        traverse_file
            ``traverse.yaml`` that lies elsewhere. Then frames.csv may be missing: the
            images in ``left/`` and ``right/`` are paired by name.

        Raises
        ------
        InputError
            One line that names file, field or line, what is wrong and the remedy.
        """
        described_by = traverse_file or path / TRAVERSE
        traverse = read_traverse(described_by)
        camera = traverse.camera.build()
        truth, dating = None, None
        if traverse_file is not None and not (path / FRAMES).is_file():
            rows, dating, truth = pair_by_name(path)
        else:
            _check_names(path)
            rows = read_frames_csv(path / FRAMES)
        pairs = _pairs(path, rows, _existing_folder(images_root, path))
        check_sizes(camera, pairs, described_by, "camera")
        white_level, note = find_white_level(pairs)
        return FolderDataset(
            name=path.resolve().name,
            path=path,
            files=StereoFiles(camera, pairs, white_level, traverse.sun_direction()),
            rover_T_camera=traverse.camera_mount(),
            start=traverse.start_prior(),
            ground_truth=truth or _ground_truth(path),
            map_reference=_map_reference(path, traverse),
            orbital=_orbital(path, traverse.orbital),
            notes=tuple(text for text in (dating, note) if text),
        )


def _existing_folder(images_root: Path | None, path: Path) -> Path:
    root = path if images_root is None else images_root
    if not root.is_dir():
        raise InputError(
            "is not a folder",
            source=root,
            field="images",
            remedy="give the folder that the paths in frames.csv are relative to",
        )
    return root


def _check_names(path: Path) -> None:
    """Refuse tables whose names are nearly right: they would be left out silently."""
    for entry in sorted(os.listdir(path)):
        if entry in _FILES or not entry.lower().endswith((".csv", ".tum")):
            continue
        remedy = nearest_known(entry, _FILES)
        if remedy.startswith("did you mean") and not (path / remedy.split("'")[1]).exists():
            raise InputError(
                "is not a file of this format", source=path, field=entry[:80], remedy=remedy
            )


def _pairs(path: Path, rows: tuple[FrameRow, ...], root: Path) -> tuple[StereoPair, ...]:
    files, missing = [], []
    for row in rows:
        pair = tuple(
            _inside(root, name, path / FRAMES, f"line {row.line}") for name in (row.left, row.right)
        )
        if pair[0] == pair[1]:
            raise InputError(
                f"left and right are both {row.left}",
                source=path / FRAMES,
                field=f"line {row.line}",
                remedy="name two images",
            )
        missing += [
            (row.line, name)
            for name, file in zip((row.left, row.right), pair, strict=True)
            if not os.path.isfile(file)
        ]
        files.append(pair)
    if missing:
        line, name = missing[0]
        more = f" ({len(missing) - 1} more are missing)" if len(missing) > 1 else ""
        raise InputError(
            f"{name[:200]} does not exist{more}",
            source=path / FRAMES,
            field=f"line {line}",
            remedy=f"copy it into {root}, or drop the row",
        )
    stamps = np.array([row.stamp_s for row in rows])
    wheels = attitudes = None
    if (path / ODOMETRY).is_file():
        wheels = odometry_between_frames(stamps, read_odometry_csv(path / ODOMETRY))
    if (path / ATTITUDE).is_file():
        attitudes = attitude_at_frames(stamps, read_attitude_csv(path / ATTITUDE))
    return tuple(
        StereoPair(
            row.frame,
            row.stamp_s,
            left,
            right,
            None if wheels is None else wheels[order],
            None if attitudes is None else attitudes[order],
        )
        for order, (row, (left, right)) in enumerate(zip(rows, files, strict=True))
    )


def _inside(root: Path, name: str, source: Path, field: str) -> Path:
    """Path of a file that a dataset names; it cannot lead out of the folder."""
    absolute = PurePosixPath(name).is_absolute() or PureWindowsPath(name).anchor
    depth = 0
    for part in PurePosixPath(name).parts:
        depth += -1 if part == ".." else 1
        if depth < 0:
            break
    if absolute or depth <= 0 or not name.isprintable():
        raise InputError(
            f"{name[:200]!a} is not a path inside the folder",
            source=source,
            field=field,
            remedy="give a path relative to the folder, without leading '..'",
        )
    return root / name


def _ground_truth(path: Path) -> GroundTruth | None:
    poses, positions = path / TRUTH_POSES, path / TRUTH_POSITIONS
    if poses.is_file() and positions.is_file():
        raise InputError(
            f"holds both {TRUTH_POSES} and {TRUTH_POSITIONS}",
            source=path,
            field="ground truth",
            remedy="keep one of them",
        )
    if poses.is_file():
        return read_tum(poses)
    return read_position_csv(positions) if positions.is_file() else None


def _map_reference(path: Path, traverse: Traverse) -> MapReference | None:
    if traverse.map is not None:
        _check_crs(path, traverse.map)
    return traverse.map_reference()


def _check_crs(path: Path, model: MapModel) -> None:
    # Imported here: GDAL takes a good part of a second, and most folders have no map.
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        geographic = CRS.from_user_input(model.crs).is_geographic
    except CRSError as error:
        raise InputError(
            f"{model.crs[:60]!a} is not a coordinate reference system",
            source=path / TRAVERSE,
            field="map.crs",
            remedy="give a code like IAU_2015:30135, or WKT",
        ) from error
    if geographic:
        raise InputError(
            f"{model.crs[:60]!a} counts in degrees",
            source=path / TRAVERSE,
            field="map.crs",
            remedy="give a projected system, in metres",
        )


def _orbital(path: Path, model: OrbitalModel | None) -> OrbitalFiles | None:
    if model is None:
        return None
    found: list[Path | None] = []
    for key, name in (("ortho", model.ortho), ("dem", model.dem)):
        if name is None:
            found.append(None)
            continue
        file = _inside(path, name, path / TRAVERSE, f"orbital.{key}")
        if not os.path.isfile(file):
            raise InputError(
                f"{name[:200]} does not exist",
                source=path / TRAVERSE,
                field=f"orbital.{key}",
                remedy="copy it into the folder, or drop the key",
            )
        found.append(file)
    return OrbitalFiles(found[0], found[1], model.sun())
