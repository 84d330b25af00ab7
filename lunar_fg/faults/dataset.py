"""A dataset with faults, which is a dataset like any other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from frontends.camera import StereoCamera
from frontends.measurements import FloatArray, StartPrior
from lunar_fg.datasets.base import Dataset, GroundTruth, MapReference, OrbitalFiles
from lunar_fg.faults.base import Fault, Frame, Surroundings


class FaultyDataset:
    """A dataset seen through faults; see `lunar_fg.datasets.base.Dataset` for the rest.

    Parameters
    ----------
    dataset
        The sound one.
    faults
        What goes wrong; later ones meet what earlier ones left.
    seed
        Of every random choice; reading twice gives the same frames.
    scratch
        Folder for files that a fault makes (wrong maps).
    """

    def __init__(self, dataset: Dataset, faults: Sequence[Fault], seed: int, scratch: Path) -> None:
        self._dataset = dataset
        self._faults = tuple(faults)
        self._seed = seed
        seen = Surroundings(dataset.camera, dataset.ground_truth, dataset.orbital)
        for fault, rng in zip(self._faults, self._generators(), strict=True):
            seen = fault.surroundings(seen, scratch, rng)
        self._seen = seen

    def _generators(self) -> list[np.random.Generator]:
        return np.random.default_rng(self._seed).spawn(len(self._faults))

    @property
    def name(self) -> str:
        """Name of the sound dataset."""
        return self._dataset.name

    @property
    def path(self) -> Path:
        """Folder of the sound dataset."""
        return self._dataset.path

    @property
    def camera(self) -> StereoCamera:
        """The pair as it claims to be."""
        return self._seen.camera

    @property
    def rover_T_camera(self) -> FloatArray:
        """(4, 4) pose of the left camera in rover axes."""
        return self._dataset.rover_T_camera

    @property
    def start(self) -> StartPrior:
        """Where the rover starts."""
        return self._dataset.start

    @property
    def ground_truth(self) -> GroundTruth | None:
        """Truth, dated by the clock of the frames."""
        return self._seen.ground_truth

    @property
    def map_reference(self) -> MapReference | None:
        """Where the map frame lies."""
        return self._dataset.map_reference

    @property
    def orbital(self) -> OrbitalFiles | None:
        """Orbital maps as they claim to be."""
        return self._seen.orbital

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of the sound dataset, and what goes wrong here."""
        injected = (
            f"injected fault: {type(fault).__name__}, frames {fault.span.first} to "
            f"{fault.span.last}"
            for fault in self._faults
        )
        return (*self._dataset.notes, *injected)

    def __len__(self) -> int:
        """Count the frames of the sound dataset."""
        return len(self._dataset)

    def frames(self, after: int = -1) -> Iterator[Frame]:
        """Read the frames as the faults leave them; all are read, for faults have a history."""
        frames: Iterator[Frame] = self._dataset.frames()
        for fault, rng in zip(self._faults, self._generators(), strict=True):
            frames = fault.frames(frames, rng)
        return (frame for frame in frames if frame.index > after)
