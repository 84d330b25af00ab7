"""Drift figures: agreement with evo and with the benchmark's definition on real data."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lunar_fg.evaluation.alignment import AlignmentKind, align
from lunar_fg.evaluation.association import Pair, UndefinedMetricError, associate
from lunar_fg.evaluation.drift import (
    ate_rmse_m,
    drift_profile,
    relative_pose_error,
    segment_errors,
    segment_plan,
)
from lunar_fg.trajectory import PositionTrack, Trajectory
from lunar_fg.trajectory_io import read_trajectory, write_tum

EVO = 1e-6
ESTIMATES = [("07", "libviso_orig"), ("07", "bfm_refined"), ("00", "libviso_refined")]


def real_pair(shared_data: Path, sequence: str, system: str, folder: Path) -> Pair:
    """A real estimate and its truth; rotations of few digits made exact by way of TUM."""
    root = shared_data / "kitti-gt-poses"
    tracks = []
    for path in (
        root / "stereo-vo-estimates" / f"vo_kitti_{sequence}_{system}.txt",
        root / "gt" / f"{sequence}.txt",
    ):
        write_tum(folder / "t.tum", read_trajectory(path))
        tracks.append(read_trajectory(folder / "t.tum"))
    return associate(*tracks)


def evo_path(poses: np.ndarray) -> Any:
    trajectory = pytest.importorskip("evo.core.trajectory")
    return trajectory.PosePath3D(poses_se3=list(poses.copy()))


def evo_rmse(metric: Any, truth: Any, estimate: Any) -> float:
    metrics = pytest.importorskip("evo.core.metrics")
    metric.process_data((truth, estimate))
    return float(metric.get_statistic(metrics.StatisticsType.rmse))


def evo_ate(estimate: Any, truth: Any, kind: AlignmentKind) -> float:
    metrics = pytest.importorskip("evo.core.metrics")
    if kind is AlignmentKind.ORIGIN:
        estimate.align_origin(truth)
    elif kind is not AlignmentKind.NONE:
        estimate.align(truth, correct_scale=kind is AlignmentKind.SIM3)
    return evo_rmse(metrics.APE(metrics.PoseRelation.translation_part), truth, estimate)


@pytest.mark.parametrize(("sequence", "system"), ESTIMATES)
def test_ate_and_rpe_agree_with_evo(
    shared_data: Path, tmp_path: Path, sequence: str, system: str
) -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    pair = real_pair(shared_data, sequence, system, tmp_path)
    truth = evo_path(pair.true_poses)
    for kind in set(AlignmentKind) - {AlignmentKind.YAW}:
        expected = evo_ate(evo_path(pair.estimate.map_T_rover), truth, kind)
        assert ate_rmse_m(pair, align(kind, pair)) == pytest.approx(expected, abs=EVO)
    translation, rotation = relative_pose_error(pair)
    estimate = evo_path(pair.estimate.map_T_rover)
    for found, relation in (
        (translation, metrics.PoseRelation.translation_part),
        (rotation, metrics.PoseRelation.rotation_angle_deg),
    ):
        rpe = metrics.RPE(relation, 1, metrics.Unit.frames)
        assert found == pytest.approx(evo_rmse(rpe, truth, estimate), abs=EVO)


def test_planar_truth_agrees_with_evo_on_zeros(shared_data: Path, tmp_path: Path) -> None:
    pair = real_pair(shared_data, "07", "libviso_orig", tmp_path)
    planar = PositionTrack(pair.truth.stamp_s, pair.truth.positions[:, [0, 2]])
    poses = np.tile(np.eye(4), (len(planar), 1, 1))
    poses[:, :3, 3] = planar.positions
    placed = associate(pair.estimate, planar)
    for kind in (AlignmentKind.NONE, AlignmentKind.SE3, AlignmentKind.SIM3):
        expected = evo_ate(evo_path(pair.estimate.map_T_rover), evo_path(poses), kind)
        assert ate_rmse_m(placed, align(kind, placed)) == pytest.approx(expected, abs=EVO)


def kitti_benchmark(pair: Pair, lengths: tuple[float, ...], step: int) -> tuple[float, float]:
    """Segment errors written out as loops, from the benchmark's description."""
    truth, estimate = pair.true_poses, pair.estimate.map_T_rover
    distance = [0.0]
    for a, b in pairwise(truth):
        distance.append(distance[-1] + float(np.linalg.norm(b[:3, 3] - a[:3, 3])))
    translation, rotation = [], []
    for first in range(0, len(truth), step):
        for length in lengths:
            ends = [i for i in range(first, len(truth)) if distance[i] > distance[first] + length]
            if not ends:
                continue
            true_motion = np.linalg.inv(truth[first]) @ truth[ends[0]]
            motion = np.linalg.inv(estimate[first]) @ estimate[ends[0]]
            error = np.linalg.inv(motion) @ true_motion
            angle = np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))
            rotation.append(np.rad2deg(angle) / length)
            translation.append(100 * np.linalg.norm(error[:3, 3]) / length)
    return float(np.mean(translation)), float(np.mean(rotation))


