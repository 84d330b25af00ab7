"""Bad landmarks and a solver that gives up: every keyframe enters, and a warning says how."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from frontends.errors import EstimationError
from lunar_fg.graph import GraphConfig, IncrementalSmoother, optimize_batch
from lunar_fg.graph import fullgraph as fullgraph_module
from lunar_fg.graph import segment as segment_module
from lunar_fg.graph.isam import GuardedIsam
from lunar_fg.graph.isam_steps import linearization
from lunar_fg.simulation.measurements import TraverseSpec, simulate

RUN = simulate(TraverseSpec(keyframes=25, landmarks=60), seed=12)


def observed(keyframe, rows, disparity, sigma_disparity, sigma_px=0.3):
    """The keyframe with other disparities and sigmas at some rows."""
    o = keyframe.observations
    u_right, sigma_d, sigma = o.u_right.copy(), o.sigma_disparity_px.copy(), o.sigma_px.copy()
    u_right[rows] = o.u_left[rows] - disparity
    sigma_d[rows], sigma[rows] = sigma_disparity, sigma_px
    points = RUN.camera.triangulate(o.u_left, o.v, o.u_left - u_right)
    o = replace(
        o, u_right=u_right, sigma_disparity_px=sigma_d, sigma_px=sigma, points_cam=points,
        points_covariance=RUN.camera.triangulation_covariance(
            o.u_left, o.v, o.u_left - u_right, sigma, sigma_d
        ),
    )  # fmt: skip
    return replace(keyframe, observations=o)


def as_on_kitti():
    """Far at first, then seen with a huge sigma, which opens the gate, then near for certain."""
    keyframes = list(RUN.keyframes)
    ids = [set(k.observations.landmark_id.tolist()) for k in keyframes]
    for k in range(1, len(keyframes) - 4, 3):
        common = np.array(sorted(set.intersection(*ids[k : k + 4])))[:6]
        for step, (disparity, sigma_d, sigma) in enumerate(
            [(2.5, 0.55, 0.15), (12.8, 6.8, 17.0), (12.9, 0.3, 0.3), (13.2, 0.3, 0.3)]
        ):
            rows = np.flatnonzero(np.isin(keyframes[k + step].observations.landmark_id, common))
            keyframes[k + step] = observed(keyframes[k + step], rows, disparity, sigma_d, sigma)
    return keyframes


def no_parallax():
    keyframes = list(RUN.keyframes)
    return [observed(k, np.arange(0, 60, 2), 1e-3, 1e-4) for k in keyframes]


def all_far():
    return [observed(k, np.arange(60), 4.2, 1.0, 1.0) for k in RUN.keyframes]


def same_pixel():
    """Thirty landmarks at one place, under names of their own."""
    keyframes = []
    for k in RUN.keyframes:
        o = k.observations
        rows = np.r_[np.arange(30), np.full(30, 3)]
        copied = o.select(rows)
        keyframes.append(replace(k, observations=replace(copied, landmark_id=o.landmark_id)))
    return keyframes


CASES = {"kitti": as_on_kitti, "no parallax": no_parallax, "far": all_far, "one pixel": same_pixel}


def run_all(keyframes, mode):
    smoother = IncrementalSmoother(
        RUN.camera, RUN.rover_T_camera, RUN.start, GraphConfig(landmarks=mode)
    )
    for keyframe in keyframes:
        estimate = smoother.add(keyframe)
        assert np.isfinite(estimate.covariance).all()
    smoother.finish()
    return smoother


def position_error(trajectory):
    return np.linalg.norm(trajectory.map_T_rover[:, :3, 3] - RUN.map_T_rover[:, :3, 3], axis=1)


@pytest.mark.parametrize("mode", ["segments", "full"])
@pytest.mark.parametrize("name", CASES)
def test_bad_landmarks_end_no_run(name, mode):
    smoother = run_all(CASES[name](), mode)
    trajectory = smoother.trajectory()
    assert len(trajectory) == 25
    assert np.linalg.eigvalsh(trajectory.covariance).min() > 0.0
    # Where all landmarks lie about their depth the trajectory cannot be right, but it is there.
    assert name != "kitti" or position_error(trajectory).max() < 0.5


@pytest.mark.parametrize("name", CASES)
def test_batch_counts_what_it_sets_aside(name):
    result = optimize_batch(
        RUN.camera, RUN.rover_T_camera, RUN.start, CASES[name](),
        GraphConfig(gate_probability=0.9999999),
    )  # fmt: skip
    assert np.isfinite(result.trajectory.covariance).all()
    assert result.report.landmarks_set_aside >= 0
    assert result.report.landmarks > 0


def test_a_landmark_behind_the_camera_is_taken_out_and_named():
    graph = IncrementalSmoother(
        RUN.camera, RUN.rover_T_camera, RUN.start, GraphConfig(landmarks="full")
    )
    original, moved = fullgraph_module.map_point, []

    def behind(map_T_rover, rover_T_camera, point):
        if len(moved) < 3:
            moved.append(point)
            point = -point
        return original(map_T_rover, rover_T_camera, point)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fullgraph_module, "map_point", behind)
        for keyframe in RUN.keyframes[:6]:
            graph.add(keyframe)
    assert any("3 landmarks" in w and "keyframes 1" in w for w in graph.warnings)
    for keyframe in RUN.keyframes[6:]:
        graph.add(keyframe)
    graph.finish()
    assert position_error(graph.trajectory()).max() < 0.3


@pytest.mark.parametrize("refusals", [1, 2])
def test_a_keyframe_that_gtsam_refuses_enters_by_its_motion(refusals, monkeypatch):
    smoother = IncrementalSmoother(
        RUN.camera, RUN.rover_T_camera, RUN.start, GraphConfig(landmarks="full")
    )
    original, refused = GuardedIsam.update, []

    def update(self, factors, values, frame):
        if frame == 7 and len(refused) < refusals:
            refused.append(frame)
            raise EstimationError("Indeterminate linear system")
        return original(self, factors, values, frame)

    monkeypatch.setattr(GuardedIsam, "update", update)
    for keyframe in RUN.keyframes:
        smoother.add(keyframe)
    smoother.finish()
    assert len(smoother.trajectory()) == 25
    assert position_error(smoother.trajectory()).max() < 0.5
    named = [w for w in smoother.warnings if w.startswith("keyframe 7")]
    assert len(named) == refusals
    assert "Indeterminate" in named[0]


def test_removed_landmarks_leave_a_graph_that_goes_on():
    """Removing, adding, failing and rebuilding keep the books and iSAM2 in step."""
    smoother = run_all(RUN.keyframes[:10], "full")
    graph = smoother._graph
    alive = graph._whole.live()
    graph._isam.remove(set(alive[:10]))
    graph._whole.set_aside(alive[:10])
    for keyframe in RUN.keyframes[10:14]:
        smoother.add(keyframe)
    gone = graph._whole.live()[:5]
    graph._isam.remove(set(gone))
    graph._whole.set_aside(gone)
    before = smoother.trajectory()
    guard = graph._isam
    guard._rebuild(linearization(guard._isam, guard._initial))
    np.testing.assert_allclose(smoother.trajectory().map_T_rover, before.map_T_rover, atol=0.02)
    for keyframe in RUN.keyframes[14:]:
        smoother.add(keyframe)
    smoother.finish()
    assert position_error(smoother.trajectory()).max() < 0.5


def test_isam_failing_inside_an_update_is_repaired(monkeypatch):
    """The real thing: a landmark without any derivative makes GTSAM throw."""
    smoother = IncrementalSmoother(
        RUN.camera, RUN.rover_T_camera, RUN.start, GraphConfig(landmarks="full")
    )
    for keyframe in RUN.keyframes[:5]:
        smoother.add(keyframe)
    isam = smoother._graph._isam
    key = smoother._graph._whole.live()[0]
    point = isam._isam.calculateEstimatePoint3(key)
    values = gtsam.Values()
    values.insert(gtsam.symbol("l", 10**6), gtsam.Point3(-point))
    stereo = smoother._graph._whole._stereo.create(
        gtsam.symbol("x", 4), gtsam.symbol("l", 10**6), np.array([300.0, 280.0, 200.0]), np.eye(3)
    )
    factors = gtsam.NonlinearFactorGraph()
    factors.add(stereo)
    assert isam.update(factors, values, 5) == {gtsam.symbol("l", 10**6)}
    for keyframe in RUN.keyframes[5:]:
        smoother.add(keyframe)
    assert position_error(smoother.trajectory()).max() < 0.5


def test_a_segment_without_a_solution_is_named(monkeypatch):
    def fail(self, max_iterations):
        raise EstimationError("its measurements do not fix all poses")

    monkeypatch.setattr(segment_module.WindowSolver, "solve", fail)
    smoother = run_all(RUN.keyframes, "segments")
    named = [w for w in smoother.warnings if w.startswith("segment that ends at keyframe")]
    assert len(named) == 3
    assert "keyframe 10" in named[0]
    assert "motions alone" in named[0]
    assert position_error(smoother.trajectory()).max() < 0.5


def test_a_segment_that_isam_refuses_stays_open_and_is_tried_again(monkeypatch):
    original, refused = GuardedIsam.update, []

    def update(self, factors, values, frame):
        if frame == 10:
            refused.append(frame)
            raise EstimationError("no")
        return original(self, factors, values, frame)

    monkeypatch.setattr(GuardedIsam, "update", update)
    smoother = run_all(RUN.keyframes, "segments")
    assert any("keyframe 10: stays open" in w for w in smoother.warnings)
    assert len(smoother.trajectory()) == 25
    assert position_error(smoother.trajectory()).max() < 0.5
