"""Lens models and rectification against exact truth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from frontends.calibration_check import check_calibration
from frontends.camera import StereoCamera
from frontends.distortion import Lens, LensCamera
from frontends.errors import InputError
from frontends.geometry import pose, so3_exp
from frontends.measurements import StereoFrame
from frontends.undistort import StereoCalibration, rectifier_of

RADTAN = LensCamera(
    752, 480, 458.65, 457.3, 367.2, 248.4, Lens.RADTAN, (-0.283, 0.074, 0.0002, 1.8e-5)
)
EQUI = LensCamera(640, 480, 300.0, 301.0, 322.0, 238.0, Lens.EQUIDISTANT, (0.01, -0.02, 0.01, 0.0))
PINHOLE = LensCamera(640, 480, 500.0, 500.0, 319.5, 239.5)


@pytest.mark.parametrize("camera", [RADTAN, EQUI, PINHOLE])
def test_rays_are_the_inverse_of_projection(camera: LensCamera) -> None:
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 25), np.linspace(0, camera.height - 1, 25))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    np.testing.assert_allclose(camera.project(camera.rays(pixels)), pixels, atol=1e-6)


def test_radtan_is_opencvs() -> None:
    points = np.random.default_rng(0).uniform([-1, -0.5, 2], [1, 0.5, 5], (50, 3))
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), RADTAN.matrix, np.array(RADTAN.coefficients)
    )
    np.testing.assert_allclose(RADTAN.project(points), expected[:, 0], atol=1e-9)


def test_a_lens_that_folds_over_is_refused() -> None:
    folded = LensCamera(640, 480, 250.0, 250.0, 319.5, 239.5, Lens.RADTAN, (-0.5, 0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="folds over"):
        folded.rays(np.array([[0.0, 0.0]]))


@pytest.mark.parametrize("camera", [RADTAN, EQUI, PINHOLE])
def test_the_rectified_pair_sees_points_where_it_should(camera: LensCamera) -> None:
    left_T_right = pose(so3_exp([0.01, -0.02, 0.005]), [0.11, 0.002, -0.001])
    rectifier = rectifier_of(StereoCalibration(camera, camera, left_T_right))
    pair = rectifier.camera
    rng = np.random.default_rng(1)
    uv = rng.uniform([200, 100], [pair.width - 200, pair.height - 100], (200, 2)).round()
    points = pair.triangulate(uv[:, 0], uv[:, 1], rng.uniform(5.0, 40.0, 200))
    turn = rectifier.left_T_rectified[:3, :3]
    in_left = points @ turn.T
    in_right = (in_left - left_T_right[:3, 3]) @ left_T_right[:3, :3]
    u, v = uv.astype(int).T
    np.testing.assert_allclose(rectifier.left_map[v, u], camera.project(in_left), atol=1e-3)
    u_right = pair.project(points)[:, 1]
    whole = rectifier.right_map[v, np.floor(u_right).astype(int)]
    after = rectifier.right_map[v, np.floor(u_right).astype(int) + 1]
    part = (u_right - np.floor(u_right))[:, None]
    np.testing.assert_allclose(whole + part * (after - whole), camera.project(in_right), atol=0.01)


def test_no_black_margins() -> None:
    white = np.full((480, 752), 200, np.uint8)
    left_T_right = pose(so3_exp([0.0, 0.03, 0.02]), [0.11, 0.0, 0.0])
    rectifier = rectifier_of(StereoCalibration(RADTAN, RADTAN, left_T_right))
    for source in (rectifier.left_map, rectifier.right_map):
        assert source.min() > -0.5
        assert (source.reshape(-1, 2).max(axis=0) < [751.5, 479.5]).all()
    assert rectifier.rectify(white, white)[0].min() >= 199


@pytest.mark.parametrize(
    ("transform", "text"),
    [
        (pose(np.eye(3), [-0.1, 0.0, 0.0]), "exchange the two cameras"),
        (pose(np.eye(3), [0.0, 0.1, 0.0]), "beside it"),
        (pose(np.eye(3), [0.0, 0.0, 0.0]), "baseline"),
        (np.diag([1.0, 1.0, -1.0, 1.0]) + np.eye(4)[:, [3]] * 0, "rigid"),
    ],
)
def test_pairs_that_are_none_are_refused(transform, text) -> None:
    with pytest.raises(InputError, match=text):
        StereoCalibration(PINHOLE, PINHOLE, transform)


def seen_through(camera: StereoCamera, turn: np.ndarray, shift: float = 0.0) -> StereoFrame:
    """A textured slope, seen by a pair whose right camera is turned without its knowing."""
    rng = np.random.default_rng(5)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (camera.height, camera.width)), (0, 0), 2.0)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    # pixel of the turned right camera -> pixel of the straight one -> left pixel
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    rays = rays @ so3_exp(turn).T
    x = camera.cx + camera.fx * rays[..., 0] / rays[..., 2]
    y = camera.cy + camera.fy * rays[..., 1] / rays[..., 2]
    disparity = 5.0 + 30.0 * y / camera.height + shift
    right = cv2.remap(
        texture, (x + disparity).astype(np.float32), y.astype(np.float32), cv2.INTER_CUBIC
    )
    return StereoFrame(0, 0.0, texture, right, camera)


CAMERA = StereoCamera(640, 480, 500.0, 500.0, 319.5, 239.5, 0.2)


def test_a_good_calibration_passes_without_a_word() -> None:
    check = check_calibration(CAMERA, [seen_through(CAMERA, np.zeros(3))])
    assert check.matches > 100
    assert check.findings == ()
    assert abs(check.vertical_px) < 0.2
    assert check.median_depth_m == pytest.approx(0.2 * 500.0 / 20.0, rel=0.2)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_turn_of_the_right_camera_is_found(axis: int) -> None:
    turn = np.zeros(3)
    turn[axis] = (0.006, 0.03, 0.02)[axis]
    check = check_calibration(CAMERA, [seen_through(CAMERA, turn)])
    np.testing.assert_allclose(check.turn_deg, np.degrees(turn), atol=0.15)
    assert any("looks turned by" in finding for finding in check.findings)


def test_swapped_eyes_are_found() -> None:
    frame = seen_through(CAMERA, np.zeros(3))
    swapped = StereoFrame(0, 0.0, frame.right, frame.left, CAMERA)
    assert "swapped" in check_calibration(CAMERA, [swapped]).findings[0]


def test_matches_beyond_infinity_are_found() -> None:
    frame = seen_through(CAMERA, np.zeros(3), shift=-12.0)
    assert any("beyond infinity" in text for text in check_calibration(CAMERA, [frame]).findings)


def test_an_implausible_baseline_is_found() -> None:
    millimetres = StereoCamera(640, 480, 500.0, 500.0, 319.5, 239.5, 200.0)
    findings = check_calibration(millimetres, [seen_through(CAMERA, np.zeros(3))]).findings
    assert any("check its unit" in text for text in findings)


def test_images_of_other_things_are_said_to_be_unchecked() -> None:
    frame = seen_through(CAMERA, np.zeros(3))
    noise = np.random.default_rng(9).integers(0, 255, frame.left.shape, dtype=np.uint8)
    findings = check_calibration(CAMERA, [StereoFrame(0, 0.0, frame.left, noise, CAMERA)]).findings
    assert "cannot be checked" in findings[0]
