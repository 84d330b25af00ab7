"""Orbital maps in the archives' formats, huge ones, and ones that mean harm."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import psutil
import pytest
import rasterio
from rasterio.shutil import copy
from rasterio.transform import from_origin

from frontends.errors import InputError
from frontends.orbital import OrbitalMap, Raster

#: 10 m about a place inside the HiRISE cutout.
EAST, NORTH = 75.55 + 60.0, -2111841.3 - 70.0


def cube(shared_data: Path) -> Path:
    return shared_data / "hirise-multidate" / "no_change_before.cub"


def pds3_of(tif: Path, target: Path) -> None:
    """A PDS3 map by hand: label of one record, then the samples."""
    with rasterio.open(tif) as source:
        values, place = source.read(1), source.transform
    rows, columns = values.shape
    label = (
        "PDS_VERSION_ID = PDS3\r\nRECORD_TYPE = FIXED_LENGTH\r\nRECORD_BYTES = 2400\r\n"
        f"FILE_RECORDS = {rows + 1}\r\nLABEL_RECORDS = 1\r\n^IMAGE = 2\r\nTARGET_NAME = MARS\r\n"
        f"OBJECT = IMAGE\r\n LINES = {rows}\r\n LINE_SAMPLES = {columns}\r\n SAMPLE_BITS = 32\r\n"
        " SAMPLE_TYPE = PC_REAL\r\n BANDS = 1\r\n MISSING_CONSTANT = -32768.0\r\nEND_OBJECT = IMAGE"
        '\r\nOBJECT = IMAGE_MAP_PROJECTION\r\n MAP_PROJECTION_TYPE = "EQUIRECTANGULAR"\r\n'
        " A_AXIS_RADIUS = 3389.341 <KM>\r\n B_AXIS_RADIUS = 3389.341 <KM>\r\n"
        " C_AXIS_RADIUS = 3389.341 <KM>\r\n CENTER_LATITUDE = 0.0 <DEGREE>\r\n"
        f" CENTER_LONGITUDE = 0.0 <DEGREE>\r\n MAP_SCALE = {place.a} <METERS/PIXEL>\r\n"
        f" LINE_PROJECTION_OFFSET = {place.f / place.a - 0.5}\r\n"
        f" SAMPLE_PROJECTION_OFFSET = {-place.c / place.a - 0.5}\r\n"
        "END_OBJECT = IMAGE_MAP_PROJECTION\r\nEND\r\n"
    )
    target.write_bytes(label.encode().ljust(2400) + values.astype("<f4").tobytes())


@pytest.mark.parametrize(
    ("driver", "suffix"),
    [("GTiff", "tif"), ("ISIS3", "cub"), ("PDS4", "xml"), ("VICAR", "vic"),
     ("JP2OpenJPEG", "jp2"), ("PDS", "img")],
)  # fmt: skip
def test_every_format_shows_the_same_place(
    shared_data: Path, tmp_path: Path, driver: str, suffix: str
) -> None:
    """A real HiRISE cube brought to each format: the same window, to the format's precision."""
    bounds = (EAST, NORTH, EAST + 10.0, NORTH + 10.0)
    expected = Raster.open(cube(shared_data)).window(bounds).values
    with rasterio.open(cube(shared_data)) as source:
        profile, values = source.profile, source.read(1)
    scale = 6e5 if driver == "JP2OpenJPEG" else 1.0  # whole numbers only
    values = np.where(values < 0.0, 0.0, values) * scale
    values = values.astype(np.uint16 if scale > 1.0 else np.float32)
    tif = tmp_path / "plain.tif"
    with rasterio.open(
        tif, "w", driver="GTiff", width=600, height=600, count=1, dtype=values.dtype,
        crs=profile["crs"], transform=profile["transform"], nodata=0,
    ) as target:  # fmt: skip
        target.write(values, 1)
    file = tmp_path / f"map.{suffix}"
    if driver == "PDS":
        pds3_of(tif, file)
    elif driver != "GTiff":
        lossless = {"QUALITY": "100", "REVERSIBLE": "YES"} if scale > 1.0 else {}
        copy(str(tif), str(file), driver=driver, **lossless)
    else:
        file = tif
    raster = Raster.open(file)
    assert raster.gsd_m == pytest.approx(0.25697, abs=1e-4)
    got = raster.window(bounds).values / scale
    assert np.isfinite(got).all()
    np.testing.assert_allclose(got, expected, atol=2e-5)


def test_another_projection_of_mars_finds_the_same_stones(shared_data: Path) -> None:
    """The cube in a polar map frame: the image is turned and scaled, not moved."""
    own = Raster.open(cube(shared_data))
    with rasterio.open(cube(shared_data)) as source:
        crs = source.crs
        x, y = source.transform * (300, 300)
    polar = (
        'PROJCS["polar",'
        + crs.to_wkt().split("PROJCS", 1)[1].split(",", 1)[1].split(",PROJ")[0]
        + ',PROJECTION["Polar_Stereographic"],PARAMETER["latitude_of_origin",-90],'
        'PARAMETER["central_meridian",0],PARAMETER["scale_factor",1],PARAMETER["false_easting",0],'
        'PARAMETER["false_northing",0],UNIT["metre",1]]'
    )
    from rasterio.warp import transform as warp_points

    px, py = (values[0] for values in warp_points(crs, polar, [x], [y]))
    moved = Raster.open(cube(shared_data), polar, (px, py, 0.0))
    middle = moved.window((-3.0, -3.0, 3.0, 3.0)).values
    here = own.window((x - 3.0, y - 3.0, x + 3.0, y + 3.0)).values
    assert np.nanmean(middle) == pytest.approx(float(np.nanmean(here)), rel=0.02)


