"""The motion between two views of a place that lie far apart in time."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from synthetic import CAMERA, Scene, rover_T_camera

from frontends.geometry import inverse, pose, se3_exp, se3_log, so3_exp
from frontends.relative import MotionPrediction, RelativeConfig
from frontends.revisit import Place, Revisiting
from frontends.stereo import StereoPerception

MOUNT = rover_T_camera(1.0, 0.6)
STRICT = RelativeConfig(false_alarms=1e-6)
#: Where the later views are: beside, ahead and turned.
LATER = [
    pose(so3_exp([0.0, 0.0, yaw]), [x, y, 0.0])
    for x, y, yaw in ((0.0, 0.1, 0.0), (0.15, -0.1, 0.08), (-0.1, 0.2, -0.12), (0.05, 0.0, 0.2))
]
SIGMA_ROT, SIGMA_TRANS = 0.02, 0.15


def view(map_T_rover, index, scene=None):
    """Landmarks with ids."""
    perception = StereoPerception(CAMERA)
    features = perception.perceive((scene or Scene()).frame(map_T_rover @ MOUNT, index))
    return features.named(1000 * index + np.arange(len(features)))


@pytest.fixture(scope="module")
def old():
    return Place.of(0, view(np.eye(4), 0), 300)


def prediction(a_T_b, seed):
    covariance = np.diag([SIGMA_ROT**2] * 3 + [SIGMA_TRANS**2] * 3)
    off = np.random.default_rng((1, seed)).multivariate_normal(np.zeros(6), covariance)
    return MotionPrediction(a_T_b @ se3_exp(off), covariance)


def in_cameras(map_T_rover):
    return inverse(MOUNT) @ map_T_rover @ MOUNT


@pytest.fixture(scope="module", params=[Scene(), Scene(_grey=8.0)], ids=["as before", "fainter"])
def again(request, old):
    """Measured motions and the truth, some under less contrast than the old view had."""
    found = []
    for k, map_T_rover in enumerate(LATER):
        features = view(map_T_rover, k + 1, request.param)
        true = in_cameras(map_T_rover)
        measured = Revisiting(CAMERA, STRICT).measure(old, features, prediction(true, k))
        found.append((measured, true))
    return found


def test_a_place_is_recognised_from_beside(again):
    for measured, true in again:
        assert measured.accepted, measured.reason
        off = se3_log(inverse(measured.a_T_b) @ true)
        assert np.linalg.norm(off[3:]) < 0.2 * SIGMA_TRANS
        assert np.linalg.norm(off[:3]) < SIGMA_ROT


def test_its_covariance_holds_the_error(again):
    for measured, true in again:
        off = se3_log(inverse(measured.a_T_b) @ true)
        assert off @ np.linalg.solve(measured.covariance, off) < chi2.ppf(0.999, 6)


def test_an_unknown_place_is_refused(old):
    """Views of other ground, whatever the prediction says."""
    for k, x in enumerate(np.linspace(5.0, 11.0, 12)):
        features = view(pose(np.eye(3), [x, 3.0, 0.0]), 10 + k)
        measured = Revisiting(CAMERA, STRICT).measure(old, features, prediction(np.eye(4), k))
        assert not measured.accepted
        assert measured.reason


def test_far_landmarks_are_left_out():
    """They tell how the rover has turned, but not where it is."""
    features = view(np.eye(4), 0)
    place = Place.of(0, features, 10_000)
    depth = place.observations(CAMERA).points_cam[:, 2]
    seen = features.observations.points_cam[:, 2]
    assert depth.max() <= 3.0 * np.median(seen) + 1e-6
    assert len(place) == np.sum(seen <= 3.0 * np.median(seen))


def test_a_place_is_small_and_says_what_was_seen(old):
    features = view(np.eye(4), 0)
    observations = features.observations
    kept = old.observations(CAMERA)
    _, mine, theirs = np.intersect1d(
        kept.landmark_id, observations.landmark_id, return_indices=True
    )
    assert len(mine) == len(old) <= 300
    seen = observations.select(theirs)
    np.testing.assert_allclose(kept.points_cam[mine], seen.points_cam, rtol=1e-4)
    np.testing.assert_allclose(kept.sigma_px[mine], seen.sigma_px, rtol=1e-5)
    step = old.descriptors[mine] / 127.0 - features.descriptors[theirs]
    assert np.abs(step).max() <= 0.5 / 127.0 + 1e-6
    assert old.nbytes <= 100 * len(old)


def test_a_correction_of_disparities_reaches_the_place(old):
    observations = view(np.eye(4), 0).observations
    nearer = replace(observations, u_right=observations.u_right - 0.5)
    kept = nearer.select(np.arange(0, len(nearer), 2))
    corrected = old.corrected(kept)
    assert set(corrected.landmark_id) == set(old.landmark_id) & set(kept.landmark_id)
    row = {int(i): k for k, i in enumerate(old.landmark_id)}
    rows = [row[int(i)] for i in corrected.landmark_id]
    np.testing.assert_allclose(corrected.uvd[:, 2], old.uvd[rows, 2] + 0.5, atol=1e-4)
    np.testing.assert_array_equal(corrected.descriptors, old.descriptors[rows])
