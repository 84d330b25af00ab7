"""The two-view gate and the geometry below it."""

import numpy as np
import pytest
from scipy.stats import chi2

from frontends.geometry import inverse, se3_exp
from lunar_fg.graph import GraphConfig, kernels
from lunar_fg.graph.setup import Setup
from lunar_fg.graph.tracks import Sightings, TrackTable, homogeneous, lens
from lunar_fg.simulation.measurements import TraverseSpec, simulate


@pytest.fixture(scope="module")
def traverse():
    return simulate(TraverseSpec(keyframes=12, landmarks=300), seed=3)


def two_view_distance(camera, first, second, a_T_b, covariance):
    return kernels.distances(
        lens(camera), first.uuv, first.covariance, second.uuv, second.covariance,
        np.zeros(len(first), dtype=np.int64), inverse(a_T_b)[None], covariance[None],
    )  # fmt: skip


def test_homogeneous_points_project_back(traverse):
    camera = traverse.camera
    uuv = np.array([[300.0, 280.0, 100.0], [10.0, 9.9, 470.0]])
    points = homogeneous(camera, uuv)
    np.testing.assert_allclose(camera.project(points[:, :3] / points[:, 3:]), uuv)


def test_poses_move_as_the_exponential_says():
    rng = np.random.default_rng(0)
    poses = np.stack([se3_exp(rng.normal(size=6)) for _ in range(5)])
    step = np.concatenate([rng.normal(size=6) * s for s in (0.0, 1e-9, 1e-5, 1e-3, 1.0)])
    expected = [pose @ se3_exp(step[6 * i : 6 * i + 6]) for i, pose in enumerate(poses)]
    np.testing.assert_allclose(kernels.moved(poses, step), np.stack(expected), atol=1e-13)


def test_inverse_of_a_positive_matrix_and_refusal_of_others():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(60, 60))
    matrix = root @ root.T + np.eye(60)
    positive, result = kernels.inverse_positive(matrix)
    assert positive
    np.testing.assert_allclose(result @ matrix, np.eye(60), atol=1e-9)
    for bad in (-np.eye(3), np.zeros((3, 3)), np.ones((3, 3))):
        assert not kernels.inverse_positive(bad)[0]


def shared(first, second):
    _, a, b = np.intersect1d(first.landmark, second.landmark, return_indices=True)
    return first.take(a), second.take(b)


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_step_of_the_normal_equations(damping):
    rng = np.random.default_rng(2)
    root = rng.normal(size=(18, 18)) * np.geomspace(1.0, 1e3, 18)
    hessian, gradient = root.T @ root + np.eye(18), rng.normal(size=18)
    positive, step, square = kernels.step_of(hessian, gradient, damping)
    reduced = hessian[6:, 6:]
    expected = -np.linalg.solve(reduced + damping * np.diag(np.diag(reduced)), gradient[6:])
    assert positive
    np.testing.assert_array_equal(step[:6], 0.0)
    np.testing.assert_allclose(step[6:], expected, rtol=1e-6, atol=1e-12)
    assert square == pytest.approx(expected @ reduced @ expected, rel=1e-6)
    hessian[7] = hessian[:, 7] = 0.0
    assert not kernels.step_of(hessian, gradient, damping)[0]


def test_distance_is_chi_square_with_three_degrees(traverse):
    distances = []
    for a, b in zip(traverse.keyframes, traverse.keyframes[1:], strict=False):
        first, second = shared(Sightings.of(a.observations), Sightings.of(b.observations))
        motion = b.relative
        distances.append(
            two_view_distance(traverse.camera, first, second, motion.a_T_b, motion.covariance)
        )
    distances = np.concatenate(distances)
    # Sightings of one pair share the motion's error, so the band is wider than 1/sqrt(n).
    assert distances.mean() == pytest.approx(3.0, rel=0.15)
    assert np.mean(distances > chi2.ppf(0.99, 3)) < 0.03


def test_bad_sightings_are_cut_and_good_ones_pass():
    for share, low, high in ((0.0, 0.0, 0.01), (0.2, 0.15, 0.45)):
        traverse = simulate(TraverseSpec(keyframes=10, bad_share=share), seed=5)
        table = TrackTable(Setup.checked(traverse.camera, np.eye(4)))
        linked = cut = 0
        for k, keyframe in enumerate(traverse.keyframes):
            motion = keyframe.motion(traverse.rover_T_camera) if k else None
            tracked = table.add(Sightings.of(keyframe.observations), motion, 3)
            linked, cut = linked + tracked.linked, cut + tracked.cut
        assert low <= cut / (cut + linked) <= high


def test_too_few_links_cut_all(traverse):
    table = TrackTable(Setup.checked(traverse.camera, np.eye(4)))
    first, second = traverse.keyframes[:2]
    table.add(Sightings.of(first.observations), None, None)
    tracked = table.add(
        Sightings.of(second.observations), second.motion(traverse.rover_T_camera), 10_000
    )
    assert tracked.linked == 0
    assert tracked.cut > 100


def test_a_landmark_survives_a_gap_up_to_the_limit(traverse):
    keyframes = traverse.keyframes[:4]
    sightings = Sightings.of(keyframes[0].observations).take(np.arange(20))
    still = (np.eye(4), 1e-6 * np.eye(6))
    for max_gap, expected in ((3, 20), (2, 0)):
        table = TrackTable(
            Setup.checked(traverse.camera, np.eye(4), config=GraphConfig(max_track_gap=max_gap))
        )
        table.add(sightings, None, None)
        for _ in range(2):
            table.add(Sightings.of(None), still, 1)
        assert table.add(sightings, still, 1).linked == expected


def test_points_behind_the_second_camera_never_pass(traverse):
    sightings = Sightings.of(traverse.keyframes[0].observations)
    past = np.eye(4)
    past[2, 3] = 1000.0
    distance = two_view_distance(traverse.camera, sightings, sightings, past, np.eye(6))
    assert (distance > 1e20).all()


def test_non_positive_disparity_is_left_out(traverse):
    observations = traverse.keyframes[0].observations
    swapped = observations.__class__(
        observations.landmark_id, observations.u_right, observations.u_left, observations.v,
        observations.sigma_px, observations.sigma_disparity_px, observations.points_cam,
        observations.points_covariance,
    )  # fmt: skip
    assert len(Sightings.of(swapped)) == 0
