"""A traverse simulated at measurement level: stereo landmark tracks with exact truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from frontends.camera import StereoCamera, level_rover_T_camera
from frontends.geometry import inverse, se3_exp, transform_points, yaw_pitch_roll
from frontends.measurements import (
    FloatArray,
    Odometry,
    RelativePose,
    StartPrior,
    StereoObservations,
    Tilt,
    Verdict,
)
from lunar_fg.graph.config import GraphConfig
from lunar_fg.graph.keyframe import Keyframe

#: Settings that are right for simulated landmarks: they err independently of each other, real
#: ones do not.
INDEPENDENT = GraphConfig(landmark_correlation=0.0, disparity_sigma_px=0.0, scale_sigma=0.0)


@dataclass(frozen=True, slots=True)
class TraverseSpec:
    """What to simulate.

    Attributes
    ----------
    keyframes, step_m, turn_rad
        Length of the traverse, distance and largest heading change between keyframes.
    landmarks
        Observations a keyframe.
    least_track, most_track
        Keyframes a landmark is tracked for, uniform.
    sigma_px, sigma_disparity_px
        Pixel noise, as reported and as drawn.
    disparity_error_px
        1-sigma of an error that all disparities of the traverse have in common; not reported.
    bad_share
        Share of sightings moved by up to 40 px.
    odometry, tilt
        Whether the wheels and an inclinometer measure, too.
    odometry_sigmas
        Noise of the wheels' motions: rotation (rad), then translation (m), rover axes.
    relative_sigma_rot_rad, relative_sigma_trans_m
        Noise of the frontend's relative poses; without landmarks they are what carries it.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "allow_inf_nan": False}

    keyframes: int = 40
    step_m: float = 0.5
    turn_rad: float = 0.05
    landmarks: int = 100
    least_track: int = 2
    most_track: int = 8
    sigma_px: float = 0.7
    sigma_disparity_px: float = 0.7
    disparity_error_px: float = 0.0
    bad_share: float = 0.0
    odometry: bool = False
    tilt: bool = False
    odometry_sigmas: tuple[float, ...] = (4e-3, 4e-3, 1e-2, 0.02, 0.02, 0.02)
    relative_sigma_rot_rad: float = 5e-4
    relative_sigma_trans_m: float = 0.005


@dataclass(frozen=True, slots=True)
class SimulatedTraverse:
    """The measurements and the truth.

    Attributes
    ----------
    camera, rover_T_camera, start
        What the smoother needs; `start` is drawn from its own prior.
    keyframes
        The measurements.
    map_T_rover
        (N, 4, 4) truth.
    """

    camera: StereoCamera
    rover_T_camera: FloatArray
    start: StartPrior
    keyframes: tuple[Keyframe, ...]
    map_T_rover: FloatArray


_CAMERA = StereoCamera(640, 480, 500.0, 500.0, 320.0, 240.0, 0.3)


def simulate(spec: TraverseSpec, seed: int) -> SimulatedTraverse:
    """Simulate a traverse.

    Parameters
    ----------
    spec
        What to simulate.
    seed
        Of all random numbers; equal seeds give equal traverses.
    """
    rng = np.random.default_rng(seed)
    camera, rover_T_camera = _CAMERA, level_rover_T_camera()
    truth = _path(spec, rng)
    start_sigma = np.array([2e-3] * 3 + [5e-3] * 3)
    start = StartPrior(
        truth[0] @ se3_exp(start_sigma * rng.normal(size=6)),
        (2e-3, 2e-3, 2e-3),
        (5e-3, 5e-3, 5e-3),
    )
    live_id = np.empty(0, dtype=np.int64)
    live_point, live_left = np.empty((0, 3)), np.empty(0, dtype=np.int64)
    offset = spec.disparity_error_px * np.random.default_rng([seed, 1]).normal()
    keyframes, next_id = [], 0
    for k in range(spec.keyframes):
        camera_T_map = inverse(truth[k] @ rover_T_camera)
        seen = (live_left > 0) & _visible(camera, transform_points(camera_T_map, live_point))
        live_id, live_point, live_left = live_id[seen], live_point[seen], live_left[seen]
        missing = spec.landmarks - len(live_id)
        fresh = _draw_points(camera, rng, missing)
        live_id = np.concatenate([live_id, next_id + np.arange(missing)])
        next_id += missing
        live_point = np.concatenate([live_point, transform_points(inverse(camera_T_map), fresh)])
        live_left = np.concatenate(
            [live_left, rng.integers(spec.least_track, spec.most_track + 1, missing)]
        )
        live_left = live_left - 1
        pixels = camera.project(transform_points(camera_T_map, live_point))
        relative = odometry = None
        if k:
            motion = inverse(truth[k - 1]) @ truth[k]
            relative = _relative(spec, rng, motion, rover_T_camera)
            odometry = _odometry(spec, rng, motion) if spec.odometry else None
        keyframes.append(
            Keyframe(
                k,
                float(k),
                _observe(spec, rng, camera, live_id, pixels, offset),
                relative,
                odometry,
                _tilt(rng, truth[k]) if spec.tilt else None,
            )
        )
    return SimulatedTraverse(camera, rover_T_camera, start, tuple(keyframes), truth)


