"""What every dataset offers, whatever its format."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.measurements import StartPrior, StereoFrame, SunDirection, UnusableFrame

FloatArray = NDArray[np.float64]

#: Stamps closer than this are the same time: text files round them.
STAMP_TOLERANCE_S = 1e-3


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """Where the rover truly was.

    Attributes
    ----------
    stamp_s
        (N,), strictly increasing.
    position_m
        (N, 3); z is 0 where `has_height` is false.
    map_T_rover
        (N, 4, 4) in the dataset's map frame, or None: position only, in a frame of its
        own that has to be aligned before it is compared.
    has_height
        Whether z was measured.
    """

    stamp_s: FloatArray
    position_m: FloatArray
    map_T_rover: FloatArray | None = None
    has_height: bool = True

    def __len__(self) -> int:
        """Count the stamps."""
        return len(self.stamp_s)

    @classmethod
    def of_poses(cls, stamp_s: FloatArray, map_T_rover: FloatArray) -> GroundTruth:
        """Truth from full poses; (N,) and (N, 4, 4)."""
        return cls(stamp_s, map_T_rover[:, :3, 3].copy(), map_T_rover)


@dataclass(frozen=True, slots=True)
class MapReference:
    """The map frame: coordinates of `crs` less `origin_m` (east, north, height)."""

    crs: str
    origin_m: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class OrbitalFiles:
    """Orbital maps that come with a dataset; `sun` is the light of the ortho image."""

    ortho: Path | None
    dem: Path | None
    sun: SunDirection | None


class Dataset(Protocol):
    """A stereo sequence, opened and checked; images are read one frame at a time."""

    @property
    def name(self) -> str:
        """Short name for run folders and plots."""
        ...

    @property
    def path(self) -> Path:
        """Folder that was opened."""
        ...

    @property
    def camera(self) -> StereoCamera:
        """The rectified pair."""
        ...

    @property
    def rover_T_camera(self) -> FloatArray:
        """(4, 4) pose of the left camera in rover axes."""
        ...

    @property
    def start(self) -> StartPrior:
        """Where the rover starts."""
        ...

    @property
    def ground_truth(self) -> GroundTruth | None:
        """Truth for the evaluation, never for the navigation."""
        ...

    @property
    def map_reference(self) -> MapReference | None:
        """Where the map frame lies, where that is known."""
        ...

    @property
    def orbital(self) -> OrbitalFiles | None:
        """Orbital maps of the place, where there are any."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """What the reader assumed; belongs into the run's warnings."""
        ...

    def __len__(self) -> int:
        """Count the frames, usable or not."""
        ...

    def frames(self, after: int = -1) -> Iterator[StereoFrame | UnusableFrame]:
        """Read the frames with an index above `after` in order, one at a time.

        A bad image never ends the iteration; what is skipped is not decoded.
        """
        ...


class Reader(Protocol):
    """A dataset format: knows its folders and opens them."""

    @property
    def format_name(self) -> str:
        """Name of the format."""
        ...

    @property
    def looks_for(self) -> str:
        """The files by which a folder of this format is known, for messages."""
        ...

    def detects(self, path: Path) -> bool:
        """Whether the folder is meant to be of this format."""
        ...

    def open(self, path: Path, images_root: Path | None) -> Dataset:
        """Open the folder and check all that can be checked without decoding images."""
        ...
