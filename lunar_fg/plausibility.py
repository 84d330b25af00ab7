"""Do the sensors agree? What contradicts the images is not believed, and said.

Checks of what a covariance cannot tell: wheels that spin on the spot, an inclinometer that
jumps, a camera that repeats its last image, a rover that was carried.
"""

from __future__ import annotations

import hashlib
import math
from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, nbinom

from frontends.geometry import inverse, se3_log
from frontends.measurements import Image, Odometry, RelativePose, StereoFrame, Tilt
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.motion_config import MotionConfig

FloatArray = NDArray[np.float64]

#: A sound sensor is refused once in so many keyframes.
_FALSE_ALARM = 1e-5
_LARGEST_TILT_SIGMA_RAD = 1.0
_MOTION_GATE, _TILT_GATE, _SLIP_GATE = (float(chi2.isf(_FALSE_ALARM, df)) for df in (6, 2, 1))
#: What lasts for so many frames is usual.
_LASTING = 50
_MOST_TOLD = 5
#: Noise is in every row: each eighth tells as well whether an image is a new one.
_EVERY_ROW = 8


@dataclass(slots=True)
class Episodes:
    """Frames at which something happened, told as one sentence for each run of frames.

    Attributes
    ----------
    text
        What happened, e.g. ``"the wheels disagree with the images: taken as slip"``.
    """

    text: str
    _spans: list[tuple[int, int]] = field(default_factory=list)

    def note(self, frame: int, last: int | None = None) -> None:
        """Remember that it happened at a frame, too, or from there to a later one."""
        last = frame if last is None else last
        if self._spans and frame - self._spans[-1][1] <= 2:
            self._spans[-1] = (self._spans[-1][0], last)
        else:
            self._spans.append((frame, last))

    def sentences(self) -> tuple[str, ...]:
        """One sentence a run of frames."""
        return tuple(f"{frames_named(first, last)}: {self.text}" for first, last in self._spans)


def frames_named(first: int, last: int) -> str:
    """Say which frames: "frame 3", or "frames 3 to 5"."""
    return f"frame {first}" if first == last else f"frames {first} to {last}"


class DeadCamera:
    """Recognises a camera that delivers nothing, or its last image again.

    Sensor noise makes two images of one scene differ; equal bytes are one image.
    """

    def __init__(self) -> None:
        self.seen: tuple[bytes, bytes] | None = None
        """Digests of the last left and right image."""
        self._examined: tuple[bytes, bytes] | None = None

    def found(self, frame: StereoFrame) -> str:
        """Say what is wrong with the images; empty when nothing is."""
        self._examined = None
        for name, image in (("left", frame.left), ("right", frame.right)):
            if image.min() == image.max():
                return f"the {name} image is blank"
        self._examined = _digest(frame.left), _digest(frame.right)
        for name, now, before in zip(
            ("left", "right"), self._examined, self.seen or (), strict=False
        ):
            if now == before:
                return f"the {name} image is that of the frame before"
        return ""

    def remember(self) -> None:
        """Compare the next frame with the one examined last, unless it was blank."""
        self.seen = self._examined or self.seen


def _digest(image: Image) -> bytes:
    rows = np.ascontiguousarray(image[::_EVERY_ROW])
    return hashlib.blake2b(rows.tobytes(), digest_size=16).digest()


