"""Band-limited fractal noise at any point of the plane, from a seed alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit

FloatArray = NDArray[np.float64]

#: RMS of unit gradient noise (Perlin, quintic fade), measured over 4e6 points.
_GRADIENT_NOISE_RMS = 0.2156


@dataclass(frozen=True, slots=True)
class Octaves:
    """A sum of gradient noises (Perlin 2002), each turned and shifted at random.

    The turns keep the lattices from lining up; the sum is defined everywhere and has no
    period that matters (2^31 cells).

    Attributes
    ----------
    wavelength_m, rms_m
        (N,) cell size and RMS of each octave.
    turn_rad, shift
        (N,) and (N, 2): each octave's own lattice.
    hash_seed
        (N,) int64.
    """

    wavelength_m: FloatArray
    rms_m: FloatArray
    turn_rad: FloatArray
    shift: FloatArray
    hash_seed: NDArray[np.int64]

    @classmethod
    def draw(
        cls,
        rng: np.random.Generator,
        wavelength_m: NDArray[np.floating[Any]],
        rms_m: NDArray[np.floating[Any]],
    ) -> Octaves:
        """Lattices for the given octaves."""
        n = len(wavelength_m)
        return cls(
            np.asarray(wavelength_m, dtype=np.float64),
            np.asarray(rms_m, dtype=np.float64),
            rng.uniform(0.0, 2.0 * np.pi, n),
            rng.uniform(-1e3, 1e3, (n, 2)),
            rng.integers(0, 2**20, n),
        )

    def between(self, shortest_m: float, longest_m: float = np.inf) -> Octaves:
        """The octaves with wavelengths of at least `shortest_m` and below `longest_m`."""
        keep = (self.wavelength_m >= shortest_m) & (self.wavelength_m < longest_m)
        return Octaves(
            self.wavelength_m[keep],
            self.rms_m[keep],
            self.turn_rad[keep],
            self.shift[keep],
            self.hash_seed[keep],
        )

    def at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Value at points; any shape, m."""
        flat = np.zeros(x.size)
        _sum_octaves(
            np.ascontiguousarray(x, dtype=np.float64).ravel(),
            np.ascontiguousarray(y, dtype=np.float64).ravel(),
            self.wavelength_m,
            self.rms_m / _GRADIENT_NOISE_RMS,
            self.turn_rad,
            self.shift,
            self.hash_seed,
            flat,
        )
        return flat.reshape(x.shape)


_ANGLES = np.linspace(0.0, 2.0 * np.pi, 256, endpoint=False)
_COS, _SIN = np.cos(_ANGLES), np.sin(_ANGLES)


@njit
def _corner(i: int, j: int, seed: int, u: float, v: float) -> float:
    h = (i * 374761393 + j * 668265263 + seed * 1274126177) & 0x7FFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0x7FFFFFFF
    h = (h ^ (h >> 16)) & 255
    return float(_COS[h] * u + _SIN[h] * v)


@njit
def _fade(t: float) -> float:
    return t * t * t * (t * (t * 6.0 - 15.0) + 10.0)


@kernel
def _sum_octaves(
    x: FloatArray,
    y: FloatArray,
    wavelength: FloatArray,
    amplitude: FloatArray,
    turn: FloatArray,
    shift: FloatArray,
    seed: NDArray[np.int64],
    out: FloatArray,
) -> None:
    for k in range(len(wavelength)):
        c, s = np.cos(turn[k]) / wavelength[k], np.sin(turn[k]) / wavelength[k]
        for n in range(len(x)):
            u = c * x[n] - s * y[n] + shift[k, 0]
            v = s * x[n] + c * y[n] + shift[k, 1]
            i, j = int(np.floor(u)), int(np.floor(v))
            u -= i
            v -= j
            fu, fv = _fade(u), _fade(v)
            south = _corner(i, j, seed[k], u, v)
            south += fu * (_corner(i + 1, j, seed[k], u - 1.0, v) - south)
            north = _corner(i, j + 1, seed[k], u, v - 1.0)
            north += fu * (_corner(i + 1, j + 1, seed[k], u - 1.0, v - 1.0) - north)
            out[n] += amplitude[k] * (south + fv * (north - south))
