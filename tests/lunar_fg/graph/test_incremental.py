"""Segments, full landmarks and batch on the same data; what happens when something is missing."""

from dataclasses import replace

import numpy as np
import pytest

from frontends.errors import EstimationError, InputError
from frontends.geometry import inverse, se3_exp, se3_log, yaw_pitch_roll
from frontends.measurements import Odometry, RelativePose, StartPrior, Tilt, Verdict
from lunar_fg.graph import GraphConfig, IncrementalSmoother, Keyframe, optimize_batch
from lunar_fg.graph.incremental import NO_VERTICAL_WARNING
from lunar_fg.graph.isam import QR_WARNING
from lunar_fg.simulation.measurements import INDEPENDENT, TraverseSpec, simulate


def smoothed(run, keyframes=None, finish=True, **config):
    settings = INDEPENDENT.model_copy(update=config)
    smoother = IncrementalSmoother(run.camera, run.rover_T_camera, run.start, settings)
    for keyframe in run.keyframes if keyframes is None else keyframes:
        smoother.add(keyframe)
    if finish:
        smoother.finish()
    return smoother


def position_gap(a, b):
    return np.linalg.norm(a.map_T_rover[:, :3, 3] - b.map_T_rover[:, :3, 3], axis=1)


@pytest.mark.parametrize("spec", [TraverseSpec(keyframes=34, landmarks=70),
                                  TraverseSpec(keyframes=34, landmarks=70, bad_share=0.1,
                                               odometry=True, tilt=True)],
                         ids=["clean", "outliers-odometry-tilt"])  # fmt: skip
def test_segments_full_and_batch_agree(spec):
    run = simulate(spec, seed=21)
    segments = smoothed(run).trajectory()
    full = smoothed(run, landmarks="full").trajectory()
    result = optimize_batch(
        run.camera, run.rover_T_camera, run.start, run.keyframes, INDEPENDENT, segments
    )
    batch = result.trajectory
    assert result.report.converged
    assert result.report.cost_after <= result.report.cost_before
    # Full landmarks are the same graph as batch; segments lose what tracks say across
    # their boundaries, so they differ by less than their own sigma.
    assert position_gap(full, batch).max() < 1e-3
    np.testing.assert_allclose(full.covariance, batch.covariance, rtol=0.05, atol=1e-9)
    sigma = np.sqrt(np.trace(batch.covariance[:, 3:, 3:], axis1=1, axis2=2))
    assert (position_gap(segments, batch) < sigma).all()
    ratio = np.sqrt(np.trace(segments.covariance[:, 3:, 3:], axis1=1, axis2=2)) / sigma
    assert ratio.max() < 1.15
    assert ratio.min() > 0.9


def test_tilts_inside_segments_count_as_in_batch():
    """Left out, they cost 15 % of accuracy on average, and half of what is known of the tilt."""
    run = simulate(TraverseSpec(keyframes=41, landmarks=60, odometry=True, tilt=True), seed=3)
    segments = smoothed(run).trajectory()
    batch = optimize_batch(
        run.camera, run.rover_T_camera, run.start, run.keyframes, INDEPENDENT, segments
    ).trajectory
    ratio = np.sqrt(segments.covariance[:, [0, 1], [0, 1]] / batch.covariance[:, [0, 1], [0, 1]])
    assert ratio.max() < 1.12
    assert ratio.min() > 0.93


def test_estimates_follow_the_segment():
    run = simulate(TraverseSpec(keyframes=25), seed=1)
    smoother = IncrementalSmoother(run.camera, run.rover_T_camera, run.start, GraphConfig())
    estimates = [smoother.add(keyframe) for keyframe in run.keyframes]
    trajectory = smoother.trajectory()
    assert trajectory.index.tolist() == [e.index for e in estimates] == list(range(25))
    np.testing.assert_allclose(trajectory.map_T_rover[-1], estimates[-1].map_T_rover)
    np.testing.assert_allclose(trajectory.covariance[-1], estimates[-1].covariance)
    assert estimates[0].used == ("start",)
    assert estimates[5].used == ("stereo landmarks",)
    assert not any(e.lost for e in estimates)
    # Smoothing by the landmarks beats the chain of relative poses it replaces.
    inside = np.sqrt(np.trace(trajectory.covariance[9][3:, 3:]))
    assert inside < np.sqrt(np.trace(estimates[9].covariance[3:, 3:]))
    assert np.linalg.eigvalsh(trajectory.covariance).min() > 0.0


