"""Coordinate reference systems of the Moon and Mars, there and back through GeoTIFF."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import CRS, Geod
from rasterio.transform import from_origin

from frontends.errors import InputError
from lunar_fg.datasets.base import MapReference
from lunar_fg.georeference import (
    CRS_TAG,
    Georeference,
    authority_code,
    difference,
    parse_crs,
    read_crs,
    require_same,
)

CODES = ["IAU_2015:30135", "IAU_2015:30130", "IAU_2015:30110", "IAU_2015:49910", "IAU_2015:49935"]
MOON_SOUTH = "IAU_2015:30135"


def write_tif(path: Path, wkt: str | None, tag: str | None = None) -> Path:
    transform = from_origin(12_000.0, -8_000.0, 2.0, 2.0)
    with rasterio.open(
        path, "w", driver="GTiff", width=8, height=8, count=1, dtype="uint8", crs=wkt,
        transform=transform,
    ) as raster:  # fmt: skip
        raster.write(np.zeros((1, 8, 8), np.uint8))
        if tag is not None:
            raster.update_tags(**{CRS_TAG: tag})
    return path


@pytest.mark.parametrize("code", CODES)
def test_a_geotiff_without_its_code_is_still_the_same_crs(code: str, tmp_path: Path) -> None:
    crs = parse_crs(code)
    path = write_tif(tmp_path / "map.tif", crs.to_wkt())
    with rasterio.open(path) as raster:
        read_back = CRS.from_wkt(raster.crs.to_wkt())
    assert difference(crs, read_back, (12_000.0, -8_000.0)) == ""
    require_same(Georeference(crs, (12_000.0, -8_000.0, 0.0), code), read_back, path)
    tagged = read_crs(write_tif(tmp_path / "tagged.tif", crs.to_wkt(), code))
    assert authority_code(tagged) == code


def test_polar_stereographic_loses_its_code_and_is_why_the_tag_exists(tmp_path: Path) -> None:
    path = write_tif(tmp_path / "map.tif", parse_crs(MOON_SOUTH).to_wkt())
    assert authority_code(read_crs(path)) == ""


@pytest.mark.parametrize(
    ("other", "word"),
    [
        ("IAU_2015:49935", "3396190"),  # Mars
        ("EPSG:3031", "6378137"),  # Earth
        ("IAU_2015:30130", "lat"),  # the other pole
        ("+proj=stere +lat_0=-90 +lat_ts=-60 +R=1737400 +units=m +type=crs", "lat_ts"),
        ("+proj=stere +lat_0=-90 +lon_0=10 +R=1737400 +units=m +type=crs", "lon_0"),
        ("+proj=stere +lat_0=-90 +x_0=0.5 +R=1737400 +units=m +type=crs", "x_0"),
    ],
)
def test_another_body_or_projection_is_refused(other: str, word: str) -> None:
    georeference = Georeference(parse_crs(MOON_SOUTH), (0.0, 0.0, 0.0), MOON_SOUTH)
    with pytest.raises(InputError, match=word):
        require_same(georeference, parse_crs(other), "map.tif")


def test_a_radius_off_by_a_kilometre_is_refused() -> None:
    old = "+proj=stere +lat_0=-90 +R=1738400 +units=m +type=crs"
    with pytest.raises(InputError, match="another body or another model"):
        require_same(Georeference(parse_crs(MOON_SOUTH)), parse_crs(old), "map.tif")


def test_a_tag_that_contradicts_the_file_is_refused(tmp_path: Path) -> None:
    path = write_tif(tmp_path / "map.tif", parse_crs(MOON_SOUTH).to_wkt(), "IAU_2015:49935")
    with pytest.raises(InputError, match=CRS_TAG):
        read_crs(path)


@pytest.mark.parametrize("text", ["IAU_2015:1", "nonsense", "IAU_2015:30100", "EPSG:2225"])
def test_what_is_no_plane_in_metres_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="crs"):
        parse_crs(text)


def test_files_without_crs_or_content_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no coordinate reference system"):
        read_crs(write_tif(tmp_path / "bare.tif", None))
    (tmp_path / "text.tif").write_text("not a map")
    with pytest.raises(InputError, match="cannot be read"):
        read_crs(tmp_path / "text.tif")


def test_longitude_and_latitude_there_and_back() -> None:
    georeference = Georeference.of(MapReference(MOON_SOUTH, (12_000.0, -8_000.0, 100.0)))
    assert georeference.code == MOON_SOUTH
    points = np.array([[0.0, 0.0, 0.0], [300.0, -40.0, 2.0]])
    lonlat = georeference.to_lonlat(points)
    # The pole is at the plane's origin: 14.4 km away on a sphere of 1737.4 km.
    assert lonlat[0, 1] == pytest.approx(-90.0 + np.degrees(np.hypot(12, 8) / 1737.4), abs=1e-4)
    assert lonlat[0, 2] == 100.0
    np.testing.assert_allclose(georeference.from_lonlat(lonlat[:, :2]), points[:, :2], atol=1e-6)
    geod = Geod(a=1737400.0, b=1737400.0)
    *_, distance = geod.inv(*lonlat[0, :2], *lonlat[1, :2])
    assert distance == pytest.approx(np.hypot(300, 40), rel=1e-4)
