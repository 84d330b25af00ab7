"""Image pairs as they arrive in a folder.

``left/NAME`` and ``right/NAME`` are a pair, the number in NAME is the frame; from 1e14 on it is
the time in nanoseconds. An image that cannot be read yet is waited for: it is taken for broken,
and a lone image for alone, when nothing was written to it for `STALE_S`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from watchfiles import watch

from frontends.camera import StereoCamera
from frontends.errors import InputError
from frontends.measurements import StartPrior, StereoFrame, UnusableFrame
from lunar_fg.datasets.base import FloatArray, GroundTruth, MapReference, OrbitalFiles
from lunar_fg.datasets.image_pairs import frame_number, stamp_of
from lunar_fg.datasets.images import SUFFIXES
from lunar_fg.datasets.schema import read_traverse
from lunar_fg.datasets.stereo_files import StereoFiles, StereoPair, find_white_level

#: A file in the folder with this name ends the run after the pairs that are there.
MARKER = "end"
#: How long an image may stay unreadable, or without its partner, after it was last written.
STALE_S = 3.0
#: How often the folder is looked at when the system reports no change.
_TICK_MS = 200


class Policy(StrEnum):
    """What is done when pairs arrive faster than they are processed."""

    EVERY = "every"
    NEWEST = "newest"


@dataclass(slots=True)
class Arrivals:
    """What happened to the pairs.

    Attributes
    ----------
    skipped
        Left out for a newer one (policy "newest").
    late
        Came after a newer one had been taken.
    written_s
        Time (s, epoch) when the pair of each frame was complete on disk, by frame.
    """

    skipped: int = 0
    late: int = 0
    written_s: dict[int, float] = field(default_factory=dict)


class FollowedFolder:
    """A folder that is being written; a `Dataset` whose frames come as the images do.

    Parameters
    ----------
    path
        Folder with ``left/`` and ``right/``.
    traverse
        Its ``traverse.yaml``; the one in the folder where not given.
    policy
        See `Policy`.
    quiet_s
        The frames end when no pair has come for so long; None waits for ever.

    Raises
    ------
    InputError
        The folder or its description is missing or wrong.
    """

    def __init__(
        self,
        path: Path,
        traverse: Path | None = None,
        policy: Policy = Policy.EVERY,
        quiet_s: float | None = None,
    ) -> None:
        if not path.is_dir():
            raise InputError("no such folder", source=path)
        self.traverse = traverse or path / "traverse.yaml"
        described = read_traverse(self.traverse)
        self.name = path.resolve().name
        self.path = path
        self.camera: StereoCamera = described.camera.build()
        self.rover_T_camera: FloatArray = described.camera_mount()
        self.start: StartPrior = described.start_prior()
        self.map_reference: MapReference | None = described.map_reference()
        self.ground_truth: GroundTruth | None = None
        self.orbital: OrbitalFiles | None = None
        self.notes: tuple[str, ...] = (f"followed live, policy {policy.value!r}",)
        self.arrivals = Arrivals()
        self._sun = described.sun_direction()
        self._policy = policy
        self._quiet_s = quiet_s
        self._stop = threading.Event()
        self._files: StereoFiles | None = None
        self._last = -1
        for side in ("left", "right"):
            (path / side).mkdir(exist_ok=True)

    def __len__(self) -> int:
        """Count the pairs that are there now."""
        return len(self._pairs())

    def stop(self) -> None:
        """End the frames after the one that is being processed; from any thread."""
        self._stop.set()

    def frames(self, after: int = -1) -> Iterator[StereoFrame | UnusableFrame]:
        """Yield frames as their images arrive, until told to stop, marked, or quiet."""
        self._last = after
        changes = watch(
            self.path,
            stop_event=self._stop,
            rust_timeout=_TICK_MS,
            yield_on_timeout=True,
            raise_interrupt=False,
            debounce=50,
            step=20,
        )
        last_taken = time.monotonic()
        while not self._stop.is_set():
            # Before the folder is looked at: what was there by then will not be missed.
            ending = (self.path / MARKER).exists()
            frame = self._next()
            if frame is not None:
                last_taken = time.monotonic()
                yield frame
                continue
            waiting = bool(self._pairs())
            quiet = self._quiet_s is not None and time.monotonic() - last_taken > self._quiet_s
            if not waiting and (ending or quiet):
                return
            if next(changes, None) is None:
                return

    def _pairs(self) -> dict[int, str]:
        """Names of images on either side that were not taken yet, by number, in order."""
        found = {}
        for side in ("left", "right"):
            for entry in (self.path / side).iterdir():
                if entry.suffix.lower() in SUFFIXES and not entry.name.startswith("."):
                    number = frame_number(self.path, entry.name)
                    if number > self._last:
                        found[number] = entry.name
                    elif number not in self.arrivals.written_s:
                        self.arrivals.written_s[number] = entry.stat().st_mtime
                        self.arrivals.late += 1
        return dict(sorted(found.items()))

    def _next(self) -> StereoFrame | UnusableFrame | None:
        """Give the next frame by the policy, or None when it is not there yet."""
        waiting = self._pairs()
        if self._policy is Policy.NEWEST:
            return self._newest(waiting)
        for number, name in waiting.items():
            return self._taken(number, self._read(number, name))
        return None

    def _newest(self, waiting: dict[int, str]) -> StereoFrame | UnusableFrame | None:
        for number, name in reversed(waiting.items()):
            frame = self._read(number, name)
            if isinstance(frame, StereoFrame):
                older = [other for other in waiting if other < number]
                self.arrivals.skipped += len(older)
                self.arrivals.written_s |= dict.fromkeys(older, 0.0)
                return self._taken(number, frame)
        for number, name in waiting.items():  # none can be read: the first may be given up
            return self._taken(number, self._read(number, name))
        return None

    def _taken(
        self, number: int, frame: StereoFrame | UnusableFrame | None
    ) -> StereoFrame | UnusableFrame | None:
        if frame is not None:
            self._last = number
        return frame

    def _read(self, number: int, name: str) -> StereoFrame | UnusableFrame | None:
        """Read a pair; None while it may still be written."""
        sides = [self.path / side / name for side in ("left", "right")]
        written = [path.stat().st_mtime for path in sides if path.exists()]
        newest = max(written, default=0.0)
        stamp_s = stamp_of(number)
        pair = StereoPair(number, stamp_s, sides[0], sides[1])
        frame: StereoFrame | UnusableFrame = UnusableFrame(
            number, stamp_s, f"{name} is on one side only"
        )
        if len(written) == len(sides):
            if self._files is None:
                level, note = find_white_level((pair,))
                self.notes = (*self.notes, note) if note else self.notes
                self._files = StereoFiles(self.camera, (), level, self._sun)
            frame = self._files.read(pair)
        if isinstance(frame, UnusableFrame) and time.time() - newest < STALE_S:
            return None
        self.arrivals.written_s[number] = newest
        return frame
