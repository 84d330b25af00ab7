"""NEES: honest covariances lie in the band, others do not (Monte Carlo)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from frontends.geometry import pose, so3_exp
from lunar_fg.evaluation import share_start
from lunar_fg.evaluation.association import Pair, UndefinedMetricError, associate
from lunar_fg.evaluation.consistency import Nees, NeesFrame, coverage, nees, pooled
from lunar_fg.trajectory import PositionTrack, Trajectory

Simulate = Callable[..., tuple[Trajectory, Trajectory]]
RUNS = 60


def campaign(
    simulate: Simulate,
    frame: NeesFrame,
    see: Callable[[Trajectory, Trajectory], Pair] = associate,
    **options: float,
) -> list[Nees]:
    rng = np.random.default_rng(11)
    return [nees(see(*simulate(rng, **options)), frame) for _ in range(RUNS)]


def in_another_frame(estimate: Trajectory, truth: Trajectory) -> Pair:
    return associate(estimate, truth.moved(pose(so3_exp([0.3, 1.0, -2.0]), [400.0, -9.0, 30.0])))


def positions_only(estimate: Trajectory, truth: Trajectory) -> Pair:
    return associate(estimate, PositionTrack(truth.stamp_s, truth.positions))


def plane_only(estimate: Trajectory, truth: Trajectory) -> Pair:
    return associate(estimate, PositionTrack(truth.stamp_s, truth.positions[:, :2]))


@pytest.mark.parametrize(
    ("frame", "see", "options", "dof"),
    [
        (NeesFrame.FROM_START, associate, {}, 6),
        (NeesFrame.FROM_START, in_another_frame, {"start_sigma": 0.05}, 6),
        (NeesFrame.SAME_MAP, associate, {"start_sigma": 0.05}, 6),
        (NeesFrame.SAME_MAP, associate, {"start_sigma": 0.05, "fix_every": 20}, 6),
        (NeesFrame.SAME_MAP, positions_only, {"start_sigma": 0.05, "fix_every": 20}, 3),
        (NeesFrame.SAME_MAP, plane_only, {"start_sigma": 0.05}, 2),
    ],
)
def test_honest_covariances_lie_in_the_band(
    simulate: Simulate,
    frame: NeesFrame,
    see: Callable[[Trajectory, Trajectory], Pair],
    options: dict[str, float],
    dof: int,
) -> None:
    runs = campaign(simulate, frame, see, **options)
    assert {run.dof for run in runs} == {dof}
    together = pooled(runs)
    assert together.honest, together
    assert np.mean([run.honest for run in runs]) >= 0.88
    # The band is as wide as the spread of the means, not ten times narrower.
    spread = float(np.var([run.mean for run in runs]))
    expected = 2.0 / (dof * float(np.mean([run.n for run in runs])))
    assert 0.5 < spread / expected < 2.0


def test_a_random_walk_is_worth_two_poses(simulate: Simulate) -> None:
    estimate, truth = simulate(np.random.default_rng(0), 200)
    found = nees(associate(estimate, truth), NeesFrame.FROM_START)
    assert found.poses == 199
    assert 1.5 < found.n < 3.0


@pytest.mark.parametrize(("scale", "mean"), [(0.25, 4.0), (4.0, 0.25)])
def test_wrong_covariances_lie_outside(simulate: Simulate, scale: float, mean: float) -> None:
    runs = campaign(simulate, NeesFrame.FROM_START, covariance_scale=scale)
    together = pooled(runs)
    assert together.mean == pytest.approx(mean, rel=0.15)
    assert not together.honest
    if scale < 1.0:
        assert np.mean([run.honest for run in runs]) < 0.2


def test_what_cannot_be_told_is_undefined(simulate: Simulate) -> None:
    estimate, truth = simulate(np.random.default_rng(0), 40, start_sigma=0.5, fix_every=5)
    with pytest.raises(UndefinedMetricError, match="absolute fixes"):
        nees(associate(estimate, truth), NeesFrame.FROM_START)
    with pytest.raises(UndefinedMetricError, match="positions only"):
        nees(positions_only(estimate, truth), NeesFrame.FROM_START)
    with pytest.raises(UndefinedMetricError, match="no covariance"):
        nees(associate(truth, truth), NeesFrame.SAME_MAP)
    with pytest.raises(UndefinedMetricError, match="fewer than two"):
        nees(associate(estimate.select(slice(0, 1)), truth), NeesFrame.SAME_MAP)
    with pytest.raises(UndefinedMetricError, match="pooling"):
        pooled([])


def test_most_poses_of_honest_estimates_are_within_three_sigmas(simulate: Simulate) -> None:
    rng = np.random.default_rng(5)
    pairs = [associate(*simulate(rng, start_sigma=0.05)) for _ in range(RUNS)]
    honest = np.mean([coverage(pair, NeesFrame.SAME_MAP).mean() for pair in pairs])
    assert honest > 0.98
    bold = [associate(*simulate(rng, start_sigma=0.05, covariance_scale=0.1)) for _ in range(RUNS)]
    assert np.mean([coverage(pair, NeesFrame.SAME_MAP).mean() for pair in bold]) < 0.9
    moved = [
        in_another_frame(*simulate(rng, start_sigma=0.05, covariance_scale=1.0))
        for _ in range(RUNS)
    ]
    assert np.mean([coverage(pair, NeesFrame.FROM_START).mean() for pair in moved]) > 0.98


def test_one_map_is_recognised_by_its_start(simulate: Simulate) -> None:
    rng = np.random.default_rng(6)
    runs = [simulate(rng, start_sigma=0.05) for _ in range(RUNS)]
    assert all(share_start(*run) for run in runs)
    away = pose(so3_exp([0.0, 0.0, 0.4]), [1.0, 0.0, 0.0])
    assert not any(share_start(estimate, truth.moved(away)) for estimate, truth in runs)
    estimate, truth = runs[0]
    assert not share_start(estimate, PositionTrack(truth.stamp_s, truth.positions))
    assert not share_start(Trajectory(estimate.stamp_s, estimate.map_T_rover), truth)
