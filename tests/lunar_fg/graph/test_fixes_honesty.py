"""Monte Carlo: with absolute fixes the covariances still say how large the errors are."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from frontends.geometry import inverse, se3_log
from frontends.measurements import Verdict
from lunar_fg.graph import IncrementalSmoother
from lunar_fg.simulation.fixes import FixSpec, simulate_fixes
from lunar_fg.simulation.measurements import INDEPENDENT, TraverseSpec, simulate

FIXES = FixSpec(every=9, sigma_xy_m=0.1, sigma_yaw_rad=0.01, correlation=0.6, false_share=0.25)
PLACES = ("online, at a fix", "online, between", "smoothed, between", "smoothed, last")


def squared_error(pose, covariance, truth):
    error = se3_log(inverse(pose) @ truth)
    return error @ np.linalg.solve(covariance, error)


def once(mode, spec, seed):
    """Squared errors at the `PLACES`; fixes for keyframes in segments come three late."""
    run = simulate(spec, seed)
    fixes = simulate_fixes(range(spec.keyframes), run.map_T_rover, FIXES, seed + 5000)
    waiting = {fix.frame: (fix, i % 2 * 3) for i, fix in enumerate(fixes.fixes)}
    smoother = IncrementalSmoother(
        run.camera,
        run.rover_T_camera,
        run.start,
        INDEPENDENT.model_copy(update={"landmarks": mode}),
    )
    row = []
    for keyframe in run.keyframes:
        if not spec.landmarks:
            keyframe = replace(keyframe, observations=None, relative=None)
        smoother.add(keyframe)
        for fix, late in waiting.values():
            if fix.frame + late == keyframe.index:
                smoother.add_fix(fix)
        if keyframe.index in (21, 32):
            now = smoother.predicted(keyframe.index)
            truth = run.map_T_rover[keyframe.index]
            row.append(squared_error(now.map_T_rover, now.covariance, truth))
    smoother.finish()
    whole = smoother.trajectory()
    row += [
        squared_error(whole.map_T_rover[i], whole.covariance[i], run.map_T_rover[i])
        for i in (14, spec.keyframes - 1)
    ]
    verdicts = [e.ruling.verdict is Verdict.ACCEPTED for e in smoother.ledger]
    return row, sum(v != t for v, t in zip(verdicts, fixes.true.tolist(), strict=True))


@pytest.mark.parametrize(
    ("mode", "spec", "runs"),
    [
        ("segments", TraverseSpec(keyframes=36, landmarks=30, odometry=True, tilt=True), 40),
        ("segments", TraverseSpec(keyframes=36, landmarks=0, odometry=True, tilt=True), 50),
        ("full", TraverseSpec(keyframes=36, landmarks=0, odometry=True, tilt=True), 50),
        (
            "full",
            TraverseSpec(keyframes=36, landmarks=20, odometry=True, tilt=True, bad_share=0.1),
            30,
        ),
    ],
    ids=["segments", "segments-wheels", "full-wheels", "full-outliers"],
)
def test_nees_with_fixes_lies_in_its_band(mode, spec, runs):
    found = [once(mode, spec, seed) for seed in range(700, 700 + runs)]
    squared = np.array([row for row, _ in found])
    low, high = chi2.ppf([0.025 / 4, 1 - 0.025 / 4], 6 * runs) / (6 * runs)
    nees = dict(zip(PLACES, squared.mean(axis=0) / 6.0, strict=True))
    assert all(low < value < high for value in nees.values()), (low, high, nees)
    # A false fix that looks true is rare at five sigmas or more from the truth.
    assert sum(wrong for _, wrong in found) <= 0.05 * 3 * runs