class Plausibility:
    """Compares wheels and inclinometer with the motion that the images show.

    Parameters
    ----------
    rover_T_camera
        (4, 4) pose of the left camera in the rover.
    config
        How uncertain a rover is that was carried.
    """

    def __init__(self, rover_T_camera: FloatArray, config: MotionConfig | None = None) -> None:
        self._rover_T_camera = rover_T_camera
        self._config = config or MotionConfig()
        self._carried = Episodes(
            "the images have nothing in common with those before, though by the wheels they show "
            "the same ground: the rover was carried, or slid; where it is now, a fix must tell"
        )
        self._slip = Episodes("wheels and images disagree on the motion: taken as wheel slip")
        self._unseen = Episodes(
            "the images do not show the motion since the frame before: it is by wheels alone, or "
            "the last one again"
        )
        self._jump = Episodes("the attitude jumped and the images did not: roll and pitch left out")
        # Where down was when the inclinometer was last believed, rover axes, its variance about
        # x and y, and what vision, which carries it on, has added since.
        self._down: FloatArray | None = None
        self._variance = self._drift = 0.0

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was not believed, one sentence a run of frames."""
        found = (self._carried, self._unseen, self._slip, self._jump)
        return tuple(line for episodes in found for line in episodes.sentences())

    def odometry(
        self,
        frame: int,
        odometry: Odometry | None,
        relative: RelativePose,
        *,
        carried: bool = False,
    ) -> Odometry | None:
        """Return the odometry, as uncertain as its disagreement with the images shows.

        Wheels slip, images that many landmarks agree on do not: where the two differ by more
        than their covariances allow, the difference itself becomes the wheels' uncertainty.
        Of a rover that was `carried` (see `other_ground`) they are not believed at all.
        """
        if not relative.accepted:
            if odometry is None or not carried:
                self._unseen.note(frame)
                return odometry
            self._carried.note(frame)
            sigmas = [self._config.carried_sigma_rad] * 3 + [self._config.carried_sigma_m] * 3
            return replace(odometry, covariance=odometry.covariance + np.diag(np.square(sigmas)))
        if odometry is None:
            return None
        seen = relative.in_frames(self._rover_T_camera)
        difference = se3_log(inverse(odometry.a_T_b) @ seen.a_T_b)
        both = odometry.covariance + seen.covariance
        whole = difference @ np.linalg.solve(both, difference)
        if whole < _MOTION_GATE and not self._slipped(odometry, seen, difference):
            return odometry
        self._slip.note(frame)
        return replace(odometry, covariance=odometry.covariance + np.outer(difference, difference))

    def _slipped(self, odometry: Odometry, seen: RelativePose, difference: FloatArray) -> bool:
        """Whether the wheels counted another distance, by what they err in one step.

        The graph's covariance is that of independent steps which add up right: larger than of
        one step alone, whose slip is that of the step before.
        """
        distance = max(float(np.linalg.norm(m.a_T_b[:3, 3])) for m in (odometry, seen))
        if distance == 0.0:
            return False
        slip2 = (self._config.slip * distance) ** 2
        added = slip2 * (1.0 / math.tanh(0.5 * distance / self._config.slip_length_m) - 1.0)
        least = self._config.wheel_sigma_m**2 + slip2
        variance = max(float(odometry.covariance[3, 3]) - added, least)
        return float(difference[3] ** 2) > _SLIP_GATE * (variance + float(seen.covariance[3, 3]))

    def tilt(self, frame: int, tilt: Tilt | None, relative: RelativePose) -> Tilt | None:
        """Return the tilt, or None from where it jumped until it comes back.

        Where vision was lost in between, a new tilt cannot be compared and is believed. The
        error of an inclinometer is mostly a bias, which no number of readings averages out: after
        the first, a reading s tells what vision has lost since the one before, q, and no more,

            1 / s^2 = 1 / sigma^2 - 1 / (sigma^2 + q),

        so that down is known to sigma at all times, and never better by their number.
        """
        self._carry(relative)
        if tilt is None:
            return None
        measured = _down(tilt)
        if self._down is not None:
            angle2 = float(np.sum(np.cross(self._down, measured) ** 2))
            if angle2 / (self._variance + self._drift + tilt.sigma_rad**2) > _TILT_GATE:
                self._jump.note(frame)
                return None
        variance = tilt.sigma_rad**2
        if self._down is not None:
            variance *= (variance + self._drift) / max(self._drift, 1e-12)
        self._down, self._variance, self._drift = measured, tilt.sigma_rad**2, 0.0
        return replace(tilt, sigma_rad=min(math.sqrt(variance), _LARGEST_TILT_SIGMA_RAD))

    def _carry(self, relative: RelativePose) -> None:
        if self._down is None:
            return
        if not relative.accepted:
            self._down = None
            return
        seen = relative.in_frames(self._rover_T_camera)
        self._down = seen.a_T_b[:3, :3].T @ self._down
        self._drift += float(np.linalg.eigvalsh(seen.covariance[:3, :3])[-1])


@dataclass(frozen=True, slots=True)
class Refound:
    """Landmarks that two views have in common.

    Attributes
    ----------
    possible
        Those of the first that the wheels' motion leaves in the picture, or all of the second
        if these are fewer.
    found
        Those that agree on one motion.
    """

    possible: int
    found: int


def other_ground(before: Refound | None, now: Refound) -> bool:
    """Whether two views show different ground, though by the wheels it is the same.

    The motion before shows how often a landmark is found again. With Jeffreys' prior on that
    rate, and counts that are Poisson's, the count now is negative binomial; that so few are
    found again on the same ground must be as rare as a false alarm may be. Where the motion
    before was not seen, nothing is known of the rate, and no alarm is raised.
    """
    if before is None or before.possible == 0 or now.possible == 0:
        return False
    share = before.possible / (before.possible + now.possible)
    return float(nbinom.cdf(now.found, before.found + 0.5, share)) < _FALSE_ALARM


class Richness:
    """Notices images in which far fewer landmarks are found again than in those before.

    Fewer than in each of the last two that were usual: one alone may have been an exception.
    """

    def __init__(self) -> None:
        self._usual: deque[Refound] = deque(maxlen=2)
        self._lasting = 0
        self._poor = Episodes(
            "far fewer landmarks were found again than just before: dust, blur, exposure, shadow, "
            "or poor ground"
        )

    def see(self, frame: int, now: Refound | None) -> None:
        """Take in what a motion was seen by; None where it was not seen."""
        if now is None:
            return
        poor = bool(self._usual) and all(other_ground(usual, now) for usual in self._usual)
        if poor and self._lasting < _LASTING:
            self._poor.note(frame)
            self._lasting += 1
        else:
            self._usual.append(now)
            self._lasting = 0

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence a run of poor frames, of the first few."""
        told = self._poor.sentences()
        more = len(told) - _MOST_TOLD
        if more <= 0:
            return told
        return (*told[:_MOST_TOLD], f"and {more} more times: {self._poor.text}")


def was_carried(keyframe: Keyframe, config: MotionConfig) -> bool:
    """Whether nothing is known of the motion that led to a keyframe; see `Plausibility`."""
    relative, odometry = keyframe.relative, keyframe.odometry
    if relative is None or relative.accepted or odometry is None:
        return False
    return float(odometry.covariance[3, 3]) >= config.carried_sigma_m**2 > 0.0


def _down(tilt: Tilt) -> FloatArray:
    """Unit vector to the map's -z in rover axes."""
    level_R_rover = Rotation.from_euler("ZYX", [0.0, tilt.pitch_rad, tilt.roll_rad]).as_matrix()
    return np.asarray(-level_R_rover[2])
