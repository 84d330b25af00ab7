"""Predicted motions: wheels, attitude, constant velocity."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import rover_T_camera

from frontends.camera import level_rover_T_camera
from frontends.geometry import adjoint, inverse, pose, se3_exp, se3_log, yaw_pitch_roll
from frontends.measurements import (
    Attitude,
    RelativePose,
    UnusableFrame,
    Verdict,
    WheelOdometry,
)
from lunar_fg.motion import MotionModel, tilt_of
from lunar_fg.motion_config import MotionConfig

MOUNT = rover_T_camera(1.1, 0.4)


def frame(index=0, wheels=None, attitude=None):
    return UnusableFrame(
        index,
        float(index),
        "no images in this test",
        None if wheels is None else WheelOdometry(*wheels),
        attitude,
    )


def attitude(roll=0.0, pitch=0.0, yaw=0.0, sigma=0.005):
    return Attitude(roll, pitch, yaw, sigma, 0.05)


def measured(a_T_b, verdict=Verdict.ACCEPTED):
    return RelativePose(a_T_b, 1e-6 * np.eye(6), np.zeros(0, int), 20, verdict)


def moved(*motions, model=None):
    """A model that has seen frames 0, 1, ... with these motions between them."""
    model = model or MotionModel(MOUNT)
    model.update(frame(0), None)
    for k, motion in enumerate(motions, start=1):
        model.update(frame(k), measured(motion))
    return model


def sigmas(prediction):
    return np.sqrt(np.diag(prediction.covariance))


def test_without_wheels_the_last_motion_goes_on():
    model = moved()
    assert not model.known
    np.testing.assert_array_equal(model.predict(frame(1)).a_T_b, np.eye(4))
    last = se3_exp([0.01, 0.02, -0.01, 0.1, 0.0, 0.5])
    model = moved(last)
    assert model.known
    prediction = model.predict(frame(2))
    np.testing.assert_allclose(prediction.a_T_b, last, atol=1e-12)
    slow = moved(se3_exp([0, 0, 0, 0, 0, 0.01]))
    assert (sigmas(prediction)[3:] > sigmas(slow.predict(frame(2)))[3:]).all()
    model.update(frame(2), measured(last, Verdict.REFUSED))
    assert not model.known


def at(stamp_s):
    return replace(frame(2), stamp_s=stamp_s)


@pytest.mark.parametrize("share", [0.25, 1.0, 3.0])
def test_a_velocity_lasts_for_the_time_that_passes(share):
    twist = np.array([0.01, 0.02, -0.01, 0.1, 0.0, 0.5])
    prediction = moved(se3_exp(twist)).predict(at(1.0 + share))
    np.testing.assert_allclose(prediction.a_T_b, se3_exp(share * twist), atol=1e-12)
    steady = sigmas(moved(se3_exp(twist)).predict(at(2.0)))
    assert (sigmas(prediction) >= steady - 1e-12).all() == (share >= 1.0)


def test_over_a_long_gap_no_velocity_lasts():
    model = moved(se3_exp([0.0, 0.0, 0.0, 0.0, 0.0, 0.5]))
    prediction = model.predict(at(1.0 + 40_000.0))
    np.testing.assert_array_equal(prediction.a_T_b, np.eye(4))
    np.testing.assert_allclose(sigmas(prediction)[3:], MotionConfig().unknown_sigma_m)


def test_a_velocity_over_two_losses_counts_the_time_of_each_frame():
    twist = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5])
    model = moved(se3_exp(twist))
    model.update(frame(2), measured(se3_exp(twist), Verdict.REFUSED))
    np.testing.assert_allclose(model.predict(frame(3)).a_T_b, se3_exp(twist), atol=1e-12)


@pytest.mark.parametrize(
    ("wheels", "expected"),
    [
        ((0.5, 0.0, 0.0), (0.5, 0.0, 0.0)),
        ((0.0, 0.2, 0.0), (0.0, 0.2, 0.0)),
        ((0.0, 0.0, 0.3), (0.0, 0.0, 0.3)),
        ((1.0, 0.0, 0.2), (np.cos(0.1), np.sin(0.1), 0.2)),
        ((-0.4, 0.0, -0.1), (-0.4 * np.cos(0.05), 0.4 * np.sin(0.05), -0.1)),
    ],
)
def test_wheels_alone_drive_a_chord_on_level_ground(wheels, expected):
    motion = MotionModel(MOUNT).odometry(frame(1, wheels))
    x, y, yaw = expected
    np.testing.assert_allclose(motion.a_T_b[:3, 3], [x, y, 0.0], atol=1e-12)
    np.testing.assert_allclose(yaw_pitch_roll(motion.a_T_b), [yaw, 0.0, 0.0], atol=1e-12)


def test_attitude_gives_the_change_of_tilt_and_a_compass_that_is_out_no_turn():
    model = MotionModel(MOUNT)
    before, now = (
        replace(reading, sigma_yaw_rad=100.0)
        for reading in (attitude(0.1, -0.2, 0.7), attitude(-0.05, 0.15, 2.9))
    )
    model.update(frame(0, attitude=before), measured(np.eye(4)))
    motion = model.odometry(frame(1, (0.3, 0.0, 0.25), now))
    start = Rotation.from_euler("ZYX", [0.7, -0.2, 0.1]).as_matrix()
    end = start @ motion.a_T_b[:3, :3]
    yaw, pitch, roll = yaw_pitch_roll(pose(end, np.zeros(3)))
    assert (yaw, pitch, roll) == pytest.approx((0.95, 0.15, -0.05), abs=1e-6)
    # the readings are the graph's tilts as well: here they are no information
    without = model.odometry(frame(1, (0.3, 0.0, 0.25)))
    np.testing.assert_allclose(motion.covariance, without.covariance, rtol=1e-6)
    predicted = model.predict(frame(1, (0.3, 0.0, 0.25), now))
    assert np.linalg.eigvalsh(predicted.covariance[:3, :3])[0] == pytest.approx(2 * 0.005**2)


def test_a_turn_on_the_spot_is_known_from_the_attitude():
    """Wheels over-read it by a share; where the rover drove meanwhile is anyone's guess."""
    model, sigma = MotionModel(MOUNT), 0.01
    before, now = (
        replace(reading, sigma_yaw_rad=sigma)
        for reading in (attitude(0.0, 0.0, -1.9), attitude(0.0, 0.0, -1.9 + 3.12))
    )
    model.update(frame(0, attitude=before), measured(np.eye(4)))
    motion = model.odometry(frame(1, (0.4, 0.0, 3.3), now))
    yaw = yaw_pitch_roll(motion.a_T_b)[0]
    assert yaw == pytest.approx(3.12, abs=0.01)
    assert np.sqrt(motion.covariance[2, 2]) == pytest.approx(np.sqrt(2.0) * sigma, rel=0.05)
    assert np.sqrt(motion.covariance[3, 3]) > 0.3


