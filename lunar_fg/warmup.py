"""Compile every kernel before the first run needs it."""

from __future__ import annotations

import time

import cv2
import numpy as np

from frontends.camera import StereoCamera
from frontends.measurements import StereoFrame
from frontends.surf import warmup as warm_surf
from lunar_fg.config import Config
from lunar_fg.navigator import Navigator

_FRAMES = 12
_DISPARITY_PX = 12
_STEP_PX = 4


def warmup() -> float:
    """Compile all kernels, or load them from the disk cache, by a short drive along a wall.

    Returns
    -------
    float
        Seconds it took.
    """
    start = time.perf_counter()
    warm_surf()
    camera = StereoCamera(320, 240, 240.0, 240.0, 159.5, 119.5, 0.1)
    noise = np.random.default_rng(0).standard_normal((240, 480))
    smooth = np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0))
    wall = np.clip(128.0 + 40.0 * smooth / smooth.std(), 0, 255).astype(np.uint8)
    navigator = Navigator(camera, Config())
    for index in range(_FRAMES):
        left = _STEP_PX * index
        right = left + _DISPARITY_PX
        navigator.step(
            StereoFrame(
                index,
                float(index),
                np.ascontiguousarray(wall[:, left : left + camera.width]),
                np.ascontiguousarray(wall[:, right : right + camera.width]),
                camera,
            )
        )
    navigator.finish()
    return time.perf_counter() - start
