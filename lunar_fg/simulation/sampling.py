"""Rays where they tell something: many at edges and shadow borders, few on even ground."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.measurements import SunDirection
from lunar_fg.simulation.scene import Hits, Mask, Scene
from lunar_fg.simulation.shading import inside_one_plane, spread

Float32 = NDArray[np.float32]

#: A pixel's rays take over the plane that its middle met when the eight pixels around lie on
#: it within this share of their distance. Rays are at most half as far from the middle as
#: those pixels are, and a curved ground leaves its plane with the square: at the border of
#: what is allowed a disparity of 30 px is off by 0.02 px.
_ONE_PLANE = 0.003


#: Rows of pixels that are worked on at a time: what they need stays in the processor's cache.
_STRIP = 32


@dataclass(frozen=True, slots=True)
class View:
    """What the middles of H x W pixels see.

    Attributes
    ----------
    scene, sun, fill_light
        What is looked at, and its light; see `Scene.radiance`.
    origin
        (3,) where all rays start, in the scene's axes.
    towards
        (H, W, 3) unit vectors through the pixels' middles.
    hits
        What they met, row by row.
    even, settled
        (H, W): all rays of the pixel meet about the plane that its middle met; they are also
        all lit or all dark.
    dark
        (H, W): the middle does not see the Sun.
    """

    scene: Scene
    sun: SunDirection
    fill_light: float
    origin: Float32
    towards: Float32
    hits: Hits
    even: Mask
    settled: Mask
    dark: Mask

    @classmethod
    def of(
        cls, scene: Scene, sun: SunDirection, fill_light: float, origin: Float32, towards: Float32
    ) -> View:
        """Trace the rays through the middles of the pixels."""
        shape, rays = towards.shape[:2], towards.reshape(-1, 3)
        origins = _from(origin, rays)
        hits = scene.trace(origins, rays)
        dark = scene.unlit(hits, origins, rays, sun).reshape(shape)
        even = np.empty(shape, dtype=np.bool_)
        inside_one_plane(
            hits.part.reshape(shape),
            hits.distance.reshape(shape),
            hits.facet.reshape(towards.shape),
            towards,
            len(scene.levels),
            _ONE_PLANE,
            even,
        )
        state, around = dark.astype(np.uint8), np.ones((3, 3), dtype=np.uint8)
        settled = even & (cv2.erode(state, around) == cv2.dilate(state, around))
        return cls(scene, sun, fill_light, origin, towards, hits, even, settled, dark)

    def radiance(self, rays: Float32, k: int, ray_angle: float) -> Float32:
        """Radiance factor along k x k rays a pixel, (H k, W k).

        Parameters
        ----------
        rays
            (H k, W k, 3) unit vectors.
        k
            Rays along each side of a pixel.
        ray_angle
            Between neighbouring rays, rad.
        """
        height, width = rays.shape[0], rays.shape[1]
        picture = np.empty((height, width), dtype=np.float32)
        for first in range(0, len(self.even), _STRIP):
            rows = slice(first, min(first + _STRIP, len(self.even)))
            finer = slice(rows.start * k, rows.stop * k)
            strip = np.ascontiguousarray(rays[finer]).reshape(-1, 3)
            origins = _from(self.origin, strip)
            hits, dark = self._strip(rows, strip, origins, k)
            picture[finer] = self.scene.radiance(
                hits, dark, origins, strip, ray_angle, self.sun, self.fill_light
            ).reshape(-1, width)
        return picture

    def _strip(self, rows: slice, rays: Float32, origins: Float32, k: int) -> tuple[Hits, Mask]:
        """What the rays of some rows of pixels met, and whether it is dark."""
        columns = self.even.shape[1]
        pixels = self.hits.at(slice(rows.start * columns, rows.stop * columns))
        if k == 1:
            return pixels, self.dark[rows].ravel()
        coarse, fine = (-1, columns), (-1, k * columns)
        hits = Hits.nothing(len(rays))
        spread(
            pixels.part.reshape(coarse),
            pixels.distance.reshape(coarse),
            pixels.facet.reshape(*coarse, 3),
            self.towards[rows],
            rays.reshape(*fine, 3),
            self.even[rows],
            hits.part.reshape(fine),
            hits.distance.reshape(fine),
            hits.facet.reshape(*fine, 3),
        )
        edges = np.nonzero(~_repeated(self.even[rows], k).ravel())[0]
        hits.put(edges, self.scene.trace(origins[edges], rays[edges]))
        dark = _repeated(self.dark[rows], k).ravel()
        mixed = np.nonzero(~_repeated(self.settled[rows], k).ravel())[0]
        dark[mixed] = self.scene.unlit(hits.at(mixed), origins[mixed], rays[mixed], self.sun)
        return hits, dark


def _from(origin: Float32, rays: Float32) -> Float32:
    origins = np.empty(rays.shape, dtype=np.float32)
    origins[:] = origin
    return origins


def _repeated(mask: Mask, k: int) -> Mask:
    return mask.repeat(k, axis=0).repeat(k, axis=1)
