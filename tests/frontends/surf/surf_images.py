"""Synthetic textured images and the slow references the kernels are compared with."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter


def textured(seed: int, height: int = 360, width: int = 400) -> NDArray[np.uint8]:
    """Soil-like texture: noise with power at all scales, grey 20..235."""
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width))
    for sigma in (1.5, 3, 6, 12, 24):
        layer = gaussian_filter(rng.standard_normal((height, width)), sigma)
        image += layer / layer.std()
    low, high = np.percentile(image, [0.5, 99.5])
    return np.clip(20 + 215 * (image - low) / (high - low), 0, 255).astype(np.uint8)


def blob(x: float, y: float, sigma: float, shape: tuple[int, int] = (96, 96)) -> NDArray[np.uint8]:
    """One bright Gaussian blob at a sub-pixel position."""
    row, column = np.mgrid[: shape[0], : shape[1]]
    value = np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * sigma**2))
    return np.rint(40 + 180 * value).astype(np.uint8)


def similarity(scale: float, degrees: float, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Rotation and scaling about the image centre, as a 2 x 3 matrix for pixel centres."""
    centre = ((shape[1] - 1) / 2, (shape[0] - 1) / 2)
    return np.asarray(cv2.getRotationMatrix2D(centre, degrees, scale))


def warped(image: NDArray[np.uint8], matrix: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Warp with area-like smoothing when shrinking, so that the texture does not alias."""
    scale = np.sqrt(abs(np.linalg.det(matrix[:, :2])))
    if scale < 1:
        image = cv2.GaussianBlur(image, (0, 0), 0.5 * np.sqrt(1 / scale**2 - 1) + 1e-3)
    size = (image.shape[1], image.shape[0])
    return np.asarray(
        cv2.warpAffine(image, matrix, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT),
        np.uint8,
    )


def apply(matrix: NDArray[np.float64], xy: NDArray[np.floating]) -> NDArray[np.float64]:
    """Transform (N, 2) points by a 2 x 3 matrix."""
    return np.asarray(xy @ matrix[:, :2].T + matrix[:, 2], np.float64)


def mutual_matches(
    a: NDArray[np.float32], b: NDArray[np.float32], ratio: float = 0.8
) -> NDArray[np.intp]:
    """Mutual nearest neighbours that pass the ratio test, (M, 2)."""
    distance = np.sqrt(np.maximum(0, 2 - 2 * a.astype(float) @ b.T.astype(float)))
    order = np.argsort(distance, axis=1)[:, :2]
    rows = np.arange(len(a))
    good = distance[rows, order[:, 0]] < ratio * distance[rows, order[:, 1]]
    good &= distance.argmin(axis=0)[order[:, 0]] == rows
    return np.column_stack([rows[good], order[good, 0]])


def hessian_reference(
    grey: NDArray[np.floating], side: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Determinant (eq. 10) and trace of one filter by explicit convolution; NaN at the border.

    The filters are drawn as in the paper's figure: 9 x 9 has lobes of 3 x 5 and 3 x 3, larger
    ones keep the proportions (long side 5/9 of the filter, the nearest odd number of pixels
    towards the centre). Dxy is weighed so that the determinant turns with the image.
    """
    lobe = side // 3
    long = {9: 5, 15: 9, 21: 11, 27: 15}[side]
    half = side // 2
    dyy = np.zeros((side, side))
    dyy[:, half - long // 2 : half + long // 2 + 1] = 1
    dyy[lobe : 2 * lobe] *= -2
    dxy = np.zeros((side, side))
    dxy[half - lobe : half, half - lobe : half] = 1
    dxy[half + 1 : half + 1 + lobe, half + 1 : half + 1 + lobe] = 1
    dxy[half - lobe : half, half + 1 : half + 1 + lobe] = -1
    dxy[half + 1 : half + 1 + lobe, half - lobe : half] = -1
    windows = np.lib.stride_tricks.sliding_window_view(grey.astype(float), (side, side))

    def respond(kernel: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.einsum("yxij,ij->yx", windows, kernel)

    yy = respond(dyy) / (lobe * long)
    xx = respond(dyy.T) / (lobe * long)
    xy = respond(dxy) / (lobe * lobe) * (0.66 - 0.33 / lobe)
    det = np.full(grey.shape, np.nan)
    trace = det.copy()
    inside = (slice(half, -half), slice(half, -half))
    det[inside] = xx * yy - xy**2
    trace[inside] = xx + yy
    return det, trace
