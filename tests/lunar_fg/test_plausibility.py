"""Sensors that contradict the images are not believed."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import CAMERA, rover_T_camera

from frontends.geometry import adjoint, inverse, pose, se3_exp, se3_log
from frontends.measurements import Odometry, RelativePose, StereoFrame, Tilt, Verdict
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.motion_config import MotionConfig
from lunar_fg.plausibility import (
    DeadCamera,
    Episodes,
    Plausibility,
    Refound,
    Richness,
    other_ground,
    was_carried,
)

MOUNT = rover_T_camera()
SIGMA = np.diag([1e-3, 1e-3, 1e-3, 2e-3, 2e-3, 2e-3]) ** 2
WHEELS = np.diag([2e-3, 2e-3, 5e-3, 0.01, 0.01, 0.01]) ** 2
STEP = pose(np.eye(3), [0.1, 0.0, 0.0])


def seen(rover_a_T_b, accepted=True):
    camera_T_rover = inverse(MOUNT)
    turn = adjoint(camera_T_rover)
    return RelativePose(
        camera_T_rover @ rover_a_T_b @ MOUNT,
        turn @ SIGMA @ turn.T,
        np.arange(50),
        60,
        Verdict.ACCEPTED if accepted else Verdict.REFUSED,
    )


def test_wheels_that_agree_stay_as_they_are():
    plausibility = Plausibility(MOUNT)
    rng = np.random.default_rng(0)
    for k in range(300):
        noisy = STEP @ se3_exp(np.sqrt(np.diag(WHEELS)) * rng.standard_normal(6))
        odometry = Odometry(noisy, WHEELS)
        assert plausibility.odometry(k, odometry, seen(STEP)) is odometry
    assert plausibility.warnings == ()


def test_slipping_wheels_get_the_uncertainty_of_their_slip():
    plausibility = Plausibility(MOUNT)
    spinning = Odometry(pose(np.eye(3), [0.4, 0.0, 0.0]), WHEELS)
    doubted = plausibility.odometry(7, spinning, seen(STEP))
    difference = se3_log(inverse(doubted.a_T_b) @ STEP)
    assert difference @ np.linalg.solve(doubted.covariance, difference) < 1.0
    assert plausibility.warnings == (
        "frame 7: wheels and images disagree on the motion: taken as wheel slip",
    )
    # nothing says that the wheels are wrong where the images say nothing
    assert plausibility.odometry(8, spinning, seen(STEP, accepted=False)) is spinning
    assert plausibility.warnings[0].startswith("frame 8: the images do not show the motion")


def test_a_rover_that_was_carried_may_be_anywhere():
    plausibility = Plausibility(MOUNT)
    wheels = Odometry(STEP, WHEELS)
    opened = plausibility.odometry(5, wheels, seen(STEP, accepted=False), carried=True)
    assert np.sqrt(opened.covariance[3, 3]) > 15.0
    assert np.sqrt(opened.covariance[2, 2]) > 0.9
    assert was_carried(Keyframe(5, 5.0, None, seen(STEP, accepted=False), opened), MotionConfig())
    assert "carried" in plausibility.warnings[0]
    # seen ground is not carried, whatever the wheels' own uncertainty
    assert not was_carried(Keyframe(6, 6.0, None, seen(STEP), opened), MotionConfig())
    assert not was_carried(Keyframe(7, 7.0, None, None, wheels), MotionConfig())


def test_other_ground_is_told_by_how_often_landmarks_are_found_again():
    often = Refound(300, 100)
    assert other_ground(often, Refound(300, 10))
    # too few landmarks to expect many of them again
    assert not other_ground(often, Refound(40, 5))
    # nor where few were found again just before, or nothing is known of that
    assert not other_ground(Refound(300, 30), Refound(300, 10))
    assert not other_ground(None, Refound(300, 0))
    assert not other_ground(Refound(0, 0), Refound(300, 0))


def test_poor_images_are_noticed_until_they_are_usual():
    richness = Richness()
    for frame, found in enumerate([100, 110, 95, 30, 28, 100, 104]):
        richness.see(frame, Refound(300, found))
    richness.see(7, None)  # not seen at all is told elsewhere
    assert len(richness.warnings) == 1
    assert richness.warnings[0].startswith("frames 3 to 4: far fewer landmarks")
    for frame in range(8, 200):
        richness.see(frame, Refound(300, 20))
    [_, lasting] = richness.warnings
    assert lasting.startswith("frames 8 to 57")
    for frame in range(200, 230):
        richness.see(frame, Refound(300, 150 if frame % 4 else 20))
    assert len(richness.warnings) == 6
    assert richness.warnings[-1].startswith("and ")


def test_one_rich_frame_does_not_make_those_after_it_poor():
    richness = Richness()
    for frame, found in enumerate([100, 95, 200, 100, 98, 104]):
        richness.see(frame, Refound(300, found))
    assert richness.warnings == ()


def test_wheels_that_spin_on_the_spot_are_told_of():
    plausibility = Plausibility(MOUNT)
    step = np.eye(4)
    step[0, 3] = 0.75
    spun = step.copy()
    spun[0, 3] = 1.46
    sigma = 0.1 * 1.46 / np.sqrt(np.tanh(0.5 * 1.46 / MotionConfig().slip_length_m))
    wheels = Odometry(spun, np.diag([0.1, 0.1, 0.02, sigma, sigma, sigma]) ** 2)
    opened = plausibility.odometry(3, wheels, seen(step))
    assert "slip" in plausibility.warnings[0]
    assert opened.covariance[3, 3] > wheels.covariance[3, 3] + 0.4
    sound = Odometry(step, wheels.covariance)
    assert Plausibility(MOUNT).odometry(3, sound, seen(step)) is sound


def test_counts_of_the_same_ground_raise_no_alarm():
    rng = np.random.default_rng(4)
    rates = rng.uniform(0.02, 0.5, 30_000)
    possible = rng.integers(20, 500, (2, len(rates)))
    found = rng.poisson(rates * possible)
    alarms = [
        other_ground(Refound(int(n1), int(k1)), Refound(int(n2), int(k2)))
        for n1, n2, k1, k2 in zip(*possible, *found, strict=True)
    ]
    assert np.mean(alarms) <= 1e-4  # 1e-5 is what is asked for


def tilts(truth, bias, rng):
    sigma = 2e-3
    angles = Rotation.from_matrix(truth[:3, :3]).as_euler("ZYX")
    noise = sigma * rng.standard_normal(2)
    return Tilt(angles[2] + bias + noise[0], angles[1] + bias + noise[1], sigma)


def test_an_inclinometer_that_jumps_is_left_out_until_it_comes_back():
    plausibility, rng = Plausibility(MOUNT), np.random.default_rng(1)
    truth = np.eye(4)
    believed = []
    for k in range(60):
        step = pose(Rotation.from_rotvec([0.02, -0.01, 0.05]).as_matrix(), [0.1, 0, 0])
        truth = truth @ step
        tilt = tilts(truth, 0.05 if 20 <= k < 40 else 0.0, rng)
        believed.append(plausibility.tilt(k, tilt, seen(step)) is not None)
    assert believed == [not 20 <= k < 40 for k in range(60)]
    assert plausibility.warnings == (
        "frames 20 to 39: the attitude jumped and the images did not: roll and pitch left out",
    )


def test_after_lost_vision_a_new_tilt_is_believed():
    plausibility, rng = Plausibility(MOUNT), np.random.default_rng(2)
    assert plausibility.tilt(0, tilts(np.eye(4), 0.0, rng), seen(STEP)) is not None
    assert plausibility.tilt(1, None, seen(STEP, accepted=False)) is None
    assert plausibility.tilt(2, tilts(np.eye(4), 0.3, rng), seen(STEP)) is not None


def frame(index, left, right):
    return StereoFrame(index, float(index), left, right, CAMERA)


@pytest.mark.parametrize("eye", ["left", "right"])
def test_dead_cameras(eye):
    rng = np.random.default_rng(3)
    images = [rng.integers(0, 255, (240, 320), dtype=np.uint8) for _ in range(4)]
    blank = np.zeros((240, 320), np.uint8)
    camera = DeadCamera()
    assert camera.found(frame(0, images[0], images[1])) == ""
    camera.remember()
    repeated = (images[0], images[2]) if eye == "left" else (images[2], images[1])
    assert camera.found(frame(1, *repeated)) == f"the {eye} image is that of the frame before"
    dead = (blank, images[3]) if eye == "left" else (images[3], blank)
    assert camera.found(frame(2, *dead)) == f"the {eye} image is blank"


def test_episodes_read_as_spans():
    episodes = Episodes("dust")
    for k in (3, 4, 6, 20):
        episodes.note(k)
    assert episodes.sentences() == ("frames 3 to 6: dust", "frame 20: dust")


def test_readings_with_one_bias_do_not_average_out():
    plausibility = Plausibility(MOUNT)
    drift = float(np.linalg.eigvalsh(SIGMA[:3, :3])[-1])
    known = np.inf
    for k in range(300):
        reading = plausibility.tilt(k, Tilt(0.0, 0.0, 0.003), seen(STEP))
        known = 1.0 / (1.0 / (known + drift) + 1.0 / reading.sigma_rad**2)
        assert known == pytest.approx(0.003**2, rel=1e-6), k
