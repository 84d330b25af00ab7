"""Rocks: how many of which size, where, and their meshes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from frontends.geometry import so3_exp
from lunar_fg.simulation.noise import Octaves
from lunar_fg.simulation.spec import TerrainSpec

FloatArray = NDArray[np.float64]

#: Largest rock, m.
LARGEST_M = 3.0
#: Smallest diameter, m, and how far from the drive rocks of it and above are worth having.
_REACH = ((0.02, 7.0), (0.05, 16.0), (0.15, 40.0), (0.5, 150.0))
#: Rocks larger than this, m, are driven around, with so much room from the rover's middle.
_OBSTACLE_M, _CLEARANCE_M = 0.12, 0.9


#: Angles at which a rock is seen from the drive, beyond which its mesh is finer.
_FINER_RAD, _NEAREST_M = np.array([0.05, 0.2]), 1.5


@dataclass(frozen=True, slots=True)
class Rocks:
    """Rocks in map axes: (N, 2) places, (N,) diameters and distances from the drive, m."""

    xy: FloatArray
    diameter: FloatArray
    distance: FloatArray


@dataclass(frozen=True, slots=True)
class RockMesh:
    """All rocks as one mesh.

    Attributes
    ----------
    vertices, normals
        (V, 3), map axes less the scene's middle, m.
    triangles
        (F, 3).
    albedo
        (F,) factor of the mean albedo.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.int32]
    albedo: NDArray[np.float32]


def draw_rocks(spec: TerrainSpec, rng: np.random.Generator, drive: FloatArray) -> Rocks:
    """Rocks around a drive, thicker in some places than in others.

    Parameters
    ----------
    spec
        Size-frequency law.
    rng
        Source of randomness.
    drive
        (N, 2) points of the drive, m.
    """
    lengths = np.array([5.0, 25.0])
    crowd = Octaves.draw(rng, lengths, np.array([0.5, 0.6]))
    tree = KDTree(drive)
    parts = []
    for k, (smallest, reach) in enumerate(_REACH):
        largest = _REACH[k + 1][0] if k + 1 < len(_REACH) else LARGEST_M
        low, high = drive.min(axis=0) - reach, drive.max(axis=0) + reach
        law = -spec.rock_exponent
        density = spec.rock_density * (smallest**law - largest**law)
        # the crowding triples the density at most: drawn thrice as thick, then thinned
        n = rng.poisson(3.0 * density * np.prod(high - low))
        xy = rng.uniform(low, high, (n, 2))
        share = rng.uniform(0.0, 1.0, n)
        diameter = (smallest**law - share * (smallest**law - largest**law)) ** (1.0 / law)
        thick = np.exp(crowd.at(xy[:, 0], xy[:, 1]) - 0.3)
        distance = np.asarray(tree.query(xy)[0])
        keep = (rng.uniform(0.0, 3.0, n) < thick) & (distance < reach)
        keep &= (diameter < _OBSTACLE_M) | (distance > _CLEARANCE_M + 0.5 * diameter)
        parts.append((xy[keep], diameter[keep], distance[keep]))
    return Rocks(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def mesh_rocks(
    rocks: Rocks, ground: FloatArray, middle: FloatArray, rng: np.random.Generator
) -> RockMesh:
    """Meshes of all rocks, partly buried.

    Parameters
    ----------
    rocks
        Where and how large.
    ground
        (N,) height of the ground under each, m.
    middle
        (3,) point that the vertices are relative to.
    rng
        Source of randomness.
    """
    vertices, normals, triangles, albedo = [], [], [], []
    count = 0
    shapes = {level: _shapes(rng, level) for level in (1, 2, 3)}
    seen_rad = rocks.diameter / np.maximum(rocks.distance, _NEAREST_M)
    levels = 1 + np.searchsorted(_FINER_RAD, seen_rad)
    for (x, y), diameter, z, level in zip(rocks.xy, rocks.diameter, ground, levels, strict=True):
        points, normal, faces = shapes[level][rng.integers(len(shapes[level]))]
        axes = 0.5 * diameter * np.array([1.0, rng.uniform(0.65, 1.0), rng.uniform(0.45, 0.8)])
        turn = so3_exp([0.0, 0.0, rng.uniform(0.0, 2.0 * np.pi)]) @ so3_exp(
            rng.normal(0.0, 0.25, 3)
        )
        buried = rng.uniform(0.0, 0.8) * axes[2]
        placed = (points * axes) @ turn.T + [x, y, z + 0.6 * axes[2] - buried] - middle
        turned = (normal / axes) @ turn.T
        vertices.append(placed.astype(np.float32))
        normals.append((turned / np.linalg.norm(turned, axis=1)[:, None]).astype(np.float32))
        triangles.append(faces + count)
        albedo.append(np.full(len(faces), np.exp(rng.normal(0.12, 0.18)), dtype=np.float32))
        count += len(points)
    if not vertices:
        nothing = np.empty((0, 3), dtype=np.float32)
        return RockMesh(
            nothing, nothing, np.empty((0, 3), dtype=np.int32), np.empty(0, dtype=np.float32)
        )
    return RockMesh(
        np.concatenate(vertices),
        np.concatenate(normals),
        np.concatenate(triangles).astype(np.int32),
        np.concatenate(albedo),
    )


_Shape = tuple[FloatArray, FloatArray, NDArray[np.int32]]


def _shapes(rng: np.random.Generator, level: int, count: int = 24) -> list[_Shape]:
    """Rock shapes of about unit radius: a lumpy sphere with some planes cut off."""
    sphere, faces = _icosphere(level)
    shapes = []
    for _ in range(count):
        lumps = np.ones(len(sphere))
        for _ in range(5):
            direction = rng.normal(size=3)
            lumps += 0.08 * np.sin(sphere @ direction * rng.uniform(1.0, 2.5) + rng.uniform(0, 6))
        points = sphere * lumps[:, None]
        for _ in range(rng.integers(6, 14)):
            normal = rng.normal(size=3)
            normal /= np.linalg.norm(normal)
            beyond = np.maximum(points @ normal - rng.uniform(0.55, 0.95), 0.0)
            points = points - beyond[:, None] * normal
        shapes.append((points, _vertex_normals(points, faces), faces))
    return shapes


def _icosphere(level: int) -> tuple[FloatArray, NDArray[np.int32]]:
    g = 0.5 * (1.0 + np.sqrt(5.0))
    points = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g)]
    points += [(0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]
    vertices = np.array(points) / np.sqrt(1.0 + g * g)
    hull = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4)]
    hull += [(11, 10, 2), (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8)]
    hull += [(3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]
    faces = np.array(hull, dtype=np.int32)
    for _ in range(level):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
        unique, index = np.unique(edges, axis=0, return_inverse=True)
        between = vertices[unique].mean(axis=1)
        between /= np.linalg.norm(between, axis=1)[:, None]
        ab, bc, ca = (index.reshape(3, -1) + len(vertices)).astype(np.int32)
        a, b, c = faces.T
        corners = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        faces = np.concatenate([np.stack(corner, axis=1) for corner in corners])
        vertices = np.concatenate([vertices, between])
    return vertices, faces


def _vertex_normals(points: FloatArray, faces: NDArray[np.int32]) -> FloatArray:
    a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
    area = np.cross(b - a, c - a)
    normals = np.zeros_like(points)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], area)
    length = np.linalg.norm(normals, axis=1)[:, None]
    return np.asarray(np.where(length > 0.0, normals / np.maximum(length, 1e-12), [0.0, 0.0, 1.0]))
