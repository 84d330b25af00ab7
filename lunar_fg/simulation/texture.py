"""What is too fine for a mesh: centimetre relief and tone, as filtered periodic images.

Two textures cover the ground. Each is looked up through a slow warp of the plane, so that
its period never shows; image pyramids keep the far ground from aliasing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frontends.measurements import SunDirection
from frontends.photometry import shadowed
from lunar_fg.simulation.shading import TextureData, sample_texture

FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Texture:
    """A periodic image of slope to east, slope to north, log albedo and share of light.

    Attributes
    ----------
    texel_m
        Texel of the finest image.
    texels
        (M, 4) float32: the images, each half as fine as the one before, row after row.
    sizes
        Of the images, texels; powers of two.
    warp
        Phases of the warp, rad.
    """

    texel_m: float
    texels: Float32
    sizes: NDArray[np.int64]
    warp: tuple[float, float]

    @property
    def data(self) -> TextureData:
        """What the compiled functions take."""
        return (self.texels, self.sizes, self.texel_m, self.warp)

    def sample(self, x: Float32, y: Float32, footprint_m: Float32) -> Float32:
        """Values at points (N,) averaged over about a footprint each, (N, 4)."""
        out = np.empty((len(x), 4), dtype=np.float32)
        sample_texture(*self.data, x, y, footprint_m, out)
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
        Finest texel, and texels along each side, a power of two.
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
    return Texture(
        texel_m,
        np.concatenate([image.reshape(-1, 4) for image in pyramid]),
        np.array([len(image) for image in pyramid]),
        (float(phases[0]), float(phases[1])),
    )


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
