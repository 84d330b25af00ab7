"""The ground as a function of the place: fractal relief, craters, albedo.

A height asked for at a spacing holds the relief that this spacing can carry; the finer
rest is left out, so that coarse grids far away do not alias.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lunar_fg.simulation.base_relief import BaseRelief, read_base_relief
from lunar_fg.simulation.craters import Craters, draw_craters
from lunar_fg.simulation.noise import Octaves
from lunar_fg.simulation.spec import TerrainSpec

FloatArray = NDArray[np.float64]
Extent = tuple[float, float, float, float]

#: Wavelengths of the relief that grids carry; below comes the texture (`texture.py`).
SHORTEST_WAVE_M, LONGEST_WAVE_M = 0.1, 1500.0
#: How far the land goes on around the middle of the drive.
HORIZON_M = 2000.0
_LACUNARITY = 1.9
_LEAST_CELLS_A_CRATER = 5.0


@dataclass(frozen=True, slots=True)
class GridFrame:
    """Nodes of a north-up grid in the map frame; row 0 is the south edge.

    Attributes
    ----------
    x0, y0
        First node, m.
    spacing_m
        Between nodes.
    rows, columns
        Number of nodes.
    """

    x0: float
    y0: float
    spacing_m: float
    rows: int
    columns: int

    @classmethod
    def covering(cls, extent: Extent, spacing_m: float) -> GridFrame:
        """Smallest grid on multiples of the spacing that covers an extent."""
        x0, y0 = (np.floor(value / spacing_m) for value in extent[:2])
        x1, y1 = (np.ceil(value / spacing_m) for value in extent[2:])
        return cls(
            float(x0 * spacing_m),
            float(y0 * spacing_m),
            spacing_m,
            int(y1 - y0) + 1,
            int(x1 - x0) + 1,
        )

    def nodes(self) -> tuple[FloatArray, FloatArray]:
        """Coordinates x and y of all nodes, each (rows, columns)."""
        x = self.x0 + self.spacing_m * np.arange(self.columns)
        y = self.y0 + self.spacing_m * np.arange(self.rows)
        grid_x, grid_y = np.meshgrid(x, y)
        return grid_x, grid_y


@dataclass(frozen=True, slots=True)
class Terrain:
    """The ground, without rocks, in the map frame.

    Attributes
    ----------
    base
        Real coarse relief, where there is one.
    relief, tone
        Octaves of height, m, and of the logarithm of albedo.
    craters
        All of them.
    extent
        Where there is land.
    """

    base: BaseRelief | None
    relief: Octaves
    tone: Octaves
    craters: Craters
    extent: Extent

    def height(self, grid: GridFrame) -> FloatArray:
        """Height at a grid's nodes, (rows, columns), m."""
        x, y = grid.nodes()
        height = self.relief.between(2.0 * grid.spacing_m).at(x, y)
        if self.base is not None:
            height += self.base.at(x, y)
        craters = self.craters.larger_than(_LEAST_CELLS_A_CRATER * grid.spacing_m)
        craters.add_to(height, grid.x0, grid.y0, grid.spacing_m)
        return height

    def albedo(self, grid: GridFrame) -> FloatArray:
        """Factor of the mean albedo at a grid's nodes, (rows, columns)."""
        x, y = grid.nodes()
        return np.exp(self.tone.between(2.0 * grid.spacing_m).at(x, y))


def make_terrain(spec: TerrainSpec, seed: int, near: Extent) -> Terrain:
    """Draw the ground.

    Parameters
    ----------
    spec
        Statistics, and the base relief where there is one.
    seed
        Of all of it.
    near
        Where rover and map images look closely (west, south, east, north; m): the small
        craters are drawn there only.

    Raises
    ------
    InputError
        When the base relief cannot be used.
    """
    rng = np.random.default_rng([seed, 1])
    base = None if spec.dem is None else read_base_relief(spec.dem)
    middle = 0.5 * (near[0] + near[2]), 0.5 * (near[1] + near[3])
    extent = _around(middle, HORIZON_M)
    longest, largest = LONGEST_WAVE_M, 400.0
    if base is not None:
        west, south, east, north = base.extent
        extent = (
            max(extent[0], west),
            max(extent[1], south),
            min(extent[2], east),
            min(extent[3], north),
        )
        # what the DEM holds already is not drawn a second time
        longest, largest = 2.0 * base.resolution_m, 4.0 * base.resolution_m
    count = int(np.log(longest / SHORTEST_WAVE_M) / np.log(_LACUNARITY)) + 1
    wavelength = SHORTEST_WAVE_M * _LACUNARITY ** np.arange(count)
    exponent = np.where(wavelength >= 1.0, spec.hurst, spec.hurst_below_1m)
    relief = Octaves.draw(rng, wavelength, spec.roughness_m * wavelength**exponent)
    tones = 0.3 * 2.0 ** np.arange(11)
    tone = Octaves.draw(rng, tones, np.full(len(tones), 0.022))
    middle_distance = _grown(near, 150.0)
    bands = [
        (0.2, 1.0, _grown(near, 5.0)),
        (1.0, 6.0, _clipped(middle_distance, extent)),
        (6.0, largest, extent),
    ]
    return Terrain(base, relief, tone, draw_craters(rng, spec.crater_density, bands), extent)


def _around(middle: tuple[float, float], reach: float) -> Extent:
    return (middle[0] - reach, middle[1] - reach, middle[0] + reach, middle[1] + reach)


def _grown(extent: Extent, by: float) -> Extent:
    return (extent[0] - by, extent[1] - by, extent[2] + by, extent[3] + by)


def _clipped(extent: Extent, within: Extent) -> Extent:
    return (
        max(extent[0], within[0]),
        max(extent[1], within[1]),
        min(extent[2], within[2]),
        min(extent[3], within[3]),
    )
