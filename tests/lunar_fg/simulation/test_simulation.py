"""The dataset as a whole: readable, repeatable, cached; and what is refused."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
import rasterio

from frontends.errors import InputError
from frontends.measurements import StereoFrame
from lunar_fg.commands.simulate import adapted
from lunar_fg.datasets import open_dataset
from lunar_fg.simulation import cache
from lunar_fg.simulation.camera import camera_mount
from lunar_fg.simulation.parallel import in_processes
from lunar_fg.simulation.simulate import World, simulate
from lunar_fg.simulation.spec import (
    CameraSpec,
    OrbitalSpec,
    PathSpec,
    SimulationSpec,
    SunSpec,
    read_spec,
)
from lunar_fg.trajectory_io import read_trajectory

TINY = SimulationSpec(
    seed=3,
    camera=CameraSpec(width=96, height=64, supersampling=1),
    path=PathSpec(length_m=3.0, waypoint_offset_m=1.0),
    orbital=OrbitalSpec(margin_m=8.0, gsd_m=0.5, sun=SunSpec(azimuth_deg=290.0)),
    depth=True,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("simulated") / "data"
    simulate(TINY, path, workers=1)
    return path


def digests(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_same_seed_same_bytes_on_any_number_of_processes(folder: Path, tmp_path: Path) -> None:
    simulate(TINY, tmp_path / "again", workers=2)
    assert digests(tmp_path / "again") == digests(folder)


def test_the_dataset_opens_with_all_that_it_holds(folder: Path) -> None:
    dataset = open_dataset(folder)
    frames = list(dataset.frames())
    assert len(frames) == 3
    for frame in frames:
        assert isinstance(frame, StereoFrame)
        assert frame.left.shape == (64, 96)
        assert frame.attitude is not None
        assert frame.sun is not None
    assert frames[1].odometry is not None
    assert abs(frames[1].odometry.d_forward_m - 1.5) < 0.3
    assert dataset.orbital is not None
    assert dataset.orbital.sun is not None
    assert dataset.map_reference is not None
    truth = dataset.ground_truth
    assert truth is not None
    assert truth.map_T_rover is not None
    camera = read_trajectory(folder / "truth" / "camera.tum")
    expected = truth.map_T_rover @ camera_mount(TINY.camera)
    np.testing.assert_allclose(camera.map_T_rover, expected, atol=1e-6)
    depth = np.load(folder / "truth" / "depth" / "000001.npy")
    assert depth.shape == (64, 96)
    assert read_spec(folder / "simulation.yaml") == TINY


def test_maps_lie_where_they_say(folder: Path) -> None:
    east, north, up = TINY.orbital.origin
    truth = read_trajectory(folder / "ground_truth.tum").positions
    with rasterio.open(folder / "orbital" / "dem.tif") as dem:
        assert dem.crs.is_projected
        at = [(x + east, y + north) for x, y, _ in truth]
        heights = np.array([value[0] for value in dem.sample(at)]) - up
        assert dem.res == (1.0, 1.0)
    assert np.abs(heights - truth[:, 2]).max() < 0.5
    with rasterio.open(folder / "orbital" / "ortho.tif") as ortho:
        assert ortho.res == (0.5, 0.5)
        assert ortho.tags()["SUN_AZIMUTH_DEG"] == "290"
        image, bounds = ortho.read(1), ortho.bounds
    with rasterio.open(folder / "orbital_wrong" / "ortho.tif") as wrong:
        assert wrong.bounds == bounds
        alike = np.corrcoef(image.ravel(), wrong.read(1).ravel())[0, 1]
    assert abs(alike) < 0.3


def test_a_second_call_takes_the_cached_dataset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rendered = []

    def fake(spec: SimulationSpec, folder: Path, **_: object) -> None:
        folder.mkdir(parents=True)
        (folder / "simulation.yaml").write_text("{}")
        rendered.append(spec.seed)

    monkeypatch.setattr(cache, "simulate", fake)
    first = cache.cached_dataset(TINY, root=tmp_path)
    assert cache.cached_dataset(TINY, root=tmp_path) == first
    other = TINY.model_copy(update={"seed": 4})
    assert cache.cached_dataset(other, root=tmp_path) != first
    assert rendered == [3, 4]
    assert not list(tmp_path.glob(".*"))
    for seed in range(10, 20):
        cache.cached_dataset(TINY.model_copy(update={"seed": seed}), root=tmp_path)
    assert len(list(tmp_path.iterdir())) <= 6


def test_an_interrupted_rendering_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: SimulationSpec, folder: Path, **__: object) -> None:
        folder.mkdir(parents=True)
        raise KeyboardInterrupt

    monkeypatch.setattr(cache, "simulate", broken)
    with pytest.raises(KeyboardInterrupt):
        cache.cached_dataset(TINY, root=tmp_path)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_simulated_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"command line: path\.length_m"):
        adapted(TINY, length=-5.0)
    with pytest.raises(InputError, match="--sun"):
        adapted(TINY, sun="south")
    with pytest.raises(InputError, match=r"sun\.elevation_deg"):
        adapted(TINY, sun="150,-3")
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="not empty"):
        simulate(TINY, taken)
    wrong = tmp_path / "spec.yaml"
    wrong.write_text("camera: {widht: 5}\n")
    with pytest.raises(InputError, match=r"camera\.widht"):
        read_spec(wrong)
    no_dem = adapted(TINY, dem=tmp_path / "no.tif")
    with pytest.raises(InputError, match=r"no\.tif"):
        simulate(no_dem, tmp_path / "out")


def test_a_drive_larger_than_its_dem_is_refused(shared_data: Path, tmp_path: Path) -> None:
    tile = shared_data / "lola-southpole" / "NPB_final_adj_5mpp_surf_piece_1km_2_12.tif"
    with pytest.raises(InputError, match="too small"):
        simulate(adapted(TINY, dem=tile, length=900.0), tmp_path / "out")


def test_errors_of_other_processes_arrive_here(world: World) -> None:
    def work(job: int) -> int:
        if job == 3:
            raise InputError("cannot be done", source="job")
        return job * job

    with pytest.raises(InputError, match="cannot be done"):
        list(in_processes(work, range(6), workers=2))
    assert sorted(in_processes(work, [0, 1, 2], workers=2)) == [(0, 0), (1, 1), (2, 4)]
