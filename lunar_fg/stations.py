"""Keyframes whose ground is measured, and which of it is due for the next absolute fix."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_FEWEST = 3
#: Share of a fix's ground that will do when the rover is uncertain, or nothing more comes.
_LEAST_SHARE = 0.5
#: After a refusal a fix is tried again with so much more ground, and this much is kept.
_MORE, _KEPT = 0.25, 1.5


@dataclass(frozen=True, slots=True)
class _Station:
    """A keyframe, and how far the rover had driven."""

    frame: int
    driven_m: float


class Stations:
    """Ground along the drive that no believed fix has used yet.

    Parameters
    ----------
    step_m
        Ground is measured so often.
    length_m
        Length of drive whose ground makes a fix.
    """

    def __init__(self, step_m: float, length_m: float) -> None:
        self._step_m = step_m
        self._length_m = length_m
        self._stations: list[_Station] = []
        self._driven_m = 0.0
        self._last: FloatArray | None = None
        self._next_try_m = 0.0
        self._tried: set[int] = set()

    @property
    def frames(self) -> list[int]:
        """Keyframes whose ground may be used, oldest first."""
        return [station.frame for station in self._stations]

    def come(self, frame: int, map_T_rover: FloatArray, *, usable: bool) -> bool:
        """Count the way to a keyframe; whether it is a station: far enough on, and `usable`."""
        if self._last is not None:
            step = float(np.linalg.norm(map_T_rover[:2, 3] - self._last[:2, 3]))
            if step < self._step_m and self._stations:
                return False
            self._driven_m += step
        self._last = map_T_rover
        if usable:
            self._stations.append(_Station(frame, self._driven_m))
        return usable

    def lose(self) -> None:
        """Begin anew: what was seen so far cannot be joined with what comes."""
        self._stations, self._last = [], None
        self._next_try_m = self._driven_m

    def jump(self) -> None:
        """Do not count the way to the next keyframe: the path was computed anew."""
        self._last = None

    def due(
        self, *, last: bool, most_sigma_m: float, sigma_m: Callable[[int], float]
    ) -> int | None:
        """The anchor of the next fix, the keyframe in the middle of the ground; None: not yet.

        Parameters
        ----------
        last
            Nothing more will be seen: half as much ground will do.
        most_sigma_m, sigma_m
            So it will where the newest station is less certain than this; gives a keyframe's
            1-sigma.
        """
        early = not last and self._driven_m < self._next_try_m
        if len(self._stations) < _FEWEST or early:
            return None
        first, newest = self._stations[0], self._stations[-1]
        driven = newest.driven_m - first.driven_m
        if driven < _LEAST_SHARE * self._length_m:
            return None
        middle = 0.5 * (newest.driven_m + first.driven_m)
        free = [s for s in self._stations if s.frame not in self._tried]
        if not free:
            return None
        anchor = min(free, key=lambda s: abs(s.driven_m - middle)).frame
        enough = driven >= self._length_m or last
        return anchor if enough or sigma_m(newest.frame) > most_sigma_m else None

    def tried(self, anchor: int) -> None:
        """Remember that a keyframe was an anchor: it is none again."""
        self._tried.add(anchor)

    def settle(self, accepted: bool) -> None:
        """Let go of the ground of a believed fix; keep it after a refusal, for a longer one."""
        if accepted:
            self._stations = []
            self._next_try_m = self._driven_m
            return
        self._next_try_m = self._driven_m + _MORE * self._length_m
        oldest = self._driven_m - _KEPT * self._length_m
        self._stations = [s for s in self._stations if s.driven_m >= oldest]