def test_the_gale_elevation_model_and_its_no_data(shared_data: Path) -> None:
    dem = shared_data / "gale-hirise-traverse" / "missionDEM.tif"
    place = OrbitalMap.open(None, dem, origin_m=(8142406.0, -276655.0, -4450.0))
    heights = place.height((20.0, 20.0, 120.0, 120.0))
    assert heights is not None
    assert -40.0 < np.nanmin(heights.values) < np.nanmax(heights.values) < 40.0
    beyond = place.height((-50.0, 0.0, -10.0, 20.0))
    assert beyond is not None
    assert np.isnan(beyond.values).all()


@pytest.fixture(scope="module")
def huge(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """50,000 x 50,000 pixels (2.5 GB as bytes), mostly sparse, one block written."""
    file = tmp_path_factory.mktemp("huge") / "map.tif"
    with rasterio.open(
        file, "w", driver="GTiff", width=50_000, height=50_000, count=1, dtype="uint8",
        crs="IAU_2015:30135", transform=from_origin(0.0, 25_000.0, 0.5, 0.5), tiled=True,
        blockxsize=512, blockysize=512, SPARSE_OK="TRUE", BIGTIFF="YES",
    ) as target:  # fmt: skip
        block = np.random.default_rng(0).integers(1, 255, (512, 512), dtype=np.uint8)
        target.write(block, 1, window=((25_088, 25_600), (25_088, 25_600)))
    return file


def test_a_huge_map_never_enters_memory(huge: Path) -> None:
    process = psutil.Process()
    raster = Raster.open(huge)
    before = process.memory_info().rss
    for shift in range(5):
        window = raster.window((12_544.0 + shift, 12_200.0, 12_800.0 + shift, 12_456.0))
        assert window.values.shape == (512, 512)
    assert window.values.max() > 100
    assert process.memory_info().rss - before < 200_000_000
    with pytest.raises(InputError, match="cells"):
        raster.window(raster.bounds_m)


def test_overviews_serve_coarse_windows(huge: Path, tmp_path: Path) -> None:
    file = tmp_path / "map.tif"
    with rasterio.open(
        file, "w", driver="GTiff", width=4096, height=4096, count=1, dtype="uint8", tiled=True,
        crs="IAU_2015:30135", transform=from_origin(0.0, 2048.0, 0.5, 0.5),
    ) as target:  # fmt: skip
        target.write(np.full((4096, 4096), 100, np.uint8), 1)
        target.build_overviews([8], rasterio.enums.Resampling.average)
    # a mark in the overview alone shows which one is read
    with rasterio.open(file, "r+", OVERVIEW_LEVEL=0) as level:
        assert level.shape == (512, 512)
        level.write(np.full((512, 512), 200, np.uint8), 1)
    values = Raster.open(file).window((0.0, 0.0, 2048.0, 2048.0), 8.0).values
    assert np.nanmedian(values) == 200.0


@pytest.mark.parametrize(
    ("name", "content", "part"),
    [
        ("a.tif", b'<VRTDataset rasterXSize="9" rasterYSize="9"></VRTDataset>', "no known format"),
        ("a.tif", b"<GDAL_WMS><Service></Service></GDAL_WMS>", "no known format"),
        ("a.tif", b"", "no known format"),
        ("a.tif", b"II*\0" + struct.pack("<I", 8) + b"\xff" * 40, "cannot be read"),
        ("a.lbl", b'PDS_VERSION_ID = PDS3\r\n^IMAGE = ("/etc/passwd", 1)\r\nEND\r\n', "outside"),
        ("a.xml", b"<Product_Observational><file_name>../x.img</file_name>", "outside"),
        ("a.cub", b"Object = IsisCube\r\n  Object = Core\r\n ^Core = ../x\r\n", "outside"),
        ("a.cub", b"Object = IsisCube\n Object = Core\n Samples = 999999999\n", "cannot be read"),
    ],
)
def test_hostile_and_broken_maps(tmp_path: Path, name: str, content: bytes, part: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=part):
        Raster.open(tmp_path / name)


def test_a_truncated_map_is_said_when_it_is_read(shared_data: Path, tmp_path: Path) -> None:
    data = cube(shared_data).read_bytes()
    (tmp_path / "cut.cub").write_bytes(data[: len(data) // 2])
    raster = Raster.open(tmp_path / "cut.cub")
    with pytest.raises(InputError, match="cannot be read"):
        raster.window((EAST, NORTH - 70.0, EAST + 10.0, NORTH - 60.0))
