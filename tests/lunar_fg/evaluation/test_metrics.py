"""The figures of a run: the fixed keys, nulls with reasons, valid JSON."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from frontends.camera import level_rover_T_camera
from frontends.geometry import pose, so3_exp
from lunar_fg.evaluation import Accuracy, Metrics, evaluate, without_truth
from lunar_fg.evaluation.metrics import AteRmse, KittiDrift, NeesBand, Rpe, to_json
from lunar_fg.trajectory import PositionTrack, Trajectory
from lunar_fg.trajectory_io import read_track, read_trajectory

Simulate = Callable[..., tuple[Trajectory, Trajectory]]

KEYS = [
    "frames",
    "frames_lost",
    "distance_m",
    "ate_rmse_m",
    "scale_sim3",
    "kitti",
    "rpe",
    "final_error_m",
    "nees",
    "timing_ms",
    "matches",
    "warnings",
    "route",
    "dead_reckoning",
]


def test_the_keys_are_those_of_the_issue(simulate: Simulate) -> None:
    estimate, truth = simulate(np.random.default_rng(0), 120)
    metrics = Metrics.of_run(
        evaluate(estimate, truth),
        frames=120,
        frames_lost=2,
        timing_ms={"surf": [10.0, 12.0, 14.0], "graph": [np.nan, 2.0], "never": []},
        matches={"stereo": [100, 300, 200]},
        warnings=["vertical offset -3.15 px corrected"],
    )
    found = json.loads(metrics.to_json())
    assert list(found) == KEYS
    assert list(found["ate_rmse_m"]) == ["none", "origin", "yaw", "se3", "sim3"]
    assert list(found["kitti"]) == ["translation_percent", "rotation_deg_per_m"]
    assert list(found["rpe"]) == ["translation_m", "rotation_deg"]
    assert list(found["nees"]) == ["mean", "lower95", "upper95", "n"]
    assert found["timing_ms"]["surf"]["median"] == 12.0
    assert found["timing_ms"]["graph"] == {"median": 2.0, "p95": 2.0}
    assert "never" not in found["timing_ms"]
    assert found["matches"] == {"stereo": 200.0}
    assert found["warnings"][0].startswith("vertical offset")
    numbers = [*found["ate_rmse_m"].values(), *found["kitti"].values(), *found["nees"].values()]
    assert all(isinstance(number, float) for number in numbers)
    assert found["final_error_m"] > 0
    assert list(json.loads(evaluate(estimate, truth).to_json())) == [
        key
        for key in KEYS
        if key not in ("frames", "frames_lost", "timing_ms", "matches", "route", "dead_reckoning")
    ]


def test_null_has_a_reason(simulate: Simulate) -> None:
    estimate, truth = simulate(np.random.default_rng(0), 120)
    placed = PositionTrack(truth.stamp_s, truth.positions[:, :2])
    accuracy = evaluate(estimate, placed)
    assert accuracy.ate_rmse_m.origin is None
    assert accuracy.ate_rmse_m.se3 is not None
    assert accuracy.kitti == KittiDrift()
    assert accuracy.rpe == Rpe()
    assert accuracy.nees == NeesBand()
    assert accuracy.final_error_m is not None
    text = "\n".join(accuracy.warnings)
    for name in ("ate_rmse_m.origin", "kitti", "rpe", "nees", "final_error_m", "no z"):
        assert name in text
    assert evaluate(estimate, placed, same_map=True).nees.mean is not None


def test_same_map_takes_the_final_error_as_it_is(simulate: Simulate) -> None:
    estimate, truth = simulate(np.random.default_rng(0), 50, start_sigma=0.2)
    offset = float(np.linalg.norm(estimate.positions[-1] - truth.positions[-1]))
    assert evaluate(estimate, truth, same_map=True).final_error_m == pytest.approx(offset)
    assert evaluate(estimate, truth).final_error_m != pytest.approx(offset)


def test_a_single_pose_gives_nulls_not_errors() -> None:
    one = Trajectory(np.zeros(1), np.eye(4)[None], np.eye(6)[None])
    accuracy = evaluate(one, one)
    assert accuracy.ate_rmse_m == AteRmse(none=0.0, origin=0.0)
    assert accuracy.scale_sim3 is None
    assert json.loads(accuracy.to_json())["kitti"]["translation_percent"] is None


def test_hardly_moving_gives_no_percentages(shared_data: Path) -> None:
    still = read_trajectory(shared_data / "euroc-v101-still" / "gt_V1_01_first6s.txt")
    moved = still.moved(pose(so3_exp([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0]))
    accuracy = evaluate(moved, still)
    assert accuracy.kitti.translation_percent is None
    assert accuracy.ate_rmse_m.se3 == pytest.approx(0.0, abs=1e-9)


def test_other_body_axes_are_noticed(shared_data: Path) -> None:
    camera = read_trajectory(shared_data / "kitti-06-000-050" / "poses.txt")
    turn = level_rover_T_camera()
    rover = camera.moved(turn).of_sensor(np.linalg.inv(turn))
    assert any("deg apart" in warning for warning in evaluate(rover, camera).warnings)
    assert not any("apart" in warning for warning in evaluate(camera, camera).warnings)


def test_missing_truth_is_said(shared_data: Path) -> None:
    truth = read_track(shared_data / "moonranger-run1" / "ground_truth.csv")
    poses = np.tile(np.eye(4), (len(truth), 1, 1))
    poses[:, :3, 3] = truth.positions
    stamps = truth.stamp_s + np.where(np.arange(len(truth)) < 8, 0.1, 0.0)
    accuracy = evaluate(Trajectory(stamps, poses), truth)
    assert "120 of 128 poses have truth within 0.01 s" in accuracy.warnings
    assert without_truth(Trajectory(stamps, poses)).distance_m == pytest.approx(4.116, abs=1e-3)


def test_json_knows_no_nan() -> None:
    text = to_json({"a": float("nan"), "b": [np.float64(1.5), np.inf], "c": {"d": np.int64(3)}})
    assert json.loads(text) == {"a": None, "b": [1.5, None], "c": {"d": 3}}
    assert json.loads(Accuracy().to_json())["distance_m"] is None