def lost(keyframe, sigma=0.3):
    return RelativePose(
        keyframe.relative.a_T_b @ se3_exp([0.01, 0, 0, 0.1, 0, 0]), sigma**2 * np.eye(6),
        np.empty(0, dtype=np.int64), 3, Verdict.REFUSED, "3 inliers",
    )  # fmt: skip


@pytest.mark.parametrize("mode", ["segments", "full"])
def test_a_lost_keyframe_is_carried_by_its_prediction(mode):
    run = simulate(TraverseSpec(keyframes=24), seed=2)
    keyframes = list(run.keyframes)
    keyframes[7] = replace(keyframes[7], observations=None, relative=lost(keyframes[7]))
    smoother = IncrementalSmoother(
        run.camera, run.rover_T_camera, run.start, GraphConfig(landmarks=mode)
    )
    estimates = [smoother.add(keyframe) for keyframe in keyframes]
    assert [e.index for e in estimates if e.lost] == [7]
    assert estimates[7].used == ("prediction",)
    assert "relative pose: 3 inliers" in estimates[7].refused
    smoother.finish()
    # Landmarks seen on both sides of the gap bridge it.
    bridged = smoother.trajectory()
    assert np.linalg.norm(bridged.map_T_rover[-1, :3, 3] - run.map_T_rover[-1, :3, 3]) < 0.3
    assert np.sqrt(np.trace(bridged.covariance[-1, 3:, 3:])) < 0.3


@pytest.mark.parametrize("mode", ["segments", "full"])
def test_odometry_alone_carries_the_rover(mode):
    run = simulate(TraverseSpec(keyframes=24, odometry=True), seed=3)
    blind = [replace(k, observations=None, relative=None) for k in run.keyframes]
    smoother = smoothed(run, blind, landmarks=mode)
    expected = run.start.map_T_rover
    for keyframe in blind[1:]:
        expected = expected @ keyframe.odometry.a_T_b
    np.testing.assert_allclose(smoother.trajectory().map_T_rover[-1], expected, atol=1e-6)
    assert smoother.add(replace(blind[-1], index=99, stamp_s=99.0)).lost


def test_odometry_and_pixels_are_better_than_either():
    run = simulate(TraverseSpec(keyframes=21, odometry=True, landmarks=30), seed=4)
    without = [replace(k, odometry=None) for k in run.keyframes]
    both = smoothed(run).trajectory().covariance[-1]
    assert np.trace(both) < np.trace(smoothed(run, without).trajectory().covariance[-1])


@pytest.mark.parametrize("mode", ["segments", "full"])
def test_tilt_levels_a_tilted_start(mode):
    run = simulate(TraverseSpec(keyframes=31, tilt=True), seed=5)
    # The start's prior knows roll and pitch to 10 degrees only.
    crooked = StartPrior(
        run.map_T_rover[0] @ se3_exp([0.1, -0.1, 0, 0, 0, 0]), (0.17, 0.17, 1e-3), (1e-3,) * 3
    )
    tilted = smoothed(replace(run, start=crooked), landmarks=mode).trajectory()
    _, pitch, roll = yaw_pitch_roll(run.map_T_rover[-1].T @ tilted.map_T_rover[-1])
    assert np.hypot(roll, pitch) < np.deg2rad(1.0)


