"""OpenCV FileStorage, YAML or XML, under the names that are in use for stereo pairs.

``M1 D1 M2 D2`` beside ``R T`` (OpenCV's own stereo sample, one file or two), the same with
``K``, ``cameraMatrix``, ``distCoeffs`` and endings ``_left``/``_right``; x_right = R x_left + T.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from frontends.distortion import Lens, LensCamera
from frontends.errors import InputError
from frontends.geometry import inverse, pose
from frontends.undistort import StereoCalibration
from lunar_fg.datasets.calibrations.values import Section, Size

_EYES = (("1", "2"), ("_1", "_2"), ("_left", "_right"), ("Left", "Right"), ("0", "1"))
_MATRICES = ("M", "K", "cameraMatrix", "camera_matrix", "CameraMatrix", "intrinsics")
_COEFFICIENTS = ("D", "distCoeffs", "dist_coeffs", "DistCoeffs", "distortion", "dist_coeff")
_ROTATIONS = ("R", "Rotation", "rotation_matrix")
_TRANSLATIONS = ("T", "Translation", "t", "translation_vector")
_WIDTHS = ("image_width", "width", "imageWidth")
_HEIGHTS = ("image_height", "height", "imageHeight")
_SIZES = ("size", "imageSize", "image_size", "Size")
_MOST_ELEMENTS = 10_000
_FISHEYE = ("fisheye", "equidistant", "is_fisheye")


def is_opencv(section: Section) -> bool:
    """Whether the names are those of a stereo calibration by OpenCV."""
    return _eyes(section) is not None and any(section.has(name) for name in _TRANSLATIONS)


def opencv(section: Section, size: Size | None) -> StereoCalibration:
    """Calibration from the merged values of one file or two.

    Raises
    ------
    InputError
        When a value is missing or wrong, or the image size is neither there nor known.
    """
    names = _eyes(section)
    assert names is not None
    (left, left_d), (right, right_d) = names
    size = _size(section) or size
    if size is None:
        raise section.error("image_width", "is missing", "add image_width and image_height")
    rotation = section.matrix(_first(section, _ROTATIONS), 3, 3)
    translation = section.numbers(_first(section, _TRANSLATIONS), 3)
    right_T_left = pose(rotation, translation)
    fisheye = any(section.values.get(name) in (1, True, "true") for name in _FISHEYE)
    return StereoCalibration(
        _camera(section, left, left_d, size, fisheye),
        _camera(section, right, right_d, size, fisheye),
        inverse(right_T_left),
    )


def read_storage_xml(path: Path, text: str) -> dict[str, object]:
    """Values of an OpenCV XML storage; no document types, so no entities to expand.

    Raises
    ------
    InputError
        When the text is no such storage.
    """
    if re.search(r"<!\s*(?:DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise InputError(
            "declares a document type", source=path, remedy="OpenCV's files have none: remove it"
        )
    try:
        root = ElementTree.fromstring(text)  # noqa: S314  # no entities: refused above
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise InputError(f"is not XML: {error}", source=path) from error
    if root.tag != "opencv_storage" or len(list(root.iter())) > _MOST_ELEMENTS:
        raise InputError("is no OpenCV storage", source=path, field=root.tag[:60])
    return {element.tag: _value(element) for element in root}


def _value(element: ElementTree.Element) -> object:
    data = element.find("data")
    words = ((data.text if data is not None else element.text) or "").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return " ".join(words)
    return numbers[0] if data is None and len(numbers) == 1 else numbers


def _eyes(section: Section) -> tuple[tuple[str, str], tuple[str, str]] | None:
    """Names of matrix and coefficients of both eyes."""
    for left, right in _EYES:
        for matrix in _MATRICES:
            for coefficients in _COEFFICIENTS:
                names = (
                    (matrix + left, coefficients + left),
                    (matrix + right, coefficients + right),
                )
                if section.has(*names[0], *names[1]):
                    return names
    return None


def _camera(
    section: Section, matrix: str, coefficients: str, size: Size, fisheye: bool
) -> LensCamera:
    values = section.numbers(coefficients)
    lens = Lens.EQUIDISTANT if fisheye else Lens.RADTAN
    if not values.any():
        lens, values = Lens.NONE, np.zeros(0)
    return section.intrinsics(matrix, size, lens, values)


def _size(section: Section) -> Size | None:
    width, height = (
        next((name for name in names if section.has(name)), None) for names in (_WIDTHS, _HEIGHTS)
    )
    if width is not None and height is not None:
        return section.size(width, height)
    name = next((name for name in _SIZES if section.has(name)), None)
    return None if name is None else section.size_list(name)


def _first(section: Section, names: tuple[str, ...]) -> str:
    return next((name for name in names if section.has(name)), names[0])
