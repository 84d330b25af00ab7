"""Patches followed into images that are warped, re-exposed and noisy by known amounts."""

import cv2
import numpy as np
import pytest
from synthetic import CAMERA, GROUND, Scene, rover_T_camera

from frontends.foreshortening import surface_warp
from frontends.geometry import inverse, pose, so3_exp, transform_points
from frontends.templates import Templates

SIZE = 240
FAR = np.full(80, 20.0)


def texture(seed=0):
    noise = np.random.default_rng(seed).standard_normal((SIZE, SIZE))
    smooth = np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0))
    return np.clip(128.0 + 40.0 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def places(seed=1, n=80):
    return np.random.default_rng(seed).uniform(60.0, SIZE - 60.0, (n, 2))


def warped(image, matrix, shift, gain=1.0, bias=0.0, noise=0.0):
    """Image that shows at ``A p + c`` what the first shows at p, about its middle."""
    middle = np.full(2, (SIZE - 1) / 2.0)
    offset = middle - matrix @ middle + shift
    seen = cv2.warpAffine(
        image.astype(np.float32), np.column_stack([matrix, offset]), (SIZE, SIZE),
        flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT,
    )  # fmt: skip
    seen = gain * seen + bias + noise * np.random.default_rng(2).standard_normal(seen.shape)
    return np.clip(np.rint(seen), 0, 255).astype(np.uint8), lambda uv: uv @ matrix.T + offset


@pytest.mark.parametrize(
    ("matrix", "gain", "bias"),
    [
        (np.eye(2), 1.0, 0.0),
        (np.eye(2), 0.6, 30.0),
        (1.1 * np.eye(2), 1.0, 0.0),
        (np.array([[1.05, 0.08], [-0.05, 1.15]]), 1.2, -20.0),
        (0.9 * np.eye(2), 0.8, 0.0),
    ],
    ids=["shift", "exposure", "nearer", "affine", "farther"],
)
def test_a_patch_is_found_to_its_sigma(matrix, gain, bias):
    image = texture()
    other, moved = warped(image, matrix, np.array([0.37, -0.61]), gain, bias, noise=2.0)
    uv = places()
    true = moved(uv)
    start = true + np.random.default_rng(3).uniform(-0.8, 0.8, uv.shape)
    found = Templates.cut(image, uv).follow(other, start, FAR)
    assert found.found.mean() > 0.9
    error = (found.uv - true)[found.found]
    assert np.median(np.abs(error)) < 0.05
    # beside what the last step may leave
    normalised = error / np.hypot(found.sigma_px[found.found, None], 0.03)
    assert 0.3 < 1.4826 * np.median(np.abs(normalised)) < 1.5
    assert np.median(np.abs(found.warp[found.found] - matrix)) < 0.03


def test_a_warp_that_is_expected_is_found_from_far():
    """Ground that comes near is stretched to twice its height."""
    matrix = np.array([[1.4, 0.3], [0.0, 2.0]])
    image = texture()
    other, moved = warped(image, matrix, np.zeros(2), noise=1.0)
    uv = np.full(2, (SIZE - 1) / 2.0) + np.random.default_rng(4).uniform(-30, 30, (60, 2))
    templates = Templates.cut(image, uv)
    known = templates.turned(np.tile(matrix, (60, 1, 1)), np.zeros((60, 2)))
    start = moved(uv) + 0.3
    found = known.follow(other, start, FAR)
    assert found.found.mean() > 0.8
    assert np.median(np.abs(found.uv - moved(uv))[found.found]) < 0.1


def test_other_ground_is_not_found():
    uv = places()
    found = Templates.cut(texture(0), uv).follow(texture(9), uv, np.full(80, 3.0))
    assert found.found.mean() < 0.05
    np.testing.assert_array_equal(found.uv[~found.found], uv[~found.found])
    assert np.isinf(found.sigma_px[~found.found]).all()


def test_flat_images_give_nothing():
    uv = places()
    flat = np.full((SIZE, SIZE), 90, np.uint8)
    assert not Templates.cut(flat, uv).follow(flat, uv, FAR).found.any()
    assert not Templates.cut(texture(), uv).follow(flat, uv, FAR).found.any()
    assert not Templates.cut(flat, uv).follow(texture(), uv, FAR).found.any()


def test_nothing_is_found_beyond_its_reach():
    image = texture()
    other, moved = warped(image, np.eye(2), np.array([1.5, 0.0]))
    templates, uv = Templates.cut(image, places()), places()
    assert templates.follow(other, uv, np.full(80, 2.0)).found.mean() > 0.8
    assert not templates.follow(other, uv, np.full(80, 1.0)).found.any()
    assert moved(uv)[0, 0] == uv[0, 0] + 1.5


def test_features_at_the_border_and_outside_do_no_harm():
    image = texture()
    corners = np.array([[0.0, 0.0], [SIZE - 1.0, 0.0], [0.3, SIZE - 1.0], [SIZE - 1.0, SIZE - 1.0]])
    templates = Templates.cut(image, corners)
    again = templates.follow(image, corners, FAR[:4])
    np.testing.assert_allclose(again.uv, corners, atol=0.05)
    outside = Templates.cut(image, places(n=4)).follow(image, corners + 500.0, FAR[:4])
    assert not outside.found.any()
    small = np.zeros((8, 8), np.uint8)
    assert not Templates.cut(small, corners[:1]).follow(image, corners[:1], FAR[:1]).found.any()


def test_a_landmark_beside_the_middle_is_followed_itself():
    """`moved` names another point of the same patch."""
    image = texture()
    matrix = np.array([[1.1, 0.1], [-0.05, 1.2]])
    other, moved = warped(image, matrix, np.zeros(2))
    uv, shift = places(), np.tile([1.5, -1.0], (80, 1))
    templates = Templates.cut(image, uv).moved(shift, np.full(80, 0.3))
    found = templates.follow(other, moved(uv + shift) + 0.2, FAR)
    assert np.median(np.abs(found.uv - moved(uv + shift))[found.found]) < 0.06
    assert (found.sigma_px[found.found] > 0.3).all()


def test_a_patch_that_is_stretched_too_far_is_of_no_more_use():
    templates = Templates.cut(texture(), places(n=3))
    scale = np.array([1.0, 1.6, 0.6])
    stretched = templates.turned(scale[:, None, None] * templates.warp, np.zeros((3, 2)))
    np.testing.assert_array_equal(stretched.useful(), [True, False, False])


MOUNT = rover_T_camera()
LATER = pose(so3_exp([0.02, -0.01, 0.1]), [0.4, 0.05, 0.0])


def on_the_ground(u, v):
    """Points of the ground at pixels, and the slope of their disparities."""

    def disparity(u, v):
        return CAMERA.fx * CAMERA.baseline_m / Scene((GROUND,)).depth(MOUNT, u, v)

    along_u = disparity(u + 0.5, v) - disparity(u - 0.5, v)
    along_v = disparity(u, v + 0.5) - disparity(u, v - 0.5)
    points = CAMERA.triangulate(u, v, disparity(u, v))
    return points, np.stack([along_u, along_v], axis=-1)


def seen_from(later, points):
    """Pixels of points of the first view in a later one."""
    b_T_a = inverse(inverse(MOUNT) @ later @ MOUNT)
    return CAMERA.project(transform_points(b_T_a, points))[:, ::2]


def test_the_warp_of_a_plane_is_that_of_its_projection():
    u, v = np.array([100.0, 160.0, 220.0]), np.array([150.0, 180.0, 200.0])
    points, slope = on_the_ground(u, v)
    warp, bend = surface_warp(CAMERA, inverse(MOUNT) @ LATER @ MOUNT, points, slope)
    assert warp[:, 1, 1].min() > 1.2  # it does stretch
    for du, dv in ((8.0, 0.0), (0.0, 8.0), (-8.0, 5.0), (3.0, -8.0)):
        p = np.array([du, dv])
        beside = seen_from(LATER, on_the_ground(u + du, v + dv)[0]) - seen_from(LATER, points)
        np.testing.assert_allclose(warp @ p / (1.0 + bend @ p)[:, None], beside, atol=0.02)


def test_two_motions_turn_a_patch_as_both_together():
    u, v = np.array([100.0, 160.0, 220.0]), np.array([150.0, 180.0, 200.0])
    points, slope = on_the_ground(u, v)
    # level, so that the ground looks the same from all three places
    one = pose(so3_exp([0.0, 0.0, 0.1]), [0.4, 0.05, 0.0])
    two = pose(so3_exp([0.0, 0.0, -0.05]), [0.2, 0.0, 0.0])
    in_cameras = [inverse(MOUNT) @ motion @ MOUNT for motion in (one, two, one @ two)]
    first = surface_warp(CAMERA, in_cameras[0], points, slope)
    seen = seen_from(one, points)
    second = surface_warp(CAMERA, in_cameras[1], *on_the_ground(*seen.T))
    both = surface_warp(CAMERA, in_cameras[2], points, slope)
    templates = Templates.cut(texture(), np.stack([u, v], axis=-1))
    turned = templates.turned(*first).turned(*second)
    np.testing.assert_allclose(turned.warp, both[0], atol=2e-3)
    np.testing.assert_allclose(turned.bend, both[1], atol=1e-5)


def test_the_near_side_of_a_patch_does_not_draw_it_there():
    """Perspective, left out of the model, moves what is found by a tenth of a pixel."""
    image = texture()
    uv = np.full(2, (SIZE - 1) / 2.0) + np.random.default_rng(5).uniform(-40, 40, (60, 2))
    off = {True: [], False: []}
    bend = np.array([0.0, -0.006])
    warp = np.diag([1.2, 1.4])
    rows, columns = np.mgrid[:SIZE, :SIZE].astype(np.float32)
    for place in uv:
        # pixels of the later image, carried back: p = (A - q g^T)^-1 q
        q = np.stack([columns - place[0], rows - place[1]], axis=-1).astype(float)
        back = np.linalg.solve(warp - q[..., :, None] * bend, q[..., None])[..., 0]
        source = (back + place).astype(np.float32)
        later = cv2.remap(image, source[..., 0], source[..., 1], cv2.INTER_CUBIC)
        template = Templates.cut(image, place[None])
        for bent in (True, False):
            known = template.turned(warp[None], bent * bend[None])
            found = known.follow(later, place[None] + 0.2, FAR[:1])
            if found.found[0]:
                off[bent].append(found.uv[0, 1] - place[1])
    assert len(off[True]) > 50
    assert abs(np.median(off[True])) < 0.02
    assert abs(np.median(off[False])) > 0.05
