"""Cells on the map plane, north up: the one geometry of rover-made and orbital maps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frontends.errors import InputError

FloatArray = NDArray[np.float64]

#: Cells of one grid: more is a mistake in the bounds or the cell size.
_MOST_CELLS = 200_000_000


@dataclass(frozen=True, slots=True)
class Grid:
    """Square cells; row 0 is the northernmost, column 0 the westernmost.

    Attributes
    ----------
    x_m, y_m
        Centre of cell (0, 0), map frame.
    cell_m
        Side of a cell.
    rows, columns
        Size.

    Raises
    ------
    InputError
        When a value is not finite, or the cell size or the extent is not positive.
    """

    x_m: float
    y_m: float
    cell_m: float
    rows: int
    columns: int

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.x_m, self.y_m, self.cell_m))) or self.cell_m <= 0.0:
            raise InputError(
                f"origin ({self.x_m}, {self.y_m}) m, cell {self.cell_m} m",
                source="grid",
                remedy="give finite coordinates and a cell size above 0",
            )
        if self.rows < 1 or self.columns < 1 or self.rows * self.columns > _MOST_CELLS:
            raise InputError(
                f"has {self.rows} x {self.columns} cells",
                source="grid",
                remedy="check the bounds against the cell size, both in metres",
            )

    @classmethod
    def covering(cls, bounds_m: tuple[float, float, float, float], cell_m: float) -> Grid:
        """Cover bounds (x and y from, x and y to); centres at odd multiples of half a cell.

        Grids of one cell size so share their cells, whatever their bounds.
        """
        if not all(map(math.isfinite, (*bounds_m, cell_m))) or cell_m <= 0.0:
            raise InputError(f"bounds {bounds_m} m, cell {cell_m} m", source="grid")
        west, south, east, north = bounds_m
        first_column, first_row = math.floor(west / cell_m), math.ceil(north / cell_m)
        columns = max(1, math.ceil(east / cell_m) - first_column)
        rows = max(1, first_row - math.floor(south / cell_m))
        return cls((first_column + 0.5) * cell_m, (first_row - 0.5) * cell_m, cell_m, rows, columns)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.rows, self.columns

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """Outer edges: x and y from, x and y to."""
        west, north = self.x_m - 0.5 * self.cell_m, self.y_m + 0.5 * self.cell_m
        return (
            west,
            north - self.rows * self.cell_m,
            west + self.columns * self.cell_m,
            north,
        )

    def pixel(self, x_m: FloatArray, y_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Column and row of places, fractional; cell centres are at integers."""
        return (
            np.asarray((x_m - self.x_m) / self.cell_m),
            np.asarray((self.y_m - y_m) / self.cell_m),
        )

    def place(self, column: FloatArray, row: FloatArray) -> tuple[FloatArray, FloatArray]:
        """X and y of fractional columns and rows, m."""
        return (
            np.asarray(self.x_m + self.cell_m * column),
            np.asarray(self.y_m - self.cell_m * row),
        )

    def centres(self) -> tuple[FloatArray, FloatArray]:
        """Give x (columns,) and y (rows,) of the cell centres, m."""
        return (
            self.x_m + self.cell_m * np.arange(self.columns, dtype=np.float64),
            self.y_m - self.cell_m * np.arange(self.rows, dtype=np.float64),
        )
