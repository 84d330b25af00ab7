"""The live view: a headless run leaves a recording that Rerun itself reads again."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import CRS
from rasterio.transform import from_origin
from synthetic import CAMERA, arc, rover_T_camera, sequence

from frontends.errors import DependencyError
from frontends.measurements import StartPrior
from lunar_fg.datasets.base import MapReference, OrbitalFiles
from lunar_fg.live import LiveView, open_live_view
from lunar_fg.navigator import Navigator


class Drive:
    """As much of a dataset as the live view asks for."""

    path = Path("drive")
    camera = CAMERA
    start = StartPrior()
    map_reference = MapReference("IAU_2015:30135", (12_000.0, -8_000.0, 0.0))

    def __init__(self, ortho: Path | None) -> None:
        self.rover_T_camera = rover_T_camera()
        self.orbital = None if ortho is None else OrbitalFiles(ortho, None, None)


def write_ortho(path: Path) -> Path:
    with rasterio.open(
        path, "w", driver="GTiff", width=64, height=64, count=1, dtype="uint8",
        crs=CRS.from_user_input("IAU_2015:30135").to_wkt(),
        transform=from_origin(11_984.0, -7_984.0, 0.5, 0.5),
    ) as raster:  # fmt: skip
        raster.write(np.random.default_rng(0).integers(0, 255, (1, 64, 64), dtype=np.uint8))
    return path


def test_a_headless_run_is_recorded_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    drive = Drive(write_ortho(tmp_path / "ortho.tif"))
    recording = tmp_path / "run.rrd"
    view = open_live_view(drive, recording)  # type: ignore[arg-type]
    navigator = Navigator(CAMERA, rover_T_camera=drive.rover_T_camera)
    for frame in sequence(arc(3)):
        view.observe(frame, navigator, navigator.step(frame))
    view.close()
    printed = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", str(recording)],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    text = printed.stdout + printed.stderr
    for entity in (
        "/images/left", "/images/right", "/images/left/landmarks", "/images/left/disparity",
        "/map/landmarks", "/map/path", "/map/uncertainty", "/map/rover", "/map/orbital",
        "/matches/inliers", "/sigma/forward",
    ):  # fmt: skip
        assert entity in text, entity
    assert "blueprint" in text.lower(), "an explicit blueprint"


def test_without_rerun_it_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(DependencyError, match=r"lunar-fg\[viz\]"):
        LiveView(Drive(None), tmp_path / "run.rrd")  # type: ignore[arg-type]
