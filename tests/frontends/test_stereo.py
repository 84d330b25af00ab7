"""Stereo perception on rendered pairs with exact geometry, and on real ones."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from synthetic import CAMERA, GROUND, Plane, Scene, arc, rover_T_camera

from frontends.camera import StereoCamera
from frontends.errors import InputError
from frontends.measurements import StereoFrame
from frontends.stereo import StereoConfig, StereoPerception

WALL = Plane((3.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
#: Looks steeply down: the ground fills the image, nothing hides anything.
STEEP = rover_T_camera(1.0, 1.2)
MOUNT = rover_T_camera()


def perceive(frame, config=None):
    perception = StereoPerception(frame.camera, config)
    return perception.perceive(frame), perception


def blank(value, camera=CAMERA, index=0):
    image = np.full((camera.height, camera.width), value, np.uint8)
    return StereoFrame(index, 0.0, image, image.copy(), camera)


def disparity_error(scene, map_T_camera, observations):
    depth = scene.depth(map_T_camera, observations.u_left, observations.v)
    return observations.disparity_px - CAMERA.fx * CAMERA.baseline_m / depth


@pytest.mark.parametrize(
    ("planes", "map_T_camera"),
    [((WALL,), rover_T_camera(1.0, 0.0)), ((GROUND,), STEEP)],
    ids=["wall", "ground from above"],
)
def test_points_are_where_they_are_within_their_sigmas(planes, map_T_camera):
    scene = Scene(planes)
    features, _ = perceive(scene.frame(map_T_camera))
    seen = features.observations
    assert len(seen) > 200
    normalised = disparity_error(scene, map_T_camera, seen) / seen.sigma_disparity_px
    # one match in a hundred may be wrong; of the others the sigmas have a floor of 0.05 px,
    # so they may be too large, never much too small
    right = np.abs(normalised) < 5.0
    assert right.mean() > 0.98
    assert np.mean(normalised[right] ** 2) < 1.5
    assert np.percentile(np.abs(normalised), 95) < 2.6
    assert abs(np.median(normalised)) < 0.3
    depth = scene.depth(map_T_camera, seen.u_left, seen.v)
    sigma_z = np.sqrt(seen.points_covariance[:, 2, 2])
    assert np.median(np.abs(seen.points_cam[:, 2] - depth) / sigma_z) < 0.9


def test_points_of_sloping_ground_are_within_their_sigmas():
    """What a rover sees: the ground runs away from it, 0.12 px of disparity an image row."""
    scene = Scene((GROUND,))
    seen = perceive(scene.frame(MOUNT))[0].observations
    normalised = disparity_error(scene, MOUNT, seen) / seen.sigma_disparity_px
    assert np.median(np.abs(normalised)) < 0.9


def test_points_of_sloping_ground_are_right_to_a_quarter_pixel():
    scene = Scene((GROUND,))
    seen = perceive(scene.frame(MOUNT))[0].observations
    error = disparity_error(scene, MOUNT, seen)
    assert 1.4826 * np.median(np.abs(error)) < 0.25
    assert np.mean(np.abs(error) > 1.0) < 0.12


def test_the_covariance_goes_with_the_points():
    seen = perceive(Scene().frame(MOUNT))[0].observations
    np.testing.assert_allclose(
        seen.points_cam, CAMERA.triangulate(seen.u_left, seen.v, seen.disparity_px)
    )
    assert (np.linalg.eigvalsh(seen.points_covariance) > 0.0).all()
    assert (seen.landmark_id == -1).all()


@pytest.mark.parametrize("offset", [-3.15, 0.0, 0.7, 2.0])
def test_a_vertical_offset_is_found_and_removed(offset):
    scene = Scene(vertical_px=offset)
    features, perception = perceive(scene.frame(MOUNT))
    assert perception.vertical_measured
    u, v = np.meshgrid(np.linspace(30, 290, 5), np.linspace(60, 220, 5))
    field = perception.rectification.vertical_at(CAMERA, u.ravel(), v.ravel())
    assert np.abs(field - offset).max() < 0.25
    assert perception.rectification.vertical_px[0] == pytest.approx(offset, abs=0.1)
    plain, _ = perceive(Scene().frame(MOUNT))
    assert len(features) > 0.85 * len(plain)
    error = disparity_error(scene, MOUNT, features.observations)
    assert np.median(np.abs(error)) < 0.2


def test_the_vertical_field_waits_for_a_pair_with_texture():
    perception = StereoPerception(CAMERA)
    perception.perceive(blank(90))
    assert not perception.vertical_measured
    perception.perceive(Scene(vertical_px=2.0).frame(MOUNT, 1))
    assert perception.vertical_measured
    assert perception.rectification.vertical_px[0] == pytest.approx(2.0, abs=0.1)


def real_pair(folder, camera, index=40):
    names = [folder / side / f"{index:06d}.png" for side in ("left", "right")]
    left, right = (cv2.imread(str(name), cv2.IMREAD_GRAYSCALE) for name in names)
    return StereoFrame(index, 0.0, left, right, camera)


MOONRANGER = StereoCamera(512, 288, 257.69, 257.69, 261.98, 141.07, 0.07)


def test_the_offset_of_the_real_pair_is_found(shared_data):
    features, perception = perceive(real_pair(shared_data / "moonranger-run1", MOONRANGER))
    assert perception.rectification.vertical_px[0] == pytest.approx(-3.1, abs=0.2)
    assert len(features) > 200
    assert features.epipolar_sigma_px < 0.4


def test_a_real_pair_that_is_swapped_is_named(shared_data):
    frame = real_pair(shared_data / "moonranger-run1", MOONRANGER)
    with pytest.raises(InputError, match="swapped"):
        perceive(replace(frame, left=frame.right, right=frame.left))


@pytest.mark.parametrize("offset", [0.0, -3.15])
def test_swapped_images_are_named(offset):
    frame = Scene(vertical_px=offset).frame(MOUNT, index=12)
    with pytest.raises(InputError, match="swapped") as caught:
        perceive(replace(frame, left=frame.right, right=frame.left))
    assert "frame 12" in str(caught.value)
    assert "negative" in str(caught.value)


def at_infinity(index):
    """A pair with the texture of a wall and no disparity; noise of its own in each image."""
    one_eye = replace(CAMERA, baseline_m=1e-6)
    frame = Scene((WALL,), camera=one_eye, noise=3.0).frame(rover_T_camera(1.0, 0.0), index)
    return replace(frame, camera=CAMERA)


def test_a_scene_at_infinity_is_not_taken_for_a_swapped_pair():
    for index in range(6):
        perceive(at_infinity(index))


def test_a_scene_at_infinity_has_no_landmarks():
    features, _ = perceive(at_infinity(1))
    assert len(features) < 0.02 * features.keypoints[0]


@pytest.mark.parametrize("value", [0, 128, 255])
def test_images_without_texture_give_no_landmarks(value):
    features, perception = perceive(blank(value))
    assert len(features) == features.matches == features.refined == 0
    assert not perception.vertical_measured
    assert features.observations.points_cam.shape == (0, 3)


def test_one_black_image_gives_no_landmarks():
    frame = Scene().frame(MOUNT)
    features, _ = perceive(replace(frame, right=np.zeros_like(frame.right)))
    assert len(features) == 0


def test_noise_gives_next_to_nothing():
    rng = np.random.default_rng(0)
    frame = replace(
        blank(0),
        left=rng.integers(0, 255, (240, 320), np.uint8),
        right=rng.integers(0, 255, (240, 320), np.uint8),
    )
    features, _ = perceive(frame)
    assert len(features) < 0.2 * features.keypoints[0]


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(
    "image",
    [
        np.zeros((240, 321), np.uint8),
        np.zeros((320, 240), np.uint8),
        np.zeros((240, 320, 3), np.uint8),
        np.zeros((240, 320), np.float32),
        np.zeros((240, 320), np.uint16),
        np.zeros((0, 0), np.uint8),
    ],
    ids=["wide", "turned", "colour", "float", "16 bit", "empty"],
)
def test_an_image_that_does_not_fit_is_named(side, image):
    with pytest.raises(InputError) as caught:
        perceive(replace(blank(0, index=5), **{side: image}))
    assert "frame 5" in str(caught.value)
    assert caught.value.field == side


def test_equal_images_give_no_landmark():
    """Zero disparity: at infinity, certainly not behind the camera."""
    frame = Scene().frame(MOUNT)
    features, _ = perceive(replace(frame, right=frame.left.copy()))
    assert (features.observations.points_cam[:, 2] > 0.0).all()
    assert len(features) < 0.02 * features.keypoints[0]


def test_nothing_beyond_the_range_nor_at_the_border_is_kept():
    config = StereoConfig(max_depth_sigma=0.02, border_px=40.0)
    frame = Scene().frame(MOUNT)
    strict = perceive(frame, config)[0].observations
    loose = perceive(frame)[0].observations
    assert 0 < len(strict) < len(loose)
    assert strict.u_left.min() >= 40.0
    assert strict.u_left.max() <= CAMERA.width - 41.0
    assert strict.v.min() >= 40.0
    assert strict.v.max() <= CAMERA.height - 41.0
    for seen, share in ((strict, 0.02), (loose, 0.25)):
        z = seen.points_cam[:, 2]
        assert (z > 0.0).all()
        assert (np.sqrt(seen.points_covariance[:, 2, 2]) < share * z).all()


def test_nothing_nearer_than_the_search_reaches():
    config = StereoConfig(near_baselines=20.0)
    seen = perceive(Scene().frame(MOUNT), config)[0].observations
    assert np.percentile(seen.points_cam[:, 2], 2) > 0.9 * 20.0 * CAMERA.baseline_m


def test_the_same_pair_gives_the_same_bytes():
    frame = Scene().frame(MOUNT)
    perception = StereoPerception(CAMERA)
    first, second = perception.perceive(frame), perception.perceive(frame)
    third, _ = perceive(frame)
    for other in (second, third):
        for name in ("u_left", "u_right", "v", "points_cam", "points_covariance"):
            a, b = getattr(first.observations, name), getattr(other.observations, name)
            assert a.tobytes() == b.tobytes()
        assert first.descriptors.tobytes() == other.descriptors.tobytes()


@pytest.mark.parametrize(
    ("gain", "bias"),
    [
        (1.0, 0.0),
        (0.9, 0.0),
        (0.8, 10.0),
    ],
)
def test_exposure_that_differs_between_the_images_costs_no_precision(gain, bias):
    scene, level = Scene((WALL,)), rover_T_camera(1.0, 0.0)
    frame = scene.frame(level)
    right = np.clip(gain * frame.right.astype(float) + bias, 0, 255).astype(np.uint8)
    features, _ = perceive(replace(frame, right=right))
    assert len(features) > 300
    error = disparity_error(scene, level, features.observations)
    assert 1.4826 * np.median(np.abs(error)) < 0.06


def test_a_wrong_calibration_shows_as_a_disparity_error():
    """The scene's own knob: what the disparity check is there to find."""
    scene = Scene((WALL,), disparity_px=1.5)
    level = rover_T_camera(1.0, 0.0)
    seen = perceive(scene.frame(level))[0].observations
    assert np.median(disparity_error(scene, level, seen)) == pytest.approx(1.5, abs=0.05)


