"""The navigator on a rendered drive with exact truth."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from synthetic import CAMERA, Scene, arc, rover_T_camera, sequence

from frontends.disparity_check import DisparityCheckConfig
from frontends.errors import EstimationError, InputError, LunarFgError
from frontends.geometry import inverse, pose, se3_log, so3_exp
from frontends.measurements import (
    Attitude,
    StartPrior,
    StereoFrame,
    UnusableFrame,
    WheelOdometry,
)
from lunar_fg.config import Config
from lunar_fg.navigator import Navigator

MOUNT = rover_T_camera()
POSES = arc(24)
QUIET = Config(disparity_check=DisparityCheckConfig(mode="off"))


@pytest.fixture(scope="module")
def frames():
    return sequence(POSES)


def navigate(frames, config=QUIET, **kwargs):
    navigator = Navigator(CAMERA, config, MOUNT, **kwargs)
    estimates = [navigator.step(frame) for frame in frames]
    navigator.finish()
    return navigator, estimates


def position_error(poses, truth):
    return np.linalg.norm(np.asarray(poses)[:, :3, 3] - truth[: len(poses), :3, 3], axis=1)


def unusable(frame, reason="left image missing"):
    return UnusableFrame(frame.index, frame.stamp_s, reason, frame.odometry, frame.attitude)


def flat(frame):
    image = np.full_like(frame.left, 77)
    return replace(frame, left=image, right=image.copy())


@pytest.mark.parametrize("landmarks", ["segments", "full"])
def test_the_trajectory_is_the_driven_one(frames, landmarks):
    config = QUIET.model_copy(
        update={"graph": QUIET.graph.model_copy(update={"landmarks": landmarks})}
    )
    navigator, estimates = navigate(frames, config)
    trajectory = navigator.trajectory()
    distance = np.linalg.norm(np.diff(POSES[:, :3, 3], axis=0), axis=1).sum()
    assert position_error(trajectory.map_T_rover, POSES).max() < 0.02 * distance
    assert position_error([e.map_T_rover for e in estimates], POSES).max() < 0.03 * distance
    turn = se3_log(inverse(trajectory.map_T_rover[-1]) @ POSES[-1])[:3]
    assert np.linalg.norm(turn) < 0.02
    assert navigator.frames_lost == 0
    assert navigator.frames_usable == len(frames) == len(navigator.reports)
    assert not any(e.lost for e in estimates)
    np.testing.assert_array_equal(trajectory.stamp_s, [f.stamp_s for f in frames])
    assert [e.index for e in estimates] == [f.index for f in frames]
    for covariance in trajectory.covariance:
        assert np.linalg.eigvalsh(covariance)[0] > 0.0
    # uncertainty grows with distance when nothing absolute comes in
    spread = [np.trace(c[3:, 3:]) for c in trajectory.covariance]
    assert spread[-1] > spread[5] > spread[0]


def test_the_start_decides_where_the_map_is(frames):
    start = StartPrior(arc(9, 1.0, 0.2)[-1], (0.01, 0.01, 0.05), (1.0, 1.0, 1.0))
    navigator, _ = navigate(frames[:6], start=start)
    moved, _ = navigate(frames[:6])
    np.testing.assert_allclose(
        navigator.trajectory().map_T_rover,
        start.map_T_rover @ moved.trajectory().map_T_rover,
        atol=1e-3,
    )


def test_the_same_frames_give_the_same_bytes(frames):
    first, _ = navigate(frames[:8], Config())
    second, _ = navigate(frames[:8], Config())
    assert first.trajectory().map_T_rover.tobytes() == second.trajectory().map_T_rover.tobytes()
    assert first.trajectory().covariance.tobytes() == second.trajectory().covariance.tobytes()


@pytest.mark.parametrize("spoil", [unusable, flat], ids=["unusable", "flat"])
def test_a_lost_frame_is_counted_and_the_run_goes_on(frames, spoil):
    run = [*frames[:8], spoil(frames[8]), *frames[9:]]
    navigator, estimates = navigate(run)
    plain, _ = navigate(frames)
    assert navigator.frames_lost == 1
    assert [e.lost for e in estimates] == [k == 8 for k in range(len(run))]
    assert len(navigator.trajectory()) == len(frames)
    assert navigator.frames_usable == len(frames) - 1
    distance = np.linalg.norm(np.diff(POSES[:, :3, 3], axis=0), axis=1).sum()
    found = navigator.trajectory().map_T_rover
    assert position_error(found, POSES).max() < 0.03 * distance
    assert position_error(plain.trajectory().map_T_rover, POSES).max() < 0.02 * distance
    assert any("relative pose" in reason for reason in estimates[8].refused)
    reason = "missing" if spoil is unusable else "blank"
    assert any("frame 8" in text and reason in text for text in navigator.warnings)
    # the lost pose says that it is only predicted
    sigma = [np.sqrt(np.trace(e.covariance[3:, 3:])) for e in estimates]
    assert sigma[8] > 2.0 * sigma[7]


def test_estimates_that_were_given_do_not_change(frames):
    navigator = Navigator(CAMERA, QUIET, MOUNT)
    given, bytes_then = [], []
    for frame in [*frames[:6], unusable(frames[6]), *frames[7:12]]:
        estimate = navigator.step(frame)
        given.append(estimate)
        bytes_then.append(estimate.map_T_rover.tobytes() + estimate.covariance.tobytes())
    navigator.finish()
    now = [e.map_T_rover.tobytes() + e.covariance.tobytes() for e in given]
    assert now == bytes_then


def test_the_first_frames_may_be_unusable(frames):
    run = [unusable(frames[0]), flat(frames[1]), *frames[2:8]]
    navigator, estimates = navigate(run)
    assert len(navigator.trajectory()) == 8
    # frames 0 and 1 saw nothing, frame 2 has nothing to compare with
    assert [e.lost for e in estimates[2:]] == [True] + [False] * 5
    step = se3_log(inverse(navigator.trajectory().map_T_rover[-1]) @ POSES[7])
    assert np.linalg.norm(step[:3]) < 0.1


def test_a_motion_that_was_never_seen_is_not_claimed_to_be_known():
    """Half a metre a frame, first frame unusable: NEES of the lost pose says what is claimed."""
    fast = sequence(arc(2, step_m=0.5))
    _, estimates = navigate([unusable(fast[0]), fast[1]])
    sigma = np.sqrt(np.diag(estimates[1].covariance)[3])
    assert 3.0 * sigma > 0.5


def test_all_frames_unusable(frames):
    navigator, estimates = navigate([unusable(frame) for frame in frames[:4]])
    assert navigator.frames_usable == 0
    assert len(navigator.trajectory()) == 4
    assert all(e.lost for e in estimates[1:])
    assert [w for w in navigator.warnings if "missing" in w] == [
        "frames 0 to 3: left image missing"
    ]


def test_no_frame_is_a_named_error():
    navigator = Navigator(CAMERA)
    with pytest.raises(LunarFgError, match="empty"):
        navigator.trajectory()
    navigator.finish()
    with pytest.raises(EstimationError):
        navigator.trajectory()
    assert navigator.reports == []
    assert navigator.frames_usable == navigator.frames_lost == 0
    assert navigator.warnings == ()


def test_a_single_frame(frames):
    navigator, estimates = navigate(frames[:1], Config())
    np.testing.assert_allclose(navigator.trajectory().map_T_rover[0], np.eye(4), atol=1e-9)
    assert not estimates[0].lost
    assert navigator.frames_lost == 0


def test_finish_twice_is_finish_once(frames):
    navigator, _ = navigate(frames[:4])
    before = navigator.trajectory().map_T_rover
    navigator.finish()
    np.testing.assert_allclose(navigator.trajectory().map_T_rover, before, atol=1e-9)


BAD_ORDER = {
    "repeated index": lambda f: replace(f, index=3),
    "index back": lambda f: replace(f, index=1),
    "repeated stamp": lambda f: replace(f, stamp_s=1.5),
    "stamp back": lambda f: replace(f, stamp_s=0.2),
    "stamp nan": lambda f: replace(f, stamp_s=float("nan")),
    "too wide": lambda f: replace(f, left=np.zeros((240, 400), np.uint8)),
}


@pytest.mark.parametrize("spoil", BAD_ORDER.values(), ids=BAD_ORDER)
def test_a_frame_that_does_not_follow_is_an_error_and_nothing_is_lost(frames, spoil):
    navigator = Navigator(CAMERA, QUIET, MOUNT)
    for frame in frames[:4]:
        navigator.step(frame)
    before = navigator.trajectory()
    with pytest.raises(InputError) as caught:
        navigator.step(spoil(frames[4]))
    assert "\n" not in str(caught.value)
    after = navigator.trajectory()
    assert after.map_T_rover.tobytes() == before.map_T_rover.tobytes()
    navigator.finish()
    assert len(navigator.trajectory()) == 4


@pytest.mark.parametrize("spoil", BAD_ORDER.values(), ids=BAD_ORDER)
def test_after_a_refused_frame_the_run_is_as_if_it_had_not_come(frames, spoil):
    plain, _ = navigate([*frames[:4], *frames[6:10]])
    navigator = Navigator(CAMERA, QUIET, MOUNT)
    for frame in frames[:4]:
        navigator.step(frame)
    with pytest.raises(InputError):
        navigator.step(spoil(frames[5]))
    for frame in frames[6:10]:
        navigator.step(frame)
    navigator.finish()
    assert len(navigator.reports) == len(navigator.trajectory())
    np.testing.assert_array_equal(
        navigator.trajectory().map_T_rover, plain.trajectory().map_T_rover
    )


def test_times_are_one_a_frame_also_after_a_refused_frame(frames):
    navigator = Navigator(CAMERA, QUIET, MOUNT)
    navigator.step(frames[0])
    with pytest.raises(InputError):
        navigator.step(BAD_ORDER["too wide"](frames[1]))
    navigator.step(frames[1])
    navigator.finish()
    times = navigator.stopwatch.milliseconds()
    assert {len(column) for column in times.values()} == {len(navigator.reports)}


def test_times_by_stage(frames):
    navigator, _ = navigate(frames[:3])
    times = navigator.stopwatch.milliseconds()
    assert {"total", "stereo", "tracking", "relative pose", "graph"} <= set(times)
    assert all(len(column) == 3 for column in times.values())
    assert np.isfinite(times["total"]).all()
    parts = sum(np.nan_to_num(times[s]) for s in ("stereo", "tracking", "relative pose", "graph"))
    assert (parts <= np.array(times["total"])).all()


def test_a_frame_of_another_camera_is_refused(frames):
    navigator = Navigator(CAMERA, QUIET, MOUNT)
    other = replace(CAMERA, baseline_m=2.0 * CAMERA.baseline_m)
    with pytest.raises(InputError):
        navigator.step(replace(frames[0], camera=other))


@pytest.mark.parametrize("seed", [-1, 0.5, "many", None])
def test_a_seed_that_is_none_is_refused_with_the_settings(seed):
    with pytest.raises((ValidationError, LunarFgError), match="seed"):
        Config(seed=seed)


def test_the_vertical_offset_is_told(frames):
    tilted = sequence(POSES[:3], Scene(vertical_px=-3.15))
    navigator, _ = navigate(tilted)
    assert any("vertically" in text and "-3.1" in text for text in navigator.warnings)
    plain, _ = navigate(frames[:3])
    assert not any("vertically" in text for text in plain.warnings)


def with_wheels(frames, poses):
    result = [frames[0]]
    for k in range(1, len(frames)):
        step = inverse(poses[k - 1]) @ poses[k]
        yaw = float(np.arctan2(step[1, 0], step[0, 0]))
        chord = np.linalg.norm(step[:2, 3])
        result.append(replace(frames[k], odometry=WheelOdometry(float(chord), 0.0, yaw)))
    return result


def test_wheels_carry_a_gap_without_images(frames):
    wheels = with_wheels(frames, POSES)
    run = [*wheels[:6], *(unusable(frame) for frame in wheels[6:14]), *wheels[14:18]]
    navigator, _ = navigate(run)
    assert position_error(navigator.trajectory().map_T_rover, POSES)[-1] < 0.05
    assert navigator.frames_usable == 10


def test_images_outweigh_slipping_wheels(frames):
    slipping = [
        replace(f, odometry=replace(f.odometry, d_forward_m=1.25 * f.odometry.d_forward_m))
        if f.odometry
        else f
        for f in with_wheels(frames[:14], POSES)
    ]
    navigator, _ = navigate(slipping)
    driven = 13 * 0.08
    assert position_error(navigator.trajectory().map_T_rover, POSES)[-1] < 0.05 * driven


def test_any_frame_may_come_as_plain_arrays(frames):
    """A user's own reader: views and read-only arrays."""
    left, right = frames[0].left.copy(), frames[0].right.copy()
    left.flags.writeable = right.flags.writeable = False
    wide = np.zeros((240, 640), np.uint8)
    wide[:, ::2] = right
    frame = StereoFrame(0, 0.0, left, wide[:, ::2], CAMERA)
    _, estimates = navigate([frame])
    assert len(estimates) == 1


