"""The ground and rocks as ray-casting meshes, and how bright what a ray meets is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from frontends.measurements import SunDirection
from frontends.photometry import DEFAULT_LAW, ReflectanceLaw, sun_vector
from lunar_fg.simulation.levels import Level
from lunar_fg.simulation.rocks import RockMesh
from lunar_fg.simulation.shading import orient, surface
from lunar_fg.simulation.texture import Texture

FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]
IntArray = NDArray[np.int64]
Parts = NDArray[np.int32]
Mask = NDArray[np.bool_]

#: Mean albedo factor of the highlands.
_ALBEDO = np.float32(0.13)
#: A shadow ray starts off the surface by so much, plus a share of the ray's length: single
#: precision rounds a hit to about 1e-7 of the scene's size.
_OFFSET_M, _OFFSET_SHARE = 1e-3, 2e-5


@dataclass(frozen=True, slots=True)
class Hits:
    """What each of N rays met.

    Attributes
    ----------
    part
        (N,) which mesh: a level of the ground, or the rocks as the last; -1: nothing.
    distance
        (N,) along the ray, m; undefined where nothing was met, as all that follows.
    triangle, u, v
        (N,) triangle of that mesh and barycentric coordinates in it; of rocks alone.
    facet
        (N, 3) unit normal of the triangle, towards the ray's origin.
    """

    part: Parts
    distance: Float32
    triangle: NDArray[np.int32]
    u: Float32
    v: Float32
    facet: Float32

    def __len__(self) -> int:
        return len(self.part)

    @classmethod
    def nothing(cls, count: int) -> Hits:
        """As many rays that met nothing, to be filled in."""
        return cls(
            np.full(count, -1, dtype=np.int32),
            np.zeros(count, dtype=np.float32),
            np.zeros(count, dtype=np.int32),
            np.zeros(count, dtype=np.float32),
            np.zeros(count, dtype=np.float32),
            np.zeros((count, 3), dtype=np.float32),
        )

    def at(self, index: IntArray | slice) -> Hits:
        """What the rays of the given indices met."""
        return Hits(
            self.part[index],
            self.distance[index],
            self.triangle[index],
            self.u[index],
            self.v[index],
            self.facet[index],
        )

    def put(self, index: IntArray, other: Hits) -> None:
        """Fill in what the rays of the given indices met."""
        for field in ("part", "distance", "triangle", "u", "v", "facet"):
            getattr(self, field)[index] = getattr(other, field)


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
        self._shading = np.concatenate([level.shading.reshape(-1, 3) for level in levels])
        first = np.cumsum([0] + [level.height.size for level in levels])
        frames = (level.frame for level in levels)
        self._frames = np.array(
            [
                (f.x0, f.y0, f.spacing_m, f.rows, f.columns, n)
                for f, n in zip(frames, first, strict=False)
            ]
        )
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
        part = np.where(found["primID"] >= 0, found["geomID"], -1).astype(np.int32)
        facet = np.asarray(found["Ng"], dtype=np.float32)
        orient(facet, directions)
        return Hits(part, found["tfar"], found["primID"], found["u"], found["v"], facet)

    def unlit(self, hits: Hits, origins: Float32, directions: Float32, sun: SunDirection) -> Mask:
        """Which rays met what does not see the Sun, (N,): it is turned away, or in a shadow.

        Parameters
        ----------
        hits, origins, directions
            What `trace` gave, and what it was given.
        sun
            The light.
        """
        to_sun = sun_vector(sun).astype(np.float32)
        dark = np.ones(len(hits), dtype=np.bool_)
        facing = np.nonzero((hits.part >= 0) & (hits.facet @ to_sun > 0.0))[0]
        distance, facet = hits.distance[facing, None], hits.facet[facing]
        start = origins[facing] + distance * directions[facing]
        start += (_OFFSET_M + _OFFSET_SHARE * distance) * facet
        rays = np.ascontiguousarray(np.broadcast_to(to_sun, start.shape))
        dark[facing] = self._embree.run(start, rays, query="OCCLUDED") == 0
        return dark

    def radiance(
        self,
        hits: Hits,
        dark: Mask,
        origins: Float32,
        directions: Float32,
        ray_angle: float,
        sun: SunDirection,
        fill_light: float,
        ray_width_m: float = 0.0,
    ) -> Float32:
        """Radiance factor of what each ray met, (N,); 0 where it met nothing.

        Parameters
        ----------
        hits, dark, origins, directions
            What `trace` and `unlit` gave, and what they were given.
        ray_angle, ray_width_m
            Spread of a ray, rad, and its width at the start: how much ground it stands for.
        sun
            The light.
        fill_light
            Light from the sunlit ground around, as a share of the direct light.
        """
        to_sun = sun_vector(sun).astype(np.float32)
        mu0, mu, up, albedo, light = self._surface(
            hits, origins, directions, to_sun, ray_angle, ray_width_m
        ).T
        radiance = fill_light * to_sun[2] * (0.5 + 0.5 * up)
        lit = np.nonzero((mu0 > 0.0) & ~dark)[0]
        phase = -(directions[lit] @ to_sun)
        radiance[lit] += self._law(mu0[lit], mu[lit], phase) * light[lit]
        radiance *= _ALBEDO * albedo
        return np.asarray(radiance, dtype=np.float32)

    def _surface(
        self,
        hits: Hits,
        origins: Float32,
        directions: Float32,
        to_sun: Float32,
        ray_angle: float,
        ray_width_m: float,
    ) -> Float32:
        """See `shading.surface`."""
        surfaces = np.zeros((len(hits), 5), dtype=np.float32)
        surface(
            hits.part,
            hits.distance,
            hits.facet,
            *self._stones(hits),
            origins,
            directions,
            self.middle,
            to_sun,
            ray_angle,
            ray_width_m,
            self._shading,
            self._frames,
            self._medium.data,
            self._fine.data,
            surfaces,
        )
        return surfaces

    def _stones(self, hits: Hits) -> tuple[Float32, Float32]:
        """Unit normal and albedo factor where rays met rocks, in their order."""
        stones = np.nonzero(hits.part == len(self.levels))[0]
        if self.rocks is None or len(stones) == 0:
            return np.empty((0, 3), dtype=np.float32), np.empty(0, dtype=np.float32)
        corners = self.rocks.triangles[hits.triangle[stones]]
        u, v = hits.u[stones, None], hits.v[stones, None]
        normals = self.rocks.normals
        smooth = (1.0 - u - v) * normals[corners[:, 0]]
        smooth += u * normals[corners[:, 1]] + v * normals[corners[:, 2]]
        # between a lump and a facetted stone
        between = smooth + hits.facet[stones]
        return _unit(between), self.rocks.albedo[hits.triangle[stones]]


def _unit(vectors: Float32) -> Float32:
    # several times as fast as numpy's norm along the short axis
    length = np.sqrt(np.einsum("ni,ni->n", vectors, vectors))
    return np.asarray(vectors / np.maximum(length, np.float32(1e-30))[:, None])
