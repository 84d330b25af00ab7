"""The stereo camera: projection, triangulation and its covariance."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frontends.camera import StereoCamera, level_rover_T_camera
from frontends.errors import InputError
from frontends.geometry import is_rigid

# fx and fy differ, so that exchanging them shows
CAMERA = StereoCamera(512, 288, 257.69, 263.1, 261.98, 141.07, 0.07)


@settings(max_examples=100, deadline=None)
@given(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0), st.floats(0.1, 500.0))
def test_projection_and_triangulation_are_inverse(x, y, z):
    point = np.array([[x, y, z]])
    u_left, u_right, v = CAMERA.project(point).T
    np.testing.assert_allclose(
        CAMERA.triangulate(u_left, v, u_left - u_right), point, rtol=1e-6, atol=1e-6
    )


def test_the_equations_of_the_paper():
    u_left, u_right, v = CAMERA.project(np.array([[0.3, -0.2, 2.0]]))[0]
    assert u_left == pytest.approx(257.69 * 0.3 / 2.0 + 261.98)
    assert v == pytest.approx(263.1 * -0.2 / 2.0 + 141.07)
    assert u_left - u_right == pytest.approx(257.69 * 0.07 / 2.0)
    assert CAMERA.depth(np.array([u_left - u_right]))[0] == pytest.approx(2.0)


@pytest.mark.parametrize("pixel", [(20.0, 10.0), (261.98, 141.07), (500.0, 280.0)])
@pytest.mark.parametrize("disparity", [3.0, 20.0])
def test_triangulation_covariance_is_that_of_samples(pixel, disparity):
    rng = np.random.default_rng(5)
    n, sigma, sigma_disparity = 200_000, 0.4, 0.02 * disparity
    shift = rng.standard_normal((n, 3)) * [sigma, sigma, sigma_disparity]
    samples = CAMERA.triangulate(
        pixel[0] + shift[:, 0], pixel[1] + shift[:, 1], disparity + shift[:, 2]
    )
    one = np.ones(1)
    covariance = CAMERA.triangulation_covariance(
        pixel[0] * one, pixel[1] * one, disparity * one, sigma * one, sigma_disparity * one
    )[0]
    measured = np.cov(samples.T)
    scale = np.sqrt(np.outer(np.diag(measured), np.diag(measured)))
    np.testing.assert_allclose(covariance / scale, measured / scale, atol=0.01)
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9)


def test_contains_counts_the_centres_of_the_border_pixels():
    u = np.array([0.0, -0.01, 511.0, 511.01, 8.0, 7.9])
    v = np.full(6, 100.0)
    assert CAMERA.contains(u, v).tolist() == [True, False, True, False, True, True]
    assert CAMERA.contains(u, v, 8.0).tolist() == [False, False, False, False, True, False]
    assert CAMERA.contains(v, np.array([0.0, 287.0, 287.5, -1.0, 5.0, 280.0])).tolist() == [
        True, True, False, False, True, True,
    ]  # fmt: skip
    assert not CAMERA.contains(np.array([np.nan]), np.array([5.0])).any()


@pytest.mark.parametrize("name", ["width", "height", "fx", "fy", "cx", "cy", "baseline_m"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 0, -1])
def test_bad_values_are_input_errors_that_name_the_field(name, value):
    if name in ("cx", "cy") and np.isfinite(value):
        return  # a principal point may lie anywhere
    given_values = {
        "width": 512, "height": 288, "fx": 250.0, "fy": 250.0, "cx": 256.0, "cy": 144.0,
        "baseline_m": 0.07,
    }  # fmt: skip
    with pytest.raises(InputError) as caught:
        StereoCamera(**{**given_values, name: value})
    assert caught.value.field == name
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_level_camera_looks_forward_with_its_right_to_the_rovers_right():
    mount = level_rover_T_camera()
    assert is_rigid(mount, 1e-15)
    np.testing.assert_array_equal(mount[:3, :3] @ [0, 0, 1], [1, 0, 0])
    np.testing.assert_array_equal(mount[:3, :3] @ [1, 0, 0], [0, -1, 0])
    np.testing.assert_array_equal(mount[:3, :3] @ [0, 1, 0], [0, 0, -1])


@pytest.mark.parametrize("value", ["250", None])
def test_a_value_that_is_no_number_is_an_input_error(value):
    with pytest.raises(InputError):
        StereoCamera(512, 288, value, 250.0, 256.0, 144.0, 0.07)
