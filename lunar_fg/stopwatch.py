"""Time of each stage of each frame."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Collects wall time by stage, one value a frame."""

    def __init__(self) -> None:
        self._frames: list[dict[str, float]] = []
        self._current: dict[str, float] | None = None

    @contextmanager
    def frame(self) -> Iterator[None]:
        """Time a whole frame, as stage ``total``; a frame that fails is not counted."""
        self._current = {}
        try:
            with self.stage("total"):
                yield
            self._frames.append(self._current)
        finally:
            self._current = None

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time one stage of the current frame; several calls in one frame add up.

        Outside of a frame nothing is kept.
        """
        start = time.perf_counter()
        yield
        if self._current is not None:
            spent = 1e3 * (time.perf_counter() - start)
            self._current[name] = self._current.get(name, 0.0) + spent

    def milliseconds(self) -> dict[str, list[float]]:
        """Milliseconds by stage, one value a frame, NaN where a stage did not run."""
        names = dict.fromkeys(name for frame in self._frames for name in frame)
        gap = float("nan")
        return {name: [frame.get(name, gap) for frame in self._frames] for name in names}
