"""Time of each stage of each frame."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Collects wall time by stage, one value a frame."""

    def __init__(self) -> None:
        self._samples: dict[str, list[float]] = {}
        self._frames = 0

    @contextmanager
    def frame(self) -> Iterator[None]:
        """Time a whole frame, as stage ``total``; stages inside belong to it."""
        self._frames += 1
        with self.stage("total"):
            yield

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time one stage of the current frame; several calls in one frame add up."""
        start = time.perf_counter()
        try:
            yield
        finally:
            samples = self._samples.setdefault(name, [])
            samples.extend([float("nan")] * (self._frames - len(samples)))
            spent = 1e3 * (time.perf_counter() - start)
            samples[-1] = spent if samples[-1] != samples[-1] else samples[-1] + spent

    def milliseconds(self) -> dict[str, list[float]]:
        """Milliseconds by stage, one value a frame, NaN where a stage did not run."""
        gap = float("nan")
        return {
            name: samples + [gap] * (self._frames - len(samples))
            for name, samples in self._samples.items()
        }
