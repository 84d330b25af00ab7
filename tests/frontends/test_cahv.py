"""CAHV and CAHVOR against exact truth."""

from __future__ import annotations

import numpy as np
import pytest

from frontends.cahv import CahvCamera
from frontends.errors import InputError
from frontends.geometry import pose, so3_exp
from frontends.undistort import StereoCalibration, rectifier_of

SIZE = (1024, 1024)
#: Spirit's left Navcam, sol 1869, as its label has it.
SPIRIT = CahvCamera(
    *SIZE,
    c=np.array([0.454993, 0.141198, -1.23312]),
    a=np.array([-0.69585, 0.571462, 0.435]),
    h=np.array([-1075.03, -654.572, 220.543]),
    v=np.array([50.6594, -19.3653, 1294.76]),
    o=np.array([-0.61985, 0.672629, 0.404174]),
    r=np.array([0.019876, -0.014281, 0.020876]),
)


def cahvor_pair() -> tuple[CahvCamera, CahvCamera]:
    """Two cameras with toe-in, roll, tilted axes and lenses that differ, 0.2 m apart."""
    x, y, z = np.eye(3)
    down = pose(np.column_stack([y, z, x]) @ so3_exp([-0.3, 0.0, 0.0]), [0.45, 0.0, -1.2])
    cameras = []
    for side, turn, focal in (
        (-0.1, [0.004, 0.02, -0.006], (1234.0, 1231.0)),
        (0.1, [-0.003, -0.015, 0.009], (1228.0, 1226.5)),
    ):
        place = down @ pose(so3_exp(turn), [side, 0.002 * side, 0.01 * side])
        linear = CahvCamera.linear(SIZE, place, focal, (510.0 + 90 * side, 517.0 - 50 * side))
        optical = place[:3, :3] @ np.array([0.01 * side, 0.006, 1.0])
        cameras.append(
            CahvCamera(
                *SIZE, linear.c, linear.a, linear.h, linear.v,
                o=optical / np.linalg.norm(optical),
                r=np.array([1e-4, -0.18 + 0.05 * side, 0.11]),
            )
        )  # fmt: skip
    return cameras[0], cameras[1]


def scene(camera: CahvCamera, count: int = 2000) -> np.ndarray:
    """Points 1 to 60 m ahead, all over the field of view."""
    rng = np.random.default_rng(3)
    pixels = rng.uniform(0.0, 1023.0, (count, 2))
    return camera.c + camera.rays(pixels) * np.geomspace(1.0, 60.0, count)[:, None]


@pytest.mark.parametrize("camera", [SPIRIT, *cahvor_pair()])
def test_rays_are_the_inverse_of_projection(camera: CahvCamera) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0.0, 1023.0, (500, 2))
    points = camera.c + camera.rays(pixels) * rng.uniform(0.5, 50.0, (500, 1))
    np.testing.assert_allclose(camera.project_points(points), pixels, atol=1e-6)


def test_cahv_projects_as_its_pinhole() -> None:
    place = pose(so3_exp([0.2, -0.5, 0.1]), [1.0, 2.0, -0.5])
    camera = CahvCamera.linear(SIZE, place, (900.0, 910.0), (500.0, 520.0))
    point = np.array([[0.3, -0.2, 4.0]])
    world = point @ place[:3, :3].T + place[:3, 3]
    expected = [[900.0 * 0.3 / 4.0 + 500.0, 910.0 * -0.2 / 4.0 + 520.0]]
    np.testing.assert_allclose(camera.project_points(world), expected, atol=1e-9)
    np.testing.assert_allclose(camera.reference_T_camera(), place, atol=1e-12)
    np.testing.assert_allclose(camera.principal_point, (500.0, 520.0))


def test_moving_the_frame_moves_nothing_in_the_image() -> None:
    points = scene(SPIRIT, 50)
    new_T_old = pose(so3_exp([0.4, 1.0, -0.7]), [3.0, -2.0, 1.0])
    moved = points @ new_T_old[:3, :3].T + new_T_old[:3, 3]
    np.testing.assert_allclose(
        SPIRIT.moved(new_T_old).project_points(moved), SPIRIT.project_points(points), atol=1e-9
    )


