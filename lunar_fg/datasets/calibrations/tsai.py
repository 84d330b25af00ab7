"""Ames Stereo Pipeline ``.tsai``: one text file a camera.

``fu fv cu cv`` in px (or in mm with ``pitch``), ``C`` the centre, ``R`` camera to world row by
row, ``k1 k2 p1 p2`` Brown-Conrady. The image axes must be right and down.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from frontends.distortion import Lens, LensCamera
from frontends.errors import InputError
from frontends.geometry import inverse, is_rigid, pose
from frontends.undistort import StereoCalibration
from lunar_fg.datasets.calibrations.values import FloatArray, Section, Size

_DIRECTIONS = {
    "u_direction": (1.0, 0.0, 0.0),
    "v_direction": (0.0, 1.0, 0.0),
    "w_direction": (0.0, 0.0, 1.0),
}
_COEFFICIENTS = ("k1", "k2", "p1", "p2")
_OTHER_LENSES = ("photometrix", "adjustabletsai", "brownconrady", "rpc", "adjusted")


def read_tsai(path: Path, text: str) -> Section:
    """Values of a .tsai file.

    Raises
    ------
    InputError
        When a line is not ``name = numbers``.
    """
    values: dict[str, object] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        name, equals, rest = (part.strip() for part in line.partition("="))
        if not equals:
            if (word := name.lower()) in _OTHER_LENSES:
                raise InputError(
                    f"lens model {word!a} is not supported",
                    source=path,
                    field=f"line {number}",
                    remedy="only k1 k2 p1 p2 (tsai) is",
                )
            continue
        words = rest.split()
        try:
            values[name] = [float(word) for word in words]
        except ValueError as error:
            raise InputError(
                f"{rest[:40]!a} is not a list of numbers", source=path, field=f"line {number}"
            ) from error
    return Section(path, values)


def tsai(left: Section, right: Section, size: Size | None) -> StereoCalibration:
    """Calibration from the two cameras' values; the format holds no image size.

    Raises
    ------
    InputError
        When a value is missing or wrong, or the image size is not known.
    """
    if size is None:
        raise left.error("image size", "is not part of this format", "give the images, too")
    first, second = (_camera(section, size) for section in (left, right))
    left_T_right = inverse(_world_T_camera(left)) @ _world_T_camera(right)
    return StereoCalibration(first, second, left_T_right)


def _camera(section: Section, size: Size) -> LensCamera:
    for name, expected in _DIRECTIONS.items():
        if section.has(name) and not np.allclose(section.numbers(name, 3), expected):
            raise section.error(
                name, f"is not {expected}", "only image axes right, down, forward are supported"
            )
    pitch = section.numbers("pitch", 1)[0] if section.has("pitch") else 1.0
    if pitch <= 0.0:
        raise section.error("pitch", f"is {pitch:g}, must be positive")
    intrinsics = np.array([section.numbers(name, 1)[0] for name in ("fu", "fv", "cu", "cv")])
    given = [section.has(name) for name in _COEFFICIENTS]
    coefficients = np.array(
        [section.numbers(name, 1)[0] for name in _COEFFICIENTS] if any(given) else []
    )
    lens = Lens.RADTAN if len(coefficients) else Lens.NONE
    return section.camera("fu", size, intrinsics / pitch, lens, coefficients)


def _world_T_camera(section: Section) -> FloatArray:
    transform = pose(section.matrix("R", 3, 3), section.numbers("C", 3))
    if not is_rigid(transform, 1e-3):
        raise section.error("R", "is not a rotation")
    return transform
