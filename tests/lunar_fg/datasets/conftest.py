"""Small generated datasets."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
from dataset_files import TRAVERSE, kitti_projection, textured, write_image

TESTS = Path(__file__).resolve().parents[2]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A valid folder of five frames, 1 s apart."""
    path = tmp_path / "run"
    path.mkdir()
    (path / "traverse.yaml").write_text(TRAVERSE)
    rows = ["frame,stamp_s,left,right"]
    for frame in range(5):
        names = [f"{side}/{frame:06d}.png" for side in ("left", "right")]
        for number, name in enumerate(names):
            write_image(path / name, textured(10 * frame + number))
        rows.append(f"{frame},{10.0 + frame},{names[0]},{names[1]}")
    (path / "frames.csv").write_text("\n".join(rows) + "\n")
    return path


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """A valid KITTI sequence of four frames with official calibration lines and poses."""
    path = tmp_path / "06"
    for side, name in enumerate(("image_0", "image_1")):
        for frame in range(4):
            write_image(path / name / f"{frame:06d}.png", textured(10 * frame + side))
    (path / "calib.txt").write_text(
        "".join(f"P{i}: {kitti_projection(x)}\n" for i, x in enumerate((0, -25, 3, -22)))
        + "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n"
    )
    (path / "poses.txt").write_text(
        "".join(f"1 0 0 0.5 0 1 0 0 0 0 1 {1.0 + frame}\n" for frame in range(4))
    )
    return path


@pytest.fixture(scope="session")
def moonranger(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of tests/data completed from the real data, images left where they are."""
    spec = importlib.util.spec_from_file_location("moonranger", TESTS / "data" / "moonranger.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    target = tmp_path_factory.mktemp("data") / "moonranger-run1"
    return Path(module.write_folder(shared_data / "moonranger-run1", target))
