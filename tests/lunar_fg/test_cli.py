"""The commands as a user types them, on rendered and on real sequences."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic import CAMERA, arc, write_drive
from typer.testing import CliRunner, Result

from lunar_fg.cli import app
from lunar_fg.log import TraverseLog

FRAMES = 14
METRICS = [
    "frames", "frames_lost", "distance_m", "ate_rmse_m", "scale_sim3", "kitti", "rpe",
    "final_error_m", "nees", "timing_ms", "matches", "warnings",
    "route", "dead_reckoning",
]  # fmt: skip


def lunar_fg(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short drive in the folder format, with truth."""
    return write_drive(tmp_path_factory.mktemp("rendered") / "drive", arc(FRAMES))


@pytest.fixture
def drive(rendered: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    return Path(shutil.copytree(rendered, tmp_path / "drive"))


@pytest.fixture(scope="module")
def finished(rendered: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of the rendered drive."""
    folder = tmp_path_factory.mktemp("runs") / "drive"
    result = lunar_fg("run", rendered, "-o", folder)
    assert result.exit_code == 0, result.output
    return folder


def one_line_error(result: Result) -> str:
    """Text of the one error line of a refused command."""
    assert result.exit_code == 2, result.output
    lines = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, result.stderr
    return lines[0]


def test_a_run_writes_everything_that_is_promised(finished: Path) -> None:
    for name in (
        "config.yaml", "trajectory.tum", "trajectory.kitti", "covariance.npz", "metrics.json",
        "run.log", "run.db", "plots/top_view.png", "plots/drift.png", "plots/timing.png",
    ):  # fmt: skip
        assert (finished / name).stat().st_size > 0, name
    metrics = json.loads((finished / "metrics.json").read_text())
    assert list(metrics) == METRICS
    assert metrics["frames"] == FRAMES
    assert metrics["frames_lost"] == 0
    assert metrics["ate_rmse_m"]["se3"] < 0.02 * metrics["distance_m"]
    assert metrics["timing_ms"]["total"]["median"] > 0
    assert metrics["matches"]["inliers"] > 30
    with np.load(finished / "covariance.npz") as arrays:
        assert arrays["covariance"].shape == (FRAMES, 6, 6)


def test_a_drive_off_its_route_is_said_everywhere(rendered: Path, tmp_path: Path) -> None:
    line = {"type": "LineString", "coordinates": [[0.0, 0.0], [-0.5, 3.0]]}
    content = {"type": "Feature", "properties": {"half_width_m": 0.4}, "geometry": line}
    (tmp_path / "plan.geojson").write_text(json.dumps(content))
    folder = tmp_path / "run"
    result = lunar_fg("run", rendered, "-o", folder, "--route", tmp_path / "plan.geojson")
    assert result.exit_code == 0, result.output
    route = json.loads((folder / "metrics.json").read_text())["route"]
    assert "outside the corridor of +-0.4 m" in route["alarms"][0]
    assert "outside the corridor" in (folder / "run.log").read_text()
    assert len((folder / "route.csv").read_text().splitlines()) == FRAMES + 1
    assert json.loads((folder / "source.json").read_text())["dataset"] == str(rendered)
    assert len((folder / "frames.csv").read_text().splitlines()) == FRAMES + 1


def test_the_log_gives_back_every_measurement(finished: Path) -> None:
    with TraverseLog.open(finished / "run.db") as log:
        keyframes = log.keyframes()
    assert [keyframe.index for keyframe in keyframes] == list(range(FRAMES))
    assert all(k.observations is not None and len(k.observations) > 30 for k in keyframes)


def test_optimize_improves_or_keeps_the_trajectory(finished: Path) -> None:
    result = lunar_fg("optimize", finished)
    assert result.exit_code == 0, result.output
    assert "cost" in result.stdout
    before = json.loads((finished / "metrics.json").read_text())
    after = json.loads((finished / "batch" / "metrics.json").read_text())
    assert after["ate_rmse_m"]["se3"] < 1.5 * before["ate_rmse_m"]["se3"] + 1e-3
    assert (finished / "batch" / "plots" / "top_view.png").stat().st_size > 0


def test_eval_prints_the_keys_of_the_metrics(finished: Path, rendered: Path) -> None:
    files = finished / "trajectory.tum", rendered / "ground_truth.tum"
    result = lunar_fg("eval", *files, "--json")
    assert result.exit_code == 0, result.output
    accuracy = json.loads(result.stdout)
    assert set(accuracy) == set(METRICS) - {
        "frames",
        "frames_lost",
        "timing_ms",
        "matches",
        "route",
        "dead_reckoning",
    }
    in_run = json.loads((finished / "metrics.json").read_text())
    assert accuracy["ate_rmse_m"]["se3"] == pytest.approx(in_run["ate_rmse_m"]["se3"], abs=1e-6)
    table = lunar_fg("eval", *files)
    assert "ATE, SE3-aligned" in table.stdout


def test_an_earlier_run_is_not_overwritten_unasked(rendered: Path, finished: Path) -> None:
    before = (finished / "trajectory.tum").read_bytes()
    assert "--overwrite" in one_line_error(lunar_fg("run", rendered, "-o", finished))
    assert (finished / "trajectory.tum").read_bytes() == before


def test_settings_are_read_checked_and_written(drive: Path, tmp_path: Path) -> None:
    config = tmp_path / "settings.yaml"
    config.write_text("stereo: {max_keypoints: 300}\n")
    result = lunar_fg("run", drive, "-o", tmp_path / "out", "--config", config, "--seed", 7)
    assert result.exit_code == 0, result.output
    written = (tmp_path / "out" / "config.yaml").read_text()
    assert "max_keypoints: 300" in written
    assert "seed: 7" in written
    config.write_text("stereo: {max_keypoint: 300}\n")
    refused = lunar_fg("run", drive, "-o", tmp_path / "other", "--config", config)
    assert "stereo.max_keypoint" in one_line_error(refused)
    assert not (tmp_path / "other").exists()


def spoil_missing(drive: Path) -> None:
    (drive / "right" / "006.png").unlink()


def spoil_nan(drive: Path) -> None:
    text = (drive / "traverse.yaml").read_text()
    (drive / "traverse.yaml").write_text(text.replace('"fx": 240.0', '"fx": .nan'))


def spoil_stamps(drive: Path) -> None:
    lines = (drive / "frames.csv").read_text().splitlines()
    lines[5] = lines[5].replace(",2.0,", ",1.5,")
    (drive / "frames.csv").write_text("\n".join(lines) + "\n")


def spoil_empty(drive: Path) -> None:
    shutil.rmtree(drive)
    drive.mkdir()


def spoil_size(drive: Path) -> None:
    for path in (drive / "left").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path))[:-16])


def spoil_swapped(drive: Path) -> None:
    (drive / "left").rename(drive / "other")
    (drive / "right").rename(drive / "left")
    (drive / "other").rename(drive / "right")


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (spoil_missing, "right/006.png"),
        (spoil_nan, "fx"),
        (spoil_stamps, "frames.csv: line 6"),
        (spoil_empty, "the folder is empty"),
        (spoil_size, "left/000.png"),
        (spoil_swapped, "swapped"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(drive, tmp_path, spoil, says) -> None:
    spoil(drive)
    assert says in one_line_error(lunar_fg("run", drive, "-o", tmp_path / "out"))


def spoil_truncated(drive: Path) -> None:
    path = drive / "left" / "006.png"
    path.write_bytes(path.read_bytes()[:2000])


def spoil_black(drive: Path) -> None:
    cv2.imwrite(str(drive / "left" / "006.png"), np.zeros((CAMERA.height, CAMERA.width), np.uint8))


def spoil_one_size(drive: Path) -> None:
    path = drive / "left" / "006.png"
    cv2.imwrite(str(path), cv2.imread(str(path))[:-16])


@pytest.mark.parametrize("spoil", [spoil_truncated, spoil_black, spoil_one_size])
def test_a_bad_frame_costs_that_frame_only(drive, tmp_path, spoil) -> None:
    spoil(drive)
    result = lunar_fg("run", drive, "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["frames"] == FRAMES
    assert metrics["frames_lost"] == 1
    assert any("frame 6" in text and "006.png" in text for text in metrics["warnings"])
    assert "006.png" in (tmp_path / "out" / "run.log").read_text()


def test_nothing_computed_is_lost_when_the_input_breaks(drive, tmp_path, monkeypatch) -> None:
    from frontends.errors import InputError
    from lunar_fg.navigator import Navigator

    step = Navigator.step

    def breaks(self, frame):
        if frame.index == 9:
            raise InputError("broke", source="frame 9")
        return step(self, frame)

    monkeypatch.setattr(Navigator, "step", breaks)
    assert "broke" in one_line_error(lunar_fg("run", drive, "-o", tmp_path / "out"))
    rows = (tmp_path / "out" / "trajectory.tum").read_text().split("\n")
    assert len([row for row in rows if row and not row.startswith("#")]) == 9
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["frames"] == 9
    assert any("stopped early" in text for text in metrics["warnings"])
    assert (tmp_path / "out" / "plots" / "top_view.png").exists()


def test_no_usable_frame_is_an_error(drive, tmp_path) -> None:
    for path in (drive / "right").iterdir():
        path.write_bytes(path.read_bytes()[:500])
    error = one_line_error(lunar_fg("run", drive, "-o", tmp_path / "out"))
    assert "right/" in error or "none of its frames" in error


def test_eval_refuses_files_that_do_not_fit(tmp_path: Path) -> None:
    (tmp_path / "est.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 5)
    (tmp_path / "gt.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 4)
    refused = lunar_fg("eval", tmp_path / "est.txt", tmp_path / "gt.txt")
    assert "5" in one_line_error(refused)
    assert "missing.txt" in one_line_error(
        lunar_fg("eval", tmp_path / "missing.txt", tmp_path / "gt.txt")
    )


def test_optimize_needs_a_run(tmp_path: Path) -> None:
    assert "no such folder" in one_line_error(lunar_fg("optimize", tmp_path / "nowhere"))


def test_kitti_06_beats_every_peer(shared_data: Path, tmp_path: Path) -> None:
    result = lunar_fg("run", shared_data / "kitti-06-000-050", "-o", tmp_path / "k06")
    assert result.exit_code == 0, result.output
    metrics = json.loads((tmp_path / "k06" / "metrics.json").read_text())
    assert metrics["frames_lost"] == 0
    assert metrics["ate_rmse_m"]["se3"] < 0.041  # ORB-SLAM3's best of six runs


def test_moonranger_run1_beats_every_peer(shared_data: Path, tmp_path: Path) -> None:
    traverse = Path(__file__).parents[1] / "data" / "moonranger-run1" / "traverse.yaml"
    result = lunar_fg(
        "run", shared_data / "moonranger-run1", "--traverse", traverse, "-o", tmp_path / "run1"
    )
    assert result.exit_code == 0, result.output
    metrics = json.loads((tmp_path / "run1" / "metrics.json").read_text())
    assert metrics["frames_lost"] == 0
    assert metrics["ate_rmse_m"]["se3"] < 0.055
    warnings = " ".join(metrics["warnings"])
    assert "px apart vertically" in warnings
    assert "disparity error" in warnings


def test_the_kitti_demo_agrees_with_itself(tmp_path: Path) -> None:
    result = lunar_fg("demo", "--kitti", "-o", tmp_path / "demo")
    assert result.exit_code == 0, result.output
    assert "135 keyframes" in result.stdout
    gap_mm = float(result.stdout.split("all landmarks ")[-1].split(" mm")[0])
    assert gap_mm < 10.0
    assert (tmp_path / "demo" / "plots" / "top_view.png").exists()


def test_faults_are_injected_survived_and_said(rendered: Path, tmp_path: Path) -> None:
    result = lunar_fg(
        "run", rendered, "-o", tmp_path / "run", "--inject", "frozen@5-6", "--inject", "swapped@8-9"
    )
    assert result.exit_code == 0, result.output
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    told = "\n".join(metrics["warnings"])
    for text in (
        "injected fault: FrozenCamera, frames 5 to 6",
        "frames 5 to 6: the left image is that of the frame before",
        "frame 8: came after a later one",
    ):
        assert text in told
    assert metrics["frames"] == FRAMES - 1
    assert metrics["ate_rmse_m"]["se3"] < 0.05


def test_an_unknown_fault_is_named(rendered: Path, tmp_path: Path) -> None:
    result = lunar_fg("run", rendered, "-o", tmp_path / "run", "--inject", "frosen@5-6")
    assert "frozen" in one_line_error(result)
    assert not (tmp_path / "run").exists()
