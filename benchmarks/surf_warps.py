"""The 20 synthetic warps of real images, with their homographies, for `surf_quality`."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def about_centre(shape: tuple[int, ...], inner: NDArray[np.float64]) -> NDArray[np.float64]:
    """Homography `inner` in coordinates from the image centre, in units of half the height."""
    half = shape[0] / 2
    frame = np.array([[half, 0, (shape[1] - 1) / 2], [0, half, (shape[0] - 1) / 2], [0, 0, 1]])
    return np.asarray(frame @ inner @ np.linalg.inv(frame))


def turned(degrees: float, scale: float = 1.0) -> NDArray[np.float64]:
    c, s = scale * np.cos(np.radians(degrees)), scale * np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def tilted(degrees: float, azimuth: float) -> NDArray[np.float64]:
    """A plane turned out of the image plane, seen by a camera of 45 degrees field of view."""
    focal = 1 / np.tan(np.radians(22.5))
    axis = np.radians(degrees) * np.array(
        [np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth)), 0]
    )
    rotation = cv2.Rodrigues(axis)[0]
    camera = np.diag([focal, focal, 1])
    plane = np.column_stack([rotation[:, 0] / focal, rotation[:, 1] / focal, [0, 0, 1]])
    return np.asarray(camera @ plane)


def resampled(grey: NDArray[np.uint8], homography: NDArray[np.float64]) -> NDArray[np.float32]:
    """Warp by averaging 3 x 3 cubic samples a pixel, so that shrinking does not alias."""
    height, width = grey.shape
    fine = np.array([[3.0, 0, 1], [0, 3, 1], [0, 0, 1]])
    big = cv2.warpPerspective(
        grey.astype(np.float32), fine @ homography, (3 * width, 3 * height),
        flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT,
    )  # fmt: skip
    return np.asarray(cv2.resize(big, (width, height), interpolation=cv2.INTER_AREA))


WARPS: tuple[tuple[str, NDArray[np.float64], str, float], ...] = (
    ("rotation", turned(12), "", 0),
    ("rotation", turned(45), "", 0),
    ("rotation", turned(110), "", 0),
    ("rotation", turned(170), "", 0),
    ("scale", turned(0, 1.3), "", 0),
    ("scale", turned(5, 0.75), "", 0),
    ("scale", turned(0, 1.9), "", 0),
    ("scale", turned(-8, 0.5), "", 0),
    ("perspective", tilted(25, 0), "", 0),
    ("perspective", tilted(35, 90), "", 0),
    ("perspective", tilted(45, 30), "", 0),
    ("noise", turned(3), "noise", 5),
    ("noise", turned(3), "noise", 10),
    ("noise", turned(3), "noise", 20),
    ("exposure", turned(3), "gain", 0.5),
    ("exposure", turned(3), "gamma", 2.0),
    ("exposure", turned(3), "gain", 1.6),
    ("blur", turned(3), "blur", 1.0),
    ("blur", turned(3), "blur", 2.0),
    ("blur", turned(3), "motion", 7),
)


def degraded(grey: NDArray[np.float32], effect: str, strength: float) -> NDArray[np.uint8]:
    """Apply noise, another exposure, or blur, and quantise."""
    if effect == "noise":
        grey = grey + np.random.default_rng(7).normal(0, strength, grey.shape).astype(np.float32)
    elif effect == "gain":
        grey = strength * grey
    elif effect == "gamma":
        grey = 255 * (np.clip(grey, 0, 255) / 255) ** strength
    elif effect == "blur":
        grey = cv2.GaussianBlur(grey, (0, 0), strength)
    elif effect == "motion":
        grey = cv2.blur(grey, (int(strength), 1))
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)
