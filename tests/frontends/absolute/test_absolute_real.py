"""SURF between real orbital images: two dates of one place, and places that differ."""

import math

import cv2
import numpy as np
import pytest
import rasterio

from frontends.absolute import match_layers
from frontends.orbital import MapWindow, Raster
from frontends.terrain import Grid


@pytest.fixture(scope="module")
def dates(shared_data):
    folder = shared_data / "hirise-multidate"
    layers = []
    for name in ("before", "after"):
        raster = Raster.open(folder / f"no_change_{name}.cub")
        west, south, _, _ = raster.bounds_m
        layers.append(Raster.open(raster.path, None, (west, south, 0.0)).window(
            (5.0, 5.0, 150.0, 150.0)))  # fmt: skip
    return layers


def crop(layer, centre, side_m, angle=0.0, scale=1.0):
    """A piece turned by `angle` and drawn `scale` too large, on a grid of its own."""
    cell = layer.grid.cell_m
    n = round(side_m / cell)
    grid = Grid(-0.5 * side_m, 0.5 * side_m, cell, n, n)
    x, y = np.meshgrid(*grid.centres())
    c, s = math.cos(angle), math.sin(angle)
    column, row = layer.grid.pixel(
        centre[0] + (c * x - s * y) / scale, centre[1] + (s * x + c * y) / scale
    )
    values = cv2.remap(
        np.nan_to_num(layer.values, nan=float(np.nanmedian(layer.values))),
        column.astype(np.float32), row.astype(np.float32), cv2.INTER_CUBIC,
    )  # fmt: skip
    return MapWindow(grid, values)


@pytest.mark.parametrize(
    ("angle_deg", "scale", "side"), [(0, 1.0, 40), (30, 1.0, 40), (135, 1.0, 60), (60, 1.2, 60)]
)
def test_a_crop_of_one_date_is_found_in_the_other(dates, angle_deg, scale, side):
    before, after = dates
    centre = (75.0, 70.0)
    angle = math.radians(angle_deg)
    piece = crop(before, centre, side, angle, scale)
    found = match_layers(piece, after, known_scale=scale == 1.0)
    assert not isinstance(found, str), found
    # the two dates themselves are registered to some pixels only
    error_px = math.hypot(found.x_m - centre[0], found.y_m - centre[1]) / after.grid.cell_m
    assert error_px < 6.0
    assert abs(math.remainder(found.yaw_rad - angle, math.tau)) < math.radians(1.0)
    assert 1.0 / found.scale == pytest.approx(scale, abs=0.02) or found.scale == pytest.approx(
        1.0 / scale, abs=0.02
    )


def test_a_false_scale_is_refused_where_the_scale_is_known(dates):
    found = match_layers(crop(dates[0], (75.0, 70.0), 60.0, 0.3, 1.2), dates[1])
    assert isinstance(found, str)
    assert "scale" in found


def test_places_that_do_not_belong_together_are_refused(dates, shared_data):
    before, after = dates
    tiles = sorted((shared_data / "gale-hirise-traverse/tiles/Gale_HiRISE/17").glob("*/*.png"))
    grid = Grid(0.0, 0.0, 0.25, 256, 256)
    for path in tiles:
        tile = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert isinstance(match_layers(MapWindow(grid, tile.astype(np.float32)), after), str)
    # two parts of one image that do not overlap
    left, right = crop(before, (35.0, 75.0), 50.0), crop(after, (115.0, 75.0), 50.0)
    assert isinstance(match_layers(left, right), str)


def test_gale_tiles_lie_in_the_tile_above_them(shared_data):
    folder = shared_data / "gale-hirise-traverse/tiles/Gale_HiRISE"
    whole_path = next((folder / "16").glob("*/*.png"))
    whole = cv2.imread(str(whole_path), cv2.IMREAD_GRAYSCALE).astype(np.float32)
    coarse = MapWindow(Grid(0.0, 0.0, 2.0, 256, 256), whole)
    x16 = int(whole_path.parent.name)
    for path in sorted((folder / "17").glob("*/*.png")):
        tile = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.float32)
        found = match_layers(MapWindow(Grid(0.0, 0.0, 1.0, 256, 256), tile), coarse)
        assert not isinstance(found, str), f"{path}: {found}"
        # half a coarse cell less half a fine one lies between the two grids' first centres
        column, row = (found.x_m + 0.5) / 256.0, (-found.y_m + 0.5) / 256.0
        assert column == pytest.approx(int(path.parent.name) - 2 * x16, abs=0.02)
        assert row - round(row) == pytest.approx(0.0, abs=0.02)
        assert abs(found.yaw_rad) < 0.01


def test_tiles_are_images(shared_data):
    path = next((shared_data / "gale-hirise-traverse/tiles/Gale_HiRISE/16").glob("*/*.png"))
    with rasterio.open(path) as file:
        assert (file.width, file.height) == (256, 256)