def sunk(frame, shift_px):
    """The right camera looks lower: its image moves up by whole pixels."""
    return replace(frame, right=np.roll(frame.right, -shift_px, axis=0))


def median_depth_error(scene, perceived, map_T_camera):
    observations = perceived.observations
    true = scene.depth(map_T_camera, observations.u_left, observations.v)
    return float(np.median(np.abs(observations.points_cam[:, 2] - true) / true))


@pytest.mark.parametrize("steps", [(1, 2, 3, 4, 5, 6), (7,)], ids=["slowly", "at once"])
def test_a_rig_that_bends_is_followed(steps):
    scene, pose_ = Scene(), rover_T_camera()
    frame = scene.frame(pose_)
    perception = StereoPerception(scene.camera)
    before = len(perception.perceive(frame))
    for shift in steps:
        perceived = perception.perceive(sunk(frame, shift))
    assert len(perceived) > 0.8 * before
    assert median_depth_error(scene, perceived, pose_) < 0.02
    assert perception.rectification.vertical_px[0] == pytest.approx(steps[-1], abs=0.3)


def dim(frame, contrast, sigma, seed):
    """Images of little contrast, in which noise hides what is small."""
    rng = np.random.default_rng(seed)

    def dimmed(image):
        value = 100.0 + contrast * (image - 128.0) + sigma * rng.standard_normal(image.shape)
        return np.clip(value, 0, 255).astype(np.uint8)

    return replace(frame, left=dimmed(frame.left), right=dimmed(frame.right))


