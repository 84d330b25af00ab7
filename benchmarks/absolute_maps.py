"""Maps for the absolute-fix benchmark: rendered from above, bent, or of nothing."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import rasterio
from scipy.ndimage import gaussian_filter

from benchmarks.absolute_trials import GSDS_M, SUN_DIFFERENCES_DEG, Ground
from frontends.orbital import OrbitalMap
from lunar_fg.simulation.orbital import MapFrame, as_photograph, look_down, write_geotiff
from lunar_fg.simulation.simulate import build_world
from lunar_fg.simulation.spec import OrbitalSpec, SunSpec, read_spec

MAP_ELEVATION_DEG = 35.0
#: Local error of a bent map: 1-sigma per axis, in pixels, and the length it changes over.
BENT_PIXELS = 0.2
BENT_OVER_M = 20.0


def render_maps(folder: Path, ground: Ground, work: Path) -> None:
    """The traverse's surroundings from above, under each sun, at each ground distance."""
    spec = read_spec(folder / "simulation.yaml")
    world = None
    places = np.array([p[:2, 3] for p in ground.true.values()])
    west, south = places.min(axis=0) - 36.0
    east, north = places.max(axis=0) + 36.0
    frame = MapFrame.covering((west, south, east, north), min(GSDS_M))
    rows, columns = (n - n % 4 for n in (frame.rows, frame.columns))
    frame = MapFrame(frame.west, frame.north, frame.gsd_m, rows, columns)
    for difference in SUN_DIFFERENCES_DEG:
        paths = [work / f"{ground.name}_{difference:.0f}_{gsd}.tif" for gsd in GSDS_M]
        if all(path.exists() for path in paths):
            continue
        world = world or build_world(spec)
        sun = SunSpec(azimuth_deg=(spec.sun.azimuth_deg + difference) % 360.0,
                      elevation_deg=MAP_ELEVATION_DEG)  # fmt: skip
        light = OrbitalSpec(gsd_m=frame.gsd_m, sun=sun)
        strips = [
            look_down(world.scene, frame.strip(first, min(first + 64, rows)), light,
                      spec.camera.fill_light)
            for first in range(0, rows, 64)
        ]  # fmt: skip
        radiance = np.concatenate(strips)
        for gsd, path in zip(GSDS_M, paths, strict=True):
            k = round(gsd / frame.gsd_m)
            mean = radiance.reshape(rows // k, k, columns // k, k).mean(axis=(1, 3))
            rng = np.random.default_rng([spec.seed, round(difference), k])
            image = as_photograph(mean.astype(np.float32), light, rng)
            tags = {"SUN_AZIMUTH_DEG": f"{sun.azimuth_deg}",
                    "SUN_ELEVATION_DEG": f"{sun.elevation_deg}"}  # fmt: skip
            area = MapFrame(frame.west, frame.north, gsd, rows // k, columns // k)
            write_geotiff(path, image, area, ground.crs, ground.origin, tags)


def featureless(like: Path, path: Path, ground: Ground) -> None:
    """A map of nothing but noise, over the same place."""
    found = OrbitalMap.open(like, crs=ground.crs, origin_m=ground.origin).ortho
    west, south, east, north = found.bounds_m
    frame = MapFrame.covering((west, south, east, north), found.gsd_m)
    rng = np.random.default_rng(9)
    image = np.clip(128 + 2 * rng.standard_normal((frame.rows, frame.columns)), 0, 255)
    tags = {"SUN_AZIMUTH_DEG": "285", "SUN_ELEVATION_DEG": "35"}
    write_geotiff(path, image.astype(np.uint8), frame, ground.crs, ground.origin, tags)


def bent(like: Path, path: Path) -> None:
    """The same map, its ground moved about as orthorectification and jitter do."""
    with rasterio.open(like) as file:
        image, profile, tags = file.read(1), file.profile, file.tags()
    rows, columns = image.shape
    over = BENT_OVER_M / float(profile["transform"].a)
    rng = np.random.default_rng(list(path.name.encode()))  # each map is bent in its own way
    moved = []
    for _ in range(2):
        field = gaussian_filter(rng.standard_normal(image.shape), over, mode="wrap")
        moved.append(BENT_PIXELS * field / field.std())
    y, x = np.mgrid[:rows, :columns]
    warped = cv2.remap(
        image, (x + moved[0]).astype(np.float32), (y + moved[1]).astype(np.float32),
        cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    with rasterio.open(path, "w", **profile) as file:
        file.write(warped, 1)
        file.update_tags(**tags)
