"""KITTI odometry sequences: ``calib.txt``, image folders, poses of the left grey camera.

Axes: KITTI's poses map camera 0 to the first camera's axes. Here the map frame is the
rover's axes (x forward, y left, z up) at the first frame, and the rover sits in camera 0,
level, so that ``map_T_rover`` of the first frame is the identity.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from frontends.camera import StereoCamera, level_rover_T_camera
from frontends.errors import InputError
from frontends.geometry import inverse, is_rigid, pose
from frontends.measurements import StartPrior, StereoFrame, UnusableFrame
from lunar_fg.datasets.base import FloatArray, GroundTruth, MapReference, OrbitalFiles
from lunar_fg.datasets.images import SUFFIXES, read_header
from lunar_fg.datasets.stereo_files import StereoFiles, StereoPair, check_sizes, find_white_level
from lunar_fg.datasets.tables import check_increasing, parse_number, read_numbers, read_text

#: Image folders and the projection matrices of official calibration files, best first.
PAIRS = (
    ("image_0", "image_1", "P0", "P1"),
    ("image_2", "image_3", "P2", "P3"),
    ("image_l", "image_r", "P0", "P1"),
)
RATE_HZ = 10.0
_MAX_FRAME_NUMBER = 10**9
_POSE_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True)
class KittiDataset:
    """An opened sequence; see `lunar_fg.datasets.base.Dataset` for the attributes."""

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
        """The rectified pair."""
        return self.files.camera

    def __len__(self) -> int:
        """Count the frames, usable or not."""
        return len(self.files)

    def frames(self, after: int = -1) -> Iterator[StereoFrame | UnusableFrame]:
        """Read the frames with an index above `after` in order, one at a time."""
        return self.files.frames(after)


@dataclass(frozen=True, slots=True)
class KittiReader:
    """Reader of KITTI odometry sequences."""

    format_name: str = "kitti"
    looks_for: str = "calib.txt beside " + " or ".join(f"{a}/{b}" for a, b, _, _ in PAIRS)

    def detects(self, path: Path) -> bool:
        """Whether there is a pair of KITTI's image folders."""
        return any((path / a).is_dir() and (path / b).is_dir() for a, b, _, _ in PAIRS)

    def open(self, path: Path, images_root: Path | None = None) -> KittiDataset:
        """Open a sequence and check all that can be checked without decoding images.

        Raises
        ------
        InputError
            One line that names file, line, what is wrong and the remedy.
        """
        if images_root is not None:
            raise InputError(
                "a KITTI sequence holds its own images",
                source=path,
                field="images",
                remedy="leave the images folder out",
            )
        left_dir, right_dir, left_name, right_name = next(
            names for names in PAIRS if all((path / name).is_dir() for name in names[:2])
        )
        left, right = _list_pairs(path / left_dir, path / right_dir)
        numbers = _frame_numbers(left)
        stamps, notes = _stamps(path, numbers)
        pairs = tuple(
            StereoPair(*row) for row in zip(numbers, stamps.tolist(), left, right, strict=True)
        )
        calibration = path / "calib.txt"
        matrices = read_projections(calibration, left_name, right_name)
        camera = camera_of(calibration, matrices, _first_size(left))
        check_sizes(camera, pairs, calibration, "image size")
        white_level, note = find_white_level(pairs)
        return KittiDataset(
            name=path.resolve().name,
            path=path,
            files=StereoFiles(camera, pairs, white_level),
            rover_T_camera=_camera_mount(matrices[0]),
            ground_truth=_ground_truth(path, stamps),
            notes=(*notes, note) if note else notes,
            start=StartPrior(),
        )


def _list_pairs(left: Path, right: Path) -> tuple[list[Path], list[Path]]:
    names = [
        {file.name for file in folder.iterdir() if file.suffix.lower() in SUFFIXES}
        for folder in (left, right)
    ]
    for folder, other, alone in (
        (right, left, names[0] - names[1]),
        (left, right, names[1] - names[0]),
    ):
        if alone:
            name = min(alone)
            more = f" ({len(alone) - 1} more are missing)" if len(alone) > 1 else ""
            raise InputError(
                f"does not exist{more}, but {other.name}/{name} does",
                source=folder.parent,
                field=f"{folder.name}/{name}",
                remedy="left and right images pair up by name: copy it, or drop the other one",
            )
    if not names[0]:
        raise InputError(
            "holds no images", source=left, remedy=f"copy {', '.join(SUFFIXES)} files into it"
        )
    order = sorted(names[0])
    if all(_is_number(Path(name).stem) for name in order):
        order.sort(key=lambda name: int(Path(name).stem))
    return [left / name for name in order], [right / name for name in order]


def _is_number(stem: str) -> bool:
    return stem.isascii() and stem.isdecimal() and len(stem) <= 20


def _frame_numbers(files: list[Path]) -> list[int]:
    """Numbers from the file names; 0, 1, 2 ... where they are no distinct numbers."""
    if all(_is_number(file.stem) for file in files):
        numbers = [int(file.stem) for file in files]
        if len(set(numbers)) == len(numbers) and numbers[-1] < _MAX_FRAME_NUMBER:
            return numbers
    return list(range(len(files)))


