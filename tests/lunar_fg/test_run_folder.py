"""The run folder: round trips, taken places, aborted runs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel

from frontends.camera import level_rover_T_camera
from frontends.errors import InputError
from frontends.geometry import se3_exp
from frontends.measurements import Estimate
from lunar_fg.evaluation import Accuracy, Metrics
from lunar_fg.recorder import EstimateRecorder
from lunar_fg.run_folder import RunFolder
from lunar_fg.trajectory import Trajectory
from lunar_fg.trajectory_io import read_trajectory


class Config(BaseModel):
    threshold: float = 4.0
    folder: Path = Path("a/b")


def estimates(n: int) -> list[Estimate]:
    step = se3_exp([0.0, 0.0, 0.05, 0.3, 0.0, 0.0])
    pose, found = np.eye(4), []
    for i in range(n):
        found.append(Estimate(i, 0.1 * i, pose, np.eye(6) * 1e-4 * (i + 1)))
        pose = pose @ step
    return found


def test_round_trips(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "runs" / "a", Config())
    trajectory = Trajectory.from_estimates(estimates(7))
    folder.write_trajectory(trajectory)
    folder.write_metrics(Metrics.of_run(Accuracy(distance_m=1.8), frames=7, frames_lost=0))
    again = RunFolder.open(tmp_path / "runs" / "a")
    assert again.read_config() == {"threshold": 4.0, "folder": "a/b"}
    found = again.read_trajectory()
    np.testing.assert_allclose(found.map_T_rover, trajectory.map_T_rover, atol=2e-9)
    np.testing.assert_array_equal(found.covariance, trajectory.covariance)
    assert again.read_metrics()["distance_m"] == 1.8
    kitti = read_trajectory(again.kitti_path)
    np.testing.assert_allclose(kitti.map_T_rover, trajectory.map_T_rover, atol=1e-9)
    assert sorted(path.name for path in again.path.iterdir()) == [
        "config.yaml",
        "covariance.npz",
        "metrics.json",
        "plots",
        "trajectory.kitti",
        "trajectory.tum",
    ]


def test_kitti_file_can_hold_the_camera(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "a", {})
    folder.write_trajectory(
        Trajectory.from_estimates(estimates(7)), rover_T_camera=level_rover_T_camera()
    )
    kitti = read_trajectory(folder.kitti_path)
    np.testing.assert_allclose(kitti.map_T_rover[0], np.eye(4), atol=1e-12)
    assert kitti.map_T_rover[1, 2, 3] == pytest.approx(0.3, abs=0.01)
    assert read_trajectory(folder.tum_path).map_T_rover[1, 0, 3] == pytest.approx(0.3, abs=0.01)


def test_foreign_files_are_never_touched(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("mine: 1\n")
    for overwrite in (False, True):
        with pytest.raises(InputError, match="not a run's"):
            RunFolder.create(tmp_path, {}, overwrite=overwrite)
    assert (tmp_path / "config.yaml").read_text() == "mine: 1\n"
    with pytest.raises(InputError, match="is not the folder of a run"):
        RunFolder.open(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        RunFolder.open(tmp_path / "none")
    with pytest.raises(InputError, match="is a file"):
        RunFolder.create(tmp_path / "config.yaml", {})


def test_an_earlier_run_is_replaced_only_when_asked(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "a", {"seed": 1})
    folder.write_trajectory(Trajectory.from_estimates(estimates(3)))
    (folder.plots_path / "top_view.png").write_bytes(b"old")
    (folder.path / "notes.txt").write_text("kept")
    (folder.path / ".metrics.json.1.tmp").write_text("half")
    with pytest.raises(InputError, match="--overwrite"):
        RunFolder.create(tmp_path / "a", {"seed": 2})
    assert folder.read_config() == {"seed": 1}
    assert folder.tum_path.is_file()
    RunFolder.create(tmp_path / "a", {"seed": 2}, overwrite=True)
    assert folder.read_config() == {"seed": 2}
    assert not folder.tum_path.exists()
    assert not list(folder.plots_path.iterdir())
    assert not list(folder.path.glob(".*"))
    assert (folder.path / "notes.txt").read_text() == "kept"


def test_an_empty_folder_may_be_used(tmp_path: Path) -> None:
    assert RunFolder.create(tmp_path, {}).config_path.is_file()


def test_an_aborted_run_keeps_what_it_had(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "a", {})

    def run() -> None:
        with EstimateRecorder(folder) as recorder:
            for estimate in estimates(5):
                recorder.record(estimate)
            raise RuntimeError("the camera fell off")

    with pytest.raises(RuntimeError, match="fell off"):
        run()
    found = folder.read_trajectory()
    assert len(found) == 5
    assert found.covariance is not None
    assert folder.kitti_path.is_file()


def test_a_killed_run_keeps_what_it_had(tmp_path: Path) -> None:
    """Without the end of the ``with`` block: poses all, covariances up to the last save."""
    folder = RunFolder.create(tmp_path / "a", {})
    recorder = EstimateRecorder(folder)
    for estimate in estimates(53):
        recorder.record(estimate)
    assert len(folder.read_trajectory()) == 53
    with np.load(folder.covariance_path) as arrays:
        assert arrays["covariance"].shape == (50, 6, 6)


def test_a_run_without_frames_writes_no_trajectory(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "a", {})
    with EstimateRecorder(folder):
        pass
    assert not folder.tum_path.exists()
    with pytest.raises(InputError, match="No such file"):
        folder.read_trajectory()


def test_damaged_files_are_one_line_errors(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "a", {})
    folder.write_trajectory(Trajectory.from_estimates(estimates(3)))
    folder.covariance_path.write_bytes(b"not an archive")
    folder.metrics_path.write_text("{")
    folder.config_path.write_text("a: [\n")
    for read in (folder.read_trajectory, folder.read_metrics, folder.read_config):
        with pytest.raises(InputError) as caught:
            read()
        assert "\n" not in str(caught.value)
    assert json.dumps(str(caught.value))