@pytest.mark.parametrize("frames", [1101, 60, 12])
def test_segments_follow_the_benchmark(shared_data: Path, tmp_path: Path, frames: int) -> None:
    whole = real_pair(shared_data, "07", "libviso_refined", tmp_path)
    truth = whole.truth
    assert isinstance(truth, Trajectory)
    pair = associate(whole.estimate.select(slice(0, frames)), truth.select(slice(0, frames)))
    found = segment_errors(pair)
    step = 10 if frames == 1101 else 1
    expected = kitti_benchmark(pair, found.lengths_m, step)
    assert (found.translation_percent, found.rotation_deg_per_m) == pytest.approx(expected)
    if frames == 1101:
        assert found.lengths_m == (100.0, 200.0, 300.0, 400.0, 500.0, 600.0)


def test_lengths_suit_the_path() -> None:
    assert segment_plan(3000.0, 900.0) == (tuple(100.0 * k for k in range(1, 9)), 10)
    assert segment_plan(394.0, 390.0) == ((100.0, 200.0, 300.0), 10)
    assert segment_plan(59.9, 59.0) == ((10.0, 20.0, 30.0, 40.0, 50.0), 1)
    assert segment_plan(25.0, 20.0) == ((10.0, 20.0), 1)
    assert segment_plan(4.0, 4.0)[0] == pytest.approx((0.4, 0.8, 1.2, 1.6, 2.0))
    with pytest.raises(UndefinedMetricError, match="stays within"):
        segment_plan(3.0, 0.01)


def test_a_perfect_estimate_has_no_error(shared_data: Path) -> None:
    truth = read_trajectory(shared_data / "kitti-06-000-050" / "poses.txt")
    pair = associate(truth, truth)
    for kind in AlignmentKind:
        assert ate_rmse_m(pair, align(kind, pair)) == pytest.approx(0.0, abs=1e-6)
    segments = segment_errors(pair)
    assert segments.translation_percent == pytest.approx(0.0, abs=1e-6)
    assert relative_pose_error(pair)[0] == pytest.approx(0.0, abs=1e-6)


def test_a_scale_error_is_seen_as_such() -> None:
    poses = np.tile(np.eye(4), (101, 1, 1))
    poses[:, 0, 3] = np.arange(101) * 0.5
    short = poses.copy()
    short[:, 0, 3] *= 0.98
    stamps = np.arange(101.0)
    pair = associate(Trajectory(stamps, short), Trajectory(stamps, poses))
    # A segment ends at the first pose past its length, hence the little more than 2 %.
    assert segment_errors(pair).translation_percent == pytest.approx(2.0, rel=0.06)
    assert segment_errors(pair).rotation_deg_per_m == pytest.approx(0.0, abs=1e-9)
    assert align(AlignmentKind.SIM3, pair).scale == pytest.approx(1 / 0.98)
    profile = drift_profile(pair, align(AlignmentKind.ORIGIN, pair))
    np.testing.assert_allclose(profile.position_m, 0.02 * profile.distance_m, atol=1e-12)
    assert profile.orientation_deg is not None
    np.testing.assert_allclose(profile.orientation_deg, 0.0, atol=1e-9)
