"""Where the rover would think it is without a camera: wheels and attitude in a Kalman filter.

`DeadReckoning` is the baseline that a run is compared with: an unscented Kalman filter whose
state is the pose and the errors that do not average out: the wheels' slip along, across and in
turns, a steering that veers, and an attitude that is off by a constant. Slip is a stationary
Gauss-Markov process over the distance driven, so its error adds up over its correlation length
and averages beyond it. Nothing of it comes from an image.

`SlipFilter` is the other way round: it learns the present slip from the motions that the
images showed, and serves the prediction of where landmarks will be, never a measurement.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from filterpy.kalman import KalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from frontends.geometry import pose
from frontends.measurements import Attitude, StartPrior, WheelOdometry
from lunar_fg.motion_config import MotionConfig
from lunar_fg.record import DeadReckoned, Sensed

FloatArray = NDArray[np.float64]

# The state: position in the map; yaw, pitch, roll; slip along, across, in turns (shares); veer
# (rad/m); error of the attitude's yaw, pitch, roll.
_POSITION, _ANGLES, _SLIP, _VEER, _OFFSET = (
    slice(0, 3), slice(3, 6), slice(6, 9), 9, slice(10, 13),
)  # fmt: skip
_SIZE = 13
_YAW, _PITCH, _ROLL = 3, 4, 5
#: An attitude's yaw that is known worse than this says nothing.
_USELESS_RAD = 1.5
_LEAST_VARIANCE = 1e-14


class DeadReckoning:
    """Wheel odometry and attitude, integrated with honest covariance.

    Parameters
    ----------
    start
        Where the rover starts.
    config
        How the wheels err.
    """

    def __init__(self, start: StartPrior, config: MotionConfig | None = None) -> None:
        self._config = config or MotionConfig()
        points = MerweScaledSigmaPoints(_SIZE, alpha=1.0, beta=2.0, kappa=0.0)
        self._filter: Any = UnscentedKalmanFilter(
            _SIZE, 3, 0.0, hx=_attitude_of, fx=self._move, points=points
        )
        self._set_start(start)
        self._before: Sensed | None = None
        self._attitude_seen = False
        self._wheels_seen = False
        self.failure = ""
        """Why it had to be given up; empty while it works."""

    def _set_start(self, start: StartPrior) -> None:
        rotation = start.map_T_rover[:3, :3]
        angles = Rotation.from_matrix(rotation).as_euler("ZYX")
        self._filter.x = np.concatenate([start.map_T_rover[:3, 3], angles, np.zeros(7)])
        to_state = np.zeros((6, 6))
        to_state[:3, 3:] = rotation
        to_state[3:, :3] = np.linalg.inv(_body_rates(angles))
        config = self._config
        variance = np.full(_SIZE, _LEAST_VARIANCE)
        variance[_SLIP] = config.slip**2, config.slip**2, config.heading_sigma**2
        variance[_VEER] = config.veer_rad_per_m**2
        covariance = np.diag(variance)
        covariance[:6, :6] += to_state @ start.covariance() @ to_state.T
        self._filter.P = covariance

    def step(self, sensed: Sensed) -> DeadReckoned | None:
        """Take in the readings of the next frame; the first one is at the start.

        Returns
        -------
        DeadReckoned or None
            None before the first wheel reading, and after readings that no filter can take.
        """
        if not self.failure:
            try:
                with np.errstate(all="ignore"):  # what is not finite is found below
                    self._step(sensed)
            except (np.linalg.LinAlgError, ValueError) as error:
                self.failure = f"at {sensed.stamp_s:g} s: {error}"
        self._before = sensed
        return self.estimate if self._wheels_seen and not self.failure else None

    def _step(self, sensed: Sensed) -> None:
        if self._before is not None:
            wheels, elapsed_s = sensed.odometry, sensed.stamp_s - self._before.stamp_s
            noise = self._noise(wheels, elapsed_s)
            if wheels is None:
                self._filter.P += noise  # nothing is known to have moved
            else:
                self._wheels_seen = True
                self._filter.Q = noise
                self._filter.predict(elapsed_s, wheels=wheels)
        if sensed.attitude is not None:
            self._correct(sensed.attitude)
        self._filter.P = 0.5 * (self._filter.P + self._filter.P.T)
        if not np.isfinite(self._filter.P).all():
            raise ValueError("the covariance is not finite")

    @property
    def estimate(self) -> DeadReckoned:
        """Pose and covariance now."""
        x, P = self._filter.x, self._filter.P
        rotation = Rotation.from_euler("ZYX", x[_ANGLES]).as_matrix()
        to_body = np.zeros((6, 6))
        to_body[:3, 3:] = _body_rates(x[_ANGLES])
        to_body[3:, :3] = rotation.T
        covariance = to_body @ P[:6, :6] @ to_body.T
        return DeadReckoned(pose(rotation, x[_POSITION]), 0.5 * (covariance + covariance.T))

    def _move(self, x: FloatArray, elapsed_s: float, wheels: WheelOdometry) -> FloatArray:
        """State after a wheel motion: along the chord of its arc."""
        distance = _distance(wheels)
        slip = x[_SLIP]
        turn = (1.0 - slip[2]) * wheels.d_yaw_rad + x[_VEER] * distance
        forward = (1.0 - slip[0]) * wheels.d_forward_m
        sideways = wheels.d_lateral_m + slip[1] * abs(wheels.d_forward_m)
        level = _level(distance, self._config)
        pitch, roll = 0.5 * (1.0 + level) * x[[_PITCH, _ROLL]]
        moved = x.copy()
        moved[_POSITION] += _direction(x[_YAW] + 0.5 * turn, pitch, roll) @ [forward, sideways, 0.0]
        moved[_YAW] += turn
        moved[[_PITCH, _ROLL]] *= level
        memory = np.exp(-distance / self._config.slip_length_m)
        moved[_SLIP] *= memory
        moved[_VEER] *= memory
        moved[_OFFSET] *= np.exp(-elapsed_s / self._config.attitude_drift_s)
        return moved

    def _noise(self, wheels: WheelOdometry | None, elapsed_s: float) -> FloatArray:
        """Process noise of one step, with what a change of tilt does to the position."""
        config, x = self._config, self._filter.x
        gain = np.zeros((_SIZE, 6))  # of position, yaw, pitch, roll
        gain[:6, :6] = np.eye(6)
        sigma = np.zeros(6)
        if wheels is None:
            sigma[:3], sigma[3:6] = config.unknown_sigma_m, config.unknown_sigma_rad
            distance = 0.0
        else:
            distance = _distance(wheels)
            sigma[:3] = config.wheel_sigma_m
            sigma[3] = 1e-3
            level = _level(distance, config)
            sigma[4:6] = np.hypot(1e-3, config.tilt_rad * np.sqrt(1.0 - level**2))
            # the step is driven at the mean of the tilts at its ends
            step = [wheels.d_forward_m, wheels.d_lateral_m, 0.0]
            here = _direction(*x[_ANGLES]) @ step
            for column, axis in ((4, _PITCH), (5, _ROLL)):
                tilted = x[_ANGLES].copy()
                tilted[axis - 3] += 1e-4
                gain[:3, column] = 0.5 * (_direction(*tilted) @ step - here) / 1e-4
        noise = gain @ np.diag(sigma**2) @ gain.T
        fresh = -np.expm1(-2.0 * distance / config.slip_length_m)
        noise[_SLIP, _SLIP] += fresh * np.diag(
            [config.slip**2, config.slip**2, config.heading_sigma**2]
        )
        noise[_VEER, _VEER] += fresh * config.veer_rad_per_m**2
        if self._before is not None and self._before.attitude is not None:
            attitude = self._before.attitude
            drift = -np.expm1(-2.0 * elapsed_s / config.attitude_drift_s)
            noise[_OFFSET, _OFFSET] += drift * np.diag(_variances(attitude))
        return noise + _LEAST_VARIANCE * np.eye(_SIZE)

    def _correct(self, attitude: Attitude) -> None:
        """Attitude, whose error is taken to be constant and noise, each with its sigma."""
        ukf = self._filter
        if not self._attitude_seen:
            ukf.P[_OFFSET, _OFFSET] += np.diag(_variances(attitude))
            self._attitude_seen = True
        read = np.array([attitude.yaw_rad, attitude.pitch_rad, attitude.roll_rad])
        expected = _attitude_of(ukf.x)
        read = expected + (read - expected + np.pi) % (2.0 * np.pi) - np.pi
        variances = _variances(attitude)
        if attitude.sigma_yaw_rad > _USELESS_RAD:
            read[0], variances[0] = expected[0], 1e6
        ukf.sigmas_f = ukf.points_fn.sigma_points(ukf.x, ukf.P)
        ukf.update(read, R=np.diag(variances))


@dataclass(frozen=True, slots=True)
class Slip:
    """Shares of the wheels' distance lost along and gained to the left: (2,) and (2, 2)."""

    mean: FloatArray
    covariance: FloatArray


