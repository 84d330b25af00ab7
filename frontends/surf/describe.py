"""Orientations and descriptors of an image's keypoints, each on its own pyramid level."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.surf.accurate import RESPONSES, describe_accurate
from frontends.surf.integral import STRIP
from frontends.surf.keypoints import Keypoints
from frontends.surf.orientation import orient_level, sample_weights
from frontends.surf.pyramid import Pyramid
from frontends.surf.rotated import describe_rotated_level
from frontends.surf.subregions import DESCRIPTOR_SIZE, reach_weights, subregion_weights
from frontends.surf.upright import describe_upright_level

_SMALLEST_SIZE = 12.0  # size at which a keypoint moves to the next level's image
_LARGEST_SCALE = 3.6  # s in pixels of a level: what the padding has room for
_SCALE_OF_SIZE = 1.2 / 9  # a filter of side L stands for a Gaussian of 1.2 / 9 L

_WINDOW = reach_weights()
_SAMPLES = sample_weights()
_WIDE_WINDOW = subregion_weights(RESPONSES, RESPONSES)


def describe(
    pyramid: Pyramid, keypoints: Keypoints, *, upright: bool, accurate: bool, assign: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Descriptors and angles.

    Parameters
    ----------
    pyramid : Pyramid
    keypoints : Keypoints
        In pixels of the pyramid's image.
    upright : bool
        True: every angle is taken as 0.
    accurate : bool
        True: the descriptor of `accurate`.
    assign : bool
        True: orientations are computed; False: the keypoints' own are used.

    Returns
    -------
    descriptors : ndarray (N, 64) float32
    angles : ndarray (N,) float32
    """
    descriptors = np.empty((len(keypoints), DESCRIPTOR_SIZE), np.float32)
    angles = np.zeros_like(keypoints.angle) if assign else keypoints.angle.copy()
    level_of = np.floor(np.log2(keypoints.size / _SMALLEST_SIZE))
    level_of = np.clip(level_of, 0, pyramid.levels - 1).astype(np.int64)
    block = np.exp2(level_of).astype(np.float32)
    edges = (keypoints.xy + np.float32(0.5)) / block[:, None]
    scales = keypoints.size * (np.float32(_SCALE_OF_SIZE) / block)
    scales = np.minimum(scales, np.float32(_LARGEST_SCALE))
    column, row = edges.astype(np.int64).T
    visits = np.argsort(level_of << 48 | column // STRIP << 32 | row)
    ends = np.cumsum(np.bincount(level_of, minlength=pyramid.levels))
    for level, order in enumerate(np.split(visits, ends[:-1])):
        if not len(order):
            continue
        pixels = pyramid.level(level)
        if upright and not accurate:
            describe_upright_level(*pixels, edges, scales, order, _WINDOW, descriptors)
            continue
        if assign and not upright:
            orient_level(*pixels, edges, scales, order, _SAMPLES, angles)
        turns = np.zeros_like(angles) if upright else angles
        if accurate:
            image, centres = pyramid.scaled(level), edges - np.float32(0.5)
            describe_accurate(image, centres, scales, order, turns, _WIDE_WINDOW, descriptors)
        else:
            describe_rotated_level(*pixels, edges, scales, order, turns, _WINDOW, descriptors)
    return descriptors, angles
