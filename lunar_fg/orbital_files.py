"""The orbital map of a run: named by the user or the dataset, placed in the map frame."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from frontends.absolute import estimate_sun
from frontends.errors import InputError
from frontends.measurements import SunDirection
from frontends.orbital import OrbitalMap, Raster
from lunar_fg.datasets.base import Dataset, MapReference
from lunar_fg.georeference import parse_crs, read_crs, same_body

logger = logging.getLogger("lunar_fg.orbital")

#: Half width of the part of a map that its sun is estimated from, cells.
_SUN_CELLS = 400


@dataclass(frozen=True, slots=True)
class MapConfig:
    """Orbital map of a run; the dataset's own where nothing is given.

    Attributes
    ----------
    ortho, dem
        Files.
    sun_azimuth_deg, sun_elevation_deg
        Light of the ortho image, where neither its tags nor the dataset say it.
    use
        False: no fixes, even where the dataset has a map.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "allow_inf_nan": False}

    ortho: Path | None = None
    dem: Path | None = None
    sun_azimuth_deg: float | None = None
    sun_elevation_deg: float | None = None
    use: bool = True

    @property
    def given(self) -> bool:
        """Whether a file is named."""
        return self.ortho is not None or self.dem is not None

    def sun(self) -> SunDirection | None:
        """Light that is stated, if both angles are."""
        if self.sun_azimuth_deg is None or self.sun_elevation_deg is None:
            return None
        return SunDirection(self.sun_azimuth_deg, self.sun_elevation_deg)


def open_orbital(dataset: Dataset, config: MapConfig) -> OrbitalMap | None:
    """Open the map that a run is to use.

    Returns
    -------
    OrbitalMap or None
        None where there is none.

    Raises
    ------
    InputError
        When files that the user named cannot be used. A map that only the dataset names and
        that cannot be used is a warning: the run needs none.
    """
    if not config.use:
        return None
    if config.given:
        return place(config.ortho, config.dem, config.sun(), dataset)
    files = dataset.orbital
    if files is None:
        return None
    try:
        return place(files.ortho, files.dem, config.sun() or files.sun, dataset)
    except InputError as error:
        logger.warning("no absolute fixes: %s", error)
        return None


def place(
    ortho: Path | None, dem: Path | None, sun: SunDirection | None, dataset: Dataset
) -> OrbitalMap:
    """Open map files in a dataset's map frame.

    Raises
    ------
    InputError
        When they cannot be read, are of another body, or the rover does not start on them.
    """
    reference = dataset.map_reference
    for path in (ortho, dem):
        if path is not None and reference is not None:
            _require_same_body(path, reference)
    crs, origin = (None, (0.0, 0.0, 0.0)) if reference is None else (
        reference.crs, reference.origin_m
    )  # fmt: skip
    orbital = OrbitalMap.open(ortho, dem, crs=crs, origin_m=origin, sun=sun)
    x, y = (float(v) for v in dataset.start.map_T_rover[:2, 3])
    for layer in (orbital.ortho, orbital.dem):
        if layer is not None and not layer.covers(x, y):
            raise InputError(
                f"does not hold the rover's start ({x:.0f}, {y:.0f} m in the map frame; the "
                f"file spans {', '.join(f'{v:.0f}' for v in layer.bounds_m)})",
                source=layer.path,
                remedy="state the map frame (map: crs, origin) and start in traverse.yaml",
            )
    return with_sun(orbital, x, y)


def with_sun(orbital: OrbitalMap, x_m: float, y_m: float) -> OrbitalMap:
    """Estimate the light of the ortho image near a place, where nobody states it."""
    if orbital.sun is not None or orbital.ortho is None:
        return orbital
    half = _SUN_CELLS * orbital.gsd_m
    window = orbital.ortho.window((x_m - half, y_m - half, x_m + half, y_m + half))
    heights = orbital.height_on(window.grid)
    found = None if heights is None else estimate_sun(window.values, heights.values, orbital.gsd_m)
    if found is None:
        logger.warning("the map's sun is not known: its image cannot be used for fixes")
        return orbital
    logger.warning(
        "the map's sun is not stated: azimuth %.0f +- %.0f deg by the elevation model, "
        "elevation taken as %.0f deg",
        found.sun.azimuth_deg, found.sigma_deg, found.sun.elevation_deg,
    )  # fmt: skip
    return replace(orbital, sun=found.sun)


def _require_same_body(path: Path, reference: MapReference) -> None:
    Raster.open(path)  # says what is wrong with the file, if anything
    if not same_body(parse_crs(reference.crs, path), read_crs(path)):
        raise InputError(
            f"is of another body than the map frame {reference.crs}",
            source=path,
            field="crs",
            remedy="give the map that belongs to the traverse",
        )
