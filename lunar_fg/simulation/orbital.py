"""What an orbiter knows of the place: an ortho image under another sun, and a DEM."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from frontends.errors import InputError
from lunar_fg.simulation.scene import Scene
from lunar_fg.simulation.spec import OrbitalSpec
from lunar_fg.simulation.terrain import Extent

FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]

#: Ortho pixels that a DEM pixel spans, and the DEM's resolution (full width at half height).
DEM_STEP, DEM_RESOLUTION = 2, 4.0
#: Sides of the ray grid of a pixel.
_RAYS_A_PIXEL = 3
_FROM_M = 400.0
#: Dark 1 % and bright 99.5 % of the map become these grey levels.
_BLACK, _WHITE = 8.0, 235.0


@dataclass(frozen=True, slots=True)
class MapFrame:
    """Pixels of the ortho image in the map frame: north-west corner, size, m and px."""

    west: float
    north: float
    gsd_m: float
    rows: int
    columns: int

    @classmethod
    def covering(cls, extent: Extent, gsd_m: float) -> MapFrame:
        """Whole pixels, an even number, over an extent."""
        west = float(np.floor(extent[0] / gsd_m) * gsd_m)
        north = float(np.ceil(extent[3] / gsd_m) * gsd_m)
        even = DEM_STEP * gsd_m
        columns = DEM_STEP * int(np.ceil((extent[2] - west) / even))
        rows = DEM_STEP * int(np.ceil((north - extent[1]) / even))
        return cls(west, north, gsd_m, rows, columns)

    def strip(self, first: int, last: int) -> MapFrame:
        """Rows `first` to `last` (exclusive)."""
        north = self.north - first * self.gsd_m
        return MapFrame(self.west, north, self.gsd_m, last - first, self.columns)


def look_down(scene: Scene, frame: MapFrame, spec: OrbitalSpec, fill_light: float) -> Float32:
    """Radiance factor of ground and rocks from straight above, (H, W).

    Parameters
    ----------
    scene
        Ground and rocks.
    frame
        Pixels to fill.
    spec
        The light.
    fill_light
        As for the rover's cameras.
    """
    k = _RAYS_A_PIXEL
    step = frame.gsd_m / k
    x = frame.west + step * (np.arange(frame.columns * k) + 0.5) - scene.middle[0]
    y = frame.north - step * (np.arange(frame.rows * k) + 0.5) - scene.middle[1]
    grid_x, grid_y = np.meshgrid(x, y)
    origins = np.full((grid_x.size, 3), _FROM_M, dtype=np.float32)
    origins[:, 0], origins[:, 1] = grid_x.ravel(), grid_y.ravel()
    down = np.zeros_like(origins)
    down[:, 2] = -1.0
    hits = scene.trace(origins, down)
    sun = spec.sun.direction()
    dark = scene.unlit(hits, origins, down, sun)
    radiance = scene.radiance(hits, dark, origins, down, 0.0, sun, fill_light, step)
    radiance[hits.part < 0] = np.nan
    blocks = radiance.reshape(frame.rows, k, frame.columns, k)
    return np.asarray(blocks.mean(axis=(1, 3)), dtype=np.float32)


def as_photograph(
    radiance: Float32, spec: OrbitalSpec, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Blur, noise and eight bits."""
    blurred = gaussian_filter(radiance, spec.psf_sigma_px)
    mean = float(blurred.mean())
    noise = mean / spec.snr * np.sqrt(np.maximum(blurred, 0.0) / mean + 0.1)
    noisy = blurred + noise * rng.standard_normal(radiance.shape)
    dark, bright = np.percentile(noisy, [1.0, 99.5])
    scaled = _BLACK + (_WHITE - _BLACK) * (noisy - dark) / max(float(bright - dark), 1e-9)
    return np.asarray(np.clip(np.rint(scaled), 0, 255), dtype=np.uint8)


def as_dem(height: Float32, spec: OrbitalSpec, rng: np.random.Generator) -> Float32:
    """A stereo DEM of the same place, every `DEM_STEP` ortho pixels: smooth, with noise.

    Parameters
    ----------
    height
        (H, W) of the bare ground at the ortho's pixels, m.
    spec
        Noise.
    rng
        Source of randomness.
    """
    sigma = DEM_RESOLUTION / np.sqrt(8.0 * np.log(2.0))
    smooth = gaussian_filter(height.astype(np.float64), sigma)
    error = gaussian_filter(rng.standard_normal(height.shape), sigma)
    smooth += error * (spec.dem_sigma_px * spec.gsd_m / error.std())
    rows, columns = height.shape
    blocks = smooth.reshape(rows // DEM_STEP, DEM_STEP, columns // DEM_STEP, DEM_STEP)
    return np.asarray(blocks.mean(axis=(1, 3)), dtype=np.float32)


def write_geotiff(
    path: Path,
    image: NDArray[np.uint8] | Float32,
    frame: MapFrame,
    crs: str,
    origin: tuple[float, float, float],
    tags: dict[str, str],
) -> None:
    """Write one band in the CRS; `image` may be coarser than the frame by a whole factor.

    Raises
    ------
    InputError
        When the CRS is none, or the file cannot be written.
    """
    import rasterio
    from rasterio import Affine
    from rasterio.crs import CRS
    from rasterio.errors import CRSError, RasterioError

    cell = frame.gsd_m * frame.columns / image.shape[1]
    west, north = frame.west + origin[0], frame.north + origin[1]
    try:
        with rasterio.open(
            path,
            "w",
            driver="GTiff",
            height=image.shape[0],
            width=image.shape[1],
            count=1,
            dtype=image.dtype,
            crs=CRS.from_user_input(crs),
            transform=Affine(cell, 0.0, west, 0.0, -cell, north),
            compress="deflate",
        ) as file:
            file.write(image, 1)
            file.update_tags(**tags)
    except CRSError as error:
        raise InputError(
            f"{crs[:60]!a} is not a coordinate reference system",
            source="orbital.crs",
            remedy="give a code like IAU_2015:30135, or WKT",
        ) from error
    except RasterioError as error:
        raise InputError(f"cannot be written: {error}", source=path) from error
