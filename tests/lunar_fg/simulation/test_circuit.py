"""A drive that leads around, and its second half under another sun."""

import numpy as np
import pytest

from lunar_fg.datasets import open_dataset
from lunar_fg.simulation.drive import region_of
from lunar_fg.simulation.simulate import simulate
from lunar_fg.simulation.spec import CameraSpec, OrbitalSpec, PathSpec, SimulationSpec, SunSpec

SPEC = SimulationSpec(
    seed=3,
    sun=SunSpec(azimuth_deg=150.0, elevation_deg=20.0),
    later_sun=SunSpec(azimuth_deg=330.0, elevation_deg=20.0),
    camera=CameraSpec(width=64, height=64, supersampling=1),
    path=PathSpec(length_m=64.0, step_m=8.0, circuit_m=30.0, waypoint_offset_m=0.5),
    orbital=OrbitalSpec(margin_m=3.0, gsd_m=1.0, wrong_map=False),
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("circuit") / "data"
    simulate(SPEC, folder, workers=1)
    return open_dataset(folder)


def test_every_lap_is_beside_the_one_before(dataset):
    xy = dataset.ground_truth.map_T_rover[:, :2, 3]
    west, south, east, north = region_of(SPEC.path)
    assert ((xy > [west, south]) & (xy < [east, north])).all()
    apart = np.linalg.norm(xy[:, None] - xy[None], axis=-1)
    later = [apart[k, : k - 2].min() for k in range(len(xy) - 3, len(xy))]
    assert max(later) < 4.6  # frames are 8 m apart: half a step and the weaving
    assert min(later) > 0.02
    assert np.ptp(xy, axis=0).min() > 2.0


def test_the_later_sun_lights_the_second_half_only(dataset, tmp_path):
    simulate(SPEC.model_copy(update={"later_sun": None}), tmp_path / "data", workers=1)
    plain = open_dataset(tmp_path / "data")
    np.testing.assert_array_equal(plain.ground_truth.map_T_rover, dataset.ground_truth.map_T_rover)
    alike = [
        np.corrcoef(a.left[24:].ravel(), b.left[24:].ravel())[0, 1]
        for a, b in zip(plain.frames(), dataset.frames(), strict=True)
    ]
    half = len(alike) // 2
    assert min(alike[:half]) > 0.999
    assert max(alike[half:]) < 0.9


def test_no_single_sun_is_stated_where_there_are_two(dataset):
    assert all(frame.sun is None for frame in dataset.frames())
