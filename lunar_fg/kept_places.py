"""The places along a drive that may be seen again, and where the rover was at each."""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from frontends.measurements import Estimate
from frontends.revisit import Place
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.graph.planar import Planar, planar, planar_of, wrapped

FloatArray = NDArray[np.float64]

#: Places are kept so often: share of the reach.
_SPACING = 1.0 / 3.0
#: A place is old when the rover has driven so many reaches since.
_OLD = 3.0
_SIGMAS = 3.0
#: 1-sigma of a motion that was measured throughout, as a share of its way: far above any drift.
_MOST_DRIFT = 0.2
#: How many places are looked at for the views most alike.
_MOST_LOOKED_AT = 40


class _Column(IntEnum):
    """What is known of a place: all in metres and radians."""

    X = 0
    Y = 1
    YAW = 2
    SIGMA = 3
    """1-sigma of the position."""
    YAW_SIGMA = 4
    REACH = 5
    """How far from here the place can be told again."""
    DRIVEN = 6
    """Length of the drive up to here."""
    LOST = 7
    """Frames up to here whose motion was only predicted."""


class KeptPlaces:
    """Keeps a place every so often, in bounded memory, and finds those near a pose.

    Parameters
    ----------
    view_change_rad
        Largest change of heading at which a place can be told again.
    memory_bytes
        When the places take more, every other one is let go and fewer are kept from then on.
    """

    def __init__(self, view_change_rad: float, memory_bytes: float) -> None:
        self._view_change = view_change_rad
        self._most_bytes = memory_bytes
        self._places: list[Place] = []
        self._bytes = 0
        # Of each place where the rover was, as far as it knew then: see `_Column`.
        self._table: FloatArray = np.empty((0, len(_Column)))
        self._driven_m = 0.0
        self._lost = 0
        self._last: FloatArray | None = None
        self._thinned = 1

    @property
    def places(self) -> list[Place]:
        """What is kept, oldest first."""
        return list(self._places)

    def drive(self, estimate: Estimate) -> None:
        """Count the way to the newest keyframe."""
        position = estimate.map_T_rover[:3, 3]
        if self._last is not None:
            self._driven_m += float(np.linalg.norm(position - self._last))
        self._last = position
        self._lost += estimate.lost

    def is_far(self, xyyaw: FloatArray) -> bool:
        """Whether a pose is far enough from the last place for the next one."""
        if not self._places:
            return True
        last = self._table[-1]
        turned = abs(wrapped(xyyaw[2] - last[_Column.YAW]))
        moved = float(np.linalg.norm(xyyaw[:2] - last[:2]))
        spacing = _SPACING * self._thinned
        return moved >= spacing * last[_Column.REACH] or turned >= spacing * 2.0 * self._view_change

    def keep(self, place: Place, estimate: Estimate, reach_m: float) -> None:
        """Keep a place, where the rover is by the estimate, seen from as far as `reach_m`."""
        here = planar_of(estimate.map_T_rover, estimate.covariance)
        row = np.concatenate([here.xyyaw, _sigmas(here), [reach_m, self._driven_m, self._lost]])
        self._places.append(place)
        self._table = np.vstack([self._table, row])
        self._bytes += place.nbytes
        if self._bytes > self._most_bytes:
            self._places, self._table = self._places[::2], self._table[::2]
            self._bytes = sum(kept.nbytes for kept in self._places)
            self._thinned *= 2

    def near(
        self, smoother: IncrementalSmoother, estimate: Estimate, used: set[int]
    ) -> list[tuple[Place, float]]:
        """Old places that the rover may see now, the most alike view first, with their reach.

        Parameters
        ----------
        smoother
            Knows where the places are by now.
        estimate
            Where the rover is.
        used
            Frames of places that are left out.
        """
        here, table = planar_of(estimate.map_T_rover, estimate.covariance), self._table
        reach = table[:, _Column.REACH]
        way = self._driven_m - table[:, _Column.DRIVEN]
        position, turn = _sigmas(here)
        # of both positions; of a measured motion alone it is less
        sigma = table[:, _Column.SIGMA] + position
        measured = table[:, _Column.LOST] == self._lost
        sigma[measured] = np.minimum(sigma, _MOST_DRIFT * way)[measured]
        yaw_sigma = table[:, _Column.YAW_SIGMA] + turn
        distance = np.linalg.norm(table[:, :2] - here.xyyaw[:2], axis=1)
        turned = np.abs(np.angle(np.exp(1j * (table[:, _Column.YAW] - here.xyyaw[2]))))
        possible = way >= _OLD * reach
        possible &= distance <= reach + _SIGMAS * sigma
        possible &= turned <= self._view_change + _SIGMAS * yaw_sigma
        rows = np.flatnonzero(possible)
        views = []
        for row in rows[np.argsort(distance[rows], kind="stable")[:_MOST_LOOKED_AT]]:
            place = self._places[row]
            if place.frame in used:
                continue
            off = planar(smoother.pose(place.frame)) - here.xyyaw
            change = float(np.linalg.norm(off[:2]) / reach[row])
            change += abs(wrapped(float(off[2]))) / self._view_change
            views.append((change, place, float(reach[row])))
        views.sort(key=lambda view: view[0])
        return [(place, reach_m) for _, place, reach_m in views]


def _sigmas(planar: Planar) -> tuple[float, float]:
    """Largest 1-sigma of the position (m) and that of the yaw (rad)."""
    position = float(np.linalg.eigvalsh(planar.covariance[:2, :2])[-1])
    return math.sqrt(max(position, 0.0)), math.sqrt(max(float(planar.covariance[2, 2]), 0.0))
