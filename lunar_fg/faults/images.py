"""Faults of the cameras."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from frontends.measurements import Image, StereoFrame
from lunar_fg.faults.base import Frame, FramesOnly


@dataclass(frozen=True, slots=True)
class FrozenCamera(FramesOnly):
    """Both cameras repeat their last images; time and wheels go on."""

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Repeat the images of the last good frame before the span."""
        last: StereoFrame | None = None
        for number, frame in enumerate(frames):
            if not isinstance(frame, StereoFrame):
                yield frame
            elif number in self.span and last is not None:
                yield replace(frame, left=last.left, right=last.right)
            else:
                last = frame
                yield frame


@dataclass(frozen=True, slots=True)
class EyeLost(FramesOnly):
    """The right camera delivers black images."""

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Blacken the right images."""
        for number, frame in enumerate(frames):
            if number in self.span and isinstance(frame, StereoFrame):
                yield replace(frame, right=np.zeros_like(frame.right))
            else:
                yield frame


@dataclass(frozen=True, slots=True)
class LensDust(FramesOnly):
    """Specks stay at fixed places of the left lens; bright parts are driven to white.

    Attributes
    ----------
    specks
        How many.
    radius_share
        Of the image's width.
    gain
        Of the grey levels.
    """

    specks: int = 25
    radius_share: float = 0.03
    gain: float = 1.6

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Darken the specks' places and saturate."""
        shadow: np.ndarray[tuple[int, ...], np.dtype[np.float32]] | None = None
        for number, frame in enumerate(frames):
            if number not in self.span or not isinstance(frame, StereoFrame):
                yield frame
                continue
            if shadow is None:
                shadow = self._shadow(frame.left.shape, rng)
            left = _clipped(frame.left * shadow * self.gain)
            yield replace(frame, left=left, right=_clipped(frame.right * np.float32(self.gain)))

    def _shadow(
        self, shape: tuple[int, ...], rng: np.random.Generator
    ) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        height, width = shape[:2]
        mask = np.ones((height, width), np.float32)
        radius = max(1, round(self.radius_share * width))
        for x, y in zip(
            rng.integers(0, width, self.specks), rng.integers(0, height, self.specks), strict=True
        ):
            cv2.circle(mask, (int(x), int(y)), radius, 0.15, -1)
        return np.asarray(cv2.GaussianBlur(mask, (0, 0), 0.4 * radius), dtype=np.float32)


@dataclass(frozen=True, slots=True)
class ExposureJumps(FramesOnly):
    """Every frame has a gain of its own, the same in both eyes, `least` to `most`."""

    least: float = 0.35
    most: float = 2.0

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Multiply the grey levels."""
        for number, frame in enumerate(frames):
            if number in self.span and isinstance(frame, StereoFrame):
                gain = np.float32(np.exp(rng.uniform(np.log(self.least), np.log(self.most))))
                yield replace(
                    frame, left=_clipped(frame.left * gain), right=_clipped(frame.right * gain)
                )
            else:
                yield frame


@dataclass(frozen=True, slots=True)
class MotionBlur(FramesOnly):
    """Both images are smeared along a line of `length_px`, of random direction."""

    length_px: float = 11.0

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Smear the images."""
        for number, frame in enumerate(frames):
            if number in self.span and isinstance(frame, StereoFrame):
                kernel = _line(self.length_px, rng.uniform(0.0, np.pi))
                left, right = (
                    np.asarray(cv2.filter2D(image, -1, kernel), dtype=np.uint8)
                    for image in (frame.left, frame.right)
                )
                yield replace(frame, left=left, right=right)
            else:
                yield frame


@dataclass(frozen=True, slots=True)
class Misalignment(FramesOnly):
    """The right camera sinks: its image moves up, more with every frame, to `most_px`."""

    most_px: float = 6.0

    def frames(self, frames: Iterator[Frame], rng: np.random.Generator) -> Iterator[Frame]:
        """Move the right images."""
        for number, frame in enumerate(frames):
            if number in self.span and isinstance(frame, StereoFrame):
                shift = np.array(
                    [[1, 0, 0], [0, 1, -self.most_px * self.span.progress(number)]], np.float32
                )
                size = (frame.right.shape[1], frame.right.shape[0])
                moved = cv2.warpAffine(frame.right, shift, size, borderMode=cv2.BORDER_REPLICATE)
                yield replace(frame, right=np.asarray(moved, dtype=np.uint8))
            else:
                yield frame


def _clipped(image: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> Image:
    return np.asarray(np.clip(image, 0, 255), dtype=np.uint8)


def _line(length_px: float, direction: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Kernel of unit sum along a line through its middle."""
    half = int(np.ceil(0.5 * length_px)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    reach = 0.5 * length_px * np.array([np.cos(direction), np.sin(direction)])
    ends = [tuple(round(16 * (half + sign * float(c))) for c in reach) for sign in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0, 1, cv2.LINE_AA, 4)
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)
