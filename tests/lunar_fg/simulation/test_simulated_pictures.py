"""Rendered pictures against the truth that comes with them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from frontends.measurements import SunDirection
from frontends.photometry import shade, sun_vector
from lunar_fg.simulation.camera import (
    StereoPicture,
    camera_mount,
    pixel_rays,
    stereo_camera,
    take_pair,
)
from lunar_fg.simulation.levels import SPACINGS_M
from lunar_fg.simulation.orbital import MapFrame, as_dem, as_photograph, look_down
from lunar_fg.simulation.simulate import World, bare_ground, ground_height
from lunar_fg.simulation.spec import CameraSpec, OrbitalSpec, SimulationSpec, SunSpec

FloatArray = NDArray[np.float64]


def picture(world: World, camera: CameraSpec, sun: SunDirection, frame: int = 3) -> StereoPicture:
    pose = world.map_T_rover()[frame] @ camera_mount(camera)
    return take_pair(world.scene, pose, camera, sun, np.random.default_rng(0), depth=True)


def measured_shift(pair: StereoPicture, camera: CameraSpec) -> tuple[FloatArray, FloatArray]:
    """Columns and rows by which the right image is off where the depth says it should be.

    The right image is resampled with the disparity of the depth; what is left is measured
    at textured points by Lucas and Kanade's method.
    """
    assert pair.depth is not None
    ideal = stereo_camera(camera)
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    disparity = np.nan_to_num(ideal.fx * ideal.baseline_m / pair.depth).astype(np.float32)
    warped = cv2.remap(pair.right, u - disparity, v, cv2.INTER_CUBIC)
    corners = cv2.goodFeaturesToTrack(pair.left, 600, 0.01, 5)
    # where the depth jumps, points near the edge are seen by one camera only
    spread = cv2.dilate(pair.depth, np.ones((13, 13))) - cv2.erode(pair.depth, np.ones((13, 13)))
    column, row = np.rint(corners[:, 0]).astype(int).T
    smooth = spread[row, column] < 0.4 * pair.depth[row, column]
    smooth &= column > disparity[row, column] + 10
    start = corners[smooth]
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        pair.left, warped, start, None, winSize=(13, 13), maxLevel=0
    )
    shift = (found - start)[status[:, 0] == 1][:, 0]
    return shift[:, 0], shift[:, 1]


def test_disparity_agrees_with_depth_and_rows_are_aligned(
    world: World, spec: SimulationSpec
) -> None:
    errors, rows = [], []
    for frame in (0, 4):
        pair = picture(world, spec.camera, spec.sun.direction(), frame)
        error, shift = measured_shift(pair, spec.camera)
        errors.append(error)
        rows.append(shift)
    error, shift = np.concatenate(errors), np.concatenate(rows)
    assert len(error) > 150
    assert abs(np.median(error)) < 0.1
    assert np.median(np.abs(error)) < 0.1
    assert abs(np.median(shift)) < 0.05


def test_vertical_misalignment_is_what_was_asked_for(world: World, spec: SimulationSpec) -> None:
    camera = spec.camera.model_copy(update={"vertical_misalignment_px": 1.5})
    _, shift = measured_shift(picture(world, camera, spec.sun.direction()), camera)
    assert np.median(shift) == pytest.approx(1.5, abs=0.15)


def test_distortion_moves_pixels_as_browns_model_says() -> None:
    camera = CameraSpec(width=64, height=48, k1=-0.2, k2=0.03)
    rays = pixel_rays(camera, 1)
    ideal = stereo_camera(camera)
    x, y = rays[..., 0], rays[..., 1]
    r2 = x**2 + y**2
    stretch = 1.0 - 0.2 * r2 + 0.03 * r2**2
    u, v = np.meshgrid(np.arange(64.0), np.arange(48.0))
    np.testing.assert_allclose(ideal.fx * x * stretch + ideal.cx, u, atol=1e-5)
    np.testing.assert_allclose(ideal.fy * y * stretch + ideal.cy, v, atol=1e-5)


def test_sky_is_black_and_exposure_fills_the_range(world: World, spec: SimulationSpec) -> None:
    level = spec.camera.model_copy(update={"down_tilt_deg": 0.0})
    for elevation in (5.0, 30.0, 80.0):
        pair = picture(world, level, SunDirection(80.0, elevation))
        assert pair.depth is not None
        sky = np.isnan(pair.depth)
        away = cv2.erode(sky.astype(np.uint8), np.ones((9, 9))) == 1
        assert away.any()
        assert pair.left[away].mean() < 3
        assert 150 < np.percentile(pair.left[~sky], 99) < 250


def test_noise_is_that_of_the_photons_and_the_readout(world: World, spec: SimulationSpec) -> None:
    camera = spec.camera.model_copy(update={"full_well_e": 4000.0, "read_noise_e": 30.0})
    pose = world.map_T_rover()[2] @ camera_mount(camera)
    sun = spec.sun.direction()
    two = [
        take_pair(world.scene, pose, camera, sun, np.random.default_rng(k)).left.astype(float)
        for k in (1, 2)
    ]
    mean = 0.5 * (two[0] + two[1])
    bright = (mean > 80) & (mean < 120)
    electrons = mean[bright].mean() * 4000.0 / 255.0
    expected = np.sqrt(electrons + 30.0**2) * 255.0 / 4000.0
    measured = (two[0] - two[1])[bright].std() / np.sqrt(2.0)
    assert measured == pytest.approx(expected, rel=0.1)


def test_depth_is_that_of_the_ground(world: World, spec: SimulationSpec) -> None:
    pair = picture(world, spec.camera, spec.sun.direction())
    assert pair.depth is not None
    pose = world.map_T_rover()[3] @ camera_mount(spec.camera)
    rays = pixel_rays(spec.camera, 1) * pair.depth[..., None]
    points = rays[150:].reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
    above = points[:, 2] - ground_height(world.scene.levels, points[:, :2])
    # bilinear patches against the two triangles of a cell; stones stand above
    assert abs(np.median(above)) < 1e-4
    assert np.mean(np.abs(above) < 5e-3) > 0.85


def test_no_ray_slips_between_the_levels(world: World) -> None:
    scene = world.scene
    rng = np.random.default_rng(0)
    frame = scene.levels[-1].frame
    reach = np.array([frame.columns, frame.rows]) * SPACINGS_M[-1] + 40.0
    xy = rng.uniform(-20.0, 1.0, (200_000, 2)) + rng.uniform(0.0, 1.0, (200_000, 2)) * reach
    origins = np.column_stack([xy, np.full(len(xy), 300.0)]) - [*scene.middle[:2], 0.0]
    down = np.tile(np.float32([[0.0, 0.0, -1.0]]), (len(xy), 1))
    hits = scene.trace(origins.astype(np.float32), down)
    assert np.all(hits.part >= 0)
    ground = hits.part < len(scene.levels)
    height = 300.0 - hits.distance[ground] + scene.middle[2]
    known = ground_height(scene.levels, xy[ground])
    below = known - height
    # a ray through a seam would go on to nothing, or to far below
    assert below.max() < 0.3
    assert np.median(np.abs(below)) < 1e-3


def test_shadows_lie_away_from_the_sun(world: World, spec: SimulationSpec) -> None:
    """Around the larger stones, brightness on the side away from the Sun and towards it."""
    rocks = world.rocks
    large = np.nonzero((rocks.diameter > 0.3) & (rocks.distance < 15.0))[0]
    assert len(large) > 2
    for azimuth in (40.0, 160.0, 280.0):
        orbital = OrbitalSpec(gsd_m=0.05, sun=SunSpec(azimuth_deg=azimuth, elevation_deg=20.0))
        towards = sun_vector(SunDirection(azimuth, 0.0))[:2]
        sides = []
        for k in large:
            pair = []
            for side in (-0.65, 0.65):
                x, y = rocks.xy[k] + side * rocks.diameter[k] * towards
                spot = MapFrame(x - 0.05, y + 0.05, 0.05, 2, 2)
                pair.append(float(look_down(world.scene, spot, orbital, 0.02).mean()))
            sides.append(pair)
        away, facing = np.array(sides).T
        # low stones, and stones in a shadow, cast none
        right, wrong = np.sum(away < 0.4 * facing), np.sum(facing < 0.4 * away)
        assert right > 4
        assert right > 5 * wrong


def shift_px(a: NDArray[np.float32], b: NDArray[np.float32]) -> FloatArray:
    """Columns and rows by which `b` lies off `a`, by their detail of 2 to 12 px."""

    def detail(image: NDArray[np.float32]) -> NDArray[np.float32]:
        smooth = cv2.GaussianBlur(image, (0, 0), 2.0) - cv2.GaussianBlur(image, (0, 0), 12.0)
        return np.ascontiguousarray(smooth[20:220, 20:220] / smooth.std())

    warp = np.eye(2, 3, dtype=np.float32)
    alike, warp = cv2.findTransformECC(detail(a), detail(b), warp, cv2.MOTION_TRANSLATION)
    assert alike > 0.5
    return np.array(warp[:, 2], dtype=np.float64)


def test_ortho_lies_on_the_dem(world: World, spec: SimulationSpec) -> None:
    """By way of the bare ground: its shading on the ortho, its heights on the DEM; 0.3 px."""
    frame, orbital = world.map_frame, spec.orbital
    rng = np.random.default_rng(1)
    radiance = look_down(world.scene, frame, orbital, spec.camera.fill_light)
    ortho = as_photograph(radiance, orbital, rng).astype(np.float32)
    ground = bare_ground(world.scene, frame)
    sun = orbital.sun.direction()
    shaded = shade(ground, frame.gsd_m, sun, cast_shadows=True)
    dem = cv2.resize(as_dem(ground, orbital, rng), ortho.shape[::-1])
    to_ortho, to_dem = shift_px(shaded, ortho), shift_px(ground, dem)
    assert np.hypot(*(to_ortho - to_dem)) < 0.3
    assert np.hypot(*to_ortho) < 0.15
    moved = shift_px(shaded, np.roll(ortho, 1, axis=1))
    assert moved[0] - to_ortho[0] == pytest.approx(1.0, abs=0.1)
