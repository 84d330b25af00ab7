"""What the traverse log holds beside the measurements: the run, its sittings, whole frames."""

from __future__ import annotations

from dataclasses import dataclass

from frontends.camera import StereoCamera
from frontends.measurements import Estimate, FloatArray, StartPrior
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.record import FrameRecord


@dataclass(frozen=True, slots=True)
class Sitting:
    """A dataset that a run went through, or the last of several.

    Attributes
    ----------
    dataset, images, traverse, calibration, topics
        As given to `lunar_fg.datasets.open_dataset`.
    faults
        Texts of the faults that were injected.
    index_offset, stamp_offset_s
        What its frame numbers and stamps were raised by to follow the sitting before.
    """

    dataset: str
    images: str | None = None
    traverse: str | None = None
    index_offset: int = 0
    stamp_offset_s: float = 0.0
    calibration: tuple[str, ...] = ()
    topics: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class LoggedFrame:
    """All that the log has of one frame; `record` is None where none was given."""

    keyframe: Keyframe
    estimate: Estimate
    record: FrameRecord | None


@dataclass(frozen=True, slots=True)
class RunHeader:
    """What holds for a whole run.

    Attributes
    ----------
    camera, rover_T_camera, start
        As given to the smoother.
    config_json
        The effective configuration, as JSON.
    """

    camera: StereoCamera
    rover_T_camera: FloatArray
    start: StartPrior
    config_json: str = "{}"
