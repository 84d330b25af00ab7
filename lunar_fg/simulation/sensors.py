"""What the rover's wheels and attitude sensor report, with the errors that they have.

Wheels: they turn ``1 / (1 - s)`` metres a metre of way, with the slip
``s = slip + slip_per_slope * tan(slope along the way) + n`` (n: Gauss-Markov over 3 m); they
see no sideways motion; turns are over-read by a share, with a bias and a random walk over
the way. Attitude: roll and pitch with a bias and white noise; yaw with an offset and a
random walk over the way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frontends.geometry import inverse, se3_exp, yaw_pitch_roll
from frontends.measurements import StartPrior
from lunar_fg.simulation.drive import Drive
from lunar_fg.simulation.spec import SensorSpec

FloatArray = NDArray[np.float64]

_SLIP_CORRELATION_M = 3.0
_MOST_SLIP = 0.9


@dataclass(frozen=True, slots=True)
class WheelRows:
    """Rows of ``odometry.csv``: stamps, and increments forward, left and in yaw."""

    stamp_s: FloatArray
    increments: FloatArray


@dataclass(frozen=True, slots=True)
class AttitudeRows:
    """Rows of ``attitude.csv``: stamps, roll, pitch, yaw, and their 1-sigmas, rad."""

    stamp_s: FloatArray
    angles: FloatArray
    sigma_rp_rad: float
    sigma_yaw_rad: FloatArray


def wheel_odometry(
    drive: Drive, speed_m_s: float, spec: SensorSpec, rng: np.random.Generator
) -> WheelRows:
    """What the wheels report along a drive; the first row only marks the start."""
    count = int(drive.distance_m[-1] / spec.odometry_spacing_m)
    rows = np.unique(
        drive.nearest(np.append(spec.odometry_spacing_m * np.arange(count + 1), np.inf))
    )
    distance = drive.distance_m[rows]
    poses = drive.map_T_rover[rows]
    way = np.diff(distance)
    between = inverse(poses[:-1]) @ poses[1:]
    n = len(way)
    keep = np.exp(-way / _SLIP_CORRELATION_M)
    wander = np.empty(n)
    last = rng.normal()
    for k in range(n):
        last = keep[k] * last + np.sqrt(1.0 - keep[k] ** 2) * rng.normal()
        wander[k] = last
    climb = np.array([-np.tan(yaw_pitch_roll(pose)[1]) for pose in poses[:-1]])
    slip = spec.slip + spec.slip_per_slope * climb + spec.slip_sigma * wander
    slip = np.clip(slip, -_MOST_SLIP, _MOST_SLIP)
    turn = np.arctan2(between[:, 1, 0], between[:, 0, 0])
    read = (1.0 + spec.heading_over_read) * turn
    read += np.deg2rad(spec.heading_bias_deg_per_m) * way
    read += np.deg2rad(spec.heading_sigma_deg) * np.sqrt(way) * rng.normal(size=n)
    increments = np.zeros((n + 1, 3))
    increments[1:, 0] = between[:, 0, 3] / (1.0 - slip)
    increments[1:, 2] = read
    return WheelRows(distance / speed_m_s, increments)


def attitude(
    poses: FloatArray,
    distance_m: FloatArray,
    stamp_s: FloatArray,
    spec: SensorSpec,
    rng: np.random.Generator,
) -> AttitudeRows:
    """What the attitude sensor reports at given poses, (N, 4, 4)."""
    angles = np.array([yaw_pitch_roll(pose)[::-1] for pose in poses])
    n = len(angles)
    bias = np.deg2rad(spec.tilt_bias_deg) * rng.normal(size=2)
    angles[:, :2] += bias + np.deg2rad(spec.tilt_sigma_deg) * rng.normal(size=(n, 2))
    steps = np.diff(distance_m, prepend=0.0)
    walk = np.cumsum(np.sqrt(steps) * rng.normal(size=n))
    offset = np.deg2rad(spec.yaw_offset_deg) * rng.normal()
    angles[:, 2] += offset + np.deg2rad(spec.yaw_drift_deg) * walk
    sigma_yaw = np.hypot(spec.yaw_offset_deg, spec.yaw_drift_deg * np.sqrt(distance_m))
    return AttitudeRows(
        stamp_s,
        angles,
        float(np.deg2rad(np.hypot(spec.tilt_bias_deg, spec.tilt_sigma_deg))),
        np.deg2rad(np.maximum(sigma_yaw, 1e-3)),
    )


def start_prior(map_T_rover: FloatArray, spec: SensorSpec, rng: np.random.Generator) -> StartPrior:
    """A start that is wrong by what its own sigmas say."""
    tilt, yaw = np.deg2rad([spec.start_sigma_tilt_deg, spec.start_sigma_yaw_deg])
    rotation = (float(tilt), float(tilt), float(yaw))
    translation = (spec.start_sigma_m,) * 3
    error = np.array([*rotation, *translation]) * rng.normal(size=6)
    return StartPrior(map_T_rover @ se3_exp(error), rotation, translation)
