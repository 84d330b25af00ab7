"""Faults of the orbital map: another place, scale or orientation, a seam."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import cv2
import numpy as np
import rasterio

from lunar_fg.faults.base import Surroundings, SurroundingsOnly


class MapError(StrEnum):
    """What is wrong with a map."""

    PLACE = "place"
    SCALE = "scale"
    ROTATED = "rotated"
    SEAM = "seam"


_SEAM_M = 6.0


@dataclass(frozen=True, slots=True)
class WrongMap(SurroundingsOnly):
    """The ortho image and elevation model show something else than they claim.

    Attributes
    ----------
    error
        `PLACE`: the right half stands where the left one belongs; `SCALE`: all is 1.3 times
        as large; `ROTATED`: all is turned by 25 degrees about the middle; `SEAM`: the right
        half, another strip of the mosaic, lies `_SEAM_M` too far down: false fixes that all
        agree with each other.
    """

    error: MapError = MapError.PLACE

    def surroundings(
        self, before: Surroundings, scratch: Path, rng: np.random.Generator
    ) -> Surroundings:
        """Write wrong copies of the maps and name them instead of the true ones."""
        orbital = before.orbital
        if orbital is None:
            return before
        wrong = replace(
            orbital,
            ortho=None if orbital.ortho is None else self._spoil(orbital.ortho, scratch),
            dem=None if orbital.dem is None else self._spoil(orbital.dem, scratch),
        )
        return replace(before, orbital=wrong)

    def _spoil(self, path: Path, scratch: Path) -> Path:
        target = scratch / f"wrong-{path.name}"
        with rasterio.open(path) as source:
            profile, bands, tags = source.profile, source.read(), source.tags()
        with rasterio.open(target, "w", **profile) as sink:
            sink.update_tags(**tags)
            for number, band in enumerate(bands, start=1):
                sink.write(self._moved(band, abs(profile["transform"].e)), number)
        return target

    def _moved(
        self, band: np.ndarray[tuple[int, ...], np.dtype[np.float32]], pixel_m: float
    ) -> object:
        height, width = band.shape
        if self.error is MapError.SEAM:
            moved = band.copy()
            moved[:, width // 2 :] = np.roll(
                band[:, width // 2 :], round(_SEAM_M / pixel_m), axis=0
            )
            return moved
        if self.error is MapError.PLACE:
            return np.roll(band, width // 2, axis=1)
        scale, degrees = (1.3, 0.0) if self.error is MapError.SCALE else (1.0, 25.0)
        warp = cv2.getRotationMatrix2D((0.5 * width, 0.5 * height), degrees, scale)
        return cv2.warpAffine(band, warp, (width, height), borderMode=cv2.BORDER_REFLECT)
