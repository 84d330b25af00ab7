"""Association and alignment: invariances, special cases."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frontends.errors import InputError
from frontends.geometry import pose, so3_exp
from lunar_fg.evaluation.alignment import (
    Alignment,
    AlignmentKind,
    align,
    common_frame,
    fit_similarity,
    fit_yaw,
)
from lunar_fg.evaluation.association import Pair, UndefinedMetricError, associate
from lunar_fg.evaluation.drift import ate_rmse_m
from lunar_fg.trajectory import PositionTrack, Trajectory

SEEDS = st.integers(0, 100_000)
FITTED = [AlignmentKind.YAW, AlignmentKind.SE3, AlignmentKind.SIM3]


def wandering(rng: np.random.Generator, n: int = 30) -> Trajectory:
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, 3] = np.cumsum(rng.normal(size=(n, 3)), axis=0)
    poses[:, :3, :3] = [so3_exp(rng.normal(size=3)) for _ in range(n)]
    return Trajectory(np.arange(float(n)), poses)


def noisy(rng: np.random.Generator, truth: Trajectory) -> Trajectory:
    poses = truth.map_T_rover.copy()
    poses[:, :3, 3] += rng.normal(0, 0.3, (len(truth), 3))
    return Trajectory(truth.stamp_s, poses)


@settings(max_examples=40, deadline=None)
@given(seed=SEEDS)
def test_fits_recover_what_was_done(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(12, 3))
    done = Alignment(so3_exp(rng.normal(size=3)), rng.normal(size=3), rng.uniform(0.2, 5.0))
    found = fit_similarity(source, done.points(source), with_scale=True)
    np.testing.assert_allclose(found.rotation, done.rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, done.translation, atol=1e-9)
    assert found.scale == pytest.approx(done.scale)
    turned = Alignment(so3_exp([0, 0, rng.uniform(-3, 3)]), rng.normal(size=3))
    found = fit_yaw(source, turned.points(source))
    np.testing.assert_allclose(found.rotation, turned.rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, turned.translation, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(seed=SEEDS)
def test_fitted_errors_ignore_what_the_fit_may_change(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = wandering(rng)
    estimate = noisy(rng, truth)
    turn = pose(so3_exp(rng.normal(size=3)), rng.normal(0, 100, 3))
    yaw = pose(so3_exp([0, 0, rng.uniform(-3, 3)]), rng.normal(0, 100, 3))
    cases = [
        (AlignmentKind.YAW, estimate.moved(yaw)),
        (AlignmentKind.ORIGIN, estimate.moved(turn)),
        (AlignmentKind.SE3, estimate.moved(turn)),
        (AlignmentKind.SIM3, Alignment(turn[:3, :3], turn[:3, 3], 3.0).trajectory(estimate)),
    ]
    for kind, moved in cases:
        before, after = associate(estimate, truth), associate(moved, truth)
        expected = ate_rmse_m(before, align(kind, before))
        assert ate_rmse_m(after, align(kind, after)) == pytest.approx(expected, rel=1e-6)


@settings(max_examples=30, deadline=None)
@given(seed=SEEDS)
def test_more_freedom_never_fits_worse(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = wandering(rng)
    pair = associate(
        noisy(rng, truth).moved(pose(so3_exp(rng.normal(0, 0.1, 3)), [1, 2, 3])), truth
    )
    errors = [ate_rmse_m(pair, align(kind, pair)) for kind in [AlignmentKind.NONE, *FITTED]]
    assert all(a >= b - 1e-9 for a, b in pairwise(errors))


def test_scale_carries_the_covariance_along() -> None:
    truth = wandering(np.random.default_rng(0), 3)
    with_covariance = Trajectory(truth.stamp_s, truth.map_T_rover, np.tile(np.eye(6), (3, 1, 1)))
    scaled = Alignment(np.eye(3), np.zeros(3), 2.0).trajectory(with_covariance)
    assert scaled.covariance is not None
    np.testing.assert_allclose(np.diag(scaled.covariance[0]), [1, 1, 1, 4, 4, 4])


def test_straight_and_mirrored_paths_give_proper_rotations() -> None:
    line = np.linspace(0, 1, 9)[:, None] * [3.0, 2.0, 1.0]
    found = fit_similarity(line, line[:, [2, 1, 0]], with_scale=True)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(found.points(line), line[:, [2, 1, 0]], atol=1e-9)
    cloud = np.random.default_rng(1).normal(size=(30, 3))
    mirrored = fit_similarity(cloud, cloud * [1, 1, -1], with_scale=False)
    assert np.linalg.det(mirrored.rotation) == pytest.approx(1.0)


def test_what_is_not_determined_is_undefined() -> None:
    with pytest.raises(UndefinedMetricError, match="scale"):
        fit_similarity(np.ones((5, 3)), np.zeros((5, 3)), with_scale=True)
    with pytest.raises(UndefinedMetricError, match="fewer than two"):
        fit_yaw(np.ones((1, 3)), np.ones((1, 3)))
    truth = wandering(np.random.default_rng(2))
    positions = PositionTrack(truth.stamp_s, truth.positions)
    with pytest.raises(UndefinedMetricError, match="no orientation"):
        align(AlignmentKind.ORIGIN, associate(truth, positions))


def test_common_frame_hides_no_error() -> None:
    truth = wandering(np.random.default_rng(2))
    posed = associate(truth, truth)
    placed = associate(truth, PositionTrack(truth.stamp_s, truth.positions))
    assert common_frame(posed, same_map=True) is AlignmentKind.NONE
    assert common_frame(posed, same_map=False) is AlignmentKind.ORIGIN
    assert common_frame(placed, same_map=False) is AlignmentKind.SE3


def stamps_of(estimate: list[float], truth: list[float], tolerance_s: float = 0.01) -> Pair:
    def track(stamps: list[float]) -> Trajectory:
        return Trajectory(np.array(stamps), np.tile(np.eye(4), (len(stamps), 1, 1)))

    return associate(track(estimate), track(truth), tolerance_s)


def test_association_takes_the_nearest_once() -> None:
    pair = stamps_of([0.0, 1.0, 2.0], [0.004, 0.996, 1.003, 5.0])
    np.testing.assert_array_equal(pair.estimate.stamp_s, [0.0, 1.0])
    np.testing.assert_array_equal(pair.truth.stamp_s, [0.004, 1.003])
    assert pair.estimate_poses == 3
    pair = stamps_of([0.0, 0.1, 0.2, 0.3, 0.4], [0.0, 0.205, 0.4])
    np.testing.assert_array_equal(pair.estimate.stamp_s, [0.0, 0.2, 0.4])
    pair = stamps_of([0.99, 1.0, 1.01], [1.004, 7.0, 8.0], 0.02)
    np.testing.assert_array_equal(pair.estimate.stamp_s, [1.0])
    assert len(stamps_of([1.0], [1.0])) == 1


def test_association_agrees_with_evo() -> None:
    sync = pytest.importorskip("evo.core.sync")
    rng = np.random.default_rng(4)
    truth = np.arange(400) * 0.05
    estimate = np.sort(rng.choice(truth, 120, replace=False)) + rng.uniform(-0.02, 0.02, 120)
    pair = stamps_of(list(estimate), list(truth), 0.01)
    i, j = sync.matching_time_indices(estimate, truth, 0.01)
    np.testing.assert_array_equal(pair.estimate.stamp_s, estimate[i])
    np.testing.assert_array_equal(pair.truth.stamp_s, truth[j])


def test_nothing_to_associate_is_an_input_error() -> None:
    with pytest.raises(InputError, match=r"no stamps agree within 0\.01 s"):
        stamps_of([0.0, 1.0], [1403.0, 1404.0])
    with pytest.raises(InputError, match="truth: holds no pose"):
        stamps_of([0.0], [])
    poses = np.tile(np.eye(4), (5, 1, 1))
    rows = Trajectory(np.arange(5.0), poses, indexed=True)
    stamped = Trajectory(np.arange(5.0) * 0.1, poses)
    assert len(associate(stamped, rows)) == 5
    with pytest.raises(InputError, match="4 estimated poses, 5 true ones"):
        associate(stamped.select(slice(0, 4)), rows)
