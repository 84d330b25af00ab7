"""What a frame must be before anything of it is taken in."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace

from frontends.camera import StereoCamera
from frontends.errors import InputError
from frontends.measurements import StereoFrame, UnusableFrame, WheelOdometry
from lunar_fg.datasets.association import composed
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.motion_config import LONGEST_STEADY
from lunar_fg.plausibility import Episodes

Frame = StereoFrame | UnusableFrame


class InOrder:
    """Frames without those that come late: by index or by clock before one that came already.

    What the wheels counted up to a late frame goes to the next one that is kept.

    Parameters
    ----------
    frames
        As they arrive.
    """

    def __init__(self, frames: Iterable[Frame]) -> None:
        self._frames = frames
        self._late = Episodes("came after a later one, or with an earlier stamp: left out")
        self._out_of_turn: set[int] = set()
        self._missing: list[tuple[int, int]] = []
        self._pauses: list[str] = []

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames that can be used."""
        before: Frame | None = None
        # numbers go on by as much as they once did, and no pause is longer than the last by far
        step, longest_s = 0, math.inf
        missed: list[WheelOdometry | None] = []
        for frame in self._frames:
            if before is not None and (
                frame.index <= before.index or frame.stamp_s <= before.stamp_s
            ):
                self._late.note(frame.index)
                self._out_of_turn.add(frame.index)
                missed.append(frame.odometry)
                continue
            if before is not None:
                gap, pause_s = frame.index - before.index, frame.stamp_s - before.stamp_s
                if 0 < step < gap and not missed:
                    self._missing.append((before.index + step, frame.index - step))
                elif pause_s > LONGEST_STEADY * longest_s and not missed:
                    self._pauses.append(
                        f"frame {frame.index}: {pause_s:.0f} s after the frame before: a pause, or "
                        "the clock jumped"
                    )
                step = min(step, gap) if step else gap
                longest_s = pause_s if longest_s == math.inf else max(longest_s, pause_s)
            before = frame
            yield with_missed(frame, missed) if missed else frame
            missed = []

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was left out or missing so far, one sentence a run of frames."""
        missing = Episodes("never came, and the wheels say what they can of the way")
        for first, last in self._missing:
            if first not in self._out_of_turn:
                missing.note(first, last)
        return (*self._late.sentences(), *missing.sentences(), *self._pauses)


def with_missed(frame: Frame, missed: Sequence[WheelOdometry | None]) -> Frame:
    """Return the frame with the wheel motion of frames that were left out before it added."""
    motions = [*missed, frame.odometry]
    known = [motion for motion in motions if motion is not None]
    complete = len(known) == len(motions)
    return replace(frame, odometry=composed(known) if complete else None)


class FrameOrder:
    """Refuses a frame that does not follow, before anything of it is taken in.

    Parameters
    ----------
    camera
        The camera that all frames must have.
    """

    def __init__(self, camera: StereoCamera) -> None:
        self._camera = camera
        self._stamp_s = -math.inf
        self._index = -1

    def check(self, frame: StereoFrame | UnusableFrame) -> None:
        """Raise unless the frame can come next.

        Raises
        ------
        InputError
            A stamp that is no number, an index or stamp that does not increase, another
            camera, or wheel odometry or an attitude that is no number.
        """
        source = f"frame {frame.index}"
        _check_sensors(frame, source)
        if not math.isfinite(frame.stamp_s):
            raise InputError(
                f"is {frame.stamp_s}", source=source, field="stamp_s", remedy="give seconds"
            )
        if frame.index <= self._index:
            raise InputError(
                f"does not follow frame {self._index}",
                source=source,
                field="index",
                remedy="give frames in order from 0 or above, each once",
            )
        if frame.stamp_s <= self._stamp_s:
            raise InputError(
                f"{frame.stamp_s} s does not follow {self._stamp_s} s",
                source=source,
                field="stamp_s",
                remedy="time must run forward",
            )
        if isinstance(frame, StereoFrame) and frame.camera != self._camera:
            raise InputError(
                "is not the navigator's",
                source=source,
                field="camera",
                remedy="start a new navigator for another camera",
            )

    def accept(self, frame: StereoFrame | UnusableFrame | Keyframe) -> None:
        """Remember the frame as the newest one."""
        self._index, self._stamp_s = frame.index, frame.stamp_s


def _check_sensors(frame: StereoFrame | UnusableFrame, source: str) -> None:
    for name, values in (("odometry", frame.odometry), ("attitude", frame.attitude)):
        if values is None:
            continue
        for field, value in asdict(values).items():
            if not math.isfinite(value):
                raise InputError(
                    f"is {value}",
                    source=source,
                    field=f"{name}.{field}",
                    remedy="leave the measurement out where there is none",
                )
    if frame.attitude is not None and not 0.0 < frame.attitude.sigma_rp_rad < math.pi:
        raise InputError(
            f"is {frame.attitude.sigma_rp_rad}",
            source=source,
            field="attitude.sigma_rp_rad",
            remedy="give a 1-sigma in radians, above 0",
        )