def _path(spec: TraverseSpec, rng: np.random.Generator) -> FloatArray:
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    poses = [np.eye(4)]
    for k in range(spec.keyframes - 1):
        turn = spec.turn_rad * np.sin(phase[0] + k / 9.0)
        roll, pitch = 0.01 * np.cos(phase[1] + k / 4.0), 0.01 * np.cos(phase[2] + k / 6.0)
        poses.append(poses[-1] @ se3_exp([roll, pitch, turn, spec.step_m, 0.0, 0.0]))
    return np.stack(poses)


def _visible(camera: StereoCamera, points: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.bool]]:
    ahead = points[:, 2] > 1.0
    pixels = camera.project(np.where(ahead[:, None], points, [0.0, 0.0, 1.0]))
    inside = camera.contains(pixels[:, 0], pixels[:, 2], 5.0) & (pixels[:, 1] > 0.0)
    return np.asarray(ahead & inside)


def _draw_points(camera: StereoCamera, rng: np.random.Generator, count: int) -> FloatArray:
    u = rng.uniform(60.0, camera.width - 10.0, count)
    v = rng.uniform(10.0, camera.height - 10.0, count)
    depth = np.exp(rng.uniform(np.log(4.0), np.log(20.0), count))
    return camera.triangulate(u, v, camera.baseline_m * camera.fx / depth)


def _observe(
    spec: TraverseSpec,
    rng: np.random.Generator,
    camera: StereoCamera,
    ids: np.ndarray[tuple[int], np.dtype[np.int64]],
    pixels: FloatArray,
    offset_px: float,
) -> StereoObservations:
    n = len(ids)
    u_left = pixels[:, 0] + spec.sigma_px * rng.normal(size=n)
    v = pixels[:, 2] + spec.sigma_px * rng.normal(size=n)
    bad = rng.random(n) < spec.bad_share
    u_left = u_left + bad * rng.uniform(-40.0, 40.0, n)
    v = v + bad * rng.uniform(-40.0, 40.0, n)
    disparity = pixels[:, 0] - pixels[:, 1] + spec.sigma_disparity_px * rng.normal(size=n)
    disparity = np.maximum(disparity + offset_px, 0.1)
    sigma, sigma_d = np.full(n, spec.sigma_px), np.full(n, spec.sigma_disparity_px)
    return StereoObservations(
        ids,
        u_left,
        u_left - disparity,
        v,
        sigma,
        sigma_d,
        camera.triangulate(u_left, v, disparity),
        camera.triangulation_covariance(u_left, v, disparity, sigma, sigma_d),
    )


def _relative(
    spec: TraverseSpec, rng: np.random.Generator, motion: FloatArray, rover_T_camera: FloatArray
) -> RelativePose:
    sigmas = np.array([spec.relative_sigma_rot_rad] * 3 + [spec.relative_sigma_trans_m] * 3)
    in_camera = inverse(rover_T_camera) @ motion @ rover_T_camera
    return RelativePose(
        in_camera @ se3_exp(sigmas * rng.normal(size=6)),
        np.diag(sigmas**2),
        np.empty(0, dtype=np.int64),
        spec.landmarks,
        Verdict.ACCEPTED,
    )


def _odometry(spec: TraverseSpec, rng: np.random.Generator, motion: FloatArray) -> Odometry:
    sigmas = np.array(spec.odometry_sigmas)
    return Odometry(motion @ se3_exp(sigmas * rng.normal(size=6)), np.diag(sigmas**2))


def _tilt(rng: np.random.Generator, map_T_rover: FloatArray) -> Tilt:
    sigma = np.deg2rad(0.5)
    _, pitch, roll = yaw_pitch_roll(map_T_rover)
    noise = sigma * rng.normal(size=2)
    return Tilt(float(roll + noise[0]), float(pitch + noise[1]), float(sigma))
