"""The ground and rocks as ray-casting meshes, and how bright what a ray meets is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from frontends.measurements import SunDirection
from frontends.photometry import DEFAULT_LAW, ReflectanceLaw, sun_vector
from lunar_fg.simulation.levels import Level
from lunar_fg.simulation.rocks import RockMesh
from lunar_fg.simulation.texture import Texture, remap_points

FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]
IntArray = NDArray[np.int64]

#: Mean albedo factor of the highlands.
_ALBEDO = np.float32(0.13)
#: A shadow ray starts off the surface by so much, plus a share of the ray's length: single
#: precision rounds a hit to about 1e-7 of the scene's size.
_OFFSET_M, _OFFSET_SHARE = 1e-3, 2e-5


@dataclass(frozen=True, slots=True)
class Hits:
    """What rays met: indices of the rays that met anything, and for each of these the rest.

    Attributes
    ----------
    ray
        (M,) indices into the rays.
    distance
        (M,) along the ray, m.
    part
        (M,) which mesh: a level of the ground, or the rocks as the last.
    triangle, u, v
        (M,) triangle of that mesh and barycentric coordinates in it.
    facet
        (M, 3) unit normal of the triangle, upwards.
    """

    ray: IntArray
    distance: Float32
    part: NDArray[np.int32]
    triangle: NDArray[np.int32]
    u: Float32
    v: Float32
    facet: Float32


class Scene:
    """Ground and rocks, ready for rays.

    Coordinates given to and from the rays are relative to `middle`, which keeps single
    precision below a hundredth of a millimetre along a drive of 100 m.

    Parameters
    ----------
    levels
        The ground, coarsest first.
    rocks
        Their mesh, relative to `middle`.
    fine, medium
        Textures: centimetres, and what lies between them and the grids of the coarser
        levels (those before the last).
    middle
        (3,) origin of the scene in the map frame.
    law
        Reflectance.
    """

    def __init__(
        self,
        levels: tuple[Level, ...],
        rocks: RockMesh | None,
        fine: Texture,
        medium: Texture,
        middle: FloatArray,
        law: ReflectanceLaw = DEFAULT_LAW,
    ) -> None:
        self.levels, self.rocks, self.middle = levels, rocks, middle
        self._fine, self._medium, self._law = fine, medium, law
        self._build()

    def _build(self) -> None:
        self._embree = EmbreeScene(robust=True)
        for level in self.levels:
            TriangleMesh(self._embree, *level.mesh(self.middle))
        if self.rocks is not None and len(self.rocks.triangles):
            TriangleMesh(self._embree, self.rocks.vertices, self.rocks.triangles)
        # the first query builds the tree
        self.trace(np.zeros((1, 3), dtype=np.float32), np.ones((1, 3), dtype=np.float32))

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the tree: it is rebuilt where processes cannot share memory."""
        return {name: value for name, value in self.__dict__.items() if name != "_embree"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Build the tree again."""
        self.__dict__.update(state)
        self._build()

    def trace(self, origins: Float32, directions: Float32) -> Hits:
        """First hits of rays, (N, 3) each, directions of unit length."""
        found = self._embree.run(origins, directions, output=True)
        ray = np.nonzero(found["primID"] >= 0)[0]
        facet = np.asarray(found["Ng"][ray], dtype=np.float32)
        facet = _unit(facet)
        towards = np.einsum("ni,ni->n", facet, directions[ray])
        facet = np.where(towards[:, None] > 0.0, -facet, facet)
        return Hits(
            ray,
            found["tfar"][ray],
            found["geomID"][ray],
            found["primID"][ray],
            found["u"][ray],
            found["v"][ray],
            facet,
        )

    def radiance(
        self,
        hits: Hits,
        origins: Float32,
        directions: Float32,
        ray_angle: float,
        sun: SunDirection,
        fill_light: float,
        ray_width_m: float = 0.0,
    ) -> Float32:
        """Radiance factor at each hit, (M,).

        Parameters
        ----------
        hits, origins, directions
            What `trace` gave, and what it was given.
        ray_angle, ray_width_m
            Spread of a ray, rad, and its width at the start: how much ground it stands for.
        sun
            The light.
        fill_light
            Light from the sunlit ground around, as a share of the direct light.
        """
        direction = directions[hits.ray]
        point = origins[hits.ray] + hits.distance[:, None] * direction
        normal, albedo, light = self._surface(hits, point, direction, ray_angle, ray_width_m)
        to_sun = sun_vector(sun).astype(np.float32)
        mu0 = normal @ to_sun
        mu = -np.einsum("ni,ni->n", normal, direction)
        # a normal bent away from a grazing ray is still seen
        mu = np.maximum(mu, np.float32(0.05))
        lit = (mu0 > 0.0) & (hits.facet @ to_sun > 0.0)
        candidates = np.nonzero(lit)[0]
        offset = _OFFSET_M + _OFFSET_SHARE * hits.distance[candidates]
        start = point[candidates] + offset[:, None] * hits.facet[candidates]
        rays = np.ascontiguousarray(np.broadcast_to(to_sun, start.shape))
        blocked = self._embree.run(np.ascontiguousarray(start), rays, query="OCCLUDED") == 0
        lit[candidates[blocked]] = False
        direct = self._law(mu0, mu, -(direction @ to_sun)) * light
        ambient = fill_light * (0.5 + 0.5 * normal[:, 2]) * to_sun[2]
        return np.asarray(albedo * (np.where(lit, direct, 0.0) + ambient), dtype=np.float32)

    def _surface(
        self, hits: Hits, point: Float32, direction: Float32, ray_angle: float, ray_width_m: float
    ) -> tuple[Float32, Float32, Float32]:
        """Normal, albedo and share of light that the texture lets through, at each hit."""
        n = len(hits.ray)
        slope = np.zeros((n, 2), dtype=np.float32)
        albedo = np.full(n, _ALBEDO, dtype=np.float32)
        x = point[:, 0] + np.float32(self.middle[0])
        y = point[:, 1] + np.float32(self.middle[1])
        grazing = np.maximum(-np.einsum("ni,ni->n", hits.facet, direction), np.float32(0.02))
        width = np.float32(ray_width_m) + np.float32(ray_angle) * hits.distance
        footprint = width / np.sqrt(grazing)
        for part, level in enumerate(self.levels):
            chosen = np.nonzero(hits.part == part)[0]
            if len(chosen) == 0:
                continue
            frame = level.frame
            u = (x[chosen] - np.float32(frame.x0)) / np.float32(frame.spacing_m)
            v = (y[chosen] - np.float32(frame.y0)) / np.float32(frame.spacing_m)
            shading = remap_points(level.shading, u, v, cv2.BORDER_REPLICATE)
            slope[chosen] = shading[:, :2]
            albedo[chosen] *= shading[:, 2]
            if part < len(self.levels) - 1:
                bumps = self._medium.sample(x[chosen], y[chosen], footprint[chosen])
                slope[chosen] += bumps[:, :2]
                albedo[chosen] *= np.exp(bumps[:, 2])
        normal = np.empty((n, 3), dtype=np.float32)
        normal[:, :2] = -slope
        normal[:, 2] = 1.0
        stones = np.nonzero(hits.part == len(self.levels))[0]
        if self.rocks is not None and len(stones):
            corners = self.rocks.triangles[hits.triangle[stones]]
            u, v = hits.u[stones, None], hits.v[stones, None]
            normals = self.rocks.normals
            smooth = (1.0 - u - v) * normals[corners[:, 0]]
            smooth += u * normals[corners[:, 1]] + v * normals[corners[:, 2]]
            # between a lump and a facetted stone
            normal[stones] = smooth + hits.facet[stones]
            albedo[stones] *= self.rocks.albedo[hits.triangle[stones]]
            # the texture is laid on a stone along its height as well
            x[stones] += point[stones, 2]
            y[stones] -= np.float32(0.7) * point[stones, 2]
        normal = _unit(normal)
        fine = self._fine.sample(x, y, footprint)
        normal[:, :2] -= fine[:, :2] * np.maximum(normal[:, 2:], 0.3)
        normal = _unit(normal)
        light = fine[:, 3].copy()
        light[stones] = 1.0
        return normal, albedo * np.exp(fine[:, 2]), light


def _unit(vectors: Float32) -> Float32:
    # several times as fast as numpy's norm along the short axis
    length = np.sqrt(np.einsum("ni,ni->n", vectors, vectors))
    return np.asarray(vectors / np.maximum(length, np.float32(1e-30))[:, None])
