"""The vocabulary: covariances that go with pixels and motions."""

import numpy as np
import pytest
from synthetic import rover_T_camera

from frontends.camera import StereoCamera
from frontends.geometry import inverse, se3_exp, se3_log
from frontends.measurements import RelativePose, StartPrior, Verdict
from frontends.rectification import observe

CAMERA = StereoCamera(320, 240, 240.0, 240.0, 160.0, 120.0, 0.12)


def observations(n=5, seed=0):
    rng = np.random.default_rng(seed)
    return observe(
        CAMERA,
        np.arange(n, dtype=np.int64),
        rng.uniform(0, 320, n),
        rng.uniform(0, 240, n),
        rng.uniform(2, 30, n),
        rng.uniform(0.1, 2.0, n),
        rng.uniform(0.05, 1.0, n),
    )


def test_pixel_covariance_is_positive_and_that_of_samples():
    seen = observations()
    covariance = seen.pixel_covariance()
    assert (np.linalg.eigvalsh(covariance) > 0.0).all()
    rng = np.random.default_rng(1)
    for k in range(len(seen)):
        noise = rng.standard_normal((200_000, 3))
        du, dv = noise[:, 0] * seen.sigma_px[k], noise[:, 1] * seen.sigma_px[k]
        d_disparity = noise[:, 2] * seen.sigma_disparity_px[k]
        measured = np.cov(np.stack([du, du - d_disparity, dv]))
        np.testing.assert_allclose(covariance[k], measured, atol=0.02 * measured.max())


def test_pixel_covariance_and_point_covariance_say_the_same():
    seen = observations()
    step = 1e-5
    for k in range(len(seen)):
        pixel = np.array([seen.u_left[k], seen.u_right[k], seen.v[k]])

        def point(p):
            return CAMERA.triangulate(p[:1], p[2:], p[:1] - p[1:2])[0]

        jacobian = np.column_stack(
            [(point(pixel + step * e) - point(pixel - step * e)) / (2 * step) for e in np.eye(3)]
        )
        np.testing.assert_allclose(
            jacobian @ seen.pixel_covariance()[k] @ jacobian.T,
            seen.points_covariance[k],
            rtol=1e-4,
            atol=1e-9,
        )


def test_select_by_mask_and_by_index():
    seen = observations(6)
    index = np.array([1, 4])
    mask = np.isin(np.arange(6), index)
    by_index, by_mask = seen.select(index), seen.select(mask)
    assert by_index.landmark_id.tolist() == by_mask.landmark_id.tolist() == [1, 4]
    np.testing.assert_array_equal(by_index.points_cam, seen.points_cam[index])
    np.testing.assert_array_equal(by_index.disparity_px, seen.disparity_px[index])
    assert len(seen.select(np.zeros(6, bool))) == 0
    assert seen.select(np.zeros(0, dtype=np.int64)).pixel_covariance().shape == (0, 3, 3)


def test_motion_in_other_frames_carries_its_covariance():
    mount = rover_T_camera(1.2, 0.4)
    a_T_b = se3_exp([0.02, -0.1, 0.03, 0.1, -0.05, 0.9])
    rng = np.random.default_rng(2)
    root = 0.01 * rng.normal(size=(6, 6))
    motion = RelativePose(a_T_b, root @ root.T, np.arange(3), 9, Verdict.ACCEPTED, "as it was")
    moved = motion.in_frames(mount)
    samples = np.array(
        [
            se3_log(
                inverse(moved.a_T_b)
                @ (mount @ a_T_b @ se3_exp(root @ rng.standard_normal(6)) @ inverse(mount))
            )
            for _ in range(10_000)
        ]
    )
    measured = np.cov(samples.T)
    scale = np.sqrt(np.outer(np.diag(measured), np.diag(measured)))
    np.testing.assert_allclose(moved.covariance / scale, measured / scale, atol=0.05)
    np.testing.assert_allclose(moved.in_frames(inverse(mount)).a_T_b, a_T_b, atol=1e-12)
    assert (moved.correspondences, moved.verdict, moved.reason) == (9, "accepted", "as it was")


def test_a_forward_drive_of_the_camera_is_a_forward_drive_of_the_rover():
    forward = RelativePose(
        se3_exp([0, 0, 0, 0, 0, 0.5]), np.eye(6), np.zeros(0, int), 0, Verdict.ACCEPTED
    )
    moved = forward.in_frames(rover_T_camera(0.0, 0.0))
    np.testing.assert_allclose(moved.a_T_b[:3, 3], [0.5, 0.0, 0.0], atol=1e-12)


def test_start_prior_orders_rotation_before_translation():
    prior = StartPrior(np.eye(4), (1.0, 2.0, 3.0), (4.0, 5.0, 6.0))
    np.testing.assert_array_equal(np.diag(prior.covariance()), np.arange(1.0, 7.0) ** 2)


def test_measurements_are_frozen():
    seen = observations()
    with pytest.raises(AttributeError):
        seen.v = seen.u_left


def test_wrong_match_rate_is_the_share_that_disagrees():
    def motion(inliers, tried):
        return RelativePose(np.eye(4), np.eye(6), np.arange(inliers), tried, Verdict.ACCEPTED)

    assert motion(30, 40).wrong_match_rate == pytest.approx(0.25)
    assert motion(0, 7).wrong_match_rate == 1.0
    assert motion(7, 7).wrong_match_rate == 0.0
    assert np.isnan(motion(0, 0).wrong_match_rate)