def _stamps(path: Path, numbers: list[int]) -> tuple[FloatArray, tuple[str, ...]]:
    file = path / "times.txt"
    if not file.is_file():
        note = f"no times.txt: frames are taken to be {1.0 / RATE_HZ:g} s apart"
        return np.array(numbers) / RATE_HZ, (note,)
    lines, rows = read_numbers(file, 1)
    stamps = np.array(rows)[:, 0]
    _check_count(file, len(stamps), len(numbers))
    check_increasing(stamps, lines, file)
    return stamps, ()


def _check_count(file: Path, rows: int, images: int) -> None:
    if rows != images:
        raise InputError(
            f"has {rows} rows, but there are {images} image pairs",
            source=file,
            field="rows",
            remedy="give one row a frame; check that images and file are of one sequence",
        )


def read_projections(file: Path, left: str, right: str) -> tuple[FloatArray, FloatArray]:
    """Left and right 3x4 projections: official ``P0: ...`` lines, or 24 bare numbers."""
    named: dict[str, FloatArray] = {}
    bare: list[float] = []
    for line, text in enumerate(read_text(file).splitlines(), start=1):
        label, colon, rest = text.rpartition(":")
        values = [parse_number(cell, file, line, label or "value") for cell in rest.split()]
        if not colon:
            bare += values
        elif label.strip().startswith("P"):
            if len(values) != 12:
                raise InputError(
                    f"has {len(values)} values, must have 12",
                    source=file,
                    field=f"line {line}",
                    remedy="give the 3x4 projection matrix, row by row",
                )
            named[label.strip()] = np.reshape(values, (3, 4))
    if left in named and right in named:
        return named[left], named[right]
    if not named and len(bare) == 24:
        matrices = np.reshape(bare, (2, 3, 4))
        return matrices[0], matrices[1]
    raise InputError(
        f"holds {', '.join(sorted(named)) or 'no named matrices'} and {len(bare)} bare numbers",
        source=file,
        field=f"{left}, {right}",
        remedy=f"give the lines '{left}: ...' and '{right}: ...', or two rows of 12 numbers",
    )


def _first_size(files: list[Path]) -> tuple[int, int]:
    """Size of the first image whose header can be read; KITTI's calibration has none."""
    problem = ""
    for file in files:
        try:
            return read_header(file).size
        except InputError as error:
            problem = problem or str(error)
    raise InputError(
        f"none of the {len(files)} images can be read, the first because {problem}",
        source=files[0].parent,
        field="images",
        remedy="check that the images were copied completely",
    )


def camera_of(
    file: Path, matrices: tuple[FloatArray, FloatArray], size: tuple[int, int]
) -> StereoCamera:
    """Camera of a left and a right 3x4 projection; `file` is named in errors."""
    left, right = matrices
    upper_triangle = np.array([[left[0, 0], 0.0, left[0, 2]], [0.0, left[1, 1], left[1, 2]],
                               [0.0, 0.0, 1.0]])  # fmt: skip
    for matrix in matrices:
        if np.abs(matrix[:, :3] - upper_triangle).max() > 1e-3:
            raise InputError(
                "left and right are not the projections of one rectified pair",
                source=file,
                field="projection matrices",
                remedy="both must be [f 0 cx; 0 f cy; 0 0 1] with the same values",
            )
    if left[0, 0] <= 0.0 or left[1, 1] <= 0.0:
        raise InputError(
            f"the focal length is {min(left[0, 0], left[1, 1]):g} px",
            source=file,
            field="projection matrices",
            remedy="it must be positive",
        )
    baseline = float((left[0, 3] - right[0, 3]) / left[0, 0])
    if baseline <= 0.0:
        raise InputError(
            f"the baseline is {baseline:g} m",
            source=file,
            field="projection matrices",
            remedy="it must be positive: are left and right swapped?",
        )
    return StereoCamera(
        width=size[0],
        height=size[1],
        fx=float(left[0, 0]),
        fy=float(left[1, 1]),
        cx=float(left[0, 2]),
        cy=float(left[1, 2]),
        baseline_m=baseline,
    )


def _camera_mount(left: FloatArray) -> FloatArray:
    """``rover_T_camera`` of a left camera whose fourth column is its offset from camera 0."""
    offset = -np.linalg.solve(left[:, :3], left[:, 3])
    return np.asarray(level_rover_T_camera() @ pose(np.eye(3), offset))


def _ground_truth(path: Path, stamps: FloatArray) -> GroundTruth | None:
    file = path / "poses.txt"
    if not file.is_file():
        return None
    lines, rows = read_numbers(file, 12)
    _check_count(file, len(rows), len(stamps))
    first_T_camera = np.tile(np.eye(4), (len(rows), 1, 1))
    first_T_camera[:, :3] = np.reshape(rows, (-1, 3, 4))
    for line, transform in zip(lines, first_T_camera, strict=True):
        if not is_rigid(transform, _POSE_TOLERANCE):
            raise InputError(
                "is not a rigid transform",
                source=file,
                field=f"line {line}",
                remedy="give the 3x4 camera-to-world matrix, row by row",
            )
    level = level_rover_T_camera()
    start = inverse(first_T_camera[0])
    return GroundTruth.of_poses(stamps, level @ start @ first_T_camera @ inverse(level))
