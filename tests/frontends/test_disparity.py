"""Refined disparities against exact geometry, and on a real pair that is not quite rectified."""

import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from synthetic import CAMERA, GROUND, Plane, Scene, rover_T_camera

from frontends.disparity import refine_disparities

WALL = Plane((3.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
FOCAL_BASELINE = CAMERA.fx * CAMERA.baseline_m
LEVEL = rover_T_camera(1.0, 0.0)


def corners(image, count=350):
    """Textured places, off the pixel centres."""
    found = cv2.goodFeaturesToTrack(image, count, 0.01, 5)[:, 0].astype(np.float64)
    inside = (np.abs(found - [159.5, 119.5]) < [145.0, 105.0]).all(axis=1)
    return found[inside] + np.random.default_rng(1).uniform(-0.5, 0.5, found[inside].shape)


def refine(frame, uv, truth, *, vertical=0.0, start_sigma=0.25, max_shift=1.5):
    start = truth + start_sigma * np.random.default_rng(2).standard_normal(len(uv))
    n = len(uv)
    return refine_disparities(
        frame.left, frame.right, uv, start, np.full(n, vertical), np.full(n, max_shift)
    )


def expose(frame, gain, bias):
    grey = np.rint(gain * frame.right.astype(np.float64) + bias)
    return replace(frame, right=np.clip(grey, 0, 255).astype(np.uint8))


def robust_sigma(values):
    return 1.4826 * np.median(np.abs(values))


SCENES = {
    "ground, mast 1 m": (Scene((GROUND,)), rover_T_camera(1.0), 1.0, 0.0, 0.05),
    "ground, mast 0.4 m": (Scene((GROUND,)), rover_T_camera(0.4), 1.0, 0.0, 0.05),
    "ground, mast 2 m": (Scene((GROUND,)), rover_T_camera(2.0), 1.0, 0.0, 0.05),
    "ground from above": (Scene((GROUND,)), rover_T_camera(1.0, 1.2), 1.0, 0.0, 0.03),
    "wall": (Scene((WALL,)), LEVEL, 1.0, 0.0, 0.02),
    "noise": (Scene((GROUND,), noise=4.0), rover_T_camera(), 1.0, 0.0, 0.11),
    "darker right": (Scene((GROUND,)), rover_T_camera(), 0.9, 0.0, 0.05),
    "gain and bias": (Scene((GROUND,)), rover_T_camera(), 0.7, 20.0, 0.05),
}


@pytest.mark.parametrize(
    ("scene", "pose", "gain", "bias", "error_px"), SCENES.values(), ids=SCENES.keys()
)
def test_disparities_are_right_and_within_their_sigmas(scene, pose, gain, bias, error_px):
    frame = expose(scene.frame(pose), gain, bias)
    uv = corners(frame.left)
    truth = FOCAL_BASELINE / scene.depth(pose, *uv.T)
    found = refine(frame, uv, truth)
    good = found.confirmed
    error = (found.disparity_px - truth)[good]
    normalised = error / found.sigma_px[good]
    assert good.mean() > 0.6
    assert robust_sigma(error) < error_px
    assert abs(np.median(error)) < 0.01
    assert 0.75 < robust_sigma(normalised) < 1.25
    assert 0.75 < np.sqrt(np.mean(np.clip(normalised, -5.0, 5.0) ** 2)) < 1.3
    assert np.mean(np.abs(normalised) > 4.0) < 0.02


def test_wrong_matches_are_contradicted_and_bare_ground_is_not():
    """A wrong match differs from its partner by structure; ground without texture by noise."""
    rng = np.random.default_rng(8)
    texture = cv2.GaussianBlur(rng.standard_normal((240, 320)), (0, 0), 1.5)
    image = 120.0 + 40.0 * texture / texture.std()
    image[150:] = 120.0
    noisy = [np.clip(image + rng.normal(0, 2, image.shape), 0, 255) for _ in range(2)]
    left, right = (np.rint(one).astype(np.uint8) for one in noisy)
    u, v = (grid.ravel().astype(float) for grid in np.meshgrid(range(80, 300, 12), range(20, 230)))
    disparity = np.where(rng.random(len(u)) < 0.5, 0.0, 40.0)
    disparity[v > 130] = 0.0
    found = refine_disparities(
        left, right, np.stack([u, v], axis=-1), disparity, np.zeros(len(u)), np.ones(len(u))
    )
    wrong, bare, right_ones = disparity > 0, v > 165, (disparity == 0) & (v < 130)
    assert found.confirmed[right_ones].mean() > 0.99
    assert found.contradicted[wrong].mean() > 0.95
    assert not found.confirmed[wrong].any()
    assert not found.contradicted[bare].any()
    assert found.confirmed[bare].mean() < 0.05
    assert not (found.contradicted & found.confirmed).any()


def test_no_bias_towards_whole_pixels():
    rng = np.random.default_rng(3)
    bias = []
    for fraction in np.arange(8) / 8.0:
        scene = Scene((replace(WALL, centre=(FOCAL_BASELINE / (9.0 + fraction), 0.0, 0.0)),))
        frame = scene.frame(LEVEL, int(8 * fraction))
        uv = np.stack(np.meshgrid(np.arange(40, 290, 11), np.arange(15, 226, 11)), -1)
        uv = uv.reshape(-1, 2) + rng.uniform(-0.5, 0.5, (uv.size // 2, 2))
        found = refine(frame, uv, np.full(len(uv), 9.0 + fraction))
        assert found.confirmed.mean() > 0.9
        bias.append(np.median(found.disparity_px[found.confirmed]) - 9.0 - fraction)
    assert np.abs(bias).max() < 0.008


@pytest.fixture(scope="module")
def wall():
    frame = Scene((WALL,)).frame(LEVEL)
    uv = corners(frame.left)
    return frame, uv, np.full(len(uv), FOCAL_BASELINE / 3.0)


def test_what_remains_of_the_vertical_offset_is_v_left_minus_v_right(wall):
    _, uv, truth = wall
    frame = Scene((WALL,), vertical_px=-2.7).frame(LEVEL)
    found = refine(frame, uv, truth, vertical=-3.1)
    assert found.confirmed.mean() > 0.9
    assert np.median(found.vertical_px[found.confirmed]) == pytest.approx(0.4, abs=0.01)
    assert robust_sigma((found.disparity_px - truth)[found.confirmed]) < 0.02
    assert not refine(frame, uv, truth, vertical=-1.3).confirmed.any()


def test_a_start_that_is_wrong_is_not_confirmed(wall):
    frame, uv, truth = wall
    assert refine(frame, uv, truth + 9.0).confirmed.mean() < 0.05
    far = refine(frame, uv, truth + 0.8, start_sigma=0.0, max_shift=0.5)
    assert far.confirmed.mean() < 0.02
    assert np.array_equal(far.disparity_px[~far.confirmed], (truth + 0.8)[~far.confirmed])
    assert np.isinf(far.sigma_px[~far.confirmed]).all()
    assert refine(frame, uv, truth + 0.8, start_sigma=0.0).confirmed.mean() > 0.9


@pytest.mark.parametrize("texture", ["none", "along v only"])
def test_no_texture_along_u_is_not_confirmed(texture):
    rng = np.random.default_rng(4)
    rows = 110.0 + (0.0 if texture == "none" else 25.0) * rng.standard_normal((240, 1))
    left, right = (
        np.clip(rows + 2.0 * rng.standard_normal((240, 320)), 0, 255).astype(np.uint8)
        for _ in range(2)
    )
    uv = rng.uniform([40.0, 20.0], [300.0, 220.0], (300, 2))
    zero = np.zeros(300)
    found = refine_disparities(left, right, uv, zero + 10.0, zero, zero + 1.5)
    assert found.confirmed.mean() < 0.02


def test_nothing_is_read_outside_of_the_images(wall):
    frame, _, _ = wall
    edge = [-1e9, -3.0, 0.0, 6.9, 7.0, 8.5, 100.0, 311.5, 312.4, 319.0, 400.0, np.nan, np.inf]
    u, v, d = (grid.ravel() for grid in np.meshgrid(edge, edge, [-200.0, 0.0, 9.6, 300, np.nan]))
    zero = np.zeros(len(u))
    found = refine_disparities(
        frame.left, frame.right, np.stack([u, v], -1), d, zero, zero + np.inf
    )
    assert not found.confirmed.any()
    found = refine_disparities(frame.left, frame.right, np.stack([u, v], -1), d, zero, zero + 1.5)
    inside = (u > 7.0) & (u < 312.5) & (v > 7.0) & (v < 232.5)
    assert not found.confirmed[~inside].any()
    assert np.isfinite(found.vertical_px).all()


@pytest.mark.parametrize("shape", [(240, 20), (12, 320), (0, 0)])
def test_images_smaller_than_a_patch_and_no_features(shape):
    image = np.zeros(shape, np.uint8)
    one = np.ones(1)
    found = refine_disparities(image, image, np.full((1, 2), 9.0), one, one, one)
    assert not found.confirmed.any()
    none = np.zeros(0)
    assert (
        len(refine_disparities(image, image, none.reshape(0, 2), none, none, none).confirmed) == 0
    )
    with pytest.raises(ValueError, match="one size"):
        refine_disparities(image, np.zeros((3, 3), np.uint8), np.full((1, 2), 9.0), one, one, one)


def test_the_cost_is_like_that_of_lucas_kanade(wall):
    frame, uv, truth = wall
    uv, truth = np.tile(uv, (4, 1)), np.tile(truth, 4)
    points = uv[:, None].astype(np.float32)
    guess = (uv - np.stack([truth, 0.0 * truth], -1))[:, None].astype(np.float32)
    ours, theirs = [], []
    for _ in range(7):
        start = time.process_time()
        refine(frame, uv, truth)
        middle = time.process_time()
        cv2.calcOpticalFlowPyrLK(
            frame.left, frame.right, points, guess.copy(), winSize=(15, 15), maxLevel=0,
            criteria=(3, 10, 0.02), flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        ours.append(middle - start)
        theirs.append(time.process_time() - middle)
    assert min(ours) < 5.0 * min(theirs)


def test_the_vertical_residual_of_a_real_pair_is_a_smooth_field(shared_data):
    """MSL Navcam, not rectified: what a quadratic field leaves is the matching's own error."""
    folder = shared_data / "msl-navcam-pair"
    left, right = (
        cv2.imread(str(next(folder.glob(f"N{side}B*"))), cv2.IMREAD_GRAYSCALE) for side in "LR"
    )
    detector = cv2.SIFT_create(1500)
    (kl, dl), (kr, dr) = (detector.detectAndCompute(x, None) for x in (left, right))
    pairs = [a for a, b in cv2.BFMatcher().knnMatch(dl, dr, 2) if a.distance < 0.7 * b.distance]
    uv = np.array([kl[m.queryIdx].pt for m in pairs])
    offset = uv - np.array([kr[m.trainIdx].pt for m in pairs])
    x, y = ((uv - 511.5) / 512.0).T
    basis = np.stack([np.ones_like(x), x, y, x * y, x * x, y * y], -1)

    def fit(values, keep):
        for _ in range(8):
            field = basis @ np.linalg.lstsq(basis[keep], values[keep], rcond=None)[0]
            keep = keep & (np.abs(values - field) < max(4 * robust_sigma(values - field), 0.05))
        return field

    expected = fit(offset[:, 1], np.abs(offset[:, 1]) < 8.0)
    n = len(uv)
    found = refine_disparities(left, right, uv, offset[:, 0], expected, np.full(n, 1.5))
    good = found.confirmed
    left_over = found.vertical_px - fit(found.vertical_px, good)
    assert good.mean() > 0.75
    assert np.median(np.abs(left_over[good])) < 0.04
