"""Landmark ids over frames: rendered sequences and made-up features."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import CAMERA, Scene, arc, rover_T_camera, sequence

from frontends.geometry import inverse, se3_exp, transform_points
from frontends.measurements import RelativePose, Verdict
from frontends.rectification import observe
from frontends.relative import MotionPrediction
from frontends.stereo import StereoPerception
from frontends.stereo_features import StereoFeatures
from frontends.templates import Templates
from frontends.tracking import LandmarkTracker, Reach, TrackingConfig
from frontends.tracks import common_landmarks

NOTHING = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
NO_MOTION = MotionPrediction(np.eye(4), 1e-4 * np.eye(6))


def unit_rows(n, seed):
    rows = np.random.default_rng(seed).standard_normal((n, 64)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


DESCRIPTORS = unit_rows(400, 0)
PLACES = np.random.default_rng(1).uniform([20, 20, 4], [300, 220, 20], (400, 3))


def features(which, shift=(0.0, 0.0)):
    """Features of the made-up world's points `which`, moved in the image."""
    which = np.asarray(which, dtype=int)
    u, v, disparity = PLACES[which].T
    sigma = np.full(len(which), 0.2)
    return StereoFeatures(
        observe(CAMERA, np.full(len(which), -1), u + shift[0], v + shift[1], disparity, sigma,
                sigma),
        DESCRIPTORS[which],
        np.ones(len(which), np.int8),
        np.full(len(which), 15.0),
        (len(which), len(which)),
        len(which),
        len(which),
        0.1,
        np.zeros((len(which), 2)),
        Templates.cut(NOTHING, np.stack([u, v], axis=-1)),
        NOTHING,
    )  # fmt: skip


def accept(tracks, keep=slice(None), prediction=NO_MOTION):
    ids = tracks.observations_b.landmark_id[keep]
    return RelativePose(prediction.a_T_b, prediction.covariance, ids, len(tracks),
                        Verdict.ACCEPTED)  # fmt: skip


def step(tracker, found, prediction=NO_MOTION, keep=slice(None), reach=Reach.NEAR):
    tracks = tracker.associate(found, prediction, reach)
    return tracks, tracker.commit(found, tracks, accept(tracks, keep, prediction))


def test_ids_stay_with_the_landmark_and_new_ones_are_new():
    tracker = LandmarkTracker(CAMERA)
    _, first = step(tracker, features(range(100)))
    tracks, second = step(tracker, features(np.r_[99:39:-1, 200:230]))
    assert sorted(first.landmark_id) == list(range(100))
    assert len(tracks) == 60
    np.testing.assert_array_equal(second.landmark_id[:60], first.landmark_id[99:39:-1])
    assert (second.landmark_id[60:] >= 100).all()
    a, b = common_landmarks(first, second)
    assert len(a) == 60
    np.testing.assert_array_equal(a.landmark_id, b.landmark_id)
    np.testing.assert_allclose(a.u_left, b.u_left)


def test_tracks_that_disagree_with_the_motion_become_new_landmarks():
    tracker = LandmarkTracker(CAMERA)
    _, first = step(tracker, features(range(50)))
    _, second = step(tracker, features(range(50)), keep=slice(0, 30))
    shared = np.isin(second.landmark_id, first.landmark_id)
    assert shared.sum() == 30
    assert len(np.unique(second.landmark_id)) == 50


@pytest.mark.parametrize("max_unseen", [0, 1, 2, 5])
def test_a_landmark_comes_back_after_the_gap_it_is_allowed_and_not_later(max_unseen):
    for gap in range(max_unseen + 3):
        tracker = LandmarkTracker(CAMERA, TrackingConfig(max_unseen=max_unseen))
        _, first = step(tracker, features(range(40)))
        for k in range(gap):
            step(tracker, features(range(100 + 40 * k, 140 + 40 * k)))
        _, again = step(tracker, features(range(40)))
        back = np.isin(again.landmark_id, first.landmark_id).mean()
        assert back == (1.0 if gap <= max_unseen else 0.0), gap
        assert len(np.unique(again.landmark_id)) == 40


def test_skip_counts_as_a_frame_and_carries_the_points():
    ahead = MotionPrediction(se3_exp([0, 0, 0, 0, 0, 0.1]), 1e-4 * np.eye(6))
    missed = RelativePose(ahead.a_T_b, ahead.covariance, np.zeros(0, int), 0, Verdict.REFUSED)
    for skips, found_again in ((1, True), (2, True), (3, False)):
        tracker = LandmarkTracker(CAMERA)
        _, first = step(tracker, features(range(60)))
        for _ in range(skips):
            tracker.skip(missed)
        expected = se3_exp([0, 0, 0, 0, 0, 0.1 * skips])
        tracks = tracker.associate(features(range(60)), NO_MOTION, Reach.WIDE)
        assert (len(tracks) > 0) == found_again
        if found_again:
            row = tracks.observations_b.landmark_id
            before = first.points_cam[np.searchsorted(first.landmark_id, row)]
            np.testing.assert_allclose(
                tracks.points_a, before + inverse(expected)[:3, 3], atol=1e-9
            )