def test_landmarks_are_found_where_noise_hides_small_things():
    scene, pose_ = Scene(), rover_T_camera()
    frame = scene.frame(pose_)
    plain = StereoPerception(scene.camera).perceive(dim(frame, 0.15, 0.0, 0))
    assert plain.noise == 1.0  # smoothed only where it helps
    squared = []
    for seed in range(3):
        noisy = StereoPerception(scene.camera).perceive(dim(frame, 0.15, 2.0, seed))
        assert noisy.noise > 2.0
        assert len(noisy) > 0.6 * len(plain)
        error = disparity_error(scene, pose_, noisy.observations)
        squared.append((error / noisy.observations.sigma_disparity_px) ** 2)
    assert np.median(np.concatenate(squared)) < 1.0  # .45 of a normal distribution
    assert np.mean(np.minimum(np.concatenate(squared), 9.0)) < 2.0


def test_a_dim_scene_gives_as_many_landmarks():
    scene, pose_ = Scene(), rover_T_camera()
    frame = scene.frame(pose_)
    found = [len(StereoPerception(scene.camera).perceive(dim(frame, c, 0.0, 0))) for c in (1, 0.15)]
    assert found[1] > 0.8 * found[0]


def test_pairs_of_two_different_scenes_are_not_landmarks():
    scene = Scene()
    here, there = (scene.frame(arc(2, 30.0)[k] @ rover_T_camera()) for k in range(2))
    perception = StereoPerception(scene.camera)
    perception.perceive(here)
    assert len(perception.perceive(replace(here, right=there.right))) < 20


def test_two_threads_see_what_one_sees():
    frame = Scene().frame(MOUNT)
    one, two = (perceive(frame, StereoConfig(threads=n))[0] for n in (1, 2))
    np.testing.assert_array_equal(one.observations.points_cam, two.observations.points_cam)
    np.testing.assert_array_equal(one.descriptors, two.descriptors)
