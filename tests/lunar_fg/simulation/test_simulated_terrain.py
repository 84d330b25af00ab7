"""The statistics of ground and stones, and that one seed gives one place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

from frontends.errors import InputError
from lunar_fg.simulation.base_relief import read_base_relief
from lunar_fg.simulation.craters import Craters, draw_craters
from lunar_fg.simulation.levels import make_levels
from lunar_fg.simulation.rocks import draw_rocks
from lunar_fg.simulation.simulate import World
from lunar_fg.simulation.spec import TerrainSpec
from lunar_fg.simulation.terrain import GridFrame, make_terrain
from lunar_fg.simulation.texture import make_texture

NEAR = (-10.0, -10.0, 30.0, 10.0)


def test_relief_is_fractal_with_the_stated_exponents() -> None:
    spec = TerrainSpec(crater_density=0.0, roughness_m=0.01)

    def exponent(spacing: float, lags: tuple[int, int]) -> float:
        size = 600 * spacing
        rms = np.zeros(2)
        for seed in range(4):
            terrain = make_terrain(spec, seed, NEAR)
            height = terrain.height(GridFrame(-size / 2, -size / 2, spacing, 600, 600))
            rms += [np.mean((height[:, lag:] - height[:, :-lag]) ** 2) for lag in lags]
        return float(0.5 * np.log(rms[1] / rms[0]) / np.log(lags[1] / lags[0]))

    assert exponent(1.0, (4, 32)) == pytest.approx(0.85, abs=0.1)
    # flatter below a metre, though the long waves' slope steepens the structure function
    assert exponent(0.05, (3, 10)) < 0.8


def test_craters_follow_the_size_frequency_law() -> None:
    rng = np.random.default_rng(0)
    craters = draw_craters(rng, 0.05, [(0.5, 100.0, (0.0, 0.0, 300.0, 300.0))])
    for diameter in (0.5, 1.0, 3.0):
        expected = 0.05 * (diameter**-2 - 1e-4) * 300.0**2
        assert len(craters.larger_than(diameter)) == pytest.approx(expected, rel=0.1)
    assert craters.depth.min() < 0.02
    assert craters.depth.max() > 0.12


def test_a_crater_has_its_depth_a_raised_rim_and_an_end() -> None:
    crater = Craters(*(np.array([v]) for v in (0.0, 0.0, 10.0, 0.14)), lobes=np.zeros((1, 4)))
    height = np.zeros((401, 401))
    crater.add_to(height, -20.0, -20.0, 0.1)
    profile = height[200, 200:]
    assert profile[0] == pytest.approx(-1.4, abs=0.05)
    rim = int(np.argmax(profile))
    assert rim == pytest.approx(50, abs=5)
    assert 0.15 < profile[rim] < 0.4
    assert not profile[151:].any()


def test_rocks_follow_the_size_frequency_law() -> None:
    drive = np.column_stack([np.linspace(0.0, 400.0, 4000), np.zeros(4000)])
    spec = TerrainSpec(rock_density=2e-3)
    counts = np.zeros(2)
    for seed in range(6):
        rocks = draw_rocks(spec, np.random.default_rng(seed), drive)
        near = (rocks.distance < 6.0) & (rocks.distance > 2.0)
        counts += [(near & (rocks.diameter > size)).sum() for size in (0.03, 0.1)]
        assert not ((rocks.distance < 0.9) & (rocks.diameter > 0.12)).any()
    measured = np.log(counts[0] / counts[1]) / np.log(0.1 / 0.03)
    assert measured == pytest.approx(2.11, abs=0.15)


def test_one_seed_is_one_place() -> None:
    frame = GridFrame(0.0, 0.0, 0.1, 100, 100)
    one, same, other = (make_terrain(TerrainSpec(), seed, NEAR).height(frame) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 0.01


def test_levels_agree_where_they_meet(world: World) -> None:
    for parent, child in zip(world.scene.levels[:-1], world.scene.levels[1:], strict=True):
        border = child.cells[0] if child.cells[0].any() else child.cells[:1].any(axis=0)
        columns = np.nonzero(border)[0]
        x = child.frame.x0 + child.frame.spacing_m * columns
        y = np.full(len(x), child.frame.y0)
        np.testing.assert_allclose(child.height[0, columns], parent.at(x, y), atol=1e-9)


def test_texture_does_not_repeat_at_its_period() -> None:
    texture = make_texture(
        np.random.default_rng(0),
        texel_m=0.01,
        size=256,
        waves_m=(0.03, 0.2),
        exponent=0.7,
        rms_at_1m=0.005,
        tone_rms=0.1,
        sun=None,
    )
    x = np.linspace(0.0, 20.0, 5000, dtype=np.float32)
    y = np.full_like(x, 3.0)
    footprint = np.full_like(x, 0.01)
    here = texture.sample(x, y, footprint)[:, 2]
    there = texture.sample(x, y + np.float32(2.56), footprint)[:, 2]
    assert abs(np.corrcoef(here, there)[0, 1]) < 0.2
    # far away it is averaged, not aliased
    far = texture.sample(x, y, np.full_like(x, 0.6))[:, 2]
    assert far.std() < 0.3 * here.std()


def test_base_relief_is_kept_and_detail_is_added(shared_data: Path) -> None:
    path = shared_data / "lola-southpole" / "NPC_final_adj_5mpp_surf_piece_2km_2_1.tif"
    base = read_base_relief(path)
    with rasterio.open(path) as file:
        raw = file.read(1)
        row, column = 200, 180
        east, north = file.xy(row, column)
    x, y = np.array([east - base.origin[0]]), np.array([north - base.origin[1]])
    assert base.at(x, y)[0] + base.origin[2] == pytest.approx(raw[row, column], abs=0.01)
    terrain = make_terrain(TerrainSpec(dem=path), 0, NEAR)
    frame = GridFrame(-10.0, -10.0, 0.25, 81, 81)
    detail = terrain.height(frame) - base.at(*frame.nodes())
    assert 0.02 < detail.std() < 0.6
    levels = make_levels(terrain, np.zeros((1, 2)), NEAR)
    assert np.ptp(levels[0].height) > 50.0


def test_unusable_base_reliefs_are_refused(tmp_path: Path) -> None:
    missing = tmp_path / "no.tif"
    with pytest.raises(InputError, match="cannot be read"):
        read_base_relief(missing)
    local = tmp_path / "local.tif"
    with rasterio.open(
        local, "w", driver="GTiff", height=30, width=30, count=1, dtype="float32"
    ) as file:
        file.write(np.zeros((30, 30), dtype=np.float32), 1)
    with pytest.raises(InputError, match="no projected CRS"):
        read_base_relief(local)
