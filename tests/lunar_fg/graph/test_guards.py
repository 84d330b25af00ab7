"""Nothing a caller passes reaches GTSAM unchecked; what was computed stays readable."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frontends.errors import EstimationError, InputError
from frontends.measurements import Odometry, StartPrior, Tilt
from lunar_fg.graph import GraphConfig, IncrementalSmoother
from lunar_fg.graph.factors import (
    between_factor,
    gaussian,
    pose_key,
    start_factor,
    tilt_factor,
    upright_factor,
)
from lunar_fg.graph.isam import GuardedIsam
from lunar_fg.simulation.measurements import TraverseSpec, simulate

RUN = simulate(TraverseSpec(keyframes=8, landmarks=40, odometry=True, tilt=True), seed=9)


def started(mode="segments", count=4):
    config = GraphConfig(landmarks=mode, segment_keyframes=2)
    smoother = IncrementalSmoother(RUN.camera, RUN.rover_T_camera, RUN.start, config)
    for keyframe in RUN.keyframes[:count]:
        smoother.add(keyframe)
    return smoother


def with_value(array, position, value):
    array = np.array(array, dtype=np.float64)
    array.flat[position % array.size] = value
    return array


FIELDS = ["u_left", "u_right", "v", "sigma_px", "sigma_disparity_px"]


@pytest.mark.parametrize("mode", ["segments", "full"])
@settings(max_examples=40, deadline=None)
@given(
    field=st.sampled_from([*FIELDS, "relative", "relative_covariance", "odometry", "tilt"]),
    position=st.integers(0, 35),
    value=st.sampled_from([np.nan, np.inf, -np.inf]),
)
def test_a_value_that_is_not_finite_is_a_named_error(mode, field, position, value):
    smoother = started(mode)
    before = smoother.trajectory()
    keyframe = RUN.keyframes[4]
    if field in FIELDS:
        bad = with_value(getattr(keyframe.observations, field), position, value)
        keyframe = replace(keyframe, observations=replace(keyframe.observations, **{field: bad}))
    elif field == "relative":
        bad = with_value(keyframe.relative.a_T_b, position % 12, value)
        keyframe = replace(keyframe, relative=replace(keyframe.relative, a_T_b=bad))
    elif field == "relative_covariance":
        bad = with_value(keyframe.relative.covariance, position, value)
        keyframe = replace(keyframe, relative=replace(keyframe.relative, covariance=bad))
    elif field == "odometry":
        bad = with_value(keyframe.odometry.covariance, position, value)
        keyframe = replace(keyframe, odometry=replace(keyframe.odometry, covariance=bad))
    else:
        keyframe = replace(keyframe, tilt=Tilt(value, 0.0, 0.01))
    with pytest.raises(InputError, match="keyframe 4"):
        smoother.add(keyframe)
    after = smoother.trajectory()
    np.testing.assert_array_equal(before.map_T_rover, after.map_T_rover)
    assert smoother.add(RUN.keyframes[4]).index == 4


def indefinite():
    covariance = np.eye(6)
    covariance[0, 1] = covariance[1, 0] = 2.0
    return covariance


BAD_KEYFRAMES = {
    "index twice": lambda k: replace(k, index=3),
    "time back": lambda k: replace(k, stamp_s=1.0),
    "time nan": lambda k: replace(k, stamp_s=float("nan")),
    "not psd": lambda k: replace(k, odometry=Odometry(np.eye(4), indefinite())),
    "asymmetric": lambda k: replace(
        k, odometry=Odometry(np.eye(4), np.triu(np.ones((6, 6))) + 9 * np.eye(6))
    ),
    "wrong shape": lambda k: replace(k, odometry=Odometry(np.eye(4), np.eye(3))),
    "not rigid": lambda k: replace(k, odometry=Odometry(2.0 * np.eye(4), np.eye(6))),
    "tilt sigma": lambda k: replace(k, tilt=Tilt(0.0, 0.0, 0.0)),
    "unconnected": lambda k: replace(k, relative=None, odometry=None),
    "landmark twice": lambda k: replace(k, observations=k.observations.select(np.array([0, 1, 1]))),
    "short array": lambda k: replace(
        k, observations=replace(k.observations, v=k.observations.v[:-1])
    ),
    "sigma zero": lambda k: replace(
        k, observations=replace(k.observations, sigma_px=0.0 * k.observations.sigma_px)
    ),
}


@pytest.mark.parametrize("mode", ["segments", "full"])
@pytest.mark.parametrize("name", BAD_KEYFRAMES)
def test_bad_keyframes_are_named_and_leave_no_trace(mode, name):
    smoother, clean = started(mode), started(mode)
    with pytest.raises(InputError, match="keyframe"):
        smoother.add(BAD_KEYFRAMES[name](RUN.keyframes[4]))
    for keyframe in RUN.keyframes[4:]:
        smoother.add(keyframe)
        clean.add(keyframe)
    np.testing.assert_array_equal(smoother.trajectory().map_T_rover, clean.trajectory().map_T_rover)


def test_bad_starts_and_cameras_are_refused():
    for start in (
        StartPrior(np.full((4, 4), np.nan)),
        StartPrior(sigma_rot_rad=(0.0, 0.1, 0.1)),
        StartPrior(sigma_trans_m=(0.1, float("nan"), 0.1)),
        StartPrior(sigma_trans_m=(0.1, -1.0, 0.1)),
    ):
        with pytest.raises(InputError, match="start"):
            IncrementalSmoother(RUN.camera, RUN.rover_T_camera, start)
    with pytest.raises(InputError, match="rover_T_camera"):
        IncrementalSmoother(RUN.camera, np.zeros((4, 4)))


def test_zero_covariances_do_not_make_constraints():
    smoother = started()
    still = Odometry(np.eye(4), np.zeros((6, 6)))
    keyframe = replace(RUN.keyframes[4], odometry=still, observations=None, relative=None)
    smoother.add(keyframe)
    smoother.finish()
    assert np.isfinite(smoother.trajectory().covariance).all()


def test_factor_constructors_refuse():
    with pytest.raises(InputError, match="singular"):
        gaussian(np.zeros((6, 6)), "here", "covariance")
    with pytest.raises(InputError, match="rigid"):
        between_factor(0, 1, np.zeros((4, 4)), np.eye(6), "here")
    with pytest.raises(InputError, match="sigma"):
        tilt_factor(0, Tilt(0.0, 0.0, -1.0), "here")


def graph_of(*factors):
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def values_of(*keys):
    values = gtsam.Values()
    for key in keys:
        values.insert(key, gtsam.Pose3())
    return values


@pytest.mark.parametrize("qr", [True, False])
def test_a_failed_update_names_the_frame_and_keeps_the_rest(qr):
    isam = GuardedIsam(qr=qr)
    isam.update(graph_of(start_factor(pose_key(0), StartPrior())), values_of(pose_key(0)), 10)
    before = isam.covariance(pose_key(0))
    unknown = between_factor(pose_key(5), pose_key(1), np.eye(4), np.eye(6), "test")
    with pytest.raises(EstimationError, match="keyframe 11"):
        isam.update(graph_of(unknown), values_of(pose_key(1)), 11)
    np.testing.assert_allclose(isam.covariance(pose_key(0)), before)
    good = between_factor(pose_key(0), pose_key(1), np.eye(4), np.eye(6), "test")
    isam.update(graph_of(good), values_of(pose_key(1)), 12)
    assert np.isfinite(isam.joint_covariance(pose_key(0), pose_key(1))).all()


@pytest.mark.parametrize("qr", [True, False])
def test_an_indeterminate_system_is_told_by_frame_and_set_aside(qr):
    isam = GuardedIsam(qr=qr)
    isam.update(graph_of(start_factor(pose_key(0), StartPrior())), values_of(pose_key(0)), 10)
    motion = between_factor(pose_key(0), pose_key(1), np.eye(4), np.eye(6), "test")
    # a sigma whose square is no number any more, past all checks
    absurd = upright_factor(pose_key(1), np.array([0.0, 0.0, 1.0]), 1e-200)
    with pytest.raises(EstimationError, match=r"keyframe 11.*left out"):
        isam.update(graph_of(motion, absurd), values_of(pose_key(1)), 11)
    isam.update(graph_of(motion), values_of(pose_key(1)), 12)
    assert np.isfinite(isam.covariance(pose_key(1))).all()


def test_a_pose_without_a_measurement_is_an_error_not_a_crash():
    isam = GuardedIsam(qr=False)
    isam.update(graph_of(start_factor(pose_key(0), StartPrior())), values_of(pose_key(0)), 0)
    loose = gtsam.PoseTranslationPrior3D(
        pose_key(1), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
    )
    with pytest.raises(EstimationError, match="keyframe 7"):
        isam.update(graph_of(loose), values_of(pose_key(1)), 7)
    assert np.isfinite(isam.pose(pose_key(0))).all()
    with pytest.raises(EstimationError, match="marginal"):
        isam.covariance(pose_key(1))


def test_config_refuses_unknown_and_unlikely_values():
    for bad in ({"unknown": 1}, {"gate_probability": 1.0}, {"segment_keyframes": 0},
                {"robust_threshold_sigma": float("nan")}):  # fmt: skip
        with pytest.raises(ValueError, match=next(iter(bad))):
            GraphConfig(**bad)