def test_skip_before_anything_was_seen():
    tracker = LandmarkTracker(CAMERA)
    tracker.skip(accept(tracker.associate(features([]), NO_MOTION)))
    tracks, observations = step(tracker, features(range(5)))
    assert len(tracks) == 0
    assert len(observations) == 5


def test_a_frame_without_features():
    tracker = LandmarkTracker(CAMERA)
    step(tracker, features(range(30)))
    tracks, observations = step(tracker, features([]))
    assert len(tracks) == len(observations) == 0
    tracks, _ = step(tracker, features(range(30)))
    assert len(tracks) == 30


def test_the_window_follows_the_prediction():
    half = TrackingConfig().search_fraction * CAMERA.width
    wide_half = TrackingConfig().wide_search_fraction * CAMERA.width
    for shift, narrow, wide in ((0.9 * half, True, True), (1.1 * half, False, True),
                                (1.1 * wide_half, False, False)):  # fmt: skip
        tracker = LandmarkTracker(CAMERA)
        step(tracker, features(range(100)))
        moved = features(range(100), (shift, 0.0))
        assert (len(tracker.associate(moved, NO_MOTION)) > 50) == narrow
        assert (len(tracker.associate(moved, NO_MOTION, Reach.WIDE)) > 50) == wide
        assert len(tracker.associate(moved, NO_MOTION, Reach.ANYWHERE)) > 50


def test_landmarks_behind_the_camera_are_not_looked_for():
    tracker = LandmarkTracker(CAMERA)
    step(tracker, features(range(100)))
    past = MotionPrediction(se3_exp([0, 0, 0, 0, 0, 1e3]), 1e-4 * np.eye(6))
    assert len(tracker.associate(features(range(100)), past, Reach.WIDE)) == 0


def test_memory_does_not_grow():
    tracker = LandmarkTracker(CAMERA, TrackingConfig(max_unseen=2))
    rng = np.random.default_rng(3)
    for _ in range(60):
        step(tracker, features(rng.choice(400, 50, replace=False)))
        assert len(tracker._memory) <= 3 * 50
        assert len(np.unique(tracker._memory.landmark_id)) == len(tracker._memory)


def test_replace_points_forgets_the_rest():
    tracker = LandmarkTracker(CAMERA)
    step(tracker, features(range(40)))
    _, newest = step(tracker, features(range(20, 60)))
    half = newest.select(np.arange(0, 40, 2))
    tracker.replace_points(replace(half, points_cam=2.0 * half.points_cam))
    tracks = tracker.associate(features(range(60)), NO_MOTION, Reach.WIDE)
    assert set(tracks.observations_b.landmark_id) <= set(half.landmark_id)
    order = np.searchsorted(half.landmark_id, tracks.observations_b.landmark_id)
    sorted_rows = np.argsort(half.landmark_id)[order]
    np.testing.assert_allclose(tracks.points_a, 2.0 * half.points_cam[sorted_rows])


def test_a_rendered_drive_keeps_its_landmarks():
    poses = arc(8)
    mount = rover_T_camera()
    perception, tracker = StereoPerception(CAMERA), LandmarkTracker(CAMERA)
    seen = []
    for k, frame in enumerate(sequence(poses)):
        a_T_b = np.eye(4) if k == 0 else inverse(mount) @ inverse(poses[k - 1]) @ poses[k] @ mount
        found = perception.perceive(frame)
        truth = MotionPrediction(a_T_b, 1e-6 * np.eye(6))
        tracks = tracker.associate(found, truth)
        if k:
            # the landmark's place in the world is what the id stands for
            error = tracks.observations_b.points_cam - (
                tracks.points_a @ inverse(a_T_b)[:3, :3].T + inverse(a_T_b)[:3, 3]
            )
            near = tracks.observations_b.points_cam[:, 2] < 4.0
            assert near.sum() > 50
            assert (np.linalg.norm(error[near], axis=1) < 0.4).mean() > 0.9
        observations = tracker.commit(found, tracks, accept(tracks, prediction=truth))
        assert len(np.unique(observations.landmark_id)) == len(observations)
        seen.append(observations)
    assert len(common_landmarks(seen[-2], seen[-1])[0]) > 0.4 * len(seen[-1])
    lives = np.unique(np.concatenate([o.landmark_id for o in seen]), return_counts=True)[1]
    assert (lives >= 6).sum() > 30


