"""Wheel odometry and attitude of a drive over hills, with exact truth: slip, veer, offsets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frontends.geometry import inverse, pose, so3_exp, so3_log, yaw_pitch_roll
from frontends.measurements import Attitude, FloatArray, StartPrior, WheelOdometry
from lunar_fg.record import Sensors


@dataclass(frozen=True, slots=True)
class DriveSpec:
    """What to simulate; sigmas as in `lunar_fg.motion_config.MotionConfig`.

    Attributes
    ----------
    steps, step_m, step_s, turn_rad
        Length of the drive, and the largest heading change of a step.
    slope
        Largest slope of the hills, as a tangent.
    slip, slip_length_m, slip_on_slope
        Gauss-Markov slip along and across, its correlation length, and the slip that a
        climb adds, as a share per unit of the slope's sine.
    turn_slip, veer_rad_per_m, wheel_sigma_m
        Errors of turns, of straight driving, and of every step.
    sigma_rp_rad, sigma_yaw_rad
        Of the attitude, as reported; None for no attitude.
    white_share, offset_share
        What of that variance is noise, and what an error that drifts.
    offset_drift_s
        Time over which the drifting error stays about the same.
    """

    steps: int = 200
    step_m: float = 0.5
    step_s: float = 10.0
    turn_rad: float = 0.1
    slope: float = 0.25
    slip: float = 0.1
    slip_length_m: float = 2.0
    slip_on_slope: float = 0.0
    turn_slip: float = 0.1
    veer_rad_per_m: float = 0.01
    wheel_sigma_m: float = 0.005
    sigma_rp_rad: float | None = 0.01
    sigma_yaw_rad: float = 0.05
    white_share: float = 1.0
    offset_share: float = 1.0
    offset_drift_s: float = 1000.0


@dataclass(frozen=True, slots=True)
class SimulatedDrive:
    """Readings, truth (N, 4, 4) and a start drawn from its own prior."""

    sensors: tuple[Sensors, ...]
    map_T_rover: FloatArray
    start: StartPrior
    slip: FloatArray
    """(N, 2) along and across, as shares, over the step that ends at each frame."""


def simulate_drive(spec: DriveSpec, seed: int) -> SimulatedDrive:
    """Simulate a drive; equal seeds give equal drives."""
    rng = np.random.default_rng(seed)
    truth = _over_hills(spec, rng)
    sigma = np.array([2e-3] * 3 + [5e-3] * 3)
    error = sigma * rng.normal(size=6)
    start = StartPrior(
        truth[0] @ pose(so3_exp(error[:3]), error[3:]),
        (2e-3, 2e-3, 2e-3),
        (5e-3, 5e-3, 5e-3),
    )
    shares = np.array([spec.slip, spec.slip, spec.turn_slip, spec.veer_rad_per_m])
    errors = shares * rng.normal(size=4)
    offset = np.sqrt(spec.offset_share) * rng.normal(size=3)
    sensors = [Sensors(0.0, None, _attitude(spec, rng, truth[0], offset))]
    slips = [np.zeros(2)]
    memory = np.exp(-spec.step_m / spec.slip_length_m)
    kept = np.exp(-spec.step_s / spec.offset_drift_s)
    for k in range(1, spec.steps):
        motion = inverse(truth[k - 1]) @ truth[k]
        uphill = float(truth[k - 1][2, 0])
        slip = errors[:2] + spec.slip_on_slope * uphill * np.array([1.0, 0.0])
        wheels = _wheels(spec, rng, motion, slip, errors)
        fresh = np.sqrt(spec.offset_share * (1.0 - kept**2)) * rng.normal(size=3)
        offset = kept * offset + fresh
        attitude = _attitude(spec, rng, truth[k], offset)
        sensors.append(Sensors(spec.step_s * k, wheels, attitude))
        slips.append(slip)
        fresh = np.sqrt(1.0 - memory**2) * shares * rng.normal(size=4)
        errors = memory * errors + fresh
    return SimulatedDrive(tuple(sensors), truth, start, np.stack(slips))


def _over_hills(spec: DriveSpec, rng: np.random.Generator) -> FloatArray:
    phase = rng.uniform(0.0, 2.0 * np.pi, 4)
    wave = np.array([0.35, 0.22])  # rad/m
    amplitude = 0.5 * spec.slope / wave

    def ground(xy: FloatArray) -> tuple[float, FloatArray]:
        angles = wave * xy + phase[:2]
        return float(amplitude @ np.sin(angles)), amplitude * wave * np.cos(angles)

    xy, yaw, poses = np.zeros(2), rng.uniform(0.0, 2.0 * np.pi), []
    for k in range(spec.steps):
        z, gradient = ground(xy)
        normal = np.array([*-gradient, 1.0]) / np.sqrt(1.0 + gradient @ gradient)
        ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        forward = ahead - (ahead @ normal) * normal
        forward /= np.linalg.norm(forward)
        left = np.cross(normal, forward)
        poses.append(pose(np.column_stack([forward, left, normal]), [*xy, z]))
        yaw += spec.turn_rad * np.sin(phase[2] + k / 9.0)
        xy = xy + spec.step_m * np.array([np.cos(yaw), np.sin(yaw)])
    return np.stack(poses)


def _wheels(
    spec: DriveSpec,
    rng: np.random.Generator,
    motion: FloatArray,
    slip: FloatArray,
    errors: FloatArray,
) -> WheelOdometry:
    """What the wheels count when they slip so that this motion comes about."""
    half = so3_exp(0.5 * so3_log(motion[:3, :3]))
    forward, lateral, _ = half.T @ motion[:3, 3]
    turn, _, _ = yaw_pitch_roll(motion)
    counted = forward / (1.0 - slip[0])
    noise = spec.wheel_sigma_m * rng.normal(size=2)
    return WheelOdometry(
        float(counted + noise[0]),
        float(lateral - slip[1] * abs(counted) + noise[1]),
        float((turn - errors[3] * abs(counted)) / (1.0 - errors[2]) + 1e-3 * rng.normal()),
    )


def _attitude(
    spec: DriveSpec, rng: np.random.Generator, map_T_rover: FloatArray, offset: FloatArray
) -> Attitude | None:
    if spec.sigma_rp_rad is None:
        return None
    sigmas = np.array([spec.sigma_yaw_rad, spec.sigma_rp_rad, spec.sigma_rp_rad])
    white = np.sqrt(spec.white_share) * rng.normal(size=3)
    yaw, pitch, roll = np.array(yaw_pitch_roll(map_T_rover)) + sigmas * (white + offset)
    return Attitude(float(roll), float(pitch), float(yaw), spec.sigma_rp_rad, spec.sigma_yaw_rad)
