"""What the path between its keyframes leaves open of the place of a patch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


@dataclass(frozen=True, slots=True)
class Strip:
    """The keyframes whose ground makes a patch, in order, map axes.

    Attributes
    ----------
    xyyaw
        (N, 3) of the keyframes.
    ground_m
        (N, 2) middle of the ground that each has seen.
    spread_m2
        (N,) mean squared distance of that ground from its middle.
    weight
        (N,) how much ground it is.
    motions
        N - 1 covariances (3, 3) of x, y and yaw of the motion from each keyframe to the next, in
        the level axes of the former.
    """

    xyyaw: FloatArray
    ground_m: FloatArray
    spread_m2: FloatArray
    weight: FloatArray
    motions: Sequence[FloatArray]


def bending(strip: Strip, anchor: int) -> FloatArray:
    """Covariance (3, 3) that the motions' errors give the anchor's x, y and yaw, map axes.

    What a motion is wrong by moves all ground beyond it, seen from the anchor, and turns it about
    the keyframe where the motion ends. The patch is laid on the map as a whole: where most of its
    ground fits, which is the least-squares rigid motion of all of it.

    Parameters
    ----------
    strip
        See there.
    anchor
        Row of the anchor in it.
    """
    count = len(strip.xyyaw)
    lever = (strip.ground_m - strip.xyyaw[anchor, :2]) @ _QUARTER_TURN.T
    spread = np.sqrt(strip.spread_m2)
    # rows: the middle's east and north, and the turn of the ground about it
    design = np.zeros((count, 3, 3))
    design[:, 0, 0] = design[:, 1, 1] = 1.0
    design[:, :2, 2] = lever
    design[:, 2, 2] = spread
    root = np.repeat(np.sqrt(strip.weight), 3)
    rigid = np.linalg.pinv(root[:, None] * design.reshape(-1, 3)) * root
    total = np.zeros((3, 3))
    for k, motion in enumerate(strip.motions):
        moved = np.arange(count) > k if k >= anchor else np.arange(count) <= k
        cosine, sine = np.cos(strip.xyyaw[k, 2]), np.sin(strip.xyyaw[k, 2])
        by_motion = np.zeros((count, 3, 3))
        by_motion[moved, :2, :2] = [[cosine, -sine], [sine, cosine]]
        about = strip.ground_m - strip.xyyaw[k + 1, :2]
        by_motion[moved, :2, 2] = (about @ _QUARTER_TURN.T)[moved]
        by_motion[moved, 2, 2] = spread[moved]
        effect = rigid @ by_motion.reshape(-1, 3)
        total += effect @ motion @ effect.T
    return total
