import numpy as np
import pytest

from frontends.errors import InputError
from frontends.geometry import pose, so3_exp
from frontends.rectification import RectificationError
from frontends.terrain import (
    DenseStereo,
    Grid,
    RoverLimits,
    SurfacePoints,
    TerrainMap,
    find_hazards,
    without_rocks,
)
from tests.synthetic import GROUND, Scene, rover_T_camera


def points_of(frame, x, y, z, grey=100.0, sigma=0.02):
    n = len(x)
    return SurfacePoints(
        frame,
        np.stack([x, y, z], axis=1).astype(np.float32),
        np.full(n, sigma, dtype=np.float32),
        np.full(n, grey, dtype=np.float32),
        np.ones(n, dtype=np.int32),
    )


def field(height, side=8.0, spacing=0.05):
    x, y = (a.ravel() for a in np.meshgrid(*[np.arange(0.0, side, spacing)] * 2))
    return x, y, height(x, y)


def grid_of(height, cell=0.1, **kwargs):
    terrain = TerrainMap()
    terrain.add(points_of(0, *field(height, **kwargs)))
    return terrain.rasterise({0: np.eye(4)}, cell)


def test_dense_stereo_measures_the_plane_it_looks_at():
    mount = rover_T_camera(1.0, 0.35)
    scene = Scene(planes=(GROUND,))
    dense = DenseStereo(scene.camera, mount)
    points = dense.measure(scene.frame(mount))
    assert len(points) > 1000
    seen = points.points[:, 2] < 0.5  # the sky above has noise that may match
    error = points.points[seen, 2] / points.sigma_m[seen]
    assert np.median(np.abs(points.points[seen, 2])) < 0.02
    assert np.mean(np.abs(error) < 3.0) > 0.95
    assert points.points[:, 0].max() < dense.range_m + 0.5


def test_errors_of_the_rectification_are_removed_before_and_after():
    mount = rover_T_camera(1.0, 0.35)
    scene = Scene(planes=(GROUND,), vertical_px=2.0, disparity_px=1.5)
    dense = DenseStereo(scene.camera, mount)
    vertical = RectificationError(vertical_px=np.array([2.0, 0, 0, 0, 0, 0]))
    raw = dense.measure(scene.frame(mount), vertical)
    assert abs(np.median(raw.points[:, 2])) > 0.05
    fixed = raw.corrected(
        scene.camera, mount, RectificationError(disparity_px=np.array([1.5, 0.0, 0.0]))
    )
    assert abs(np.median(fixed.points[:, 2])) < 0.02


def test_grid_follows_the_poses_as_they_stand():
    terrain = TerrainMap()
    terrain.add(points_of(3, *field(lambda x, y: 0.0 * x, side=2.0)))
    terrain.add(points_of(5, *field(lambda x, y: 0.0 * x, side=2.0)))
    turned = pose(so3_exp([0.0, 0.0, np.pi / 2]), [10.0, 0.0, 1.5])
    grid = terrain.rasterise({3: np.eye(4), 5: turned}, 0.25)
    west, south, east, north = grid.grid.bounds_m
    assert (west, south, east, north) == pytest.approx((0.0, 0.0, 10.25, 2.0), abs=0.26)
    assert np.nanmax(grid.height_m) == pytest.approx(1.5)
    # the same keyframe elsewhere, after a correction: nothing stays behind
    moved = terrain.rasterise({3: np.eye(4), 5: np.eye(4)}, 0.25)
    assert np.nanmax(np.abs(moved.height_m)) < 1e-6
    assert moved.keyframes.max() == 2
    assert terrain.rasterise({9: np.eye(4)}, 0.25) is None


def test_sigma_counts_keyframes_not_pixels_and_their_disagreement():
    terrain = TerrainMap()
    for k in range(4):
        terrain.add(points_of(k, *field(lambda x, y: 0.0 * x, side=1.0)))
    same = terrain.rasterise({k: np.eye(4) for k in range(4)}, 0.25)
    one = terrain.rasterise({0: np.eye(4)}, 0.25)
    assert np.nanmedian(same.sigma_m) == pytest.approx(0.5 * np.nanmedian(one.sigma_m), rel=1e-3)
    lifted = {k: pose(np.eye(3), [0.0, 0.0, 0.1 * k]) for k in range(4)}
    apart = terrain.rasterise(lifted, 0.25)
    assert np.nanmedian(apart.sigma_m) > 2.0 * np.nanmedian(same.sigma_m)


def test_rocks_go_and_relief_stays():
    rng = np.random.default_rng(4)
    rocks = rng.uniform(0.5, 7.5, (25, 2))

    def height(x, y):
        z = 0.4 * np.sin(x / 1.6) + 0.15 * y
        for a, b in rocks:
            z = z + 0.3 * (np.hypot(x - a, y - b) < 0.2)
        return z

    terrain = grid_of(height)
    ground = without_rocks(terrain)
    x, y = terrain.grid.centres()
    on_rock = np.zeros(terrain.grid.shape, bool)
    for a, b in rocks:
        on_rock |= np.hypot(x[None] - a, y[:, None] - b) < 0.15
    assert ground[on_rock].mean() < 0.1
    assert ground[~on_rock].mean() > 0.9


def test_slope_and_step_of_known_shapes():
    slope = np.tan(np.radians(12.0))
    hazards = find_hazards(grid_of(lambda x, y: slope * (0.6 * x + 0.8 * y)))
    inner = hazards.slope_deg[15:-15, 15:-15]
    assert np.allclose(inner, 12.0, atol=0.2)
    assert np.nanmax(hazards.roughness_m) < 0.01
    assert not hazards.obstacle.any()
    steep = find_hazards(grid_of(lambda x, y: 0.5 * x))
    assert steep.obstacle[15:-15, 15:-15].all()
    stair = find_hazards(
        grid_of(lambda x, y: 0.3 * (x > 4.0)), RoverLimits(max_slope_deg=60.0, max_step_m=0.25)
    )
    columns = np.flatnonzero(stair.obstacle.any(axis=0))
    assert columns.min() >= 37
    assert columns.max() <= 42
    blocked = np.flatnonzero(stair.blocked.any(axis=0))
    assert columns.min() - blocked.min() == 9  # half the footprint's diagonal


def test_grid_refuses_what_it_cannot_hold():
    with pytest.raises(InputError, match="cell"):
        Grid.covering((0.0, 0.0, 1.0, 1.0), 0.0)
    with pytest.raises(InputError, match="cells"):
        Grid.covering((0.0, 0.0, 1e7, 1e7), 0.01)
    grid = Grid.covering((-1.0, -2.0, 3.0, 4.0), 0.5)
    assert grid.bounds_m == (-1.0, -2.0, 3.0, 4.0)
    column, row = grid.pixel(*grid.place(np.array([2.0]), np.array([3.0])))
    assert (column[0], row[0]) == pytest.approx((2.0, 3.0))
