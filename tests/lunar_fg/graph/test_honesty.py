"""Monte Carlo: the covariances say how large the errors are."""

import numpy as np
import pytest
from scipy.stats import chi2

from frontends.geometry import inverse, se3_log
from lunar_fg.graph import GraphConfig, IncrementalSmoother
from lunar_fg.simulation.measurements import INDEPENDENT, TraverseSpec, simulate


def squared_error(pose, covariance, truth):
    error = se3_log(inverse(pose) @ truth)
    return error @ np.linalg.solve(covariance, error)


def monte_carlo(mode, spec, seeds, config=INDEPENDENT):
    """Squared errors (runs, places): online inside a segment, online last, smoothed mid, last."""
    rows = []
    for seed in seeds:
        run = simulate(spec, seed)
        settings = config.model_copy(update={"landmarks": mode})
        smoother = IncrementalSmoother(run.camera, run.rover_T_camera, run.start, settings)
        estimates = [smoother.add(keyframe) for keyframe in run.keyframes]
        smoother.finish()
        smoothed = smoother.trajectory()
        n = len(estimates)
        row = [
            squared_error(estimates[i].map_T_rover, estimates[i].covariance, run.map_T_rover[i])
            for i in (n // 2 + 2, n - 1)
        ]
        row += [
            squared_error(smoothed.map_T_rover[i], smoothed.covariance[i], run.map_T_rover[i])
            for i in (n // 2 + 2, n - 1)
        ]
        rows.append(row)
    return np.array(rows)


@pytest.mark.parametrize(
    ("mode", "spec", "runs"),
    [
        ("segments", TraverseSpec(keyframes=33), 40),
        ("segments", TraverseSpec(keyframes=33, bad_share=0.1, odometry=True, tilt=True), 40),
        ("full", TraverseSpec(keyframes=24, landmarks=60), 30),
        ("full", TraverseSpec(keyframes=24, landmarks=60, bad_share=0.1), 30),
    ],
    ids=["segments", "segments-outliers-odometry-tilt", "full", "full-outliers"],
)
def test_nees_lies_in_its_band(mode, spec, runs):
    squared = monte_carlo(mode, spec, range(500, 500 + runs))
    # 95 % for all four places of a case together (Bonferroni).
    low, high = chi2.ppf([0.025 / 4, 1 - 0.025 / 4], 6 * runs) / (6 * runs)
    nees = squared.mean(axis=0) / 6.0
    assert (nees > low).all(), nees
    assert (nees < high).all(), nees


def test_errors_that_all_landmarks_share_are_in_the_covariance():
    """As real landmarks' errors are: without the two terms for them, NEES leaves its band."""
    spec, runs = TraverseSpec(keyframes=33, disparity_error_px=0.1), 30
    high = chi2.ppf(0.999, 6 * runs) / (6 * runs)
    shared = monte_carlo("segments", spec, range(runs), GraphConfig()).mean(axis=0) / 6.0
    alone = monte_carlo("segments", spec, range(runs)).mean(axis=0) / 6.0
    assert (shared < high).all(), shared
    assert (alone > high).any(), alone


def test_the_same_pixels_twice_would_be_over_confident():
    """Why the visual relative pose is no factor: entered as odometry, NEES leaves the band."""
    from dataclasses import replace

    from frontends.measurements import Odometry
    from lunar_fg.graph.segment import Segment
    from lunar_fg.graph.setup import Setup

    spec, squared = TraverseSpec(keyframes=11), []
    for seed in range(20):
        run = simulate(spec, seed)
        setup = Setup.checked(run.camera, run.rover_T_camera, config=INDEPENDENT)
        once = Segment(setup, run.keyframes[0])
        for keyframe in run.keyframes[1:]:
            once.add(keyframe)
        solved = once.solve()
        twice = Segment(setup, run.keyframes[0])
        for k, keyframe in enumerate(run.keyframes[1:], start=1):
            motion = inverse(solved.first_T_rover[k - 1]) @ solved.first_T_rover[k]
            pair = solved.covariance[6 * k - 6 : 6 * k, 6 * k - 6 : 6 * k] / k
            twice.add(replace(keyframe, odometry=Odometry(motion, pair)))
        again = twice.solve()
        truth = inverse(run.map_T_rover[0]) @ run.map_T_rover[-1]
        squared.append(squared_error(again.first_T_last, again.last_covariance, truth))
    assert np.mean(squared) / 6.0 > chi2.ppf(0.999, 120) / 120.0
