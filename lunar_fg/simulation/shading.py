"""What the ground looks like where rays met it: normal, albedo and grain shadows, compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit

FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]
Parts = NDArray[np.int32]
IntArray = NDArray[np.int64]
#: Texels (M, 4) of all images of a pyramid, finest first, their sizes, the finest texel, m,
#: and the phases of the warp.
TextureData = tuple[Float32, IntArray, float, tuple[float, float]]

#: A ray that grazes the ground more than this does not stand for more of it.
_LEAST_GRAZING = 0.02
#: The warp of the plane through which a texture is looked up: amplitude, m, and wave
#: numbers, rad/m.
_WARP_M, _WARP_X, _WARP_Y = 0.7, 0.37, 0.27


@njit
def _texel(texels: Float32, first: int, size: int, u: float, v: float, out: Float32) -> None:
    """Bilinear at (u, v) texels in one image of a pyramid, wrapped around."""
    column, row = math.floor(u), math.floor(v)
    # single precision, and indices without sign: four channels at a time
    s, t = np.float32(u - column), np.float32(v - row)
    # sizes are powers of two
    j0, i0 = int(column) & (size - 1), int(row) & (size - 1)
    j1, i1 = (j0 + 1) & (size - 1), (i0 + 1) & (size - 1)
    sw, se = np.uint64(first + size * i0 + j0), np.uint64(first + size * i0 + j1)
    nw, ne = np.uint64(first + size * i1 + j0), np.uint64(first + size * i1 + j1)
    for c in range(4):
        low = texels[sw, c] + s * (texels[se, c] - texels[sw, c])
        high = texels[nw, c] + s * (texels[ne, c] - texels[nw, c])
        out[c] = low + t * (high - low)


@njit
def _texture(
    texels: Float32,
    sizes: IntArray,
    texel_m: float,
    warp: tuple[float, float],
    x: float,
    y: float,
    footprint: float,
    out: Float32,
    coarse: Float32,
) -> None:
    """Slope to east, slope to north, log albedo and share of light over about a footprint."""
    u = (x + _WARP_M * math.sin(y * _WARP_X + warp[0])) / texel_m
    v = (y + _WARP_M * math.sin(x * _WARP_Y + warp[1])) / texel_m
    last = len(sizes) - 1
    level = min(max(math.log2(footprint / texel_m), 0.0), float(last))
    below = min(int(level), max(last - 1, 0))
    first = 0
    for k in range(below):
        first += sizes[k] * sizes[k]
        u *= 0.5
        v *= 0.5
    # texel k covers [k, k + 1) of its own units at every level of the pyramid
    _texel(texels, first, sizes[below], u - 0.5, v - 0.5, out)
    share = np.float32(level - below)
    if share > 0.0:
        first += sizes[below] * sizes[below]
        _texel(texels, first, sizes[below + 1], 0.5 * u - 0.5, 0.5 * v - 0.5, coarse)
        for c in range(4):
            out[c] += share * (coarse[c] - out[c])


@kernel
def sample_texture(
    texels: Float32,
    sizes: IntArray,
    texel_m: float,
    warp: tuple[float, float],
    x: Float32,
    y: Float32,
    footprint: Float32,
    out: Float32,
) -> None:
    """Values of a texture at points (N,), into (N, 4); see `texture.Texture.sample`."""
    coarse = np.empty(4, dtype=np.float32)
    for n in range(len(x)):
        _texture(texels, sizes, texel_m, warp, x[n], y[n], footprint[n], out[n], coarse)


@kernel
def orient(facet: Float32, directions: Float32) -> None:
    """Make normals (N, 3) unit and turn them towards where the rays come from, in place."""
    for n in range(len(facet)):
        x, y, z = facet[n, 0], facet[n, 1], facet[n, 2]
        scale = 1.0 / math.sqrt(max(x * x + y * y + z * z, 1e-30))
        if x * directions[n, 0] + y * directions[n, 1] + z * directions[n, 2] > 0.0:
            scale = -scale
        facet[n, 0], facet[n, 1], facet[n, 2] = x * scale, y * scale, z * scale


@kernel
def surface(
    part: Parts,
    distance: Float32,
    facet: Float32,
    rock_normal: Float32,
    rock_albedo: Float32,
    origins: Float32,
    directions: Float32,
    middle: FloatArray,
    to_sun: Float32,
    ray_angle: float,
    ray_width: float,
    shading: Float32,
    frames: FloatArray,
    medium: TextureData,
    fine: TextureData,
    out: Float32,
) -> None:
    """Cosines of incidence and emission, upward normal, albedo and light, into (N, 5).

    `part` is the level of the ground that a ray met, or their number for a rock (then
    `rock_normal` and `rock_albedo`, taken in order, say the rest), or -1 for the sky.
    `shading` is that of all levels, node by node; `frames` has a row a level: first node x and
    y, spacing, rows, columns, and index of the first node.
    """
    bumps, coarse = np.empty(4, dtype=np.float32), np.empty(4, dtype=np.float32)
    stone, grounds = 0, len(frames)
    for n in range(len(part)):
        which = part[n]
        if which < 0:
            continue
        t = distance[n]
        dx, dy, dz = directions[n, 0], directions[n, 1], directions[n, 2]
        height = origins[n, 2] + t * dz
        x = origins[n, 0] + t * dx + middle[0]
        y = origins[n, 1] + t * dy + middle[1]
        grazing = -(facet[n, 0] * dx + facet[n, 1] * dy + facet[n, 2] * dz)
        footprint = (ray_width + ray_angle * t) / math.sqrt(max(grazing, _LEAST_GRAZING))
        tone = 0.0
        if which < grounds:
            rows, columns = int(frames[which, 3]), int(frames[which, 4])
            u = min(max((x - frames[which, 0]) / frames[which, 2], 0.0), columns - 1.001)
            v = min(max((y - frames[which, 1]) / frames[which, 2], 0.0), rows - 1.001)
            j, i = int(u), int(v)
            u -= j
            v -= i
            at = int(frames[which, 5]) + i * columns + j
            for c in range(3):
                south = shading[at, c] + u * (shading[at + 1, c] - shading[at, c])
                at_north = at + columns
                north = shading[at_north, c]
                north += u * (shading[at_north + 1, c] - north)
                bumps[c] = south + v * (north - south)
            east, north_, albedo = bumps[0], bumps[1], bumps[2]
            if which < grounds - 1:
                _texture(*medium, x, y, footprint, bumps, coarse)
                east += bumps[0]
                north_ += bumps[1]
                tone += bumps[2]
            scale = 1.0 / math.sqrt(1.0 + east * east + north_ * north_)
            nx, ny, nz = -east * scale, -north_ * scale, scale
        else:
            nx, ny, nz = rock_normal[stone, 0], rock_normal[stone, 1], rock_normal[stone, 2]
            albedo = rock_albedo[stone]
            stone += 1
            # the texture is laid on a stone along its height as well
            x += height
            y -= 0.7 * height
        _texture(*fine, x, y, footprint, bumps, coarse)
        steep = max(nz, 0.3)
        nx -= bumps[0] * steep
        ny -= bumps[1] * steep
        scale = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        out[n, 0] = nx * to_sun[0] + ny * to_sun[1] + nz * to_sun[2]
        # a normal bent away from a grazing ray is still seen
        out[n, 1] = max(-(nx * dx + ny * dy + nz * dz), 0.05)
        out[n, 2] = nz
        out[n, 3] = albedo * math.exp(tone + bumps[2])
        out[n, 4] = bumps[3] if which < grounds else 1.0


@kernel
def inside_one_plane(
    part: Parts,
    distance: Float32,
    facet: Float32,
    directions: Float32,
    grounds: int,
    tolerance: float,
    out: NDArray[np.bool_],
) -> None:
    """Pixels all of whose eight neighbours see about the plane that the pixel itself sees.

    Sky among sky counts too; rocks (`part` of `grounds`) never. Arrays are (H, W, ...).
    """
    rows, columns = part.shape
    for i in range(rows):
        for j in range(columns):
            out[i, j] = part[i, j] < grounds
            ahead = 0.0
            for c in range(3):
                ahead += facet[i, j, c] * directions[i, j, c]
            ahead *= distance[i, j]
            for k in range(max(i - 1, 0), min(i + 2, rows)):
                for m in range(max(j - 1, 0), min(j + 2, columns)):
                    if not out[i, j]:
                        continue
                    if part[i, j] < 0 or part[k, m] < 0 or part[k, m] >= grounds:
                        out[i, j] = part[i, j] < 0 and part[k, m] < 0
                        continue
                    towards = 0.0
                    for c in range(3):
                        towards += facet[i, j, c] * directions[k, m, c]
                    error = abs(ahead / min(towards, -1e-6) - distance[k, m])
                    out[i, j] = error < tolerance * distance[k, m]


@kernel
def spread(
    part: Parts,
    distance: Float32,
    facet: Float32,
    directions: Float32,
    finer: Float32,
    chosen: NDArray[np.bool_],
    out_part: Parts,
    out_distance: Float32,
    out_facet: Float32,
) -> None:
    """Carry what each chosen pixel's ray met over to its finer rays, on the same plane.

    Pixels are (H, W, ...), finer rays (H k, W k, ...).
    """
    rows, columns = part.shape
    k = out_part.shape[0] // rows
    for i in range(rows):
        for a in range(k):
            for j in range(columns):
                if not chosen[i, j]:
                    continue
                ahead = 0.0
                for c in range(3):
                    ahead += facet[i, j, c] * directions[i, j, c]
                ahead *= distance[i, j]
                for b in range(k):
                    y, x = i * k + a, j * k + b
                    out_part[y, x] = part[i, j]
                    if part[i, j] < 0:
                        continue
                    towards = 0.0
                    for c in range(3):
                        towards += facet[i, j, c] * finer[y, x, c]
                        out_facet[y, x, c] = facet[i, j, c]
                    out_distance[y, x] = ahead / min(towards, -1e-6)