def test_the_covariance_grows_with_distance_and_turn():
    model = MotionModel(MOUNT)
    sigma = [
        np.sqrt(np.diag(model.odometry(frame(1, wheels)).covariance))
        for wheels in ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, 0.5))
    ]
    assert (sigma[0] > 0.0).all()
    # one step of many whose slip goes on: they are independent in the graph, and add up right
    grown = 1.0 / np.sqrt(np.tanh(0.5 * 1.0 / MotionConfig().slip_length_m))
    assert sigma[1][3] == pytest.approx(np.hypot(0.005, 0.1 * grown))
    assert sigma[1][0] > sigma[0][0]
    assert sigma[2][2] > sigma[1][2]


def test_the_prediction_is_the_odometry_seen_by_the_camera():
    model = MotionModel(MOUNT)
    odometry = model.odometry(frame(1, (0.4, 0.02, 0.1)))
    prediction = model.predict(frame(1, (0.4, 0.02, 0.1)))
    np.testing.assert_allclose(
        MOUNT @ prediction.a_T_b @ inverse(MOUNT), odometry.a_T_b, atol=1e-12
    )
    rng = np.random.default_rng(0)
    to_rover = adjoint(MOUNT)
    root = np.linalg.cholesky(to_rover @ prediction.covariance @ to_rover.T)
    samples = [
        se3_log(
            inverse(prediction.a_T_b)
            @ inverse(MOUNT)
            @ odometry.a_T_b
            @ se3_exp(root @ rng.standard_normal(6))
            @ MOUNT
        )
        for _ in range(5000)
    ]
    found = np.cov(np.array(samples).T)
    scale = np.sqrt(np.outer(np.diag(found), np.diag(found)))
    np.testing.assert_allclose(prediction.covariance / scale, found / scale, atol=0.06)


