"""How bright a lunar surface looks: reflectance laws, and shading of a relief.

Brightness is the radiance factor I/F: 1 for a white Lambert surface lit and seen from
straight above. The simulator renders with the same law that the absolute adjustment uses to
re-light a relief under the sun of a satellite image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from frontends.errors import InputError
from frontends.measurements import SunDirection

FloatArray = NDArray[np.float64]
#: Images of heights and brightnesses: single precision, a centimetre in 100 km.
Grid = NDArray[np.floating[Any]]

_LEAST_COSINE = 1e-4


class ReflectanceLaw(Protocol):
    """A bidirectional reflectance without its albedo factor."""

    def __call__(self, mu0: Grid, mu: Grid, cos_phase: Grid) -> Grid:
        """I/F of a surface element.

        Parameters
        ----------
        mu0, mu
            Cosines of incidence and emission, of one shape; unlit or unseen where <= 0.
        cos_phase
            Cosine of the angle between the directions to the Sun and to the viewer;
            broadcast against `mu0`.
        """
        ...


@dataclass(frozen=True, slots=True)
class LommelSeeliger:
    """Single scattering in a dark, porous layer: ``2 mu0 / (mu0 + mu)``.

    Normal I/F is 1; multiply by the normal albedo. No phase function: good for nadir images
    over a small range of phase.
    """

    def __call__(self, mu0: Grid, mu: Grid, cos_phase: Grid) -> Grid:
        """I/F, 0 where unlit or unseen."""
        lit = (mu0 > 0.0) & (mu > 0.0)
        return np.where(lit, 2.0 * mu0 / np.maximum(mu0 + mu, _LEAST_COSINE), 0.0)


@dataclass(frozen=True, slots=True)
class Hapke:
    """Hapke's bidirectional reflectance, with shadow-hiding opposition surge.

    Hapke (1993), *Theory of Reflectance and Emittance Spectroscopy*, eq. 8.89: I/F =
    w/4 mu0/(mu0+mu) [(1+B(g)) P(g) + H(mu0) H(mu) - 1], with the two-lobed Henyey-Greenstein
    phase function in the convention of Sato et al. (2014). Macroscopic roughness is left
    out: what it stands for, the simulator has as relief. Scaled so that straight from above,
    lit 30 degrees off, a level surface has I/F = cos(30 deg); multiply by an albedo factor.

    Attributes
    ----------
    w
        Single-scattering albedo.
    b, c
        Width of the lobes, and their share: ``(1+c)/2`` backward, ``(1-c)/2`` forward.
    surge, surge_width
        Amplitude and angular half-width (tangent of half the phase) of the opposition surge.
    """

    w: float = 0.3
    b: float = 0.24
    c: float = 0.3
    surge: float = 1.8
    surge_width: float = 0.07

    def __call__(self, mu0: Grid, mu: Grid, cos_phase: Grid) -> Grid:
        """I/F, 0 where unlit or unseen."""
        return np.asarray(self._raw(mu0, mu, cos_phase) * np.float32(self._scale()))

    def _scale(self) -> float:
        cos_30 = np.array(math.cos(math.radians(30.0)))
        return float(cos_30 / self._raw(cos_30, np.array(1.0), cos_30))

    def _raw(self, mu0: Grid, mu: Grid, cos_phase: Grid) -> Grid:
        lit = (mu0 > 0.0) & (mu > 0.0)
        m0, m = np.maximum(mu0, _LEAST_COSINE), np.maximum(mu, _LEAST_COSINE)
        scattered = self._phase(cos_phase) + self._multiple(m0) * self._multiple(m) - 1.0
        return np.where(lit, self.w / 4.0 * m0 / (m0 + m) * scattered, 0.0)

    def _phase(self, cos_phase: Grid) -> Grid:
        """``(1 + B(g)) P(g)``."""
        cosine = np.clip(cos_phase, -1.0, 1.0)
        b2 = self.b**2
        backward = (1.0 - b2) / (1.0 - 2.0 * self.b * cosine + b2) ** 1.5
        forward = (1.0 - b2) / (1.0 + 2.0 * self.b * cosine + b2) ** 1.5
        lobes = 0.5 * (1.0 + self.c) * backward + 0.5 * (1.0 - self.c) * forward
        tan_half = np.sqrt((1.0 - cosine) / np.maximum(1.0 + cosine, _LEAST_COSINE))
        return np.asarray((1.0 + self.surge / (1.0 + tan_half / self.surge_width)) * lobes)

    def _multiple(self, cosine: Grid) -> Grid:
        """Chandrasekhar's H for isotropic scatterers, Hapke's approximation."""
        return (1.0 + 2.0 * cosine) / (1.0 + 2.0 * cosine * math.sqrt(1.0 - self.w))


#: What the simulator and the absolute adjustment take when nothing else is asked for.
DEFAULT_LAW: ReflectanceLaw = Hapke()


def sun_vector(sun: SunDirection) -> FloatArray:
    """Unit vector to the Sun in map axes (east, north, up), (3,)."""
    azimuth, elevation = math.radians(sun.azimuth_deg), math.radians(sun.elevation_deg)
    level = math.cos(elevation)
    return np.array(
        [level * math.sin(azimuth), level * math.cos(azimuth), math.sin(elevation)],
        dtype=np.float64,
    )


def slopes(height: Grid, gsd_m: float) -> tuple[Grid, Grid]:
    """Slopes towards map east and north by central differences.

    Parameters
    ----------
    height
        (H, W), m, NaN where unknown; row 0 is the north edge, column 0 the west edge.
    gsd_m
        Spacing of rows and columns, m.

    Returns
    -------
    tuple
        dz/dx (east) and dz/dy (north), each (H, W); NaN beside unknown heights.
    """
    south, east = np.gradient(height, gsd_m)
    return np.asarray(east), np.asarray(-south)


def shade(
    height: Grid,
    gsd_m: float,
    sun: SunDirection,
    *,
    view: ArrayLike = (0.0, 0.0, 1.0),
    albedo: float | Grid = 1.0,
    law: ReflectanceLaw = DEFAULT_LAW,
    cast_shadows: bool = False,
) -> NDArray[np.float32]:
    """Radiance factor of a relief under a given sun.

    Parameters
    ----------
    height
        (H, W), m, NaN where unknown; north up: row 0 is the north edge, column 0 the west
        edge, as in a GeoTIFF.
    gsd_m
        Spacing of rows and columns, m.
    sun
        Direction to the Sun; azimuth clockwise from map north (-row).
    view
        (3,) direction to the viewer, map axes (east, north, up); any length. Default nadir.
    albedo
        Factor of the law, a number or (H, W).
    law
        Reflectance law.
    cast_shadows
        Whether relief that stands before the Sun darkens what lies behind; slopes turned
        away are dark in any case.

    Returns
    -------
    ndarray
        (H, W) float32, 0 in shadow, NaN where height or slope is unknown.

    Raises
    ------
    InputError
        When the grid is smaller than 2 x 2, the spacing or the view has no length.
    """
    grid = np.asarray(height, dtype=np.float32)
    towards = np.asarray(view, dtype=np.float64)
    length = float(np.linalg.norm(towards))
    _check(grid, gsd_m, length)
    towards = towards / length
    east, north = slopes(grid, gsd_m)
    sun_xyz = sun_vector(sun)
    up = 1.0 / np.sqrt(1.0 + east**2 + north**2)
    mu0 = (sun_xyz[2] - sun_xyz[0] * east - sun_xyz[1] * north) * up
    mu = (towards[2] - towards[0] * east - towards[1] * north) * up
    cos_phase = np.asarray(sun_xyz @ towards, dtype=np.float32)
    radiance = law(mu0, mu, cos_phase) * albedo
    if cast_shadows:
        radiance = np.where(shadowed(grid, gsd_m, sun), 0.0, radiance)
    return np.where(np.isfinite(up + grid), radiance, np.nan).astype(np.float32)


def shadowed(height: Grid, gsd_m: float, sun: SunDirection) -> NDArray[np.bool_]:
    """Where the relief itself hides the Sun, (H, W); all of it when the Sun is down.

    For each cell the height of the shadow's upper edge: the largest ``z - d tan(elevation)``
    at distances d towards the Sun, gathered by doubling d, in log2(size) steps.

    Parameters
    ----------
    height
        (H, W), m, NaN where unknown (casts no shadow); north up.
    gsd_m
        Spacing, m.
    sun
        Direction to the Sun.
    """
    grid = np.asarray(height, dtype=np.float32)
    if sun.elevation_deg <= 0.0:
        return np.ones(grid.shape, dtype=np.bool_)
    known = np.isfinite(grid)
    if not known.any() or sun.elevation_deg >= 90.0:
        return np.zeros(grid.shape, dtype=np.bool_)
    azimuth = math.radians(sun.azimuth_deg)
    drop = gsd_m * math.tan(math.radians(sun.elevation_deg))
    lowest = float(grid[known].min()) - 1.0
    relief = float(grid[known].max()) - lowest
    farthest = min(math.hypot(*grid.shape), relief / drop)
    filled = np.where(known, grid, np.float32(lowest))
    rows, columns = np.mgrid[: grid.shape[0], : grid.shape[1]].astype(np.float32)

    def towards_sun(field: Grid, distance: float) -> Grid:
        return np.asarray(
            cv2.remap(
                field,
                columns + np.float32(distance * math.sin(azimuth)),
                rows - np.float32(distance * math.cos(azimuth)),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=lowest,
            ),
            dtype=np.float32,
        )

    edge = towards_sun(filled, 1.0) - np.float32(drop)
    reach = 1.0
    while reach < farthest:
        edge = np.maximum(edge, towards_sun(edge, reach) - np.float32(reach * drop))
        reach *= 2.0
    return np.asarray((edge > filled) & known)


def _check(height: Grid, gsd_m: float, view_length: float) -> None:
    if height.ndim != 2 or min(height.shape) < 2:
        raise InputError(
            f"has the shape {height.shape}", source="height", remedy="give a grid of 2 x 2 or more"
        )
    if not (math.isfinite(gsd_m) and gsd_m > 0.0):
        raise InputError(f"is {gsd_m}", source="gsd_m", remedy="give the spacing in metres")
    if not (math.isfinite(view_length) and view_length > 0.0):
        raise InputError("has no length", source="view", remedy="give a direction")
