"""What is too fine for a mesh: centimetre relief and tone, as filtered periodic images.

Two textures cover the ground. Each is looked up through a slow warp of the plane, so that
its period never shows; image pyramids keep the far ground from aliasing.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.measurements import SunDirection
from frontends.photometry import shadowed

FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]

_CHUNK = 4096


@dataclass(frozen=True, slots=True)
class Texture:
    """A periodic image of slope to east, slope to north, log albedo and share of light.

    Attributes
    ----------
    texel_m
        Texel of the finest image.
    pyramid
        (n, n, 4) float32 images, each half as fine as the one before.
    warp
        Phases of the warp, rad.
    """

    texel_m: float
    pyramid: tuple[Float32, ...]
    warp: tuple[float, float]

    def sample(self, x: Float32, y: Float32, footprint_m: Float32) -> Float32:
        """Values at points (N,) averaged over about a footprint each, (N, 4)."""
        warped_x = x + 0.7 * np.sin(y * np.float32(0.37) + np.float32(self.warp[0]))
        warped_y = y + 0.7 * np.sin(x * np.float32(0.27) + np.float32(self.warp[1]))
        last = len(self.pyramid) - 1
        level = np.clip(np.log2(footprint_m / np.float32(self.texel_m)), 0.0, last)
        below = np.minimum(level.astype(np.int8), last - 1) if last else level.astype(np.int8)
        out = np.empty((len(x), 4), dtype=np.float32)
        for k in range(max(last, 1)):
            chosen = np.nonzero(below == k)[0]
            if len(chosen) == 0:
                continue
            px, py = warped_x[chosen], warped_y[chosen]
            fine = _lookup(self.pyramid[k], self.texel_m * 2.0**k, px, py)
            if k < last:
                coarse = _lookup(self.pyramid[k + 1], self.texel_m * 2.0 ** (k + 1), px, py)
                fine += (level[chosen] - k)[:, None] * (coarse - fine)
            out[chosen] = fine
        return out


def make_texture(
    rng: np.random.Generator,
    *,
    texel_m: float,
    size: int,
    waves_m: tuple[float, float],
    exponent: float,
    rms_at_1m: float,
    tone_rms: float,
    sun: SunDirection | None,
) -> Texture:
    """A texture by spectral synthesis.

    Parameters
    ----------
    rng
        Source of randomness.
    texel_m, size
        Finest texel, and texels along each side.
    waves_m
        Shortest and longest wavelength.
    exponent, rms_at_1m
        Relief: RMS of an octave of wavelength L is ``rms_at_1m * L ** exponent``.
    tone_rms
        RMS of the logarithm of albedo.
    sun
        Light under which the relief shadows itself, on level ground; None leaves that out.
    """
    height: FloatArray = _spectral(rng, size, texel_m, waves_m, exponent)
    octaves = np.log2(waves_m[1] / waves_m[0])
    middle = np.sqrt(waves_m[0] * waves_m[1])
    # the RMS of the whole band from that of its octaves
    steps = middle * np.exp2(np.arange(np.ceil(octaves)) - 0.5 * (octaves - 1.0))
    height *= rms_at_1m * float(np.sqrt(np.sum(steps ** (2.0 * exponent))))
    tone = tone_rms * _spectral(rng, size, texel_m, waves_m, 0.2)
    to_north = (np.roll(height, -1, axis=0) - np.roll(height, 1, axis=0)) / (2.0 * texel_m)
    to_east = (np.roll(height, -1, axis=1) - np.roll(height, 1, axis=1)) / (2.0 * texel_m)
    light = np.ones(height.shape)
    if sun is not None:
        pad = min(size, 200)
        tiled = np.pad(height, pad, mode="wrap")[::-1]
        dark = shadowed(tiled, texel_m, sun)[::-1][pad:-pad, pad:-pad]
        light[dark] = 0.0
    image = np.stack([to_east, to_north, tone, light], axis=2).astype(np.float32)
    pyramid: list[Float32] = [image]
    while pyramid[-1].shape[0] > 16:
        half = pyramid[-1].shape[0] // 2
        blocks = pyramid[-1].reshape(half, 2, half, 2, 4)
        pyramid.append(np.asarray(blocks.mean(axis=(1, 3)), dtype=np.float32))
    phases = rng.uniform(0.0, 2.0 * np.pi, 2)
    return Texture(texel_m, tuple(pyramid), (float(phases[0]), float(phases[1])))


def _spectral(
    rng: np.random.Generator,
    size: int,
    texel_m: float,
    waves_m: tuple[float, float],
    exponent: float,
) -> FloatArray:
    """Periodic Gaussian field of unit RMS with a power-law spectrum within a band."""
    frequency = np.hypot(
        *np.meshgrid(np.fft.rfftfreq(size, texel_m), np.fft.fftfreq(size, texel_m))
    )
    band = (frequency >= 1.0 / waves_m[1]) & (frequency <= 1.0 / waves_m[0])
    amplitude = np.zeros_like(frequency)
    amplitude[band] = frequency[band] ** (-1.0 - exponent)
    white = np.fft.rfft2(rng.normal(size=(size, size)))
    field = np.fft.irfft2(white * amplitude, s=(size, size))
    return np.asarray(field / field.std())


def _lookup(image: Float32, texel_m: float, x: Float32, y: Float32) -> Float32:
    """Bilinear, wrapped around; (N,) -> (N, 4)."""
    size = image.shape[0]
    # texel k covers [k, k + 1) finest-grid units at every level of the pyramid
    u = np.mod(x / np.float32(texel_m) - np.float32(0.5), np.float32(size))
    v = np.mod(y / np.float32(texel_m) - np.float32(0.5), np.float32(size))
    return remap_points(image, u, v, cv2.BORDER_WRAP)


def remap_points(image: Float32, u: Float32, v: Float32, border: int) -> Float32:
    """Bilinear samples of an image at points (N,), (N, channels)."""
    n = len(u)
    rows = -(-n // _CHUNK)
    maps = np.zeros((2, rows * _CHUNK), dtype=np.float32)
    maps[0, :n], maps[1, :n] = u, v
    columns = maps.reshape(2, rows, _CHUNK)
    sampled = cv2.remap(image, columns[0], columns[1], cv2.INTER_LINEAR, borderMode=border)
    return np.asarray(sampled.reshape(rows * _CHUNK, -1)[:n], dtype=np.float32)