def test_a_level_camera_sees_a_forward_drive_along_its_axis():
    model = MotionModel(level_rover_T_camera())
    prediction = model.predict(frame(1, (0.5, 0.0, 0.0)))
    np.testing.assert_allclose(prediction.a_T_b[:3, 3], [0.0, 0.0, 0.5], atol=1e-12)
    # a left turn brings the camera's axis to its left: -x
    turned = model.predict(frame(1, (0.0, 0.0, 0.2)))
    assert (turned.a_T_b[:3, :3] @ [0, 0, 1])[0] < 0.0


def test_tilt_is_taken_where_there_is_an_attitude():
    assert tilt_of(frame()) is None
    tilt = tilt_of(frame(attitude=attitude(0.1, -0.2, 0.3, 0.02)))
    assert (tilt.roll_rad, tilt.pitch_rad, tilt.sigma_rad) == (0.1, -0.2, 0.02)


def test_an_attitude_of_an_older_frame_is_not_that_of_the_frame_before():
    model = MotionModel(MOUNT)
    model.update(frame(0, attitude=attitude(pitch=0.0)), measured(np.eye(4)))
    model.update(frame(1), measured(np.eye(4)))  # no attitude here
    motion = model.odometry(frame(2, (0.2, 0.0, 0.0), attitude(pitch=0.2)))
    fresh = MotionModel(MOUNT).odometry(frame(2, (0.2, 0.0, 0.0), attitude(pitch=0.2)))
    np.testing.assert_allclose(motion.covariance, fresh.covariance)


def test_no_wheels_no_odometry():
    assert MotionModel(MOUNT).odometry(frame(attitude=attitude())) is None


@pytest.mark.parametrize("bad", [{"slip": -1.0}, {"steady_sigma_m": float("nan")}])
def test_settings_out_of_range_are_refused(bad):
    from pydantic import TypeAdapter, ValidationError

    with pytest.raises(ValidationError):
        TypeAdapter(MotionConfig).validate_python({**bad})


def test_settings_matter():
    sure = MotionModel(MOUNT, replace(MotionConfig(), slip=0.01))
    unsure = MotionModel(MOUNT)
    wheels = frame(1, (1.0, 0.0, 0.0))
    assert sure.odometry(wheels).covariance[3, 3] < unsure.odometry(wheels).covariance[3, 3]


def test_nothing_is_claimed_before_the_first_motion():
    config = MotionConfig(unknown_sigma_m=2.0, unknown_sigma_rad=0.4)
    model = MotionModel(MOUNT, config)
    for k in range(3):  # what was refused was not measured: it leaves all as unknown as it was
        prediction = model.predict(frame(k))
        np.testing.assert_array_equal(prediction.a_T_b, np.eye(4))
        np.testing.assert_allclose(np.sqrt(np.diag(prediction.covariance)), [0.4] * 3 + [2.0] * 3)
        refused = RelativePose(
            prediction.a_T_b, prediction.covariance, np.zeros(0, int), 3, Verdict.REFUSED
        )
        model.update(frame(k), refused)


def test_a_prediction_says_less_the_longer_nothing_was_measured():
    step = se3_exp([0.0, 0.01, 0.0, 0.0, 0.0, 0.2])
    model = moved(step)
    fresh = model.predict(frame(2)).covariance
    before = np.diag(fresh)
    for k in range(2, 5):
        prediction = model.predict(frame(k))
        model.update(frame(k), replace(measured(prediction.a_T_b, Verdict.REFUSED)))
        now = model.predict(frame(k + 1))
        np.testing.assert_allclose(now.a_T_b, step, atol=1e-12)
        assert (np.diag(now.covariance) > before).all()
        before = np.diag(now.covariance)
    model.update(frame(5), measured(step))
    np.testing.assert_array_equal(model.predict(frame(6)).covariance, fresh)


def test_wheels_need_no_motion_before():
    model = MotionModel(MOUNT)
    prediction = model.predict(frame(0, (0.2, 0.0, 0.0)))
    assert np.sqrt(np.diag(prediction.covariance))[3:].max() < 0.2
