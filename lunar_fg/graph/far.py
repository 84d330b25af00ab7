"""A start for what no linear step reaches: a path laid on the places that fixes give it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np

from frontends.measurements import FloatArray
from lunar_fg.graph.planar import planar, turn, wrapped


def turned_by(map_T_rover: FloatArray, place: FloatArray) -> float:
    """Angle from a pose to a place (x, y, yaw), rad."""
    return abs(wrapped(place[2] - float(planar(map_T_rover)[2])))


def onto(map_T_rover: FloatArray, place: FloatArray) -> gtsam.Pose3:
    """Motion in the map's plane that lays a pose on a place (x, y, yaw)."""
    x, y, yaw = planar(map_T_rover)
    shift = np.eye(4)
    shift[:2, :2] = turn(place[2] - yaw)
    shift[:2, 3] = place[:2] - shift[:2, :2] @ [x, y]
    return gtsam.Pose3(shift)


def shifts(looseness: Sequence[float], wanted: Mapping[int, gtsam.Pose3]) -> list[gtsam.Pose3]:
    """How each pose of a chain is to be moved so that some come to lie as wanted.

    Between two of these the loosest motion takes up all that does not fit: where the rover was
    carried, that is right at once.

    Parameters
    ----------
    looseness
        Of each motion, from one pose to the next.
    wanted
        Motions of some poses, by their number; where nothing is wanted before, nothing moves.
    """
    moved: list[gtsam.Pose3] = []
    shift, begin = gtsam.Pose3(), 0
    for number, motion in sorted(wanted.items()):
        between = looseness[begin:number]
        link = begin + int(np.argmax(between)) + 1 if len(between) else number
        moved += [shift] * (link - len(moved))
        shift, begin = motion, number
    return moved + [shift] * (len(looseness) + 1 - len(moved))
