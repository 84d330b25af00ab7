"""Orientations and descriptors of all keypoints of one pyramid level."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.surf._jit import kernel
from frontends.surf.lattice import LATTICE_LANES, LINE_LENGTH
from frontends.surf.orientation import BINS_LENGTH, orientation
from frontends.surf.rotated import describe_rotated
from frontends.surf.subregions import LANES
from frontends.surf.upright import LINES, describe_upright


@kernel
def describe_level(
    integral: NDArray[np.int32],
    boxes: NDArray[np.uint32],
    upright: bool,
    assign: bool,
    centres: NDArray[np.float32],
    scales: NDArray[np.float32],
    order: NDArray[np.int64],
    window: NDArray[np.float32],
    samples: NDArray[np.float32],
    angles: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Orientations and descriptors of the keypoints of one pyramid level.

    Parameters
    ----------
    integral : ndarray int32
        Padded integral image of the level.
    boxes : ndarray uint32
        From `box_pairs`; not read when `upright`.
    upright : bool
        True: angle 0.
    assign : bool
        True: compute the orientations; False: `angles` holds them.
    centres : ndarray (N, 2) float32
        x, y in pixel edges of the padded level.
    scales : ndarray (N,) float32
        s in pixels of the level.
    order : ndarray (M,) int64
        Which keypoints, in the order to visit them.
    window, samples : ndarray float32
        From `window_weights` and `orientation.sample_weights`.
    angles : ndarray (N,) float32
        Radians; written if `assign`.
    out : ndarray (N, 64) float32
    """
    line = np.zeros(LINE_LENGTH, np.int32)
    columns = np.zeros(LATTICE_LANES, np.uint64)
    fractions = np.zeros(LATTICE_LANES, np.int32)
    lattice = np.zeros((LINES, LATTICE_LANES + 8), np.int32)
    index = np.zeros(LANES, np.uint64)
    rows = np.zeros((2, LANES), np.float32)
    pairs = np.zeros((2, LANES), np.uint32)
    patch = np.zeros((21, LANES + 8), np.float32)
    haar = np.zeros((2, 20, LANES), np.float32)
    sums = np.zeros((4, LANES), np.float32)
    directions = np.zeros((2, 13, 16), np.float32)
    bin_of = np.zeros((13, 16), np.int32)
    sectors = np.zeros((2, BINS_LENGTH), np.float32)
    work = np.zeros((2, BINS_LENGTH), np.float32)
    for i in order:
        x = float(centres[i, 0])
        y = float(centres[i, 1])
        scale = float(scales[i])
        if upright:
            describe_upright(
                integral,
                x,
                y,
                scale,
                window,
                line,
                columns,
                fractions,
                lattice,
                haar,
                sums,
                out,
                i,
            )
            continue
        if assign:
            angles[i] = orientation(
                integral,
                x,
                y,
                scale,
                samples,
                line,
                columns,
                fractions,
                lattice,
                directions,
                bin_of,
                sectors,
                work,
            )
        describe_rotated(
            boxes,
            x,
            y,
            scale,
            float(angles[i]),
            window,
            index,
            rows,
            pairs,
            patch,
            haar,
            sums,
            out,
            i,
        )
