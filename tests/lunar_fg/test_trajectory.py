"""Trajectory: validation, distances, frames, interpolation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frontends.errors import InputError
from frontends.geometry import adjoint, inverse, pose, se3_exp, se3_log, so3_exp
from frontends.measurements import Estimate
from lunar_fg.trajectory import PositionTrack, Trajectory


def random_trajectory(seed: int, n: int = 12) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(n - 1):
        poses.append(poses[-1] @ se3_exp([*rng.normal(0, 0.2, 3), *rng.normal(0, 1.0, 3)]))
    factors = rng.normal(size=(n, 6, 6))
    covariance = factors @ factors.transpose(0, 2, 1)
    return Trajectory(np.cumsum(rng.uniform(0.1, 1.0, n)), np.array(poses), covariance)


def test_distance_of_a_known_path() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, :3, 3] = [3.0, 4.0, 0.0]
    poses[2, :3, 3] = [3.0, 4.0, 12.0]
    assert Trajectory(np.arange(3.0), poses).distance_m == pytest.approx(17.0)
    assert PositionTrack(np.arange(3.0), poses[:, :2, 3]).distance_m == pytest.approx(5.0)


def test_empty_trajectory_is_allowed() -> None:
    empty = Trajectory.from_estimates([])
    assert len(empty) == 0
    assert empty.distance_m == 0.0


def test_from_estimates_keeps_covariances() -> None:
    estimates = [Estimate(i, i * 0.1, np.eye(4), np.eye(6) * (i + 1)) for i in range(3)]
    trajectory = Trajectory.from_estimates(estimates)
    assert trajectory.covariance is not None
    np.testing.assert_array_equal(trajectory.covariance[:, 0, 0], [1, 2, 3])
    np.testing.assert_allclose(trajectory.stamp_s, [0.0, 0.1, 0.2])


@pytest.mark.parametrize(
    ("stamps", "spoil", "problem"),
    [
        ([0.0, 1.0, 1.0], None, "increase"),
        ([0.0, 2.0, 1.0], None, "increase"),
        ([0.0, 1.0, np.nan], None, "NaN"),
        ([0.0, 1.0], None, "shape"),
        ([0.0, 1.0, 2.0], (1, 0, 3, np.nan), "pose 1 is not a rigid"),
        ([0.0, 1.0, 2.0], (2, 0, 0, 2.0), "pose 2 is not a rigid"),
        ([0.0, 1.0, 2.0], (0, 0, 0, -1.0), "pose 0 is not a rigid"),
        ([0.0, 1.0, 2.0], (1, 3, 0, 1.0), "pose 1 is not a rigid"),
    ],
)
def test_bad_trajectories_are_input_errors(
    stamps: list[float], spoil: tuple[int, int, int, float] | None, problem: str
) -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    if spoil is not None:
        poses[spoil[:3]] = spoil[3]
    with pytest.raises(InputError, match=problem) as caught:
        Trajectory(np.array(stamps), poses)
    assert "\n" not in str(caught.value)


def test_bad_covariance_and_positions_are_input_errors() -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    with pytest.raises(InputError, match="covariance"):
        Trajectory(np.arange(2.0), poses, np.full((2, 6, 6), np.nan))
    with pytest.raises(InputError, match="covariance"):
        Trajectory(np.arange(2.0), poses, np.zeros((2, 3, 3)))
    with pytest.raises(InputError, match="position_m"):
        PositionTrack(np.arange(2.0), np.zeros((2, 4)))
    with pytest.raises(InputError, match="no covariance"):
        Trajectory(np.arange(2.0), poses).covariance_in("map")


def test_covariance_in_map_is_that_of_the_positions() -> None:
    """Sampled: perturb on the right, look at the positions in the map."""
    rng = np.random.default_rng(3)
    map_T_rover = pose(so3_exp([0.4, -0.9, 1.3]), [100.0, -50.0, 3.0])
    covariance = np.diag([1e-4, 2e-4, 3e-4, 0.01, 0.04, 0.0025])
    trajectory = Trajectory(np.zeros(1), map_T_rover[None], covariance[None])
    samples = rng.multivariate_normal(np.zeros(6), covariance, 4000)
    positions = np.array([(map_T_rover @ se3_exp(xi))[:3, 3] for xi in samples])
    in_map = trajectory.covariance_in("map")[0, 3:, 3:]
    np.testing.assert_allclose(np.cov(positions.T), in_map, atol=2.5e-3)
    assert np.trace(in_map) == pytest.approx(0.0525)


def test_covariance_of_a_sensor_is_carried_by_the_lever_arm() -> None:
    trajectory = random_trajectory(1)
    rover_T_sensor = pose(so3_exp([0.1, 0.2, -1.4]), [0.5, 0.1, 0.9])
    sensor = trajectory.of_sensor(rover_T_sensor)
    xi = np.array([1e-4, -2e-4, 3e-4, 1e-3, 2e-3, -1e-3])
    moved = trajectory.map_T_rover[4] @ se3_exp(xi) @ rover_T_sensor
    expected = adjoint(inverse(rover_T_sensor)) @ xi
    np.testing.assert_allclose(
        se3_log(inverse(sensor.map_T_rover[4]) @ moved), expected, rtol=1e-6, atol=1e-9
    )
    assert sensor.covariance is not None
    assert trajectory.covariance is not None
    back = sensor.of_sensor(inverse(rover_T_sensor))
    assert back.covariance is not None
    np.testing.assert_allclose(back.covariance, trajectory.covariance, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_interpolation_meets_the_poses_and_stays_between(seed: int) -> None:
    trajectory = random_trajectory(seed)
    same = trajectory.at(trajectory.stamp_s)
    np.testing.assert_allclose(same.map_T_rover, trajectory.map_T_rover, atol=1e-9)
    middle = (trajectory.stamp_s[:-1] + trajectory.stamp_s[1:]) / 2
    between = trajectory.at(middle).map_T_rover
    for a, m, b in zip(
        trajectory.map_T_rover[:-1], between, trajectory.map_T_rover[1:], strict=True
    ):
        np.testing.assert_allclose(m[:3, 3], (a[:3, 3] + b[:3, 3]) / 2, atol=1e-9)
        half = se3_log(pose(a[:3, :3].T @ m[:3, :3], np.zeros(3)))[:3]
        whole = se3_log(pose(a[:3, :3].T @ b[:3, :3], np.zeros(3)))[:3]
        np.testing.assert_allclose(2 * half, whole, atol=1e-8)


def test_nothing_is_extrapolated() -> None:
    trajectory = random_trajectory(0)
    with pytest.raises(InputError, match="outside"):
        trajectory.at(np.array([trajectory.stamp_s[-1] + 0.01]))


def test_from_start_is_the_identity_first() -> None:
    trajectory = random_trajectory(5).moved(pose(so3_exp([0.1, 0.2, 0.3]), [5.0, 6.0, 7.0]))
    start = trajectory.from_start()
    np.testing.assert_allclose(start.map_T_rover[0], np.eye(4), atol=1e-12)
    assert start.distance_m == pytest.approx(trajectory.distance_m)
