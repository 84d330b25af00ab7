"""The disparity check in a run: measured keyframes of points, and rendered images."""

import numpy as np
import pytest
from synthetic import CAMERA, PointCloud, Scene, arc, rover_T_camera, sequence

from frontends.disparity_check import DisparityCheckConfig
from frontends.errors import EstimationError
from frontends.geometry import inverse, se3_exp
from frontends.measurements import RelativePose, UnusableFrame, Verdict
from frontends.relative import RelativePositioning
from lunar_fg.config import Config
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.navigator import Navigator
from lunar_fg.self_calibration import SelfCalibration

MOUNT = rover_T_camera()
STEP = se3_exp([0.0, 0.012, 0.0, 0.0, 0.0, 0.12])
FIELD = np.array([1.0, 0.0, 0.0])


def keyframes(error=FIELD, count=10, seed=0, gap=()):
    """Keyframes of noisy points; `gap`: those without images."""
    rng = np.random.default_rng((8, seed))
    points = PointCloud.ahead(seed, count=220)
    result, map_T_camera = [], np.eye(4)
    for k in range(count):
        seen = None if k in gap else points.observe(map_T_camera, rng, error)
        hit = k > 0 and seen is not None and k - 1 not in gap
        relative = RelativePose(
            STEP,
            1e-4 * np.eye(6),
            seen.landmark_id if hit else np.zeros(0, np.int64),
            100,
            Verdict.ACCEPTED if hit else Verdict.REFUSED,
            "" if hit else "made so",
        )
        result.append(Keyframe(k, float(k), seen, relative if k else None))
        map_T_camera = map_T_camera @ STEP
    return result


def calibration(frames=6, mode="apply"):
    return SelfCalibration(CAMERA, DisparityCheckConfig(mode=mode, frames=frames), 0.25)


def test_a_small_constant_is_applied_once_when_enough_came():
    held = calibration()
    told = []
    for keyframe in keyframes(np.array([0.1, 1.5, 0.0])):
        told.append(held.watch(keyframe))
        if told[-1]:
            held.adopted(held.corrected(held.correction_px, RelativePositioning(CAMERA)))
    assert told == [k == 6 for k in range(10)]
    assert held.finding.field_px[1] == pytest.approx(1.5, abs=0.4)
    assert not held.watching
    assert not held.conclude()


@pytest.mark.parametrize("at_the_end", [False, True])
def test_a_large_error_is_looked_at_once_more(at_the_end):
    """The tracks of the first look hid a part of it."""
    held = calibration()
    first = keyframes()[:7]
    assert [held.watch(keyframe) for keyframe in first] == [False] * 6 + [True]
    found = held.finding.field_px[0]
    held.adopted(held.corrected(held.correction_px, RelativePositioning(CAMERA)))
    assert held.watching
    assert held.watched_from == 7
    left = keyframes(np.array([0.3, 0.0, 0.0]), seed=1, count=5 if at_the_end else 7)
    told = [held.watch(keyframe) for keyframe in left]
    if at_the_end:
        assert not any(told)
        assert held.conclude()
    else:
        assert told == [False] * 6 + [True]
    assert held.correction_px[0] == pytest.approx(0.3, abs=0.1)
    assert held.finding.field_px[0] == pytest.approx(found + held.correction_px[0])
    assert held.finding.significant
    held.adopted(held.corrected(held.correction_px, RelativePositioning(CAMERA)))
    assert not held.watching
    assert not held.conclude()


def test_a_second_look_goes_on_where_it_was():
    held, later = calibration(), calibration()
    for keyframe in keyframes()[:7]:
        held.watch(keyframe)
    first = held.finding
    corrected = held.corrected(held.correction_px, RelativePositioning(CAMERA))
    held.adopted(corrected)
    rest = keyframes(np.array([0.3, 0.0, 0.0]), seed=1, count=7)
    assert not any(held.watch(keyframe) for keyframe in rest[:4])
    assert not later.resume(first, held.watched_from, [*corrected, *rest[:4]])
    assert [held.watch(k) for k in rest[4:]] == [later.watch(k) for k in rest[4:]]
    assert held.correction_px.tobytes() == later.correction_px.tobytes()
    assert held.finding.field_px.tobytes() == later.finding.field_px.tobytes()


def test_a_short_run_is_judged_at_its_end():
    held = calibration(frames=30)
    assert not any(held.watch(keyframe) for keyframe in keyframes())
    assert held.conclude()
    assert not held.conclude()


