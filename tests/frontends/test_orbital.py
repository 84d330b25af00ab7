import numpy as np
import pytest
import rasterio
from rasterio.crs import CRS
from rasterio.transform import from_origin

from frontends.errors import InputError
from frontends.orbital import OrbitalMap, Raster
from frontends.terrain import Grid

MOON = "IAU_2015:30135"


def write(path, values, *, west=1000.0, north=2000.0, cell=0.5, crs=MOON, tags=None, **profile):
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=values.shape[0],
        width=values.shape[1],
        count=1,
        dtype=values.dtype,
        crs=None if crs is None else CRS.from_user_input(crs),
        transform=from_origin(west, north, cell, cell),
        **profile,
    ) as file:
        file.write(values, 1)
        file.update_tags(**(tags or {}))
    return path


def ramp(rows=80, columns=100):
    row, column = np.mgrid[:rows, :columns]
    return (10.0 * row + column).astype(np.float32)


def test_window_lies_where_the_file_says(tmp_path):
    raster = Raster.open(write(tmp_path / "m.tif", ramp()), MOON, (1010.0, 1990.0, 0.0))
    assert raster.gsd_m == pytest.approx(0.5)
    assert raster.bounds_m == pytest.approx((-10.0, -30.0, 40.0, 10.0))
    window = raster.window((0.0, -5.0, 4.0, 5.0))
    assert window.values.shape == (20, 8)
    # map (0, 5) is 20 columns and 10 rows into the file
    assert np.allclose(window.values, ramp()[10:30, 20:28])
    outside = raster.window((-12.0, -5.0, -8.0, 0.0))
    assert np.isnan(outside.values[:, :4]).all()
    assert np.isfinite(outside.values[:, 4:]).all()


def test_coarse_windows_are_averages_and_no_data_stays_out(tmp_path):
    values = ramp()
    values[:10] = -9999.0
    raster = Raster.open(write(tmp_path / "m.tif", values, nodata=-9999.0))
    window = raster.window((1000.0, 1980.0, 1020.0, 2000.0), 2.0)
    assert np.isnan(window.values[:2]).all()
    assert window.values[3, 0] == pytest.approx(values[12:16, :4].mean())


def test_scale_and_offset(tmp_path):
    path = write(tmp_path / "m.tif", np.full((10, 10), 100, dtype=np.uint16))
    with rasterio.open(path, "r+") as file:
        file.scales, file.offsets = (0.5,), (7.0,)
    assert np.allclose(Raster.open(path).window((1001, 1996, 1003, 1998)).values, 57.0)


def test_another_projection_is_warped(tmp_path):
    other = "+proj=stere +lat_0=-90 +lon_0=10 +R=1737400 +units=m +no_defs"
    raster = Raster.open(write(tmp_path / "m.tif", ramp()), other)
    x, y = np.cos(np.radians(10)), np.sin(np.radians(10))
    # polar stereographic: another central meridian turns the plane about the pole
    east, north = 1025.0 * x - 1980.0 * y, 1025.0 * y + 1980.0 * x
    window = raster.on(Grid(east, north, 0.5, 1, 1))
    assert window.values[0, 0] == pytest.approx(10.0 * 39.5 + 49.5, abs=1.0)


def test_sun_and_dem(tmp_path):
    tags = {"SUN_AZIMUTH_DEG": "120", "SUN_ELEVATION_DEG": "25"}
    ortho = write(tmp_path / "o.tif", ramp(), tags=tags)
    dem = write(tmp_path / "d.tif", ramp(40, 50), cell=1.0)
    found = OrbitalMap.open(ortho, dem, crs=MOON, origin_m=(1000.0, 1960.0, 100.0))
    assert (found.sun.azimuth_deg, found.sun.elevation_deg) == (120.0, 25.0)
    heights = found.height((0.0, 38.0, 2.0, 40.0))
    assert np.allclose(heights.values, ramp()[:2, :2] - 100.0)
    assert OrbitalMap.open(dem).sun is None


def test_refusals(tmp_path):
    (tmp_path / "no.tif").write_bytes(b"no map")
    with pytest.raises(InputError, match="cannot be read as a map"):
        Raster.open(tmp_path / "no.tif")
    with pytest.raises(InputError, match="not a CRS"):
        Raster.open(write(tmp_path / "m.tif", ramp()), "EPSG:nonsense")
    with pytest.raises(InputError, match="neither"):
        OrbitalMap.open(None)


def test_real_cubes_and_dems(shared_data):
    cube = Raster.open(shared_data / "hirise-multidate" / "no_change_before.cub")
    west, south, east, north = cube.bounds_m
    assert cube.gsd_m == pytest.approx(0.257, abs=1e-3)
    window = cube.window((west, south, east, north))
    share = np.isnan(window.values).mean()
    assert 0.05 < share < 0.08  # its special pixels
    dem = Raster.open(shared_data / "gale-hirise-traverse" / "missionDEM.tif")
    box = dem.bounds_m
    middle = dem.window((box[0] + 100, box[1] + 100, box[0] + 110, box[1] + 110))
    assert -4473 < middle.values.min() <= middle.values.max() < -4437