@pytest.mark.parametrize("config", [QUIET, Config()], ids=["quiet", "checked"])
def test_a_run_may_go_on_after_its_end(frames, config):
    """`finish` holds nothing that a further frame needs: the run is as if it had not come."""
    navigator, _ = navigate(frames[:6], config)
    estimates = [navigator.step(frame) for frame in frames[6:12]]
    navigator.finish()
    assert not any(estimate.lost for estimate in estimates)
    assert len(navigator.trajectory()) == len(navigator.reports) == 12
    plain, _ = navigate(frames[:12], config)
    found, expected = navigator.trajectory().map_T_rover, plain.trajectory().map_T_rover
    assert np.linalg.norm(found[:, :3, 3] - expected[:, :3, 3], axis=1).max() < 0.01
    assert position_error(found, POSES).max() < 0.03 * 11 * 0.08


def test_waiting_for_the_first_motion_does_not_fill_the_memory(frames):
    navigator = Navigator(CAMERA, Config(), MOUNT)
    for k in range(40):
        navigator.step(replace(frames[0], index=k, stamp_s=float(k)))
    check = navigator._calibration._check
    assert len(check._frames) < 35


LEVEL = Attitude(0.0, 0.0, 0.0, 0.005, 0.05)
NAN = float("nan")
NO_MEASUREMENT = {
    "wheels nan": lambda f: replace(f, odometry=WheelOdometry(NAN, 0.0, 0.0)),
    "wheels infinite": lambda f: replace(f, odometry=WheelOdometry(0.1, 0.0, float("inf"))),
    "attitude nan": lambda f: replace(f, attitude=replace(LEVEL, pitch_rad=NAN)),
    "attitude sigma 0": lambda f: replace(f, attitude=replace(LEVEL, sigma_rp_rad=0.0)),
    "attitude sigma nan": lambda f: replace(f, attitude=replace(LEVEL, sigma_rp_rad=NAN)),
}


