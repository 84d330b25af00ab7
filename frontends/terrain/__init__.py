"""The ground around the rover: dense stereo, elevation and ortho grids, hazards, rocks."""

from frontends.terrain.dense import DenseStereo, DenseStereoConfig, SurfacePoints
from frontends.terrain.grid import Grid
from frontends.terrain.hazards import Hazards, RoverLimits, find_hazards
from frontends.terrain.map import TerrainGrid, TerrainMap
from frontends.terrain.rocks import without_rocks

__all__ = [
    "DenseStereo",
    "DenseStereoConfig",
    "Grid",
    "Hazards",
    "RoverLimits",
    "SurfacePoints",
    "TerrainGrid",
    "TerrainMap",
    "find_hazards",
    "without_rocks",
]
