"""What a fault is: something that happens to a dataset between two of its frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from frontends.camera import StereoCamera
from frontends.measurements import StereoFrame, UnusableFrame
from lunar_fg.datasets.base import GroundTruth, OrbitalFiles

Frame = StereoFrame | UnusableFrame


@dataclass(frozen=True, slots=True)
class Span:
    """Frames `first` to `last`, both included, counted from 0 in the dataset's order."""

    first: int
    last: int

    def __contains__(self, number: int) -> bool:
        """Whether a frame lies within."""
        return self.first <= number <= self.last

    def __len__(self) -> int:
        """Count the frames."""
        return self.last - self.first + 1

    def progress(self, number: int) -> float:
        """How far through the span a frame is: above 0, 1 at the last."""
        return (number - self.first + 1) / len(self)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What of a dataset a fault may change beside its frames."""

    camera: StereoCamera
    ground_truth: GroundTruth | None
    orbital: OrbitalFiles | None


class Fault(Protocol):
    """One fault; it holds no state, so that a dataset can be read twice."""

    @property
    def span(self) -> Span:
        """When it happens."""
        ...

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Frames as they come with the fault."""
        ...

    def surroundings(
        self, before: Surroundings, scratch: Path, rng: np.random.Generator
    ) -> Surroundings:
        """Surroundings with the fault; files it makes go into the folder `scratch`."""
        ...


@dataclass(frozen=True, slots=True)
class FramesOnly:
    """Part of the faults that leave the surroundings alone."""

    span: Span

    def surroundings(
        self, before: Surroundings, scratch: Path, rng: np.random.Generator
    ) -> Surroundings:
        """Return them as they are."""
        return before


@dataclass(frozen=True, slots=True)
class SurroundingsOnly:
    """Part of the faults that leave the frames alone."""

    span: Span

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Return them as they are."""
        return frames
