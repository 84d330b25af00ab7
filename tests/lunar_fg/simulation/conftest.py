"""A small world that the tests of this folder share: building one takes seconds."""

from __future__ import annotations

import pytest

from lunar_fg.simulation.simulate import World, build_world
from lunar_fg.simulation.spec import (
    CameraSpec,
    OrbitalSpec,
    PathSpec,
    SimulationSpec,
    SunSpec,
)


@pytest.fixture(scope="session")
def spec() -> SimulationSpec:
    return SimulationSpec(
        seed=5,
        sun=SunSpec(azimuth_deg=150.0, elevation_deg=25.0),
        camera=CameraSpec(width=256, height=256, full_well_e=1e5),
        path=PathSpec(length_m=12.0, waypoint_offset_m=2.0),
        orbital=OrbitalSpec(margin_m=20.0, sun=SunSpec(azimuth_deg=300.0, elevation_deg=20.0)),
    )


@pytest.fixture(scope="session")
def world(spec: SimulationSpec) -> World:
    return build_world(spec)
