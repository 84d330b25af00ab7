"""GeoPackage and GeoJSON: opened again with pyogrio, places and sizes as in the run."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import numpy as np
import pyogrio
import pyogrio.raw
import pytest
import shapely
from finished_run import write_finished_run
from pyproj import CRS
from typer.testing import CliRunner

from frontends.errors import InputError
from lunar_fg.cli import app
from lunar_fg.geo_export import ellipse_outlines, write_geojson, write_geopackage
from lunar_fg.georeference import CRS_TAG
from lunar_fg.results import RunResults, read_results

LAYERS = ["route", "dead_reckoning", "truth", "path", "ellipses_1_sigma", "poses", "fixes"]


@pytest.fixture
def results(tmp_path: Path) -> RunResults:
    return read_results(write_finished_run(tmp_path / "run"))


def read(path: Path, layer: str) -> tuple[dict[str, np.ndarray], np.ndarray]:
    meta, _, wkb, columns = pyogrio.raw.read(path, layer=layer)
    return dict(zip(meta["fields"], columns, strict=True)), shapely.from_wkb(wkb)


def test_the_geopackage_holds_every_layer_where_it_is_on_the_moon(
    results: RunResults, tmp_path: Path
) -> None:
    path = tmp_path / "results.gpkg"
    write_geopackage(results, path)
    assert [name for name, _ in pyogrio.list_layers(path)] == LAYERS
    for layer in LAYERS:
        info = pyogrio.read_info(path, layer=layer)
        crs = CRS.from_user_input(info["crs"])
        assert crs.ellipsoid.semi_major_metre == 1_737_400.0
        assert info["layer_metadata"][CRS_TAG] == "IAU_2015:30135"
    with sqlite3.connect(path) as database:
        systems = database.execute(
            "SELECT DISTINCT organization, organization_coordsys_id FROM gpkg_contents"
            " JOIN gpkg_spatial_ref_sys USING (srs_id)"
        ).fetchall()
    assert systems == [("IAU_2015", 30135)]
    columns, points = read(path, "poses")
    wanted = results.trajectory.positions + np.array([12_000.0, -8_000.0, 100.0])
    np.testing.assert_allclose(shapely.get_coordinates(points, include_z=True), wanted, atol=1e-6)
    np.testing.assert_allclose(columns["sigma_x_m"][:3], 0.01 * np.sqrt([1, 2, 3]), rtol=1e-6)
    assert columns["yaw_deg"][0] == pytest.approx(np.rad2deg(0.4))


def test_ellipses_are_the_ones_of_the_covariance(results: RunResults, tmp_path: Path) -> None:
    path = tmp_path / "results.gpkg"
    write_geopackage(results, path)
    columns, polygons = read(path, "ellipses_1_sigma")
    area = np.pi * columns["semi_major_m"] * columns["semi_minor_m"]
    np.testing.assert_allclose(shapely.area(polygons), area, rtol=0.01)
    covariance = results.trajectory.covariance_in("map")[:, 3:5, 3:5]
    offset = ellipse_outlines(results.trajectory) - results.trajectory.positions[:, None, :2]
    whitened = np.linalg.solve(covariance[:, None], offset[..., None])[..., 0]
    np.testing.assert_allclose(np.einsum("nki,nki->nk", offset, whitened), 1.0, rtol=1e-9)


def test_fixes_have_their_verdicts(results: RunResults, tmp_path: Path) -> None:
    path = tmp_path / "results.gpkg"
    write_geopackage(results, path)
    columns, points = read(path, "fixes")
    assert columns["verdict"].tolist() == ["accepted", "refused"]
    assert columns["reason"][1] == "9.1 sigma from what was expected"
    np.testing.assert_allclose(columns["sigma_y_m"], 0.3)
    wanted = results.trajectory.positions[[10, 20], :2] + [[0.0], [6.0]]
    plane = shapely.get_coordinates(points) - [12_000.0, -8_000.0]
    np.testing.assert_allclose(plane, wanted, atol=1e-6)


def test_geojson_is_longitude_and_latitude_of_the_moon(results: RunResults, tmp_path: Path) -> None:
    path = tmp_path / "results.geojson"
    write_geojson(results, path)
    content = json.loads(path.read_text())
    assert content["crs"]["properties"]["name"] == "urn:ogc:def:crs:IAU_2015::30100"
    poses = [f for f in content["features"] if f["properties"]["layer"] == "poses"]
    assert len(poses) == len(results.trajectory)
    lonlat = np.array([f["geometry"]["coordinates"] for f in poses])
    assert results.georeference is not None
    back = results.georeference.from_lonlat(lonlat[:, :2])
    np.testing.assert_allclose(back, results.trajectory.positions[:, :2], atol=1e-6)
    info = pyogrio.read_info(path)
    assert CRS.from_user_input(info["crs"]).ellipsoid.semi_major_metre == 1_737_400.0
    assert {f["properties"]["layer"] for f in content["features"]} == set(LAYERS)


def test_without_a_map_reference_it_is_metres_of_the_map_frame(tmp_path: Path) -> None:
    folder = write_finished_run(tmp_path / "run", crs=None)
    for name in ("gpkg", "geojson"):
        answer = CliRunner().invoke(app, ["export", str(folder.path), "--format", name])
        assert answer.exit_code == 0, answer.output
    _, points = read(folder.path / "export.gpkg", "poses")
    positions = read_results(folder).trajectory.positions
    np.testing.assert_allclose(shapely.get_coordinates(points), positions[:, :2], atol=1e-8)
    content = json.loads((folder.path / "export.geojson").read_text())
    assert content["crs"]["properties"]["name"] == "map"


def test_a_damaged_log_or_route_is_a_note_and_the_rest_is_there(tmp_path: Path) -> None:
    folder = write_finished_run(tmp_path / "run")
    folder.database_path.write_bytes(b"not a database, and long enough to look like one" * 40)
    folder.route_path.write_text("{")
    results = read_results(folder)
    assert len(results.notes) == 2
    write_geopackage(results, tmp_path / "results.gpkg")
    assert "route" not in [name for name, _ in pyogrio.list_layers(tmp_path / "results.gpkg")]


def test_a_place_that_cannot_be_written_is_an_error(results: RunResults, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        write_geopackage(results, tmp_path / "no" / "such" / "results.gpkg")
    with pytest.raises(InputError, match="cannot be written"):
        write_geojson(results, tmp_path / "no" / "such" / "results.geojson")