def test_a_point_behind_the_camera_has_no_pixel() -> None:
    assert np.isnan(SPIRIT.project_points(SPIRIT.c[None] - SPIRIT.a)).all()


def test_spirit_label_is_a_square_pixel_navcam() -> None:
    assert SPIRIT.focal_h_px == pytest.approx(1188.3, abs=0.1)
    assert SPIRIT.focal_v_px == pytest.approx(SPIRIT.focal_h_px, abs=1.0)
    assert abs(SPIRIT.skew_rad) < 1e-3


def test_the_linear_pair_is_epipolar_and_triangulates_exactly() -> None:
    """Project by CAHVOR, rectify, triangulate, project again: below 0.01 px and 1e-6 m."""
    left, right = cahvor_pair()
    rectifier = rectifier_of(StereoCalibration.of_cahv(left, right))
    camera = rectifier.camera
    points = scene(left)
    linear_left, linear_right = rectifier.linear_pair(left.reference_T_camera())
    u, v = linear_left.project_points(points).T
    u_right, v_right = linear_right.project_points(points).T
    np.testing.assert_allclose(v, v_right, atol=1e-8)
    inside = camera.contains(u, v) & camera.contains(u_right, v_right)
    assert inside.mean() > 0.6
    # the maps, at whole pixels, must lead to where the lens shows the same point
    u, v, u_right, points = u[inside], v[inside], u_right[inside], points[inside]
    for eye, camera_map, column in (
        (left, rectifier.left_map, u),
        (right, rectifier.right_map, u_right),
    ):
        expected = eye.project_points(points)
        x0, y0 = np.floor(column).astype(int), np.floor(v).astype(int)
        ok = (x0 < camera.width - 1) & (y0 < camera.height - 1)
        x0, y0, fx, fy = x0[ok], y0[ok], (column - np.floor(column))[ok], (v - np.floor(v))[ok]
        got = (
            camera_map[y0, x0].T * (1 - fx) * (1 - fy)
            + camera_map[y0, x0 + 1].T * fx * (1 - fy)
            + camera_map[y0 + 1, x0].T * (1 - fx) * fy
            + camera_map[y0 + 1, x0 + 1].T * fx * fy
        ).T
        assert np.abs(got - expected[ok]).max() < 0.01
    triangulated = camera.triangulate(u, v, u - u_right)
    reference_T_rectified = linear_left.reference_T_camera()
    back = triangulated @ reference_T_rectified[:3, :3].T + reference_T_rectified[:3, 3]
    np.testing.assert_allclose(back, points, atol=1e-6)
    for eye in (left, right):
        assert np.abs(eye.project_points(back) - eye.project_points(points)).max() < 0.01


def test_one_rig_under_two_pointings_shares_its_intrinsics() -> None:
    left, right = cahvor_pair()
    first = rectifier_of(StereoCalibration.of_cahv(left, right))
    turn = pose(so3_exp([0.1, 0.2, 0.8]), [0.05, 0.0, 0.0])
    again = rectifier_of(
        StereoCalibration.of_cahv(left.moved(turn), right.moved(turn)), first.camera
    )
    np.testing.assert_allclose(again.left_map, first.left_map, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"a": np.array([0.0, 0.0, 0.2])}, "A"),
        ({"h": np.array([np.nan, 0.0, 0.0])}, "H"),
        ({"h": np.zeros(3)}, "H, V"),
        ({"r": None}, "O, R"),
    ],
)
def test_broken_models_are_named(change, part) -> None:
    values = {name: getattr(SPIRIT, name) for name in ("c", "a", "h", "v", "o", "r")}
    with pytest.raises(InputError) as caught:
        CahvCamera(*SIZE, **{**values, **change})
    assert caught.value.field == part
