"""Absolute fixes: who is in, who is out, and every verdict can be taken back."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frontends.errors import EstimationError, InputError
from frontends.geometry import inverse, se3_exp
from frontends.measurements import AbsoluteFix, FixCandidate, Verdict
from lunar_fg.graph import GraphConfig, IncrementalSmoother
from lunar_fg.graph.planar import planar
from lunar_fg.simulation.fixes import FixSpec, simulate_fixes
from lunar_fg.simulation.measurements import TraverseSpec, simulate

MODES = ["segments", "full"]
RUN = simulate(TraverseSpec(keyframes=61, landmarks=25, odometry=True, tilt=True), seed=3)
COVARIANCE = np.diag([0.09, 0.09, 4e-4])


def smoother(mode, count=0, **config):
    config = GraphConfig(landmarks=mode, **config)
    result = IncrementalSmoother(RUN.camera, RUN.rover_T_camera, RUN.start, config)
    for keyframe in RUN.keyframes[:count]:
        result.add(keyframe)
    return result


def place(frame, off=(0.0, 0.0, 0.0), covariance=COVARIANCE):
    return FixCandidate(*(planar(RUN.map_T_rover[frame]) + off), covariance)


def fix(frame, *offs):
    return AbsoluteFix(frame, tuple(place(frame, off) for off in offs or [(0.0, 0.0, 0.0)]))


def frames(entries):
    return [entry.frame for entry in entries]


def error_m(graph):
    gap = (
        graph.trajectory().map_T_rover[:, :2, 3] - RUN.map_T_rover[: len(graph.trajectory()), :2, 3]
    )
    return float(np.sqrt((gap**2).sum(axis=1).mean()))


@pytest.mark.parametrize("mode", MODES)
def test_true_fixes_pull_and_false_ones_do_not(mode):
    drifting, graph = smoother(mode, 61), smoother(mode)
    spec = FixSpec(every=6, sigma_xy_m=0.01, sigma_yaw_rad=0.002, false_share=0.4)
    fixes = simulate_fixes(range(61), RUN.map_T_rover, spec, seed=5)
    assert 0 < fixes.true.sum() < len(fixes.true)
    waiting = {f.frame: f for f in fixes.fixes}
    for keyframe in RUN.keyframes:
        graph.add(keyframe)
        # Every other fix comes late, for a keyframe within a segment.
        for frame in [keyframe.index, keyframe.index - 3]:
            if frame in waiting and (frame % 12 == 0) == (frame == keyframe.index):
                graph.add_fix(waiting.pop(frame))
    assert not waiting
    entries = sorted(graph.ledger, key=lambda entry: entry.frame)
    verdicts = [entry.ruling.verdict is Verdict.ACCEPTED for entry in entries]
    assert verdicts == fixes.true.tolist()
    graph.finish()
    drifting.finish()
    assert error_m(graph) < error_m(drifting)


@pytest.mark.parametrize("mode", MODES)
def test_a_believed_false_fix_is_taken_back(mode):
    """By wheels alone it passes (the path knows too little); later ones show it was wrong."""
    config = GraphConfig(landmarks=mode)
    graph, clean = (
        IncrementalSmoother(RUN.camera, RUN.rover_T_camera, RUN.start, config) for _ in range(2)
    )
    for keyframe in RUN.keyframes:
        blind = replace(keyframe, observations=None, relative=None)
        graph.add(blind)
        clean.add(blind)
        if keyframe.index == 40:
            off = (*(1.8 * RUN.map_T_rover[40, :2, 1]), 0.0)
            wrong = place(40, off, np.diag([0.09, 0.09, 1.0]))
            assert graph.add_fix(AbsoluteFix(40, (wrong,))).accepted
        if keyframe.index in (47, 53, 60):
            # The first two come late, for keyframes between others.
            frame = {47: 34, 53: 46, 60: 60}[keyframe.index]
            assert graph.add_fix(fix(frame)).accepted
            assert clean.add_fix(fix(frame)).accepted
    entry = next(e for e in graph.ledger if e.frame == 40)
    assert [r.verdict for r in entry.history] == [Verdict.ACCEPTED, Verdict.REFUSED]
    assert "taken back" in entry.ruling.reason
    poses, expected = graph.trajectory().map_T_rover, clean.trajectory().map_T_rover
    np.testing.assert_allclose(poses, expected, atol=5e-3)


@pytest.mark.parametrize("mode", MODES)
def test_of_several_places_at_most_one_wins(mode):
    graph = smoother(mode, 31)
    decision = graph.add_fix(fix(30, (7.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, -9.0, 0.0)))
    assert decision.accepted
    assert decision.candidate == 1
    assert not graph.add_fix(fix(20, (7.0, 0.0, 0.0), (0.0, -9.0, 0.0))).accepted
    assert graph.add_fix(AbsoluteFix(10, reason="too dark")).reason == "too dark"
    assert [e.ruling.verdict.value for e in graph.ledger] == ["accepted", "refused", "refused"]


@pytest.mark.parametrize("mode", MODES)
def test_a_person_overrules_and_the_trajectory_follows(mode):
    graph = smoother(mode, 31)
    assert graph.add_fix(fix(12)).accepted
    assert not graph.add_fix(fix(24, (0.0, 30.0, 0.0))).accepted
    before = graph.predicted(30).map_T_rover
    decision = graph.accept(24)
    assert decision.accepted
    assert "person" in decision.reason
    assert np.linalg.norm(graph.predicted(30).map_T_rover[:2, 3] - before[:2, 3]) > 0.1
    assert not graph.reject(24).accepted
    np.testing.assert_allclose(graph.predicted(30).map_T_rover, before, atol=5e-3)
    assert not graph.reject(12).accepted
    with pytest.raises(InputError, match="no such"):
        graph.accept(13)
    with pytest.raises(InputError, match="candidates"):
        graph.accept(12, candidate=3)


@pytest.mark.parametrize("mode", MODES)
def test_loop_closures_are_judged_like_fixes(mode):
    graph = smoother(mode, 61)
    covariance = np.diag([1e-4] * 3 + [1e-3] * 3)
    for i, j, off in ((3, 47, 0.0), (10, 55, 0.0), (5, 50, 4.0), (3, 7, 0.0)):
        motion = inverse(RUN.map_T_rover[i]) @ RUN.map_T_rover[j] @ se3_exp([0, 0, 0, 0, off, 0])
        assert graph.add_relative(i, j, motion, covariance).accepted == (off == 0.0)
    relative = inverse(graph.predicted(10).map_T_rover) @ graph.predicted(55).map_T_rover
    truth = inverse(RUN.map_T_rover[10]) @ RUN.map_T_rover[55]
    assert np.linalg.norm(relative[:3, 3] - truth[:3, 3]) < 0.1
    assert [(e.base, e.frame) for e in graph.ledger] == [(3, 47), (10, 55), (5, 50), (3, 7)]
    assert graph.accept(50, base=5).accepted


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("off", [[0, 0, 0, 0, 0, 3.0], [0, 0.2, 0, 0, 0, 0]])
def test_a_closure_that_is_wrong_out_of_the_plane_is_refused(mode, off):
    """A vote in the plane would not see it."""
    graph = smoother(mode, 61)
    covariance = np.diag([1e-4] * 3 + [1e-3] * 3)
    motion = inverse(RUN.map_T_rover[5]) @ RUN.map_T_rover[50]
    decision = graph.add_relative(5, 50, motion @ se3_exp(off), covariance)
    assert not decision.accepted
    assert "height" in decision.reason
    assert not graph.revote()
    assert graph.accept(50, base=5).accepted


@pytest.mark.parametrize("mode", MODES)
def test_heights_anchor_the_vertical(mode):
    graph = smoother(mode, 58)
    sigma = np.sqrt(np.linalg.inv(np.linalg.inv(graph.predicted(57).covariance))[5, 5])
    assert graph.add_height(55, float(RUN.map_T_rover[55, 2, 3]), 0.01).accepted
    assert not graph.add_height(40, 50.0, 0.1).accepted
    assert np.sqrt(graph.predicted(57).covariance[5, 5]) < sigma
    assert abs(graph.predicted(55).map_T_rover[2, 3] - RUN.map_T_rover[55, 2, 3]) < 0.03
    with pytest.raises(InputError, match="already"):
        graph.add_height(55, 0.0, 0.1)
    with pytest.raises(InputError, match="sigma"):
        graph.add_height(54, 0.0, 0.0)


@pytest.mark.parametrize("mode", MODES)
def test_prediction_of_any_keyframe(mode):
    graph = smoother(mode, 36)
    graph.add_fix(fix(24))
    whole = graph.trajectory()
    for frame in (0, 7, 20, 24, 30, 35):
        one = graph.predicted(frame)
        np.testing.assert_allclose(one.map_T_rover, whole.map_T_rover[frame], atol=1e-9)
        np.testing.assert_allclose(one.covariance, whole.covariance[frame], rtol=1e-6, atol=1e-12)
        assert one.planar().covariance.shape == (3, 3)
    for frame in (36, -1):
        with pytest.raises(InputError, match="not in the graph"):
            graph.predicted(frame)


@pytest.mark.parametrize("mode", MODES)
def test_the_window_slides_and_settled_fixes_can_be_overruled(mode):
    graph = smoother(mode, 61, fix_window=3)
    for frame in (10, 20, 30, 40, 50):
        assert graph.add_fix(fix(frame, (0.0, 0.0, 0.0))).accepted
    # Older than all that is voted on: gate alone.
    assert graph.add_fix(fix(15)).accepted
    assert not graph.add_fix(fix(16, (0.0, 20.0, 0.0))).accepted
    before = graph.predicted(60).covariance
    assert not graph.reject(20).accepted
    assert graph.add_fix(fix(60)).accepted
    assert len(graph.ledger) == 8
    assert before.shape == (6, 6)


@pytest.mark.parametrize("mode", MODES)
@settings(max_examples=25, deadline=None)
@given(
    what=st.sampled_from(["x", "covariance", "height", "sigma", "motion", "z"]),
    value=st.sampled_from([np.nan, np.inf, -np.inf, 1e150, -1e150, 0.0]),
    position=st.integers(0, 8),
)
def test_bad_fixes_are_named_or_refused_and_nothing_moves(mode, what, value, position):
    graph = smoother(mode, 8)
    before = graph.predicted(7).map_T_rover
    try:
        if what == "x":
            bad = replace(place(5), **{("x_m", "y_m", "yaw_rad")[position % 3]: value})
            accepted = graph.add_fix(AbsoluteFix(5, (bad,))).accepted and value != 0.0
        elif what == "covariance":
            covariance = COVARIANCE.copy()
            covariance.flat[position] = value
            accepted = graph.add_fix(AbsoluteFix(5, (place(5, covariance=covariance),))).accepted
            accepted = accepted and np.isnan(value)
        elif what in ("height", "sigma"):
            height, sigma = (value, 1.0) if what == "height" else (0.0, value)
            accepted = graph.add_fix(
                replace(fix(5), height_m=height, sigma_height_m=sigma)
            ).accepted
            accepted = accepted and not np.isfinite(value)
        elif what == "z":
            accepted = graph.add_height(5, value, 0.5).accepted and value != 0.0
        else:
            motion = np.eye(4)
            motion.flat[position] = value
            accepted = graph.add_relative(1, 6, motion, 1e-4 * np.eye(6)).accepted
    except (InputError, EstimationError):
        accepted = False
    assert not accepted
    after = graph.predicted(7)
    assert np.isfinite(after.map_T_rover).all()
    assert np.abs(after.map_T_rover - before).max() < 1.0
    assert graph.add(RUN.keyframes[8]).index == 8


def test_what_cannot_be_a_fix_is_named():
    graph = smoother("segments", 8)
    with pytest.raises(InputError, match="not in the graph"):
        graph.add_fix(fix(30))
    graph.add_fix(fix(5))
    with pytest.raises(InputError, match="already"):
        graph.add_fix(fix(5))
    with pytest.raises(InputError, match="forward"):
        graph.add_relative(6, 2, np.eye(4), np.eye(6))
    with pytest.raises(InputError, match="no sigma"):
        graph.add_fix(replace(fix(6), height_m=1.0))


def test_an_unmeasured_yaw_takes_no_part():
    graph = smoother("segments", 31)
    wide = np.diag([0.09, 0.09, 100.0])
    seen = place(30, (0.0, 0.0, 2.5), wide)
    sigma = graph.predicted(30).planar().covariance
    assert graph.add_fix(AbsoluteFix(30, (seen,))).accepted
    after = graph.predicted(30).planar()
    assert after.covariance[0, 0] < sigma[0, 0]
    assert abs(after.xyyaw[2] - planar(RUN.map_T_rover[30])[2]) < 0.1
