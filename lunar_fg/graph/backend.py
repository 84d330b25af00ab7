"""What the incremental smoother needs of a graph, whatever becomes of its landmarks."""

from __future__ import annotations

from typing import Protocol

from frontends.measurements import FloatArray
from lunar_fg.graph.cases import FixGraph
from lunar_fg.graph.keyframe import Entered, Keyframe


class Backend(FixGraph, Protocol):
    """A graph over keyframes; they are named by ordinal."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user should know."""
        ...

    def add(self, keyframe: Keyframe) -> Entered:
        """Take in the next keyframe."""
        ...

    def finish(self) -> None:
        """Relinearise all until nothing moves."""
        ...

    def latest(self) -> tuple[FloatArray, FloatArray]:
        """Pose (4, 4) and covariance (6, 6) of the last keyframe."""
        ...

    def pose(self, ordinal: int) -> FloatArray:
        """(4, 4) of a keyframe."""
        ...

    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Poses (N, 4, 4) and covariances (N, 6, 6) of all keyframes."""
        ...
