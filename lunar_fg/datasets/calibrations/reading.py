"""Find a calibration file's format and read it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from frontends.errors import InputError
from frontends.undistort import StereoCalibration
from lunar_fg.datasets.calibrations.camera_info import camera_info
from lunar_fg.datasets.calibrations.euroc import euroc
from lunar_fg.datasets.calibrations.kalibr import kalibr
from lunar_fg.datasets.calibrations.opencv import is_opencv, opencv, read_storage_xml
from lunar_fg.datasets.calibrations.tsai import read_tsai, tsai
from lunar_fg.datasets.calibrations.values import Section, Size
from lunar_fg.datasets.kitti import camera_of, read_projections
from lunar_fg.datasets.schema import read_traverse
from lunar_fg.datasets.strict_yaml import read_opencv_yaml

FORMATS = (
    "traverse.yaml, KITTI calib.txt, Kalibr camchain.yaml, EuRoC sensor.yaml (two), ROS "
    "camera_info YAML (two), OpenCV storage (YAML or XML), Ames .tsai (two)"
)
MAX_BYTES = 1_000_000
#: How the right camera's file is named after the left one's.
_PARTNERS = (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"), ("cam0", "cam1"),
             ("intrinsics", "extrinsics"))  # fmt: skip


def read_calibration(paths: Sequence[Path], size: Size | None = None) -> StereoCalibration:
    """Read a calibration of a stereo pair, in any of `FORMATS`.

    Parameters
    ----------
    paths
        One file, or the left and the right camera's. Where a format needs two and one is
        given, the other is found by its name (left, right; cam0, cam1).
    size
        Width and height of the images, px, for formats that do not hold it.

    Raises
    ------
    InputError
        When a file cannot be read, is of no known format, or is not of these images' size.
    """
    if not 1 <= len(paths) <= 2:
        raise InputError(
            f"{len(paths)} files", source="calibration", remedy="give one file, or left and right"
        )
    calibration = _read(paths, size)
    stated = calibration.left.width, calibration.left.height
    if size is not None and stated != size:
        raise InputError(
            f"states {stated[0]}x{stated[1]} px, the images have {size[0]}x{size[1]} px",
            source=paths[0],
            field="image size",
            remedy="give the calibration of these images",
        )
    return calibration


def _read(paths: Sequence[Path], size: Size | None) -> StereoCalibration:
    first = paths[0]
    if first.suffix.lower() == ".txt":
        return _kitti(first, size)
    if first.suffix.lower() == ".tsai":
        left, right = (read_tsai(path, _text(path)) for path in _two(paths))
        return tsai(left, right, size)
    section = _section(first)
    if section.has("schema"):
        return StereoCalibration.of_rectified(read_traverse(first).camera.build())
    if section.has("cam0", "cam1"):
        return kalibr(section)
    if section.has("T_BS"):
        return euroc(*(_section(path) for path in _two(paths)))
    if section.has("camera_matrix", "projection_matrix"):
        return camera_info(*(_section(path) for path in _two(paths)))
    merged = section
    if not is_opencv(section) and (len(paths) == 2 or _partner(first) is not None):
        other = _section(_two(paths)[1])
        merged = Section(first, {**other.values, **section.values})
    if is_opencv(merged):
        return opencv(merged, size)
    raise InputError(
        f"is no known stereo calibration: it holds {', '.join(list(section.values)[:6])[:120]!a}",
        source=first,
        remedy=f"known: {FORMATS}",
    )


def _section(path: Path) -> Section:
    if path.suffix.lower() == ".xml":
        return Section(path, read_storage_xml(path, _text(path)))
    return Section.of(path, read_opencv_yaml(path))


def _two(paths: Sequence[Path]) -> tuple[Path, Path]:
    if len(paths) == 2:
        return paths[0], paths[1]
    partner = _partner(paths[0])
    if partner is None:
        raise InputError(
            "is the calibration of one camera",
            source=paths[0],
            remedy="give --calibration twice: the left file, then the right one",
        )
    return paths[0], partner


def _partner(path: Path) -> Path | None:
    """File of the right camera beside that of the left one."""
    for left, right in _PARTNERS:
        for place in (path.with_name(path.name.replace(left, right)),
                      path.parent.with_name(path.parent.name.replace(left, right)) / path.name
                      if path.parent.name else path):  # fmt: skip
            if place != path and place.is_file():
                return place
    return None


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror}", source=path, remedy="check the path and its rights"
        ) from error
    if len(data) > MAX_BYTES:
        raise InputError(f"has more than {MAX_BYTES} bytes", source=path)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError("is not UTF-8 text", source=path) from error


def _kitti(path: Path, size: Size | None) -> StereoCalibration:
    if size is None:
        raise InputError(
            "is not part of this format", source=path, field="image size", remedy="give the images"
        )
    text = _text(path)
    names = ("P2", "P3") if "P2:" in text and "P0:" not in text else ("P0", "P1")
    return StereoCalibration.of_rectified(camera_of(path, read_projections(path, *names), size))
