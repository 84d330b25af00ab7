"""Time of each stage of each frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Stopwatch:
    """Collects the time of each stage, one value a frame.

    Parameters
    ----------
    clock
        Seconds: wall time by default; ``time.process_time`` for the CPU of all threads.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
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
        start = self._clock()
        yield
        if self._current is not None:
            spent = 1e3 * (self._clock() - start)
            self._current[name] = self._current.get(name, 0.0) + spent

    def milliseconds(self) -> dict[str, list[float]]:
        """Milliseconds by stage, one value a frame, NaN where a stage did not run."""
        names = dict.fromkeys(name for frame in self._frames for name in frame)
        gap = float("nan")
        return {name: [frame.get(name, gap) for frame in self._frames] for name in names}