class SlipFilter:
    """The wheels' slip along and across, as shares of the distance, learned from vision.

    Parameters
    ----------
    config
        How the wheels err.
    """

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._filter: Any = KalmanFilter(dim_x=2, dim_z=2)
        self._filter.x = np.zeros((2, 1))
        self._filter.P = config.slip**2 * np.eye(2)
        self._filter.H = np.eye(2)

    def after(self, wheels: WheelOdometry) -> Slip:
        """Slip to expect over a wheel motion."""
        self._set_motion(wheels)
        mean, covariance = self._filter.get_prediction()
        return Slip(mean[:, 0].copy(), covariance.copy())

    def drive(self, wheels: WheelOdometry) -> None:
        """Let the slip change over a wheel motion."""
        self._set_motion(wheels)
        self._filter.predict()

    def _set_motion(self, wheels: WheelOdometry) -> None:
        memory = np.exp(-_distance(wheels) / self._config.slip_length_m)
        self._filter.F = memory * np.eye(2)
        self._filter.Q = (1.0 - memory**2) * self._config.slip**2 * np.eye(2)

    def observe(self, wheels: WheelOdometry, seen_m: FloatArray, covariance: FloatArray) -> None:
        """Compare a wheel motion with the translation that was seen.

        Parameters
        ----------
        wheels
            The motion.
        seen_m, covariance
            (2,) forward and left, along the chord of the motion, and (2, 2), m.
        """
        forward = wheels.d_forward_m
        if abs(forward) < 2.0 * self._config.wheel_sigma_m:
            return  # a step too short to tell
        found = np.array(
            [1.0 - seen_m[0] / forward, (seen_m[1] - wheels.d_lateral_m) / abs(forward)]
        )
        noise = (covariance + self._config.wheel_sigma_m**2 * np.eye(2)) / forward**2
        self._filter.update(found[:, None], R=noise)


