"""What is known of the motion before the images are looked at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from frontends.geometry import adjoint, inverse, pose
from frontends.measurements import (
    Attitude,
    Odometry,
    RelativePose,
    StereoFrame,
    Tilt,
    UnusableFrame,
    WheelOdometry,
)
from frontends.relative import MotionPrediction

FloatArray = NDArray[np.float64]
Frame = StereoFrame | UnusableFrame
#: A 1-sigma or a share; finite, not negative.
Sigma = Annotated[float, Ge(0), Le(1e6)]


@dataclass(frozen=True, slots=True)
class MotionConfig:
    """Uncertainties of the motion models.

    Attributes
    ----------
    slip
        1-sigma of the wheels' distance, as a share of it.
    wheel_sigma_m
        1-sigma of the wheels' distance that is there at any distance.
    heading_sigma
        1-sigma of the wheels' turn, as a share of it.
    tilt_rate_rad_per_m
        1-sigma of the change of roll and pitch over a metre, where no attitude is known.
    steady_sigma
        Constant velocity: 1-sigma of the change of the step, as a share of the step.
    steady_sigma_m, steady_sigma_rad
        Constant velocity: 1-sigma that is there at any speed.
    unknown_sigma_m, unknown_sigma_rad
        1-sigma of a motion of which nothing is known.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "allow_inf_nan": False}

    slip: Sigma = 0.1
    wheel_sigma_m: Sigma = 0.005
    heading_sigma: Sigma = 0.1
    tilt_rate_rad_per_m: Sigma = 0.1
    steady_sigma: Sigma = 0.5
    steady_sigma_m: Sigma = 0.05
    steady_sigma_rad: Sigma = 0.05
    unknown_sigma_m: Sigma = 1.0
    unknown_sigma_rad: Sigma = 0.3


class MotionModel:
    """Predicts the next motion: by the wheels where there are any, else as the last one.

    Parameters
    ----------
    rover_T_camera
        (4, 4) pose of the left camera in the rover.
    config
        Uncertainties.
    """

    def __init__(self, rover_T_camera: FloatArray, config: MotionConfig | None = None) -> None:
        self.config = config or MotionConfig()
        self._camera_T_rover = inverse(rover_T_camera)
        self._last: RelativePose | None = None
        self._moved = False
        self._losses = 0
        self._attitude: Attitude | None = None

    @property
    def known(self) -> bool:
        """Whether a motion was measured just before."""
        return self._last is not None and self._last.accepted

    def odometry(self, frame: Frame) -> Odometry | None:
        """Motion by wheels and attitude since the frame before, rover axes."""
        if frame.odometry is None:
            return None
        return _wheel_motion(frame.odometry, self._attitude, frame.attitude, self.config)

    def predict(self, odometry: Odometry | None) -> MotionPrediction:
        """Motion to expect between the cameras."""
        if odometry is not None:
            turn = adjoint(self._camera_T_rover)
            rover_T_camera = inverse(self._camera_T_rover)
            return MotionPrediction(
                self._camera_T_rover @ odometry.a_T_b @ rover_T_camera,
                turn @ odometry.covariance @ turn.T,
            )
        config = self.config
        if self._last is None or not self._moved:
            sigmas = np.array([config.unknown_sigma_rad] * 3 + [config.unknown_sigma_m] * 3)
            return MotionPrediction(np.eye(4), np.diag(sigmas**2))
        # the longer nothing was measured, the less the last motion says
        staleness = 1.0 + self._losses
        step = float(np.linalg.norm(self._last.a_T_b[:3, 3]))
        sigma_m = staleness * np.hypot(config.steady_sigma_m, config.steady_sigma * step)
        sigmas = np.array([staleness * config.steady_sigma_rad] * 3 + [sigma_m] * 3)
        return MotionPrediction(self._last.a_T_b, np.diag(sigmas**2))

    def update(self, frame: Frame, relative: RelativePose) -> None:
        """Remember the motion that was found."""
        self._last = relative
        self._moved = self._moved or relative.accepted
        self._losses = 0 if relative.accepted else self._losses + 1
        self._attitude = frame.attitude


def tilt_of(frame: Frame) -> Tilt | None:
    """Roll and pitch against gravity, where the frame has an attitude."""
    if frame.attitude is None:
        return None
    return Tilt(frame.attitude.roll_rad, frame.attitude.pitch_rad, frame.attitude.sigma_rp_rad)


def _wheel_motion(
    wheels: WheelOdometry, before: Attitude | None, now: Attitude | None, config: MotionConfig
) -> Odometry:
    distance = float(np.hypot(wheels.d_forward_m, wheels.d_lateral_m))
    sigma_m = float(np.hypot(config.wheel_sigma_m, config.slip * distance))
    sigma_yaw = float(np.hypot(1e-3, config.heading_sigma * wheels.d_yaw_rad))
    rotation = Rotation.from_euler("z", wheels.d_yaw_rad)
    sigma_tilt = float(np.hypot(1e-3, config.tilt_rate_rad_per_m * distance))
    if before is not None and now is not None:
        # roll and pitch change as the attitude says; the turn stays the wheels' own, since
        # the attitude's yaw drifts
        level_before = Rotation.from_euler("ZYX", [0.0, before.pitch_rad, before.roll_rad])
        level_now = Rotation.from_euler("ZYX", [0.0, now.pitch_rad, now.roll_rad])
        rotation = level_before.inv() * rotation * level_now
        sigma_tilt = float(np.hypot(before.sigma_rp_rad, now.sigma_rp_rad))
    half = Rotation.from_rotvec(0.5 * rotation.as_rotvec())
    translation = half.apply([wheels.d_forward_m, wheels.d_lateral_m, 0.0])
    sigmas = np.array([sigma_tilt, sigma_tilt, sigma_yaw, sigma_m, sigma_m, sigma_m])
    return Odometry(pose(rotation.as_matrix(), translation), np.diag(sigmas**2))
