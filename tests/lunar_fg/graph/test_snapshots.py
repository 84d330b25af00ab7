"""A map measurement taken back leaves what there would be without it."""

from dataclasses import replace

import numpy as np
import pytest

from frontends.measurements import AbsoluteFix, FixCandidate
from lunar_fg.graph import GraphConfig, IncrementalSmoother, snapshots
from lunar_fg.graph import isam as guarded
from lunar_fg.graph.planar import planar
from lunar_fg.simulation.measurements import TraverseSpec, simulate

SIGMAS = np.array([1.0, 1.0, 0.02])
FALSE = 105


def fix(run, frame, off=0.0):
    rng = np.random.default_rng(frame)
    x, y, yaw = planar(run.map_T_rover[frame]) + 0.5 * SIGMAS * rng.normal(size=3)
    return AbsoluteFix(frame, (FixCandidate(x + off, y, yaw, np.diag(SIGMAS**2)),))


def driven(run, *changes):
    """A drive with a false fix; `changes`: (keyframe, "accept" or "reject"), said by a person."""
    smoother = IncrementalSmoother(run.camera, run.rover_T_camera, run.start)
    for keyframe in run.keyframes:
        smoother.add(keyframe)
        if keyframe.index and keyframe.index % 40 == 0:
            smoother.add_fix(fix(run, keyframe.index))
        if keyframe.index == FALSE:
            # Refused, but a keyframe with a fix ends its segment.
            smoother.add_fix(fix(run, FALSE, 40.0))
        for at, said in changes:
            if at == keyframe.index:
                getattr(smoother, said)(FALSE)
    return smoother


@pytest.fixture(scope="module")
def wheels():
    run = simulate(TraverseSpec(keyframes=160, landmarks=0, odometry=True, tilt=True), 3)
    blind = (replace(k, observations=None, relative=None) for k in run.keyframes)
    return replace(run, keyframes=tuple(blind))


@pytest.mark.parametrize("back_at", [105, 112, 135])
def test_taken_back_leaves_nothing(wheels, back_at, monkeypatch):
    """At once, some keyframes later, and after another fix; by a snapshot, and without one."""
    never = driven(wheels).trajectory().map_T_rover[:, :3, 3]
    believe, take_back = (FALSE, "accept"), (back_at, "reject")
    believed = driven(wheels, believe).trajectory().map_T_rover[:, :3, 3]
    assert np.linalg.norm(believed - never, axis=1).max() > 2.0
    went_back = []
    original = guarded.GuardedIsam._go_back

    def watched(self, *arguments):
        went_back.append(original(self, *arguments))
        return went_back[-1]

    monkeypatch.setattr(guarded.GuardedIsam, "_go_back", watched)
    after = driven(wheels, believe, take_back).trajectory().map_T_rover[:, :3, 3]
    assert went_back
    assert all(went_back)
    assert np.linalg.norm(after - never, axis=1).max() < 1e-3
    monkeypatch.setattr(guarded.GuardedIsam, "_go_back", lambda *_: False)
    without = driven(wheels, believe, take_back).trajectory().map_T_rover[:, :3, 3]
    assert np.linalg.norm(without - never, axis=1).max() < 5e-3


def test_landmarks_that_came_since_stay():
    run = simulate(TraverseSpec(keyframes=60, landmarks=30, odometry=True, tilt=True), 3)
    config = GraphConfig(landmarks="full")
    ends = []
    for false in (False, True):
        smoother = IncrementalSmoother(run.camera, run.rover_T_camera, run.start, config)
        for keyframe in run.keyframes:
            smoother.add(keyframe)
            if false and keyframe.index == 40:
                smoother.add_fix(fix(run, 40, 8.0))
                smoother.accept(40)
            if false and keyframe.index == 44:
                smoother.reject(40)
        smoother.finish()
        ends.append(smoother.trajectory().map_T_rover[:, :3, 3])
    assert np.linalg.norm(ends[1] - ends[0], axis=1).max() < 1e-3


def test_to_and_fro_is_to_the_last_bit_without_a_step(wheels, monkeypatch):
    """A verdict that changes again finds what was left, too."""
    smoother = driven(wheels)
    before = smoother.trajectory().map_T_rover
    smoother.accept(FALSE)
    believed = smoother.trajectory().map_T_rover
    assert np.abs(believed - before).max() > 2.0
    for module in (guarded, snapshots):
        monkeypatch.setattr(module, "carry", None)  # no step is taken from here on
    for _ in range(2):
        smoother.reject(FALSE)
        np.testing.assert_array_equal(smoother.trajectory().map_T_rover, before)
        smoother.accept(FALSE)
        np.testing.assert_array_equal(smoother.trajectory().map_T_rover, believed)


def test_what_came_since_is_in_both_stories(wheels):
    """Reject, drive on with a fix, accept, drive on, reject: each as if it had never been else."""
    to_and_fro = ((110, "accept"), (115, "reject"), (125, "accept"))
    ends = [
        driven(wheels, *changes).trajectory().map_T_rover[:, :3, 3]
        for changes in (((120, "accept"),), to_and_fro, (*to_and_fro, (130, "reject")), ())
    ]
    assert np.linalg.norm(ends[0] - ends[3], axis=1).max() > 2.0
    assert np.linalg.norm(ends[1] - ends[0], axis=1).max() < 2e-2
    assert np.linalg.norm(ends[2] - ends[3], axis=1).max() < 1e-3
