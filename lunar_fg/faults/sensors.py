"""Faults of wheels, inclinometer, clock and calibration."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from frontends.measurements import StereoFrame, UnusableFrame
from lunar_fg.datasets.base import GroundTruth
from lunar_fg.faults.base import Frame, FramesOnly, Span, Surroundings


@dataclass(frozen=True, slots=True)
class WheelSlip(FramesOnly):
    """The wheels count `distance_m` that the rover does not move, spread over the span."""

    distance_m: float = 5.0

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Add to the wheels' count."""
        for number, frame in enumerate(frames):
            if number in self.span and frame.odometry is not None:
                wheels = frame.odometry
                extra = self.distance_m / len(self.span)
                yield replace(
                    frame, odometry=replace(wheels, d_forward_m=wheels.d_forward_m + extra)
                )
            else:
                yield frame


@dataclass(frozen=True, slots=True)
class AttitudeBias(FramesOnly):
    """Roll and pitch are off by this much; the stated sigmas stay as they are."""

    bias_rad: float = 0.05

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Shift roll and pitch."""
        for number, frame in enumerate(frames):
            attitude = frame.attitude
            if number in self.span and attitude is not None:
                roll, pitch = (
                    angle + self.bias_rad for angle in (attitude.roll_rad, attitude.pitch_rad)
                )
                yield replace(frame, attitude=replace(attitude, roll_rad=roll, pitch_rad=pitch))
            else:
                yield frame


@dataclass(frozen=True, slots=True)
class WheelsOnly(FramesOnly):
    """Cameras and inclinometer are dead; the wheels go on."""

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Take images and attitude away."""
        for number, frame in enumerate(frames):
            if number in self.span:
                yield UnusableFrame(
                    frame.index, frame.stamp_s, "the cameras are off", frame.odometry
                )
            else:
                yield frame


@dataclass(frozen=True, slots=True)
class ClockJump(FramesOnly):
    """The clock jumps by `jump_s` at the span's first frame and stays there."""

    jump_s: float = 3600.0

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Shift the stamps from the jump on."""
        for number, frame in enumerate(frames):
            jump = self.jump_s if number >= self.span.first else 0.0
            yield replace(frame, stamp_s=frame.stamp_s + jump)

    def surroundings(
        self, before: Surroundings, scratch: Path, rng: np.random.Generator
    ) -> Surroundings:
        """Date the truth by the clock that jumps, so that it can still be compared."""
        truth = before.ground_truth
        if truth is None:
            return before
        stamps = truth.stamp_s + np.where(np.arange(len(truth)) >= self.span.first, self.jump_s, 0)
        dated = GroundTruth(stamps, truth.position_m, truth.map_T_rover, truth.has_height)
        return replace(before, ground_truth=dated)


@dataclass(frozen=True, slots=True)
class ClockBack(FramesOnly):
    """Within the span the stamps lie `back_s` in the past."""

    back_s: float = 1000.0

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Set the stamps back."""
        for number, frame in enumerate(frames):
            late = self.back_s if number in self.span else 0.0
            yield replace(frame, stamp_s=frame.stamp_s - late)


@dataclass(frozen=True, slots=True)
class WrongBaseline:
    """The calibration states a baseline that is off by `share` of it."""

    span: Span
    share: float = 0.02

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Give every frame the wrong camera."""
        for frame in frames:
            if isinstance(frame, StereoFrame):
                baseline_m = frame.camera.baseline_m * (1.0 + self.share)
                yield replace(frame, camera=replace(frame.camera, baseline_m=baseline_m))
            else:
                yield frame

    def surroundings(
        self, before: Surroundings, scratch: Path, rng: np.random.Generator
    ) -> Surroundings:
        """Give the dataset the wrong camera."""
        camera = before.camera
        wrong = replace(camera, baseline_m=camera.baseline_m * (1.0 + self.share))
        return replace(before, camera=wrong)
