"""Terrain maps of a rendered drive over flat ground: heights, places, formats."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from pyproj import CRS
from synthetic import CAMERA, arc, rover_T_camera, sequence
from typer.testing import CliRunner, Result

from lunar_fg.cli import app
from lunar_fg.georeference import CRS_TAG, Georeference, require_same
from lunar_fg.results import read_results
from lunar_fg.run_folder import RunFolder

ORIGIN = (12_000.0, -8_000.0, 100.0)
LAYERS = {
    "dem", "sigma", "ortho", "slope", "roughness", "step", "obstacles", "count", "keyframes",
}  # fmt: skip


def lunar_fg(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run folder of a short drive on the Moon, with its map."""
    base = tmp_path_factory.mktemp("map")
    rows = ["frame,stamp_s,left,right"]
    for frame in sequence(arc(8)):
        for side, image in (("left", frame.left), ("right", frame.right)):
            path = base / "drive" / side / f"{frame.index:03d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(path), image)
        name = f"{frame.index:03d}.png"
        rows.append(f"{frame.index},{frame.stamp_s},left/{name},right/{name}")
    (base / "drive" / "frames.csv").write_text("\n".join(rows) + "\n")
    camera = {name: getattr(CAMERA, name) for name in CAMERA.__slots__}
    (base / "drive" / "traverse.yaml").write_text(
        "schema: lunar-fg/traverse/1\n"
        f"camera: {json.dumps(camera)}\n"
        f"rover_T_camera: {rover_T_camera().tolist()}\n"
        f'map: {{crs: "IAU_2015:30135", origin: {list(ORIGIN)}}}\n'
    )
    assert lunar_fg("run", base / "drive", "-o", base / "run").exit_code == 0
    result = lunar_fg("map", base / "run", "--ply", "--spacing", 0.2)
    assert result.exit_code == 0, result.output
    return base / "run"


def test_every_layer_is_a_cloud_optimised_geotiff_of_the_moon(run: Path) -> None:
    georeference = Georeference(CRS.from_user_input("IAU_2015:30135"), ORIGIN)
    assert {path.stem for path in (run / "map").glob("*.tif")} == LAYERS
    for name in LAYERS:
        with rasterio.open(run / "map" / f"{name}.tif") as raster:
            assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG", name
            assert raster.tags()[CRS_TAG] == "IAU_2015:30135"
            require_same(georeference, CRS.from_wkt(raster.crs.to_wkt()), name)
            assert raster.descriptions[0]


def test_the_ground_is_flat_and_free_to_the_stated_sigma(run: Path) -> None:
    with rasterio.open(run / "map" / "dem.tif") as dem, \
            rasterio.open(run / "map" / "obstacles.tif") as obstacles, \
            rasterio.open(run / "map" / "sigma.tif") as sigma:  # fmt: skip
        height = dem.read(1) - ORIGIN[2]
        rows, columns = np.nonzero(np.isfinite(height))
        x, y = dem.xy(rows, columns)
        x, y = np.array(x) - ORIGIN[0], np.array(y) - ORIGIN[1]
        z, state = height[rows, columns], obstacles.read(1)[rows, columns]
        stated = sigma.read(1)[rows, columns]
    near = (x > 2.0) & (x < 5.0) & (np.abs(y) < 1.0)
    assert near.sum() > 200
    assert abs(np.median(z[near])) < 0.02
    assert np.mean(np.abs(z[near]) < 3.0 * stated[near]) > 0.9
    # Further off, the noise of this small camera is as high as a step.
    close = (x > 1.5) & (x < 2.5) & (np.abs(y) < 1.0)
    assert np.mean(state[close] == 1) < 0.2, "flat ground is no obstacle"


def test_the_cloud_holds_the_same_cells(run: Path) -> None:
    data = (run / "map" / "cloud.ply").read_bytes()
    head, _, body = data.partition(b"end_header\n")
    count = int(head.split(b"element vertex ")[1].split()[0])
    assert len(body) == 15 * count
    assert b"IAU_2015:30135 less origin 12000.000" in head
    points = np.frombuffer(body, [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    with rasterio.open(run / "map" / "count.tif") as raster:
        assert count == np.count_nonzero(raster.read(1))
    assert np.abs(points["xyz"][:, :2]).max() < 100.0
    assert points["rgb"].std() > 1.0


def test_a_corrected_trajectory_moves_the_map_without_the_images(run: Path, tmp_path: Path) -> None:
    moved = Path(shutil.copytree(run, tmp_path / "moved"))
    folder = RunFolder.open(moved)
    trajectory = read_results(folder).trajectory
    shift = np.eye(4)
    shift[:3, 3] = [3.0, -2.0, 0.5]
    folder.write_trajectory(trajectory.moved(shift))
    source = json.loads(folder.source_path.read_text())
    folder.source_path.write_text(json.dumps({**source, "dataset": "/no/such/place"}))
    result = lunar_fg("map", moved)
    assert result.exit_code == 0, result.output
    with rasterio.open(run / "map" / "dem.tif") as old, \
            rasterio.open(moved / "map" / "dem.tif") as new:  # fmt: skip
        assert new.transform.c - old.transform.c == pytest.approx(3.0, abs=0.11)
        assert new.transform.f - old.transform.f == pytest.approx(-2.0, abs=0.11)
        rise = np.nanmedian(new.read(1)) - np.nanmedian(old.read(1))
    assert rise == pytest.approx(0.5, abs=0.02)


def test_images_that_are_gone_are_one_line(run: Path, tmp_path: Path) -> None:
    gone = Path(shutil.copytree(run, tmp_path / "gone"))
    (gone / "map" / "points.npz").write_bytes(b"damaged")
    result = lunar_fg("map", gone)
    assert result.exit_code == 2
    assert "--measure" in result.stderr
    assert lunar_fg("map", gone, "--cell", 0.001).exit_code == 2
