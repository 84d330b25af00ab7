"""What a frame gave beside what goes into the graph: sensors as they read, counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from frontends.measurements import Attitude, FloatArray, WheelOdometry
from lunar_fg.trajectory import Trajectory


class Sensed(Protocol):
    """Anything with the readings of one time; a `StereoFrame` is one."""

    @property
    def stamp_s(self) -> float:
        """Time, s."""
        ...

    @property
    def odometry(self) -> WheelOdometry | None:
        """Wheel increment since the frame before."""
        ...

    @property
    def attitude(self) -> Attitude | None:
        """Attitude at the time."""
        ...


@dataclass(frozen=True, slots=True)
class Sensors:
    """The readings of one frame without its images; attributes as in `StereoFrame`."""

    stamp_s: float
    odometry: WheelOdometry | None = None
    attitude: Attitude | None = None

    @classmethod
    def of(cls, sensed: Sensed) -> Sensors:
        """Take the readings of a frame."""
        return cls(sensed.stamp_s, sensed.odometry, sensed.attitude)


@dataclass(frozen=True, slots=True)
class FrameReport:
    """Counts of one frame.

    Attributes
    ----------
    keypoints
        In the left image.
    stereo_matches, refined
        Pairs in the epipolar band; those whose disparity was refined.
    landmarks
        Stereo landmarks within the useful range.
    tracked, inliers
        Landmarks found again; those that agree with the motion.
    wrong_match_rate
        Share of the tracked landmarks that do not.
    """

    keypoints: int = 0
    stereo_matches: int = 0
    refined: int = 0
    landmarks: int = 0
    tracked: int = 0
    inliers: int = 0
    wrong_match_rate: float = float("nan")


@dataclass(frozen=True, slots=True)
class DeadReckoned:
    """Pose (4, 4) and covariance (6, 6) by wheels and attitude, conventions of `Estimate`."""

    map_T_rover: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """A frame's sensors and counts.

    Attributes
    ----------
    sensors
        As read.
    report
        Counts of the images.
    unusable
        Why the images could not be used; empty where they could.
    dead_reckoned
        Where the rover is by wheels and attitude, where there are wheels.
    """

    sensors: Sensors
    report: FrameReport = FrameReport()
    unusable: str = ""
    dead_reckoned: DeadReckoned | None = None


def dead_reckoning_of(records: Sequence[FrameRecord]) -> Trajectory | None:
    """Trajectory by wheels and attitude alone, from the first frame that has wheels on."""
    known = [(r.sensors.stamp_s, r.dead_reckoned) for r in records if r.dead_reckoned is not None]
    if not known:
        return None
    return Trajectory(
        np.array([stamp_s for stamp_s, _ in known]),
        np.stack([pose.map_T_rover for _, pose in known]),
        np.stack([pose.covariance for _, pose in known]),
    )
