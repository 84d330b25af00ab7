"""What goes into the graph for one keyframe, and the trajectory that comes out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frontends.errors import InputError
from frontends.geometry import adjoint, inverse
from frontends.measurements import (
    FloatArray,
    IntArray,
    Odometry,
    RelativePose,
    StereoObservations,
    Tilt,
)
from lunar_fg.graph.checks import check_covariance, check_finite, check_observations, check_pose
from lunar_fg.graph.planar import Planar, planar_of

_LEAST_MOTION_COVARIANCE = np.diag(np.square([1e-6] * 3 + [1e-5] * 3))
#: rad; what is known better makes the graph indeterminate.
_LEAST_TILT_SIGMA = 1e-9


@dataclass(frozen=True, slots=True)
class Keyframe:
    """The measurements of one keyframe.

    Attributes
    ----------
    index, stamp_s
        Of the frame in the dataset; both strictly increasing.
    observations
        Stereo landmarks, or None where the images were unusable.
    relative
        Motion since the previous keyframe in camera frames, from the same pixels: used as
        initial value and outlier filter, and as measurement only where landmarks fail.
    odometry
        Motion since the previous keyframe in rover frames, independent of the images.
    tilt
        Roll and pitch of the rover.
    """

    index: int
    stamp_s: float
    observations: StereoObservations | None = None
    relative: RelativePose | None = None
    odometry: Odometry | None = None
    tilt: Tilt | None = None

    def validate(self) -> None:
        """Check every array.

        Raises
        ------
        InputError
            Names the frame, the field and what is wrong.
        """
        source = f"keyframe {self.index}"
        check_finite(self.stamp_s, source, "stamp_s")
        if self.observations is not None:
            check_observations(self.observations, source)
        for name, motion in (("relative", self.relative), ("odometry", self.odometry)):
            if motion is not None:
                check_pose(motion.a_T_b, source, f"{name}.a_T_b")
                check_covariance(motion.covariance, 6, source, f"{name}.covariance")
        if self.tilt is not None:
            check_finite([self.tilt.roll_rad, self.tilt.pitch_rad], source, "tilt")
            if not _LEAST_TILT_SIGMA <= self.tilt.sigma_rad < np.pi:
                raise InputError(
                    f"is {self.tilt.sigma_rad}", source=source, field="tilt.sigma_rad",
                    remedy=f"give a 1-sigma in radians, {_LEAST_TILT_SIGMA:g} or more",
                )  # fmt: skip

    def motion(self, rover_T_camera: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Best guess of the motion since the previous keyframe, camera frames.

        Returns
        -------
        tuple of FloatArray or None
            ``a_T_b`` (4, 4) and covariance (6, 6): the accepted relative pose, else the
            odometry, else the refused relative pose's prediction, else None.
        """
        relative, odometry = self.relative, self.odometry
        if relative is not None and (relative.accepted or odometry is None):
            return relative.a_T_b, floored(relative.covariance)
        if odometry is None:
            return None
        camera_T_rover = inverse(rover_T_camera)
        rotate = adjoint(camera_T_rover)
        return (
            camera_T_rover @ odometry.a_T_b @ rover_T_camera,
            floored(rotate @ odometry.covariance @ rotate.T),
        )


def no_motion(source: str) -> InputError:
    """Make the error for a keyframe that nothing connects."""
    return InputError(
        "has no motion since the keyframe before",
        source=source,
        field="relative",
        remedy="give a relative pose (refused ones hold a prediction) or odometry",
    )


def floored(covariance: FloatArray) -> FloatArray:
    """Make a 6x6 motion covariance surely positive (1e-6 rad, 1e-5 m)."""
    return np.asarray(0.5 * (covariance + covariance.T) + _LEAST_MOTION_COVARIANCE)


@dataclass(frozen=True, slots=True)
class Entered:
    """How a keyframe was taken in: continued landmark tracks, cut ones, and what carries it."""

    linked: int
    cut: int
    used: tuple[str, ...]
    lost: bool


@dataclass(frozen=True, slots=True)
class PredictedPose:
    """Where a keyframe is, as far as the graph knows.

    Attributes
    ----------
    frame
        Index of the keyframe.
    map_T_rover
        (4, 4).
    covariance
        (6, 6), rotation then translation, right perturbation, rover axes.
    """

    frame: int
    map_T_rover: FloatArray
    covariance: FloatArray

    def planar(self) -> Planar:
        """x, y, yaw and their covariance (3, 3), map axes: what a search window needs."""
        return planar_of(self.map_T_rover, self.covariance)


@dataclass(frozen=True, slots=True)
class SmoothedTrajectory:
    """The latest estimate of every keyframe.

    Attributes
    ----------
    index
        (N,) frame numbers.
    stamp_s
        (N,) s.
    map_T_rover
        (N, 4, 4).
    covariance
        (N, 6, 6), rotation then translation, right perturbation, rover axes.
    """

    index: IntArray
    stamp_s: FloatArray
    map_T_rover: FloatArray
    covariance: FloatArray

    def __len__(self) -> int:
        """Count the keyframes."""
        return len(self.index)
