"""A stop is one statement that nothing moved, however many frames it lasts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from frontends.geometry import inverse, se3_exp, se3_log
from frontends.measurements import RelativePose, StereoFrame, Verdict
from lunar_fg.datasets import open_dataset
from lunar_fg.evaluation import evaluate
from lunar_fg.navigator import Navigator
from lunar_fg.standstill import STILL_M, zero_motion
from lunar_fg.trajectory_io import read_track


def measured(xi: np.ndarray, sigma_rad: float, sigma_m: float) -> RelativePose:
    covariance = np.diag([sigma_rad**2] * 3 + [sigma_m**2] * 3)
    ids = np.arange(50)
    return RelativePose(se3_exp(xi), covariance, ids, 60, Verdict.ACCEPTED)


def test_noise_is_no_motion_but_for_the_false_alarms() -> None:
    rng = np.random.default_rng(0)
    sigmas = np.array([5e-4] * 3 + [4e-3] * 3)
    still = [
        zero_motion(measured(sigmas * rng.normal(size=6), 5e-4, 4e-3)) is not None
        for _ in range(3000)
    ]
    assert 0.98 < np.mean(still) < 0.998


@pytest.mark.parametrize("step_m", [0.02, 0.05, 1.0])
def test_a_step_is_motion(step_m: float) -> None:
    assert zero_motion(measured(np.array([0, 0, 0, 0, 0, step_m]), 5e-4, 4e-3)) is None


def test_a_motion_that_is_hardly_known_is_not_called_zero() -> None:
    assert zero_motion(measured(np.zeros(6), 5e-4, 0.05)) is None
    assert zero_motion(measured(np.zeros(6), 0.05, 1e-3)) is None
    refused = replace(measured(np.zeros(6), 1e-4, 1e-4), verdict=Verdict.REFUSED)
    assert zero_motion(refused) is None


def test_a_tenth_of_a_millimetre_is_no_motion_though_it_is_seen() -> None:
    nearly = zero_motion(measured(np.array([0, 0, 0, 1e-4, 0, 0]), 1e-6, 1e-6))
    assert nearly is not None
    np.testing.assert_array_equal(nearly.a_T_b, np.eye(4))
    assert zero_motion(measured(np.array([0, 0, 0, 2 * STILL_M, 0, 0]), 1e-6, 1e-6)) is None


def test_euroc_stands(shared_data: Path) -> None:
    """Real images; the vehicle moves by 1 to 2 mm in all. Peers: 0.6 mm and more."""
    dataset = open_dataset(shared_data / "euroc-v101-still")
    navigator = Navigator(dataset.camera, rover_T_camera=dataset.rover_T_camera)
    estimates = [navigator.step(frame) for frame in dataset.frames()]
    navigator.finish()
    trajectory = navigator.trajectory()
    assert np.ptp(trajectory.positions, axis=0).max() < 0.0025  # the card: 10 mm
    truth = read_track(shared_data / "euroc-v101-still" / "gt_V1_01_first6s.txt")
    assert evaluate(trajectory, truth).ate_rmse_m.se3 < 0.0005
    assert not any(estimate.lost for estimate in estimates)
    standing = [k for k, e in enumerate(estimates) if e.used == ("relative pose",)]
    assert standing
    for k in standing:  # copies, neither better nor worse known than what they copy
        ratio = estimates[k].covariance.trace() / estimates[k - 1].covariance.trace()
        assert ratio == pytest.approx(1.0, abs=0.01)


def test_a_stop_of_twelve_frames_changes_nothing(shared_data: Path) -> None:
    """KITTI's first frame shown twelve times more, with fresh noise, before it drives on."""
    dataset = open_dataset(shared_data / "kitti-06-000-050")
    drive = [frame for frame, _ in zip(dataset.frames(), range(5), strict=False)]
    rng = np.random.default_rng(1)

    def again(frame: StereoFrame, index: int) -> StereoFrame:
        noisy = (
            np.clip(image + rng.normal(0.0, 2.0, image.shape), 0, 255).astype(np.uint8)
            for image in (frame.left, frame.right)
        )
        left, right = noisy
        return replace(frame, index=index, stamp_s=0.1 * index, left=left, right=right)

    stop = [drive[0], *(again(drive[0], k) for k in range(1, 13))]
    later = [replace(f, index=f.index + 12, stamp_s=f.stamp_s + 1.2) for f in drive[1:]]
    plain, stopped = (Navigator(dataset.camera) for _ in range(2))
    for frame in drive:
        plain.step(frame)
    for frame in (*stop, *later):
        stopped.step(frame)
    for navigator in (plain, stopped):
        navigator.finish()
    straight, halted = plain.trajectory(), stopped.trajectory()
    assert np.linalg.norm(halted.positions[:13], axis=1).max() < 0.005
    difference = inverse(straight.map_T_rover[-1]) @ halted.map_T_rover[-1]
    assert np.linalg.norm(se3_log(difference)[3:]) < 0.02  # of 4.8 m
    ratio = np.sqrt(halted.covariance[-1].diagonal() / straight.covariance[-1].diagonal())
    assert (ratio > 0.8).all()
    assert (ratio < 1.5).all()