def test_interior_poses_follow_a_later_correction():
    """A tilt at a boundary bends the whole segment, not only its end."""
    run = simulate(TraverseSpec(keyframes=11), seed=6)
    keyframes = list(run.keyframes)
    keyframes[-1] = replace(keyframes[-1], tilt=Tilt(0.0, 0.05, 1e-5))
    bent, straight = smoothed(run, keyframes), smoothed(run)
    moved = [
        np.linalg.norm(se3_log(inverse(a) @ b))
        for a, b in zip(
            straight.trajectory().map_T_rover, bent.trajectory().map_T_rover, strict=True
        )
    ]
    assert moved[-1] > 0.01
    steps = np.diff(moved)
    assert np.abs(steps).max() < 0.5 * max(moved)
    full = smoothed(run, keyframes, landmarks="full").trajectory()
    gap = position_gap(bent.trajectory(), full)
    assert gap.max() < 0.1


def chain(n, sigma=2e-3):
    rng = np.random.default_rng(0)
    covariance = np.diag([(0.2 * sigma) ** 2] * 3 + [sigma**2] * 3)
    root = np.sqrt(np.diag(covariance))
    for k in range(n):
        motion = se3_exp([0, 0, 0.01 * np.sin(k / 30), 1.0, 0, 0]) @ se3_exp(
            root * rng.normal(size=6)
        )
        yield Keyframe(k, float(k), None, None, Odometry(motion, covariance) if k else None)


@pytest.mark.parametrize("mode", ["segments", "full"])
def test_a_long_chain_without_vertical_outlives_the_4096_rule(mode):
    run = simulate(TraverseSpec(keyframes=2), seed=0)
    config = GraphConfig(landmarks=mode, segment_keyframes=1)
    smoother = IncrementalSmoother(run.camera, run.rover_T_camera, run.start, config)
    for keyframe in chain(3200):
        estimate = smoother.add(keyframe)
    assert np.isfinite(estimate.covariance).all()
    assert NO_VERTICAL_WARNING in smoother.warnings
    assert (QR_WARNING in smoother.warnings) == (mode == "full")
    trajectory = smoother.trajectory()
    assert len(trajectory) == 3200
    assert np.linalg.eigvalsh(trajectory.covariance[-1])[0] > 0.0


def test_vertical_warning_is_silent_with_tilt():
    run = simulate(TraverseSpec(keyframes=5, tilt=True), seed=0)
    assert smoothed(run).warnings == ()


@pytest.mark.parametrize("mode", ["segments", "full"])
def test_empty_single_and_unfinished_runs(mode):
    run = simulate(TraverseSpec(keyframes=4), seed=0)
    smoother = IncrementalSmoother(
        run.camera, run.rover_T_camera, run.start, GraphConfig(landmarks=mode)
    )
    smoother.finish()
    with pytest.raises(EstimationError, match="empty"):
        smoother.trajectory()
    smoother.add(run.keyframes[0])
    np.testing.assert_allclose(
        smoother.trajectory().map_T_rover[0], run.start.map_T_rover, atol=1e-9
    )
    smoother.finish()
    for keyframe in run.keyframes[1:]:
        smoother.add(keyframe)
        smoother.finish()
    assert len(smoother.trajectory()) == 4


def test_batch_refuses_what_does_not_fit():
    run = simulate(TraverseSpec(keyframes=4), seed=0)
    arguments = (run.camera, run.rover_T_camera, run.start)
    with pytest.raises(InputError, match="empty"):
        optimize_batch(*arguments, [])
    with pytest.raises(InputError, match="other keyframes"):
        optimize_batch(
            *arguments, run.keyframes, initial=smoothed(run, run.keyframes[:3]).trajectory()
        )


def test_batch_says_when_it_did_not_converge():
    run = simulate(TraverseSpec(keyframes=12, bad_share=0.1), seed=0)
    result = optimize_batch(
        run.camera, run.rover_T_camera, run.start, run.keyframes,
        GraphConfig(max_iterations=1, gate_probability=0.9999999), smoothed(run).trajectory(),
    )  # fmt: skip
    assert result.report.converged or "stopped after 10" in result.report.reason
