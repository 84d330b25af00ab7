"""Small heightfields with craters, seen by a rover in strips and from orbit as an image."""

from __future__ import annotations

import cv2
import numpy as np
import rasterio
from rasterio.transform import from_origin

from frontends.geometry import pose, so3_exp
from frontends.measurements import SunDirection
from frontends.photometry import shade
from frontends.terrain import SurfacePoints, TerrainMap

CELL = 0.125
SIDE = 640  # 80 m


def heightfield(seed: int, roughness: float = 0.04) -> np.ndarray:
    """(SIDE, SIDE) heights, m; row 0 is north."""
    rng = np.random.default_rng(seed)
    wave = np.hypot(np.fft.fftfreq(SIDE, CELL)[:, None], np.fft.rfftfreq(SIDE, CELL)[None])
    wave[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((SIDE, SIDE)))
    z = np.fft.irfft2(spectrum * wave**-1.8 * (wave < 1.5), s=(SIDE, SIDE))
    z *= roughness / np.std(z - cv2.GaussianBlur(z, (0, 0), 12))
    for _ in range(150 if roughness > 0.001 else 0):
        a, b = rng.uniform(0, SIDE * CELL, 2)
        r = rng.uniform(0.4, 2.0)
        # out to three radii: beyond, a crater is level
        i, j = (np.arange(max(0, int((c - 3 * r) / CELL)), min(SIDE, int((c + 3 * r) / CELL)))
                for c in (b, a))  # fmt: skip
        d = np.hypot(j[None] * CELL - a, i[:, None] * CELL - b) / r
        z[i[0] : i[-1] + 1, j[0] : j[-1] + 1] += (
            0.15 * r * (np.minimum(d**2 - 1, 0) + 0.3 * np.exp(-((d - 1) ** 2) / 0.1))
        )
    return z.astype(np.float32)


SUN = SunDirection(285.0, 35.0)


def write_map(path, z, sun=SUN, factor=2, seed=5, tags=True):
    """Ortho image at `factor` cells a pixel; map (0, 0) is the south-west corner."""
    rng = np.random.default_rng(seed)
    image = cv2.GaussianBlur(shade(z, CELL, sun, cast_shadows=True), (0, 0), 0.7 * factor)
    image = np.nan_to_num(image, nan=float(np.nanmean(image)))
    image = cv2.resize(image, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
    image += 0.01 * rng.standard_normal(image.shape)
    return write(path, (1000 * image).astype(np.float32), CELL * factor, sun if tags else None)


def write_dem(path, z, factor=2):
    heights = cv2.resize(z, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
    return write(path, heights, CELL * factor, None)


def write(path, values, cell, sun):
    with rasterio.open(
        path, "w", driver="GTiff", height=values.shape[0], width=values.shape[1], count=1,
        dtype=values.dtype, crs=rasterio.crs.CRS.from_user_input("IAU_2015:30135"),
        transform=from_origin(0.0, SIDE * CELL, cell, cell),
    ) as file:  # fmt: skip
        file.write(values, 1)
        if sun is not None:
            file.update_tags(SUN_AZIMUTH_DEG=sun.azimuth_deg, SUN_ELEVATION_DEG=sun.elevation_deg)
    return path


def drive(count=20, step=1.0, start=(30.0, 40.0), yaw=0.3):
    """True ``map_T_rover`` of a straight drive, height left at 0."""
    turn = so3_exp([0.0, 0.0, yaw])
    ahead = turn @ np.array([1.0, 0.0, 0.0])
    return {k: pose(turn, [*start, 0.0] + k * step * ahead) for k in range(count)}


def see(z, poses, seed=3, noise=0.01):
    """What the rover sees of the ground: a fan of 8 m ahead of each pose."""
    rng = np.random.default_rng(seed)
    terrain = TerrainMap()
    u, v = (a.ravel() for a in np.meshgrid(np.arange(1.5, 8.0, 0.1), np.arange(-5.0, 5.0, 0.1)))
    inside = np.abs(v) < 0.7 * u
    u, v = u[inside], v[inside]
    for frame, map_T_rover in poses.items():
        x, y = (map_T_rover[:2, :2] @ np.stack([u, v]) + map_T_rover[:2, 3:4]).astype(np.float32)
        column, row = x / CELL - 0.5, SIDE - y / CELL - 0.5
        height = cv2.remap(z, column[None], row[None].astype(np.float32), cv2.INTER_LINEAR)[0]
        sigma = (noise * (u / 4) ** 2 + 0.003).astype(np.float32)
        points = np.stack([u, v, height + sigma * rng.standard_normal(len(u))], axis=1)
        grey = (120 + 300 * (height - height.mean())).astype(np.float32)
        terrain.add(
            SurfacePoints(
                frame, points.astype(np.float32), sigma, grey, np.ones(len(u), dtype=np.int32)
            )
        )
    return terrain


def moved(poses, dx, dy, dyaw, about):
    """The same drive as an estimate that is off, by a turn about a keyframe and a shift."""
    centre = poses[about][:3, 3]
    turn = so3_exp([0.0, 0.0, dyaw])
    shift = pose(turn, centre - turn @ centre + np.array([dx, dy, 0.0]))
    return {k: shift @ p for k, p in poses.items()}
