"""Wheels and attitude without a camera: covariances that hold, slip that is learned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from frontends.camera import StereoCamera, level_rover_T_camera
from frontends.geometry import inverse, se3_exp, se3_log
from frontends.measurements import Attitude, RelativePose, StartPrior, Verdict, WheelOdometry
from lunar_fg.dead_reckoning import DeadReckoning, SlipFilter
from lunar_fg.graph import IncrementalSmoother, Keyframe
from lunar_fg.motion import MotionModel, tilt_of
from lunar_fg.motion_config import MotionConfig
from lunar_fg.record import Sensors
from lunar_fg.simulation.wheels import DriveSpec, simulate_drive

RUNS = 10
HILLS = DriveSpec(steps=100)


def nees_at_end(spec: DriveSpec, runs: int = RUNS) -> float:
    """Mean NEES a degree of freedom of the last pose, over independent drives."""
    values = []
    for seed in range(runs):
        drive = simulate_drive(spec, seed)
        dead_reckoning = DeadReckoning(drive.start)
        for sensors in drive.sensors:
            found = dead_reckoning.step(sensors)
        error = se3_log(inverse(found.map_T_rover) @ drive.map_T_rover[-1])
        values.append(error @ np.linalg.solve(found.covariance, error) / 6)
    return float(np.mean(values))


def test_covariances_hold_over_hills_with_slip_veer_and_a_drifting_attitude() -> None:
    lower, upper = chi2.interval(0.999, 6 * RUNS) / np.array(6 * RUNS)
    assert lower < nees_at_end(HILLS) < upper


@pytest.mark.parametrize(
    "change",
    [
        {"offset_share": 0.0},
        {"white_share": 0.0, "offset_drift_s": 1e9},
        {"sigma_rp_rad": None},
        {"slip_on_slope": 0.5},
    ],
    ids=str,
)
def test_what_is_not_as_assumed_does_not_make_it_over_confident(change: dict) -> None:
    upper = float(chi2.ppf(0.999, 6 * RUNS)) / (6 * RUNS)
    assert nees_at_end(replace(HILLS, **change)) < upper


def test_slip_that_is_not_allowed_for_is_found_out_by_the_nees() -> None:
    """The test above can fail: twice the slip is outside of the band."""
    upper = float(chi2.ppf(0.999, 6 * RUNS)) / (6 * RUNS)
    assert nees_at_end(replace(HILLS, slip=0.4, veer_rad_per_m=0.04)) > upper


def test_without_errors_it_is_where_the_rover_is() -> None:
    spec = replace(
        HILLS, slip=0.0, turn_slip=0.0, veer_rad_per_m=0.0, wheel_sigma_m=0.0,
        sigma_rp_rad=1e-4, sigma_yaw_rad=1e-4, slope=0.1,
    )  # fmt: skip
    drive = simulate_drive(spec, 0)
    start = StartPrior(drive.map_T_rover[0])
    dead_reckoning = DeadReckoning(start)
    found = [dead_reckoning.step(sensors) for sensors in drive.sensors]
    assert found[0] is None  # no wheels yet
    driven = 0.5 * spec.steps
    gap = np.linalg.norm(found[-1].map_T_rover[:3, 3] - drive.map_T_rover[-1][:3, 3])
    assert gap < 0.01 * driven


def test_an_attitude_bounds_the_heading() -> None:
    drives = [simulate_drive(replace(HILLS, sigma_rp_rad=s), 3) for s in (None, 0.01)]
    sigma = []
    for drive in drives:
        dead_reckoning = DeadReckoning(drive.start)
        for sensors in drive.sensors:
            found = dead_reckoning.step(sensors)
        sigma.append(np.sqrt(found.covariance[2, 2]))
    assert sigma[1] < 0.5 * sigma[0]


def test_without_wheels_there_is_no_baseline_and_gaps_cost_certainty() -> None:
    level = Attitude(0.0, 0.0, 0.0, 0.01, 0.05)
    alone = DeadReckoning(StartPrior())
    assert [alone.step(Sensors(float(k), None, level)) for k in range(3)] == [None] * 3
    gap = DeadReckoning(StartPrior())
    step = WheelOdometry(0.5, 0.0, 0.0)
    gap.step(Sensors(0.0))
    before = gap.step(Sensors(1.0, step))
    after = gap.step(Sensors(2.0))
    np.testing.assert_array_equal(before.map_T_rover, after.map_T_rover)
    assert np.sqrt(after.covariance[3, 3]) > 0.9 * MotionConfig().unknown_sigma_m


@pytest.mark.parametrize("yaw", [3.13, -3.13])
def test_headings_go_round(yaw: float) -> None:
    start = StartPrior(se3_exp([0.0, 0.0, 3.1, 0.0, 0.0, 0.0]), (0.1,) * 3, (0.1,) * 3)
    dead_reckoning = DeadReckoning(start)
    for k in range(20):
        wheels = WheelOdometry(0.0, 0.0, 0.0) if k else None
        found = dead_reckoning.step(Sensors(float(k), wheels, Attitude(0, 0, yaw, 0.01, 0.01)))
    assert abs(se3_log(inverse(start.map_T_rover) @ found.map_T_rover)[2]) < 0.2


def test_readings_that_no_filter_can_take_end_the_baseline_not_the_run() -> None:
    dead_reckoning = DeadReckoning(StartPrior())
    dead_reckoning.step(Sensors(0.0))
    assert dead_reckoning.step(Sensors(1.0, WheelOdometry(1e308, 1e308, 0.0))) is None
    assert dead_reckoning.failure
    assert dead_reckoning.step(Sensors(2.0, WheelOdometry(0.5, 0.0, 0.0))) is None


def seen(motion, sigma_m: float) -> RelativePose:
    covariance = np.diag([1e-3] * 3 + [sigma_m] * 3) ** 2
    return RelativePose(motion, covariance, np.arange(20), 20, Verdict.ACCEPTED)


def test_slip_is_learned_from_vision_with_honest_covariance() -> None:
    nees, with_slip, without = [], [], []
    rng = np.random.default_rng(1)
    mount = level_rover_T_camera()
    for seed in range(5):
        drive = simulate_drive(replace(HILLS, steps=80, slip=0.2), seed)
        config = MotionConfig(slip=0.2)
        model, slip = MotionModel(mount, config), SlipFilter(config)
        for k, sensors in enumerate(drive.sensors):
            if k == 0:
                model.update(sensors, None)
                continue
            truth = inverse(drive.map_T_rover[k - 1]) @ drive.map_T_rover[k]
            expected = mount @ model.predict(sensors).a_T_b @ inverse(mount)
            with_slip.append(np.linalg.norm(expected[:3, 3] - truth[:3, 3]))
            plain = model.odometry(sensors).a_T_b
            without.append(np.linalg.norm(plain[:3, 3] - truth[:3, 3]))
            noisy = truth @ se3_exp(np.array([1e-3] * 3 + [0.01] * 3) * rng.normal(size=6))
            model.update(sensors, seen(inverse(mount) @ noisy @ mount, 0.01))
            found = slip.after(sensors.odometry)
            error = drive.slip[k] - found.mean
            if k > 10:
                nees.append(error @ np.linalg.solve(found.covariance, error) / 2)
            slip.drive(sensors.odometry)
            half = noisy[:2, 3]
            slip.observe(sensors.odometry, half, 1e-4 * np.eye(2))
    assert np.mean(with_slip) < 0.75 * np.mean(without)
    assert 0.6 < np.mean(nees) < 1.4


def test_odometry_and_tilts_in_the_graph_do_not_count_the_attitude_twice() -> None:
    """Wheels and inclinometer alone, in the graph: NEES of the last pose over drives.

    Slip goes on from step to step; were the steps' sigmas those of one step alone, the sum
    would be over-confident.
    """
    camera = StereoCamera(640, 480, 500.0, 500.0, 320.0, 240.0, 0.3)
    tilts, places = [], []
    for seed in range(RUNS):
        spec = replace(HILLS, steps=80, slope=0.1, offset_share=0.0, turn_slip=0.0)
        drive = simulate_drive(spec, 100 + seed)
        smoother = IncrementalSmoother(camera, level_rover_T_camera(), drive.start)
        model = MotionModel(level_rover_T_camera())
        for k, sensors in enumerate(drive.sensors):
            odometry = model.odometry(sensors)
            model.update(sensors, None)
            smoother.add(Keyframe(k, sensors.stamp_s, None, None, odometry, tilt_of(sensors)))
        smoother.finish()
        found = smoother.trajectory()
        error = se3_log(inverse(found.map_T_rover[-1]) @ drive.map_T_rover[-1])
        covariance = found.covariance[-1]
        tilts.append(error[:2] @ np.linalg.solve(covariance[:2, :2], error[:2]) / 2)
        places.append(error[3:5] @ np.linalg.solve(covariance[3:5, 3:5], error[3:5]) / 2)
    upper = float(chi2.ppf(0.999, 2 * RUNS)) / (2 * RUNS)
    assert np.mean(tilts) < upper
    assert 0.3 < np.mean(places) < upper
