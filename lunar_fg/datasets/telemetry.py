"""A rover mission's telemetry table: raw positions, and the positions corrected from images.

Columns RAW_X, RAW_Y (m, as the wheels and the attitude give them) and CORRECTED_X, CORRECTED_Y
(m, localised by people in images), both x east and y north, in the order of the traverse: the
form in which the whole traverse of the rover Spirit is published.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from frontends.errors import InputError
from frontends.measurements import FloatArray
from lunar_fg.bounded import check_size

_COLUMNS = ("RAW_X", "RAW_Y", "CORRECTED_X", "CORRECTED_Y")


@dataclass(frozen=True, slots=True)
class Telemetry:
    """Positions at the stops of a traverse, from the first one, m.

    Attributes
    ----------
    raw_m, corrected_m
        (N, 2) x and y.
    """

    raw_m: FloatArray
    corrected_m: FloatArray

    def __len__(self) -> int:
        """Count the stops."""
        return len(self.raw_m)


def read_telemetry(path: Path, least_step_m: float = 0.01) -> Telemetry:
    """Read a table of raw and corrected positions.

    Parameters
    ----------
    path
        CSV with a header.
    least_step_m
        Rows nearer than this to the row before, in both, are the same stop.

    Raises
    ------
    InputError
        The file is missing, lacks a column, or holds no number where one must be.
    """
    if not path.is_file():
        raise InputError("is missing", source=path)
    check_size(path)
    try:
        with path.open(encoding="utf-8") as file:
            header = [name.strip() for name in file.readline().split(",")]
            missing = [name for name in _COLUMNS if name not in header]
            if missing:
                raise InputError("is missing", source=path, field=f"column {missing[0]}")
            columns = [header.index(name) for name in _COLUMNS]
            table = np.loadtxt(file, delimiter=",", usecols=columns, ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"is not a table of numbers ({error})", source=path) from error
    if len(table) < 2 or not np.isfinite(table).all():
        raise InputError("holds too few rows, or a value that is not finite", source=path)
    table = table - table[0]
    step = np.abs(np.diff(table, axis=0)).max(axis=1)
    table = table[np.concatenate([[True], step > least_step_m])]
    return Telemetry(table[:, :2].copy(), table[:, 2:].copy())