def _distance(wheels: WheelOdometry) -> float:
    return float(np.hypot(wheels.d_forward_m, wheels.d_lateral_m))


def _level(distance_m: float, config: MotionConfig) -> float:
    """Share of a tilt that is left over a distance: the ground is level on the whole."""
    if config.tilt_rad <= 0.0:
        return 0.0
    share = config.tilt_rate_rad_per_m / config.tilt_rad
    return float(np.exp(-0.5 * share**2 * distance_m))


def _attitude_of(x: FloatArray) -> FloatArray:
    """Yaw, pitch, roll that the attitude reads in a state."""
    return np.asarray(x[_ANGLES] + x[_OFFSET])


def _variances(attitude: Attitude) -> FloatArray:
    """Of yaw, pitch, roll, rad^2."""
    yaw, tilt = min(attitude.sigma_yaw_rad, np.pi), attitude.sigma_rp_rad
    return np.array([yaw, tilt, tilt]) ** 2


def _direction(yaw: float, pitch: float, roll: float) -> FloatArray:
    """Rz(yaw) Ry(pitch) Rx(roll)."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll), np.sin(roll)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _body_rates(angles: FloatArray) -> FloatArray:
    """Rotation vector in rover axes of small changes of yaw, pitch, roll, (3, 3)."""
    _, pitch, roll = angles
    return np.array(
        [
            [-np.sin(pitch), 0.0, 1.0],
            [np.cos(pitch) * np.sin(roll), np.cos(roll), 0.0],
            [np.cos(pitch) * np.cos(roll), -np.sin(roll), 0.0],
        ]
    )
