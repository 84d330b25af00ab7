"""What the dataset tests write to disk."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from frontends.errors import InputError

WIDTH, HEIGHT = 64, 48

TRAVERSE = f"""\
schema: lunar-fg/traverse/1
camera:
  {{width: {WIDTH}, height: {HEIGHT}, fx: 50.0, fy: 50.0, cx: 31.5, cy: 23.5, baseline_m: 0.1}}
"""


def textured(seed: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    """A grey image of blurred noise, (height, width)."""
    noise = np.random.default_rng(seed).integers(0, 256, (size[1], size[0]), dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (5, 5), 1.0))


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def kitti_projection(offset: float) -> str:
    return f"50 0 31.5 {offset} 0 50 23.5 0 0 0 1 0"


def refusal_of(read: Callable[[Path], object], path: Path) -> str:
    """Text of the InputError that reading gives, empty when it is read; others escape."""
    try:
        read(path)
    except InputError as error:
        return str(error)
    return ""