def test_sigmas_and_point_covariance_of_a_tracked_landmark_agree():
    tracker = LandmarkTracker(CAMERA)
    step(tracker, features(range(50)))
    nearer = features(range(50))
    shifted = replace(nearer, observations=observe(
        CAMERA, nearer.observations.landmark_id, nearer.observations.u_left,
        nearer.observations.v, 1.3 * nearer.observations.disparity_px,
        nearer.observations.sigma_px, nearer.observations.sigma_disparity_px,
    ))  # fmt: skip
    _, seen = step(tracker, shifted)
    expected = CAMERA.triangulation_covariance(
        seen.u_left, seen.v, seen.disparity_px, seen.sigma_px, seen.sigma_disparity_px
    )
    np.testing.assert_allclose(seen.points_covariance, expected, rtol=1e-6)


def approached(found, by):
    """The same features, `by` times nearer."""
    seen = found.observations
    return replace(found, observations=observe(
        CAMERA, seen.landmark_id, seen.u_left, seen.v, by * seen.disparity_px, seen.sigma_px,
        seen.sigma_disparity_px,
    ))  # fmt: skip


def test_noise_grows_with_the_approach_since_the_first_sighting():
    """A random walk: the variance is that of all steps together, whatever their number."""
    tracker, config = LandmarkTracker(CAMERA), TrackingConfig()
    _, first = step(tracker, features(range(50)))
    # the patch defines the landmark's point: its first detection errs by nothing
    np.testing.assert_array_equal(first.sigma_px, config.template_sigma_px)
    step(tracker, approached(features(range(50)), 1.2))
    _, seen = step(tracker, approached(features(range(50)), 1.5))
    walk = config.scale_change_sigma * 15.0
    expected = np.hypot(np.sqrt(2.0) * 0.2, walk * np.sqrt(np.log(1.5)))
    np.testing.assert_allclose(seen.sigma_px, expected, rtol=1e-6)


def driven(poses, follow):
    """Observations of a rendered drive, and how wrong its landmarks' places are, in sigmas.

    The true motions are given. A landmark is where its first sighting says, exactly: how far it
    goes astray after that is the tracking's error.
    """
    mount = rover_T_camera()
    perception, tracker = StereoPerception(CAMERA), LandmarkTracker(CAMERA)
    scene, first, errors = Scene(), {}, []
    for k, frame in enumerate(sequence(poses)):
        a_T_b = np.eye(4) if k == 0 else inverse(mount) @ inverse(poses[k - 1]) @ poses[k] @ mount
        found = perception.perceive(frame)
        truth = MotionPrediction(a_T_b, 1e-6 * np.eye(6))
        tracks = tracker.associate(found, truth)
        motion = accept(tracks, prediction=truth)
        if follow:
            tracks = tracker.follow(found, tracks, motion)
        held = tracks.observations_b
        camera = poses[k] @ mount
        for row, name in enumerate(held.landmark_id):
            u, _, v = CAMERA.project(transform_points(inverse(camera), first[name][None]))[0]
            off = np.hypot(held.u_left[row] - u, held.v[row] - v)
            errors.append((off, held.sigma_px[row], tracks.followed[row] or not follow))
        seen = tracker.commit(found, tracks, motion)
        depth = scene.depth(camera, seen.u_left, seen.v)
        points = CAMERA.triangulate(seen.u_left, seen.v, CAMERA.fx * CAMERA.baseline_m / depth)
        for name, point in zip(seen.landmark_id, transform_points(camera, points), strict=True):
            first.setdefault(name, point)
    return np.array(errors)


def test_landmarks_stay_where_their_patches_are():
    poses = arc(8)
    plain, followed = driven(poses, follow=False), driven(poses, follow=True)
    off, sigma, by_patch = followed.T
    by_patch = by_patch.astype(bool)
    assert by_patch.mean() > 0.5
    assert np.median(off[by_patch]) < 0.4 * np.median(plain[:, 0])
    # two axes: the median of a Rayleigh distribution is at 1.18 sigma
    assert 0.2 < np.median(off[by_patch] / sigma[by_patch]) < 1.4
    assert np.mean(off[by_patch] > 5.0 * sigma[by_patch]) < 0.05


def test_nothing_is_followed_without_a_motion_that_tracks_agree_with():
    tracker = LandmarkTracker(CAMERA)
    step(tracker, features(range(50)))
    found = features(range(50))
    tracks = tracker.associate(found, NO_MOTION)
    same = tracker.follow(found, tracks, accept(tracks, keep=slice(0, 0)))
    assert not same.followed.any()
    np.testing.assert_array_equal(same.observations_b.u_left, tracks.observations_b.u_left)
