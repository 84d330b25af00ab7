"""Normalised correlation of a masked template with a masked image, by FFT.

Padfield (2012), *Masked object registration in the Fourier domain*, for templates whose
mask is not rectangular and maps with holes.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

Layer = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: Overlaps below this share of the template are not judged.
_LEAST_OVERLAP = 0.8


def high_pass(values: Layer, mask: Mask, sigma_px: float) -> Layer:
    """Remove what is smoother than `sigma_px`, within a mask; 0 outside of it.

    Normalised convolution: the mask's shape leaves no trace in the result.
    """
    held = np.where(mask, values, 0.0).astype(np.float32)
    return np.where(mask, held - smooth(held, mask, sigma_px), 0.0).astype(np.float32)


def winsorised(values: Layer, mask: Mask) -> Layer:
    """Values limited to three robust sigmas about the median; 0 outside of the mask.

    A few rims, rocks and edges are many times as bright as all the rest: a coefficient would
    be theirs alone, and would jump with every one that the next turn takes off the edge.
    """
    known = values[mask]
    if not known.size:
        return values
    middle = float(np.median(known))
    reach = 3.0 * 1.4826 * float(np.median(np.abs(known - middle)))
    if reach == 0.0:
        return values
    limited = np.clip(values, middle - reach, middle + reach)
    return np.where(mask, limited, 0.0).astype(np.float32)


def smooth(values: Layer, mask: Mask, sigma_px: float) -> Layer:
    """Gaussian mean of the known values around each cell."""
    held = np.where(mask, values, 0.0).astype(np.float32)
    weight = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), sigma_px)
    total = cv2.GaussianBlur(held, (0, 0), sigma_px)
    return np.asarray(total / np.maximum(weight, 1e-6), dtype=np.float32)


@dataclass(frozen=True, slots=True)
class _Spectra:
    image: NDArray[np.complex64]
    square: NDArray[np.complex64]
    mask: NDArray[np.complex64]


class MaskedCorrelator:
    """Correlates templates with one image at all integer shifts.

    Parameters
    ----------
    image
        (H, W), high-passed.
    mask
        Where it is known.
    template_shape
        Largest template.
    """

    def __init__(self, image: Layer, mask: Mask, template_shape: tuple[int, int]) -> None:
        self._shape = image.shape
        # shifts that keep the template within the image do not wrap around
        full = [max(a, b) for a, b in zip(image.shape, template_shape, strict=True)]
        self._size = tuple(fft.next_fast_len(n, real=True) for n in full)
        known = mask.astype(np.float32)
        # one scale for the whole image keeps the sums of squares within single precision
        scale = float(np.std(image[mask])) if mask.any() else 1.0
        held = np.where(mask, image / max(scale, 1e-12), 0.0).astype(np.float32)
        self._spectra = _Spectra(self._forward(held), self._forward(held**2), self._forward(known))

    def surface(self, template: Layer, mask: Mask) -> Layer:
        """Correlation coefficient at each shift.

        Parameters
        ----------
        template
            (h, w).
        mask
            Where it is known.

        Returns
        -------
        Layer
            (H - h + 1, W - w + 1): entry (i, j) is the coefficient with the template's
            first cell on the image's cell (i, j); NaN where too little overlaps.
        """
        h, w = template.shape
        rows, columns = self._shape[0] - h + 1, self._shape[1] - w + 1
        if rows < 1 or columns < 1 or not mask.any():
            return np.zeros((0, 0), dtype=np.float32)
        spread = max(float(np.std(template[mask])), 1e-12)
        held = np.where(mask, (template - template[mask].mean()) / spread, 0.0)
        known = np.conj(self._forward(mask.astype(np.float32)))
        value = np.conj(self._forward(held.astype(np.float32)))
        square = np.conj(self._forward((held**2).astype(np.float32)))

        def at_shifts(product: NDArray[np.complex64]) -> NDArray[np.float64]:
            whole = fft.irfft2(product, self._size)
            return np.asarray(whole[:rows, :columns], dtype=np.float64)

        image = self._spectra
        overlap = np.maximum(at_shifts(known * image.mask), 1e-3)
        image_sum, image_square = at_shifts(known * image.image), at_shifts(known * image.square)
        value_sum, value_square = at_shifts(value * image.mask), at_shifts(square * image.mask)
        both = at_shifts(value * image.image) - image_sum * value_sum / overlap
        variance = (image_square - image_sum**2 / overlap) * (value_square - value_sum**2 / overlap)
        enough = overlap >= _LEAST_OVERLAP * mask.sum()
        flat = variance <= (1e-3 * overlap) ** 2
        result = both / np.sqrt(np.where(flat, 1.0, variance))
        return np.where(enough & ~flat, np.clip(result, -1.0, 1.0), np.nan).astype(np.float32)

    def _forward(self, values: Layer) -> NDArray[np.complex64]:
        return np.asarray(fft.rfft2(values, self._size), dtype=np.complex64)
