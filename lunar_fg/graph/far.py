"""A start for what no linear step reaches: a path laid on the places that fixes give it."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence

import gtsam
import numpy as np

from frontends.errors import EstimationError
from frontends.measurements import FloatArray
from lunar_fg.graph.isam import GuardedIsam
from lunar_fg.graph.planar import planar, turn


def turned_by(map_T_rover: FloatArray, place: FloatArray) -> float:
    """Angle from a pose to a place (x, y, yaw), rad."""
    yaw = math.atan2(map_T_rover[1, 0], map_T_rover[0, 0])
    return abs(math.remainder(float(place[2]) - yaw, 2.0 * math.pi))


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


def exchange(
    isam: GuardedIsam,
    entering: Mapping[str, gtsam.NonlinearFactor],
    leaving: Collection[str],
    frame: int,
    start: Callable[[], gtsam.Values],
    *,
    far: bool,
) -> set[int]:
    """Put named factors in and take others out, from a new start where no step leads there.

    Parameters
    ----------
    isam
        Holds the factors.
    entering, leaving, frame
        As for `GuardedIsam.exchange`.
    start
        Makes values for everything; used where they are `far`, or where the step fails.

    Returns
    -------
    set of int
        Keys of landmarks that had to be taken out.

    Raises
    ------
    EstimationError
        As for `GuardedIsam.exchange_from`.
    """
    if not far:
        try:
            isam.exchange(entering, leaving, frame)
        except EstimationError:
            pass  # tried again from the start that is made for it
        else:
            return set()
    return isam.exchange_from(start(), entering, leaving, frame)
