"""The residual fields of a rectified pair and their robust fit."""

import numpy as np
import pytest
from synthetic import CAMERA

from frontends.rectification import (
    RectificationError,
    disparity_basis,
    observe,
    robust_fit,
    vertical_basis,
)


def pixels(n, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(0, CAMERA.width, n), rng.uniform(0, CAMERA.height, n), rng


@pytest.mark.parametrize(
    ("wrong_share", "one_sided"),
    [
        (0.0, False),
        (0.2, True),
        (0.4, False),
    ],
)
def test_robust_fit_finds_the_field_under_outliers(wrong_share, one_sided):
    truth = np.array([-3.15, 0.4, -0.8, 0.3, -0.5, 0.7])
    errors = []
    for seed in range(10):
        u, v, rng = pixels(300, seed)
        basis = vertical_basis(CAMERA, u, v)
        values = basis @ truth + 0.3 * rng.standard_normal(300)
        wrong = rng.random(300) < wrong_share
        low = 2.0 if one_sided else -14.0
        values[wrong] = rng.uniform(low, 14.0, int(wrong.sum()))
        found, scale = robust_fit(basis, values)
        assert 0.2 < scale < 1.2
        errors.append(np.abs(basis @ (found - truth)).max())
    assert np.median(errors) < 0.25
    assert max(errors) < 0.6


def test_robust_fit_is_exact_without_noise():
    u, v, _ = pixels(60)
    basis = disparity_basis(CAMERA, u, v)
    found, scale = robust_fit(basis, basis @ [1.0, -2.0, 0.5])
    np.testing.assert_allclose(found, [1.0, -2.0, 0.5], atol=1e-9)
    assert scale <= 1e-3


def test_robust_fit_survives_features_on_one_image_row():
    """Features along a horizon: the terms y and x y cannot be told from 1 and x."""
    u, _, rng = pixels(80)
    basis = vertical_basis(CAMERA, u, np.full(80, 100.0))
    values = 1.0 + 0.1 * rng.standard_normal(80)
    found, _ = robust_fit(basis, values)
    assert np.isfinite(found).all()
    corner = vertical_basis(CAMERA, np.array([0.0, 319.0]), np.array([0.0, 239.0])) @ found
    assert np.abs(corner - 1.0).max() < 1.0


def test_the_fields_are_in_focal_lengths_from_the_principal_point():
    u = np.array([CAMERA.cx, CAMERA.cx + CAMERA.fx, CAMERA.cx])
    v = np.array([CAMERA.cy, CAMERA.cy, CAMERA.cy - CAMERA.fy])
    error = RectificationError(
        np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0]), np.array([1.0, 2.0, 4.0])
    )
    np.testing.assert_allclose(error.vertical_at(CAMERA, u, v), [1.0, 19.0, 29.0])
    np.testing.assert_allclose(error.disparity_at(CAMERA, u, v), [1.0, 3.0, 5.0])


def test_correct_removes_the_error_and_triangulates_anew():
    u, v, rng = pixels(50)
    true_disparity = rng.uniform(3.0, 20.0, 50)
    error = RectificationError(disparity_px=np.array([1.5, -2.0, 1.0]))
    sigma = np.full(50, 0.1)
    ids = np.arange(100, 150)
    measured = observe(
        CAMERA, ids, u, v, true_disparity + error.disparity_at(CAMERA, u, v), sigma, sigma
    )
    corrected = error.correct(CAMERA, measured, 0.25)
    np.testing.assert_allclose(corrected.disparity_px, true_disparity, atol=1e-9)
    np.testing.assert_allclose(
        corrected.points_cam, CAMERA.triangulate(u, v, true_disparity), rtol=1e-9
    )
    assert corrected.landmark_id.tolist() == ids.tolist()
    np.testing.assert_array_equal(corrected.u_left, u)


def test_correct_drops_what_falls_behind_the_camera():
    u, v, _ = pixels(5)
    sigma = np.full(5, 0.1)
    disparity = np.array([0.5, 1.0, 1.01, 1.5, 6.0])
    measured = observe(CAMERA, np.arange(5), u, v, disparity, sigma, sigma)
    error = RectificationError(disparity_px=np.array([1.0, 0.0, 0.0]))
    # 0.01 px left, known to 0.1 px: in front of the camera, and of no use at any share
    for max_depth_sigma, kept in ((1.0, [3, 4]), (0.25, [3, 4]), (0.1, [4])):
        corrected = error.correct(CAMERA, measured, max_depth_sigma)
        assert corrected.landmark_id.tolist() == kept
        assert (corrected.points_cam[:, 2] > 0.0).all()
    nothing = RectificationError().correct(CAMERA, measured.select(np.zeros(5, bool)), 0.25)
    assert len(nothing) == 0


def test_correct_leaves_no_point_beyond_all_range():
    """Perception drops points whose depth is not known to a quarter; so should this."""
    sigma = np.full(3, 0.1)
    place = np.full(3, 100.0)
    measured = observe(CAMERA, np.arange(3), place, place, np.array([3.01, 3.2, 9.0]), sigma, sigma)
    error = RectificationError(disparity_px=np.array([3.0, 0.0, 0.0]))
    kept = error.correct(CAMERA, measured, 0.25)
    assert len(kept) > 0
    assert (np.sqrt(kept.points_covariance[:, 2, 2]) < 0.25 * kept.points_cam[:, 2]).all()