def test_nothing_to_find():
    held = calibration()
    assert not any(held.watch(keyframe) for keyframe in keyframes(np.zeros(3)))
    assert held.finding is not None
    assert not held.finding.significant
    assert not held.conclude()


def test_report_only_reports():
    held = calibration(mode="report")
    assert not any(held.watch(keyframe) for keyframe in keyframes())
    assert held.finding.significant
    assert not held.conclude()


def test_off_does_not_look():
    held = calibration(mode="off")
    assert not any(held.watch(keyframe) for keyframe in keyframes())
    assert not held.conclude()
    assert held.finding is None


@pytest.mark.parametrize("count", [0, 1])
def test_no_motion_to_judge(count):
    held = calibration()
    assert not any(held.watch(keyframe) for keyframe in keyframes(count=count))
    assert not held.conclude()
    assert held.finding is None


def test_corrected_keyframes_hold_true_disparities_and_motions():
    held = calibration()
    given = keyframes()[:7]
    for keyframe in given:
        held.watch(keyframe)
    corrected = held.corrected(FIELD, RelativePositioning(CAMERA))
    assert [k.index for k in corrected] == [k.index for k in given]
    assert corrected[0].relative is None
    for before, after in zip(given[1:], corrected[1:], strict=True):
        shift = before.observations.disparity_px - 1.0
        kept = np.isin(before.observations.landmark_id, after.observations.landmark_id)
        np.testing.assert_allclose(after.observations.disparity_px, shift[kept], atol=1e-9)
        assert after.relative.accepted, after.relative.reason
        error = inverse(after.relative.a_T_b) @ STEP
        assert np.linalg.norm(error[:3, 3]) < 0.02
    # what was given stays as it was
    assert given[1].relative.covariance[0, 0] == 1e-4


def test_a_gap_stays_a_gap():
    held = calibration()
    for keyframe in keyframes(gap=(3,)):
        if held.watch(keyframe):
            break
    corrected = held.corrected(FIELD, RelativePositioning(CAMERA))
    assert corrected[3].observations is None
    assert not corrected[3].relative.accepted
    assert not corrected[4].relative.accepted
    assert corrected[5].relative.accepted


def run(images, **check):
    navigator = Navigator(CAMERA, Config(disparity_check=DisparityCheckConfig(**check)), MOUNT)
    estimates = [navigator.step(frame) for frame in images]
    navigator.finish()
    return navigator, estimates


def scale_of(navigator, poses):
    found = navigator.trajectory().map_T_rover[:, :3, 3]
    return np.linalg.norm(found[-1] - found[0]) / np.linalg.norm(poses[-1, :3, 3])


POSES = arc(16, step_m=0.1)


@pytest.fixture(scope="module")
def frames():
    """A drive whose disparities are all 2 px too large: everything looks too near."""
    return sequence(POSES, Scene(disparity_px=2.0))


def test_the_drive_is_measured_right_after_the_check(frames):
    off, _ = run(frames, mode="off")
    assert scale_of(off, POSES) < 0.93  # what there is to repair
    for count in (8, 100):  # within the run, and at its end
        navigator, estimates = run(frames, frames=count)
        assert scale_of(navigator, POSES) == pytest.approx(1.0, abs=0.03)
        assert len(navigator.trajectory()) == len(frames) == len(navigator.reports)
        assert navigator.frames_lost == 0
        told = [text for text in navigator.warnings if "disparity" in text]
        assert len(told) == 1
        assert "not removed" not in told[0]
        assert "removed" in told[0]
        assert [e.index for e in estimates] == list(range(len(frames)))


def test_report_says_so_and_leaves_the_drive_alone(frames):
    navigator, _ = run(frames[:12], mode="report", frames=8)
    plain, _ = run(frames[:12], mode="off")
    assert any("not removed" in text for text in navigator.warnings)
    np.testing.assert_array_equal(
        navigator.trajectory().map_T_rover, plain.trajectory().map_T_rover
    )


def test_a_clean_drive_is_left_alone():
    clean = sequence(POSES[:12])
    navigator, _ = run(clean, frames=8)
    plain, _ = run(clean, mode="off")
    assert not any("disparity" in text for text in navigator.warnings)
    np.testing.assert_array_equal(
        navigator.trajectory().map_T_rover, plain.trajectory().map_T_rover
    )


