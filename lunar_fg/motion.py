"""What is known of the motion before the images are looked at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from frontends.geometry import adjoint, inverse, pose, se3_exp, se3_log
from frontends.measurements import Attitude, Odometry, RelativePose, Tilt, WheelOdometry
from frontends.relative import MotionPrediction
from lunar_fg.dead_reckoning import SlipFilter
from lunar_fg.motion_config import LONGEST_STEADY, MotionConfig
from lunar_fg.record import Sensed

FloatArray = NDArray[np.float64]


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
        self._rover_T_camera = np.asarray(rover_T_camera)
        self._step: FloatArray | None = None  # the last motion that was measured, as a twist
        self._step_s = 0.0  # and the time it took
        self._known = False
        self._losses = 0
        self._before: Sensed | None = None
        self._slip = SlipFilter(self.config)

    @property
    def known(self) -> bool:
        """Whether a motion was measured just before."""
        return self._known

    def odometry(self, frame: Sensed) -> Odometry | None:
        """Motion by the wheels since the frame before, rover axes.

        The turn is that of wheels and attitude together. The change of roll and pitch is an
        initial value without information: the graph has the same readings as tilts. Slip goes
        on from step to step, and the graph takes steps for independent: the sigmas are such
        that they add up right.
        """
        if frame.odometry is None:
            return None
        before = None if self._before is None else self._before.attitude
        sigmas = _wheel_sigmas(frame.odometry, self.config, adding_up=True)
        turn, sigmas[2] = _turn(frame.odometry, float(sigmas[2]), before, frame.attitude)
        rotation = _rotation(turn, before, frame.attitude)
        return Odometry(_chord(frame.odometry, rotation), np.diag(sigmas**2))

    def predict(self, frame: Sensed) -> MotionPrediction:
        """Motion to expect between the cameras, whatever it is known from."""
        if frame.odometry is not None:
            return self._by_wheels(frame.odometry, frame.attitude)
        config, elapsed = self.config, self._elapsed(frame)
        if self._step is None or elapsed > LONGEST_STEADY * self._step_s:
            sigmas = np.array([config.unknown_sigma_rad] * 3 + [config.unknown_sigma_m] * 3)
            return MotionPrediction(np.eye(4), np.diag(sigmas**2))
        share = elapsed / self._step_s
        motion = se3_exp(share * self._step)
        # the longer nothing was measured, the less the last motion says
        staleness = (1.0 + self._losses) * max(share, 1.0)
        step = float(np.linalg.norm(motion[:3, 3]))
        sigma_m = staleness * np.hypot(config.steady_sigma_m, config.steady_sigma * step)
        sigmas = np.array([staleness * config.steady_sigma_rad] * 3 + [sigma_m] * 3)
        return MotionPrediction(motion, np.diag(sigmas**2))

    def update(self, frame: Sensed, relative: RelativePose | None) -> None:
        """Remember the motion that was found; None at the first frame."""
        self._known = relative is not None and relative.accepted
        if relative is not None and relative.accepted:
            self._step, self._step_s = se3_log(relative.a_T_b), self._elapsed(frame)
            self._losses = 0
        else:
            self._losses += 1
        if frame.odometry is not None:
            self._slip.drive(frame.odometry)
            if relative is not None and relative.accepted:
                seen = relative.in_frames(self._rover_T_camera)
                half = _half(Rotation.from_matrix(seen.a_T_b[:3, :3])).as_matrix()
                back = half.T @ seen.a_T_b[:3, :3]
                along = half.T @ seen.a_T_b[:3, 3]
                spread = back @ seen.covariance[3:, 3:] @ back.T
                self._slip.observe(frame.odometry, along[:2], spread[:2, :2])
        self._before = frame

    def _elapsed(self, frame: Sensed) -> float:
        return 0.0 if self._before is None else frame.stamp_s - self._before.stamp_s

    def _by_wheels(self, wheels: WheelOdometry, attitude: Attitude | None) -> MotionPrediction:
        """Wheels less the slip that the images showed lately, tilted as the attitude changed."""
        before = None if self._before is None else self._before.attitude
        sigmas = _wheel_sigmas(wheels, self.config)
        turn_rad, sigmas[2] = _turn(wheels, float(sigmas[2]), before, attitude)
        if before is not None and attitude is not None:
            sigmas[:2] = np.hypot(before.sigma_rp_rad, attitude.sigma_rp_rad)
        slip, distance = self._slip.after(wheels), abs(wheels.d_forward_m)
        covariance = np.diag(sigmas**2)
        base = np.hypot(self.config.wheel_sigma_m, _path_sigma_m(wheels))
        covariance[3:5, 3:5] = base**2 * np.eye(2)
        covariance[3:5, 3:5] += distance**2 * slip.covariance
        moved = replace(
            wheels,
            d_forward_m=wheels.d_forward_m * (1.0 - float(slip.mean[0])),
            d_lateral_m=wheels.d_lateral_m + distance * float(slip.mean[1]),
        )
        motion = _chord(moved, _rotation(turn_rad, before, attitude))
        turn = adjoint(self._camera_T_rover)
        return MotionPrediction(
            self._camera_T_rover @ motion @ self._rover_T_camera,
            turn @ covariance @ turn.T,
        )


def tilt_of(frame: Sensed) -> Tilt | None:
    """Roll and pitch against gravity, where the frame has an attitude."""
    if frame.attitude is None:
        return None
    return Tilt(frame.attitude.roll_rad, frame.attitude.pitch_rad, frame.attitude.sigma_rp_rad)


def _turn(
    wheels: WheelOdometry, sigma_rad: float, before: Attitude | None, now: Attitude | None
) -> tuple[float, float]:
    """Turn about the vertical by wheels and attitude, each for what it is worth, and its sigma.

    An attitude's yaw drifts, and two readings err alike: their difference is better than the
    sum of their sigmas says. It is the wheels' large turns that are worse.
    """
    if before is None or now is None:
        return wheels.d_yaw_rad, sigma_rad
    change = now.yaw_rad - before.yaw_rad - wheels.d_yaw_rad
    change = float(np.angle(np.exp(1j * change)))
    of_change = float(np.hypot(before.sigma_yaw_rad, now.sigma_yaw_rad))
    share = sigma_rad**2 / (sigma_rad**2 + of_change**2)
    return wheels.d_yaw_rad + share * change, float(np.sqrt(share)) * of_change


def _rotation(turn_rad: float, before: Attitude | None, now: Attitude | None) -> Rotation:
    """A turn about the vertical; roll and pitch as the attitude changes where it is known."""
    turn = Rotation.from_euler("z", turn_rad)
    if before is None or now is None:
        return turn
    level_before = Rotation.from_euler("ZYX", [0.0, before.pitch_rad, before.roll_rad])
    level_now = Rotation.from_euler("ZYX", [0.0, now.pitch_rad, now.roll_rad])
    return level_before.inv() * turn * level_now


def _half(rotation: Rotation) -> Rotation:
    return Rotation.from_rotvec(0.5 * rotation.as_rotvec())


def _chord(wheels: WheelOdometry, rotation: Rotation) -> FloatArray:
    """Motion along an arc that turns by `rotation`."""
    translation = _half(rotation).apply([wheels.d_forward_m, wheels.d_lateral_m, 0.0])
    return pose(rotation.as_matrix(), translation)


def _path_sigma_m(wheels: WheelOdometry) -> float:
    """1-sigma of the place because the turn may have come anywhere on the way, not evenly."""
    distance = float(np.hypot(wheels.d_forward_m, wheels.d_lateral_m))
    return distance * min(abs(wheels.d_yaw_rad), 2.0 * np.pi) / float(np.sqrt(12.0))


def _wheel_sigmas(
    wheels: WheelOdometry, config: MotionConfig, *, adding_up: bool = False
) -> FloatArray:
    """1-sigmas of a wheel motion, rotation then translation, without an attitude.

    With `adding_up`, those of independent steps whose sum is as uncertain as that of the true
    ones, whose slip is a first-order Gauss-Markov process over the distance: larger by
    ``(1 + r) / (1 - r)`` in variance, with the correlation ``r`` of one step with the next.
    """
    distance = float(np.hypot(wheels.d_forward_m, wheels.d_lateral_m))
    grown = 1.0
    if adding_up and distance > 0.0:
        grown = float(np.sqrt(1.0 / np.tanh(0.5 * distance / config.slip_length_m)))
    sigma_m = float(np.hypot(config.wheel_sigma_m, grown * config.slip * distance))
    sigma_m = float(np.hypot(sigma_m, _path_sigma_m(wheels)))
    turn = grown * np.hypot(
        config.heading_sigma * wheels.d_yaw_rad, config.veer_rad_per_m * distance
    )
    sigma_tilt = float(np.hypot(1e-3, config.tilt_rate_rad_per_m * distance))
    sigma_yaw = float(np.hypot(1e-3, turn))
    return np.array([sigma_tilt, sigma_tilt, sigma_yaw, sigma_m, sigma_m, sigma_m])
