"""Numbers, vectors and matrices out of parsed calibration files, with errors that say where."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from frontends.distortion import Lens, LensCamera
from frontends.errors import InputError
from frontends.geometry import is_rigid

FloatArray = NDArray[np.float64]
Size = tuple[int, int]

_LARGEST = 1e9
_MOST_VALUES = 1000
_MAX_SIDE = 32_000
#: Names of lens models in calibration files.
_LENSES = {
    "none": Lens.NONE,
    "": Lens.NONE,
    "radtan": Lens.RADTAN,
    "radial-tangential": Lens.RADTAN,
    "radialtangential": Lens.RADTAN,
    "plumb_bob": Lens.RADTAN,
    "rational_polynomial": Lens.RADTAN,
    "equi": Lens.EQUIDISTANT,
    "equidistant": Lens.EQUIDISTANT,
    "fisheye": Lens.EQUIDISTANT,
    "kannala_brandt": Lens.EQUIDISTANT,
}


@dataclass(frozen=True, slots=True)
class Section:
    """A mapping of a calibration file; every value is asked for by name and checked."""

    source: Path
    values: Mapping[str, object]
    prefix: str = ""

    @classmethod
    def of(cls, source: Path, content: object, prefix: str = "") -> Section:
        """Check that some content is a mapping with text keys."""
        if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
            raise InputError(
                "holds no named values",
                source=source,
                field=prefix or None,
                remedy="give the whole calibration file",
            )
        return cls(source, content, prefix)

    def has(self, *names: str) -> bool:
        """Whether all these names are there."""
        return all(name in self.values for name in names)

    def error(self, name: str, problem: str, remedy: str | None = None) -> InputError:
        """Make an error that names the file and the field."""
        return InputError(problem, source=self.source, field=self.prefix + name, remedy=remedy)

    def section(self, name: str) -> Section:
        """Get a mapping inside this one."""
        return Section.of(self.source, self._get(name), f"{self.prefix}{name}.")

    def text(self, name: str, default: str | None = None) -> str:
        """Get a short text."""
        value = self._get(name, default)
        if not isinstance(value, str) or len(value) > 200:
            raise self.error(name, "is not a name", "give the model's name")
        return value

    def number(self, name: str) -> float:
        """Get a finite number."""
        value = self._get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not _sane(value):
            raise self.error(name, f"is {str(value)[:40]!a}, must be a finite number")
        return float(value)

    def size(self, width: str, height: str) -> Size:
        """Get an image size, px."""
        return self._checked_size(width, self.number(width), self.number(height))

    def numbers(self, name: str, *counts: int) -> FloatArray:
        """Get a list of finite numbers; one of `counts` long, where given."""
        found = self._flat(self._get(name), name)
        if counts and len(found) not in counts:
            wanted = " or ".join(map(str, counts))
            raise self.error(name, f"has {len(found)} values, must have {wanted}")
        return found

    def size_list(self, name: str) -> Size:
        """Get an image size given as ``[width, height]``."""
        width, height = self.numbers(name, 2).tolist()
        return self._checked_size(name, width, height)

    def matrix(self, name: str, rows: int, columns: int) -> FloatArray:
        """Get a matrix: nested or flat lists, or ``{rows, cols, data}``."""
        return np.reshape(self.numbers(name, rows * columns), (rows, columns))

    def transform(self, name: str) -> FloatArray:
        """Get a rigid 4x4 transform."""
        transform = self.matrix(name, 4, 4)
        if not is_rigid(transform, 1e-3):
            raise self.error(name, "is not a rigid transform")
        return transform

    def intrinsics(self, name: str, size: Size, lens: Lens, coefficients: FloatArray) -> LensCamera:
        """Camera from a 3x3 matrix."""
        matrix = self.matrix(name, 3, 3)
        below = abs(matrix[1, 0]) + abs(matrix[2, 0]) + abs(matrix[2, 1]) + abs(matrix[2, 2] - 1.0)
        if below > 1e-9 or abs(matrix[0, 1]) > 1e-6 * abs(matrix[0, 0]):
            raise self.error(name, "is not [fx 0 cx; 0 fy cy; 0 0 1]", "skew is not supported")
        return self.camera(name, size, matrix[[0, 1, 0, 1], [0, 1, 2, 2]], lens, coefficients)

    def camera(
        self, name: str, size: Size, fx_fy_cx_cy: FloatArray, lens: Lens, coefficients: FloatArray
    ) -> LensCamera:
        """Camera from its numbers; what is wrong is reported against `name`."""
        values = tuple(coefficients.tolist())
        if lens is Lens.RADTAN and not any(values):
            lens, values = Lens.NONE, ()
        fx, fy, cx, cy = fx_fy_cx_cy.tolist()
        try:
            return LensCamera(*size, fx, fy, cx, cy, lens, values)
        except InputError as error:
            raise self.error(name, f"{error.field} {error.problem}", error.remedy) from error

    def lens(self, name: str, default: str | None = None) -> Lens:
        """Get a lens model by its name."""
        text = self.text(name, default).lower()
        if text not in _LENSES:
            known = ", ".join(sorted(filter(None, _LENSES)))
            raise self.error(name, f"{text[:40]!a} is no known lens model", f"known: {known}")
        return _LENSES[text]

    def _get(self, name: str, default: object = None) -> object:
        value = self.values.get(name, default)
        if value is None:
            raise self.error(name, "is missing", "give the whole calibration file")
        return value

    def _flat(self, value: object, name: str) -> FloatArray:
        if isinstance(value, dict):
            value = value.get("data")
        if not isinstance(value, list):
            raise self.error(name, "is not a list of numbers")
        flat: list[float] = []
        for item in value:
            row = item if isinstance(item, list) else [item]
            for cell in row:
                if isinstance(cell, bool) or not isinstance(cell, int | float) or not _sane(cell):
                    raise self.error(name, f"holds {str(cell)[:40]!a}, must be finite numbers")
                flat.append(float(cell))
            if len(flat) > _MOST_VALUES:
                raise self.error(name, f"has more than {_MOST_VALUES} values")
        return np.array(flat, dtype=np.float64)

    def _checked_size(self, name: str, width: float, height: float) -> Size:
        if (
            width != int(width)
            or height != int(height)
            or not (1 <= width <= _MAX_SIDE and 1 <= height <= _MAX_SIDE)
        ):
            raise self.error(
                name, f"is {width:g}x{height:g}, must be whole pixels up to {_MAX_SIDE} a side"
            )
        return int(width), int(height)


def _sane(value: float) -> bool:
    return math.isfinite(value) and abs(value) <= _LARGEST if abs(value) < 1e300 else False