def after_a_failed_correction(frames, monkeypatch):
    navigator = Navigator(CAMERA, Config(disparity_check=DisparityCheckConfig(frames=100)), MOUNT)
    for frame in frames[:8]:
        navigator.step(frame)

    def fail(self, keyframe):
        raise EstimationError("the graph refused the keyframe")

    with monkeypatch.context() as patch:
        patch.setattr(IncrementalSmoother, "add", fail)
        with pytest.raises(EstimationError):
            navigator.finish()
    return navigator


def test_a_failure_while_correcting_leaves_the_estimates(frames, monkeypatch):
    """The new graph replaces the old one when it is complete, not before."""
    navigator = after_a_failed_correction(frames, monkeypatch)
    assert len(navigator.trajectory()) == 8
    assert scale_of(navigator, POSES[:8]) < 0.95  # the old graph's, uncorrected


def test_what_was_not_removed_is_not_told_to_be(frames, monkeypatch):
    """Unless the correction is made up for, its text must not say that it was made."""
    navigator = after_a_failed_correction(frames, monkeypatch)
    navigator.finish()
    told = [text for text in navigator.warnings if "disparity" in text]
    right = scale_of(navigator, POSES[:8]) == pytest.approx(1.0, abs=0.03)
    assert right or not told or "not removed" in told[0]


def unusable(frame):
    return UnusableFrame(frame.index, frame.stamp_s, "images missing")


@pytest.mark.parametrize("lost", [(5,), (4, 8)])
@pytest.mark.parametrize("count", [6, 100])
def test_frames_lost_before_the_correction_stay_counted(frames, count, lost):
    images = [unusable(f) if f.index in lost else f for f in frames[:12]]
    navigator, estimates = run(images, frames=count)
    assert "; removed" in " ".join(navigator.warnings)
    assert navigator.frames_lost == len(lost)
    assert [e.index for e in estimates if e.lost] == list(lost)


def test_a_last_frame_that_is_lost_is_counted(frames):
    navigator, estimates = run([*frames[:10], unusable(frames[10])], frames=100)
    assert "; removed" in " ".join(navigator.warnings)
    assert estimates[-1].lost
    assert navigator.frames_lost == 1


def test_the_first_step_after_a_correction_at_a_gap_is_right(frames, monkeypatch):
    """Patience ends on a frame without images; the memory is older than that frame."""
    monkeypatch.setattr(SelfCalibration, "_PATIENCE", 1)
    navigator = Navigator(CAMERA, Config(disparity_check=DisparityCheckConfig(frames=9)), MOUNT)
    for frame in [*frames[:8], unusable(frames[8])]:
        navigator.step(frame)
    assert "; removed" in " ".join(navigator.warnings)
    estimate = navigator.step(frames[9])
    if not estimate.lost:
        truth = inverse(POSES[7]) @ POSES[9]
        found = navigator.trajectory().map_T_rover
        step = inverse(found[7]) @ found[9]
        assert np.linalg.norm(step[:3, 3] - truth[:3, 3]) < 0.02


def test_patience_ends_for_a_rover_that_stands():
    """Neither frames nor keyframes are held for ever."""
    held = calibration(frames=3)
    rng = np.random.default_rng(0)
    points = PointCloud.ahead(0, count=100)
    for k in range(40):
        assert not held.watch(Keyframe(k, float(k), points.observe(np.eye(4), rng)))
        assert len(held._keyframes) <= 30
    assert held._keyframes == []
    assert held.finding is None
    assert not held.conclude()


def test_keyframes_are_let_go_once_used():
    held = calibration()
    for keyframe in keyframes()[:7]:
        held.watch(keyframe)
    assert len(held.corrected(FIELD, RelativePositioning(CAMERA))) == 7
    assert len(held.corrected(FIELD, RelativePositioning(CAMERA))) == 7  # until they are in use
    held.adopted(keyframes()[:7])  # for a second look
    while held.watching:
        held.conclude()
    held.adopted(keyframes()[:7])
    assert held.corrected(FIELD, RelativePositioning(CAMERA)) == []


def test_corrected_keyframes_hold_no_point_beyond_the_range():
    held = SelfCalibration(CAMERA, DisparityCheckConfig(frames=6), 0.1)
    for keyframe in keyframes()[:7]:
        held.watch(keyframe)
    for keyframe in held.corrected(FIELD, RelativePositioning(CAMERA)):
        seen = keyframe.observations
        assert len(seen) > 30
        assert (np.sqrt(seen.points_covariance[:, 2, 2]) < 0.1 * seen.points_cam[:, 2]).all()
