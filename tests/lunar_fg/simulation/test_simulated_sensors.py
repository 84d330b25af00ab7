"""Wheels and attitude err as their models say; the rover stands on its wheels."""

from __future__ import annotations

import numpy as np

from frontends.geometry import inverse, se3_log, yaw_pitch_roll
from lunar_fg.simulation.drive import Drive
from lunar_fg.simulation.sensors import attitude, start_prior, wheel_odometry
from lunar_fg.simulation.simulate import World
from lunar_fg.simulation.spec import SensorSpec, SimulationSpec

RUNS = 60


def test_wheel_errors_follow_the_stated_model(world: World) -> None:
    spec, drive = SensorSpec(), world.drive
    way, turn = [], []
    for seed in range(RUNS):
        rows = wheel_odometry(drive, 0.1, spec, np.random.default_rng(seed))
        way.append(rows.increments[1:, 0].sum())
        turn.append(rows.increments[1:, 2].sum())
    poses, length = drive.map_T_rover, drive.distance_m[-1]
    headings = np.unwrap([yaw_pitch_roll(pose)[0] for pose in poses])
    climb = np.array([-np.tan(yaw_pitch_roll(pose)[1]) for pose in poses[:-1]])
    slip = spec.slip + spec.slip_per_slope * climb
    expected_way = np.sum(np.diff(drive.distance_m) / (1.0 - slip))
    # wander of 2 %, correlated over 3 m: about sigma * sqrt(2 * 3 m * length)
    sigma_way = spec.slip_sigma * np.sqrt(6.0 * length)
    assert abs(np.mean(way) - expected_way) < 3.0 * sigma_way / np.sqrt(RUNS) + 0.002 * length
    assert 0.5 * sigma_way < np.std(way) < 1.3 * sigma_way
    bias = np.deg2rad(spec.heading_bias_deg_per_m) * length
    expected_turn = (1.0 + spec.heading_over_read) * (headings[-1] - headings[0]) + bias
    sigma_turn = np.deg2rad(spec.heading_sigma_deg) * np.sqrt(length)
    # the turn about the rover's own up axis is not quite that of the map's
    assert abs(np.mean(turn) - expected_turn) < 3.0 * sigma_turn / np.sqrt(RUNS) + 0.02
    assert 0.7 * sigma_turn < np.std(turn) < 1.3 * sigma_turn


def test_slip_grows_with_the_slope() -> None:
    distance = np.arange(0.0, 10.0, 0.05)

    def read_on(slope: float) -> float:
        poses = np.tile(np.eye(4), (len(distance), 1, 1))
        angle = np.arctan(slope)
        c, s = np.cos(angle), np.sin(angle)
        poses[:, :3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
        poses[:, :3, 3] = distance[:, None] * [c, 0, s]
        spec = SensorSpec(slip_sigma=0.0)
        rows = wheel_odometry(Drive(distance, poses), 0.1, spec, np.random.default_rng(0))
        return float(rows.increments[:, 0].sum() / distance[-1])

    assert read_on(0.0) < read_on(0.1) < read_on(0.2)
    np.testing.assert_allclose(read_on(0.2), 1.0 / (1.0 - 0.02 - 0.5 * 0.2), rtol=1e-6)


def test_attitude_errors_are_within_their_sigmas(world: World) -> None:
    poses, distance = world.map_T_rover(), world.drive.distance_m[world.frames]
    true = np.array([yaw_pitch_roll(pose)[::-1] for pose in poses])
    scaled = []
    for seed in range(RUNS):
        rng = np.random.default_rng(seed)
        rows = attitude(poses, distance, distance * 10.0, SensorSpec(), rng)
        error = rows.angles - true
        sigma = np.column_stack([np.full((len(error), 2), rows.sigma_rp_rad), rows.sigma_yaw_rad])
        scaled.append(error / sigma)
    mean_square = np.mean(np.array(scaled) ** 2, axis=(0, 1))
    assert np.all((mean_square > 0.6) & (mean_square < 1.5))


def test_the_start_is_wrong_by_what_it_says() -> None:
    truth, square = np.eye(4), np.zeros(6)
    for seed in range(200):
        start = start_prior(truth, SensorSpec(), np.random.default_rng(seed))
        error = se3_log(inverse(start.map_T_rover) @ truth)
        square += error**2 / np.diag(start.covariance())
    assert np.all((square / 200 > 0.7) & (square / 200 < 1.35))


def test_the_rover_stands_on_its_wheels(world: World, spec: SimulationSpec) -> None:
    half_base, half_track = 0.5 * spec.path.wheel_base_m, 0.5 * spec.path.track_m
    ground = world.scene.levels[-1]
    gaps = []
    for pose in world.map_T_rover():
        wheels = np.array(
            [[a * half_base, b * half_track, 0.0, 1.0] for a in (1, -1) for b in (1, -1)]
        )
        points = wheels @ pose.T
        gaps.append(points[:, 2] - ground.at(points[:, 0], points[:, 1]))
    gaps_m = np.array(gaps)
    # four wheels and one plane: what is left over is the ground's twist, and its roughness
    assert np.abs(gaps_m.mean(axis=1)).max() < 0.02
    assert np.sqrt(np.mean(gaps_m**2)) < 0.04


def test_side_slopes_turn_the_rover_uphill(world: World) -> None:
    poses = world.drive.map_T_rover
    way = np.diff(poses[:, :3, 3], axis=0)
    sideways = np.einsum("nij,ni->nj", poses[:-1, :3, :3], way)[:, 1]
    rolls = np.array([yaw_pitch_roll(pose)[2] for pose in poses[:-1]])
    # left side up (roll < 0 is left down): slides to the right
    assert np.corrcoef(rolls, sideways)[0, 1] < -0.5
