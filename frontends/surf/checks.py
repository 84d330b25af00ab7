"""Checks of what a caller hands in: one-line errors that say what was expected."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.errors import InputError
from frontends.surf.keypoints import Keypoints

LEAST_SIDE = 24  # pixels: below, not even the lowest layer has a place


def bad_parameter(name: str, value: object, expected: str) -> InputError:
    """Error for a parameter of `SURF`."""
    return InputError(f"{value!r}, expected {expected}", source="SURF", field=name)


def grey_image(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Check the image and return it as writable, contiguous grey (what the kernels take)."""
    if not isinstance(image, np.ndarray):
        raise InputError(f"a {type(image).__name__}, expected a numpy array", source="image")
    if image.dtype != np.uint8:
        raise InputError(
            f"dtype {image.dtype}, expected uint8",
            source="image",
            remedy="scale the grey values to 0..255 and convert",
        )
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise InputError(f"shape {image.shape}, expected (H, W) or (H, W, 3)", source="image")
    if min(image.shape[:2]) < LEAST_SIDE:
        raise InputError(
            f"{image.shape[1]} x {image.shape[0]} pixels, at least {LEAST_SIDE} x {LEAST_SIDE}"
            " are needed",
            source="image",
        )
    if image.ndim == 3:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    return np.require(image, requirements=["C", "W"])


def checked_mask(mask: NDArray[Any] | None, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
    """Check the mask and return it as booleans."""
    if mask is None:
        return None
    if not isinstance(mask, np.ndarray) or mask.dtype not in (np.dtype(np.uint8), np.dtype(bool)):
        raise InputError("expected a numpy array of uint8 or bool", source="mask")
    if mask.shape != shape:
        raise InputError(f"shape {mask.shape}, the image has {shape}", source="mask")
    return np.asarray(mask != 0)


def checked_keypoints(
    keypoints: Keypoints | Sequence[cv2.KeyPoint], shape: tuple[int, ...]
) -> Keypoints:
    """Check that keypoints can be described in an image of that shape."""
    if not isinstance(keypoints, Keypoints):
        keypoints = Keypoints.from_cv2(keypoints)
    height, width = shape
    x, y = keypoints.xy[:, 0], keypoints.xy[:, 1]
    # written so that NaN fails too
    inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
    if not inside.all():
        raise InputError(f"{np.sum(~inside)} lie outside the image", source="keypoints")
    if not (np.isfinite(keypoints.size) & (keypoints.size > 0)).all():
        raise InputError("sizes must be positive", source="keypoints", field="size")
    if not np.isfinite(keypoints.angle).all():
        raise InputError("angles must be finite", source="keypoints", field="angle")
    return keypoints