@pytest.mark.parametrize("spoil", NO_MEASUREMENT.values(), ids=NO_MEASUREMENT)
def test_after_a_measurement_that_is_no_number_the_run_goes_on(frames, spoil):
    """As for a frame out of order. NaN from the wheels stopped all frames that followed."""
    navigator = Navigator(CAMERA, QUIET, MOUNT)
    for frame in frames[:4]:
        navigator.step(frame)
    with pytest.raises(InputError) as caught:
        navigator.step(spoil(frames[4]))
    assert "frame 4" in str(caught.value)
    for frame in frames[5:8]:
        navigator.step(frame)
    navigator.finish()
    assert len(navigator.reports) == len(navigator.trajectory())
    plain, _ = navigate([*frames[:4], *frames[5:8]])
    np.testing.assert_array_equal(
        navigator.trajectory().map_T_rover, plain.trajectory().map_T_rover
    )


@pytest.mark.parametrize(
    ("group", "name"),
    [
        ("stereo", "hessian_threshold"),
        ("stereo", "localisation_sigma"),
        ("tracking", "surface_slope"),
        ("disparity_check", "floor_px"),
    ],
)
def test_infinite_settings_are_refused_with_the_settings(group, name):
    with pytest.raises(ValidationError, match=name):
        Config.model_validate({group: {name: float("inf")}})


def test_a_bump_that_no_prediction_foresees_is_seen():
    """Without attitude the rover pitches by 12 degrees from one frame to the next and back."""
    poses = arc(14)
    bump = pose(so3_exp([0.0, 0.21, 0.0]), [0.0, 0.0, 0.05])
    for k in (6, 9):
        poses[k] = poses[k] @ bump
    navigator, estimates = navigate(sequence(poses))
    assert not any(estimate.lost for estimate in estimates)
    assert position_error(navigator.trajectory().map_T_rover, poses).max() < 0.05
