"""Warped images to one picture: exposure, seams and multi-band blending by `cv2.detail`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Picture = NDArray[np.uint8]
Mask = NDArray[np.uint8]

#: Its stubs ask for the GPU's matrices where it takes arrays.
_detail: Any = cv2.detail

#: Exposure and seams are found on images reduced to about this many pixels.
_SEAM_PIXELS = 100_000
#: One round holds gains to 1 too much to level images that differ by half; a few do.
_EXPOSURE_ROUNDS = 5
#: Pixels this dark that touch the border are filling, not image.
_FILLING_LEVEL = 4
#: The outermost rows and columns of a detector often saturate.
_RIM_PX = 2
#: Width of the blend, as a share of the canvas.
_BLEND_SHARE = 0.05


def blend(
    pictures: Sequence[Picture], canvas_H: Sequence[FloatArray], size: tuple[int, int]
) -> tuple[Picture, NDArray[np.bool_]]:
    """Blend pictures on a common canvas.

    Parameters
    ----------
    pictures
        (H, W, 3) uint8, BGR.
    canvas_H
        (3, 3) homography of each, from its pixels to those of the canvas.
    size
        Width and height of the canvas, px.

    Returns
    -------
    picture, covered
        (H, W, 3) uint8, and (H, W) bool where an image is.
    """
    placed = [_warped(p, h, size) for p, h in zip(pictures, canvas_H, strict=True)]
    warped = [image for image, _, _ in placed]
    masks = [mask for _, mask, _ in placed]
    corners = [corner for _, _, corner in placed]

    scale = min(1.0, float(np.sqrt(_SEAM_PIXELS / max(w.shape[0] * w.shape[1] for w in warped))))
    small = [_resized(image, scale, cv2.INTER_AREA) for image in warped]
    small_masks = [_resized(mask, scale, cv2.INTER_NEAREST) for mask in masks]
    small_corners = [(round(x * scale), round(y * scale)) for x, y in corners]

    exposure = _detail.GainCompensator()
    exposure.setNrFeeds(_EXPOSURE_ROUNDS)
    exposure.feed(small_corners, small, small_masks)
    levelled = [
        np.asarray(exposure.apply(k, corners[k], image, masks[k]), np.uint8)
        for k, image in enumerate(warped)
    ]
    small = [_resized(image, scale, cv2.INTER_AREA) for image in levelled]
    seams = _detail.GraphCutSeamFinder("COST_COLOR_GRAD").find(
        [image.astype(np.float32) for image in small], small_corners, small_masks
    )
    blender = _detail.MultiBandBlender()
    width_px = _BLEND_SHARE * float(np.sqrt(size[0] * size[1]))
    blender.setNumBands(max(1, round(np.log2(max(width_px, 2.0))) - 1))
    blender.prepare((0, 0, size[0], size[1]))
    for image, mask, seam, corner in zip(levelled, masks, seams, corners, strict=True):
        blender.feed(image.astype(np.int16), _grown(seam, mask), corner)
    picture, covered = blender.blend(None, None)
    return (
        np.clip(picture, 0, 255).astype(np.uint8),
        np.asarray(covered) > 0,
    )


def _warped(
    picture: Picture, canvas_H: FloatArray, size: tuple[int, int]
) -> tuple[Picture, Mask, tuple[int, int]]:
    """The picture in its own part of the canvas, where it is valid, the part's corner."""
    height, width = picture.shape[:2]
    outline = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], float)
    corners = cv2.perspectiveTransform(outline[None], canvas_H)[0]
    least = np.clip(np.floor(corners.min(axis=0)), 0, None).astype(int)
    most = np.minimum(np.ceil(corners.max(axis=0)), np.array(size) - 1).astype(int)
    part = (int(most[0] - least[0] + 1), int(most[1] - least[1] + 1))
    shift = np.array([[1.0, 0.0, -least[0]], [0.0, 1.0, -least[1]], [0.0, 0.0, 1.0]])
    matrix = shift @ canvas_H
    image = cv2.warpPerspective(
        picture, matrix, part, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    mask = cv2.warpPerspective(_valid(picture), matrix, part, flags=cv2.INTER_NEAREST)
    return np.asarray(image, np.uint8), np.asarray(mask, np.uint8), (int(least[0]), int(least[1]))


def _valid(picture: Picture) -> Mask:
    """255 where the picture shows something: linearised images have black borders."""
    dark = (picture.max(axis=2) <= _FILLING_LEVEL).astype(np.uint8)
    _, labels = cv2.connectedComponents(dark, connectivity=4)
    rim = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    inside = ~np.isin(labels, np.setdiff1d(np.unique(rim), [0]))
    for edge in (inside[:_RIM_PX], inside[-_RIM_PX:], inside[:, :_RIM_PX], inside[:, -_RIM_PX:]):
        edge[:] = False
    return np.where(inside, 255, 0).astype(np.uint8)


def _resized(image: NDArray[np.uint8], scale: float, interpolation: int) -> NDArray[np.uint8]:
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=interpolation), np.uint8)


def _grown(seam: Any, mask: Mask) -> Mask:
    """A seam mask in full size, grown by a coarse pixel so that no gap is left."""
    coarse = seam.get() if isinstance(seam, cv2.UMat) else seam
    grown = cv2.dilate(coarse, np.ones((3, 3), np.uint8))
    full = cv2.resize(grown, (mask.shape[1], mask.shape[0]), interpolation=cv2.INTER_NEAREST)
    return np.asarray(cv2.bitwise_and(full, mask), np.uint8)
