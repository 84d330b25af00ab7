"""Faults of the order of frames, and of the rover's own place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from frontends.measurements import WheelOdometry
from lunar_fg.faults.base import Frame, FramesOnly
from lunar_fg.order import with_missed


@dataclass(frozen=True, slots=True)
class Dropped(FramesOnly):
    """The frames never arrive; the wheels count on."""

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Leave the span out; the next frame's wheel motion holds the span's, too."""
        missed: list[WheelOdometry | None] = []
        for number, frame in enumerate(frames):
            if number in self.span:
                missed.append(frame.odometry)
                continue
            if missed:
                frame, missed = with_missed(frame, missed), []
            yield frame


@dataclass(frozen=True, slots=True)
class Swapped(FramesOnly):
    """Frames of the span arrive two and two in the wrong order."""

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Hold every second frame back by one."""
        held: Frame | None = None
        for number, frame in enumerate(frames):
            if held is not None:
                yield frame
                yield held
                held = None
            elif number in self.span and number < self.span.last:
                held = frame
            else:
                yield frame
        if held is not None:
            yield held


@dataclass(frozen=True, slots=True)
class Kidnapped(FramesOnly):
    """The rover is carried: the span's frames are missing, and no wheel has turned."""

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Leave the span out, and what the wheels counted in it."""
        for number, frame in enumerate(frames):
            if number not in self.span:
                yield frame
