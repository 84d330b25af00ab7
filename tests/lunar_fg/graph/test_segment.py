"""A segment against GTSAM on the same factors."""

import gtsam
import numpy as np
import pytest

from frontends.geometry import inverse, se3_log
from frontends.measurements import Tilt
from lunar_fg.graph.config import GraphConfig
from lunar_fg.graph.factors import between_factor, landmark_key, pose_key
from lunar_fg.graph.segment import Segment, _longest
from lunar_fg.graph.setup import Setup
from lunar_fg.graph.uprights import uprights
from lunar_fg.simulation.measurements import INDEPENDENT, TraverseSpec, simulate


def gtsam_solution(segment, traverse, threshold):
    """Levenberg-Marquardt on the segment's own window, first pose held."""
    window = segment._window()
    camera = traverse.camera
    calibration = gtsam.Cal3_S2Stereo(
        camera.fx, camera.fy, 0.0, camera.cx, camera.cy, camera.baseline_m
    )
    loss = gtsam.noiseModel.mEstimator.Huber.Create(threshold)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(
        gtsam.PriorFactorPose3(
            pose_key(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-7)
        )
    )
    for i, pose in enumerate(segment._poses):
        values.insert(pose_key(i), gtsam.Pose3(pose))
    for row in range(len(window.pose)):
        uuv = window.sightings.uuv[row]
        landmark = landmark_key(int(window.landmark[row]))
        noise = gtsam.noiseModel.Robust.Create(
            loss, gtsam.noiseModel.Gaussian.Covariance(window.sightings.covariance[row])
        )
        graph.add(
            gtsam.GenericStereoFactor3D(
                gtsam.StereoPoint2(*uuv), noise, pose_key(int(window.pose[row])), landmark,
                calibration,
            )
        )  # fmt: skip
        if not values.exists(landmark):
            pose = values.atPose3(pose_key(int(window.pose[row])))
            stereo = gtsam.StereoCamera(pose, calibration)
            values.insert(landmark, stereo.backproject(gtsam.StereoPoint2(*uuv)))
    for motion in window.motions:
        graph.add(
            between_factor(
                pose_key(motion.first), pose_key(motion.second), motion.a_T_b, motion.covariance,
                "test",
            )
        )  # fmt: skip
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    params.setMaxIterations(300)
    optimum = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    marginals = gtsam.Marginals(graph, optimum)
    last = pose_key(len(segment) - 1)
    return (
        np.stack([optimum.atPose3(pose_key(i)).matrix() for i in range(len(segment))]),
        marginals.marginalCovariance(last),
        2.0 * graph.error(optimum),
    )


def filled(traverse, config):
    segment = Segment(
        Setup.checked(traverse.camera, traverse.rover_T_camera, config=config),
        traverse.keyframes[0],
    )
    for keyframe in traverse.keyframes[1:]:
        segment.add(keyframe)
    return segment


@pytest.mark.parametrize(("bad_share", "odometry"), [(0.0, False), (0.1, True)])
def test_equals_gtsam(bad_share, odometry):
    spec = TraverseSpec(keyframes=9, bad_share=bad_share, odometry=odometry)
    traverse = simulate(spec, seed=11)
    # The wide gate leaves outliers to the robust loss.
    config = INDEPENDENT.model_copy(update={"gate_probability": 0.99999999})
    segment = filled(traverse, config)
    solution = segment.solve()
    poses, covariance, chi_square = gtsam_solution(segment, traverse, 2.0)
    back = inverse(traverse.rover_T_camera)
    camera_poses = back @ solution.first_T_rover @ traverse.rover_T_camera
    sigma = np.sqrt(np.diag(covariance))
    for ours, theirs in zip(camera_poses, poses, strict=True):
        assert (np.abs(se3_log(inverse(theirs) @ ours)) < 0.05 * sigma).all()
    rotate = np.zeros((6, 6))
    rotate[:3, :3] = rotate[3:, 3:] = traverse.rover_T_camera[:3, :3]
    ours = np.sqrt(np.diag(rotate.T @ solution.last_covariance @ rotate))
    np.testing.assert_allclose(ours, sigma, rtol=0.01)
    assert solution.chi_square == pytest.approx(chi_square, rel=5e-3)
    assert solution.converged


def test_chi_square_is_one_a_degree_of_freedom():
    solution = filled(simulate(TraverseSpec(keyframes=11), seed=2), GraphConfig()).solve()
    assert solution.chi_square / solution.degrees_of_freedom == pytest.approx(1.0, abs=0.1)


def test_far_points_help_and_do_no_harm():
    """Points at almost no disparity, some of which noise puts beyond infinity."""
    traverse = simulate(TraverseSpec(keyframes=11, sigma_disparity_px=6.0), seed=4)
    solution = filled(traverse, GraphConfig()).solve()
    assert solution.converged
    error = se3_log(inverse(solution.first_T_last) @ inverse(traverse.map_T_rover[0])
                    @ traverse.map_T_rover[-1])  # fmt: skip
    assert error @ np.linalg.solve(solution.last_covariance, error) < 30.0


def test_chained_is_the_product_of_the_motions():
    traverse = simulate(TraverseSpec(keyframes=5), seed=6)
    segment = filled(traverse, GraphConfig())
    chained = segment.chained()
    predicted, covariance = segment.predicted()
    np.testing.assert_allclose(chained.first_T_last, predicted)
    np.testing.assert_allclose(chained.last_covariance, covariance, atol=1e-15)
    assert np.linalg.eigvalsh(chained.covariance)[0] > 0.0
    assert not chained.converged


def test_capped_landmarks_stay_honest_and_keep_every_link():
    traverse = simulate(TraverseSpec(keyframes=11, landmarks=200), seed=8)
    apart = GraphConfig(landmark_correlation=0.0)  # else twice as many count for little more
    all_of_them = filled(traverse, apart).solve()
    capped = filled(traverse, apart.model_copy(update={"max_landmarks": 100})).solve()
    assert capped.sightings < 0.5 * all_of_them.sightings
    ratio = np.sqrt(np.diag(capped.last_covariance) / np.diag(all_of_them.last_covariance))
    assert (ratio > 1.0).all()
    assert (ratio < 3.0).all()


def test_longest_tracks_are_kept_at_each_start():
    start = np.array([0, 0, 0, 0, 1, 1, 1, 1, 2])
    length = np.array([2, 9, 3, 1, 2, 2, 5, 4, 1])
    kept = _longest(start, length, 4)
    assert kept.tolist() == [False, True, True, False, True, False, True, True, False]


@pytest.mark.parametrize("end", [0, 10])
def test_tilts_within_a_segment_come_together_at_its_ends(end):
    traverse = simulate(TraverseSpec(keyframes=11, tilt=True), seed=3)
    solution = filled(traverse, GraphConfig()).solve()
    members = [3, 4] if end == 0 else [7, 8]
    tilts = {i: traverse.keyframes[i].tilt for i in members}
    found = uprights(solution, tilts)
    assert found[0 if end else 1] is None
    up, sigma = found[1 if end else 0]
    truth = traverse.map_T_rover[end][2, :3]
    assert np.arccos(np.clip(up @ truth, -1.0, 1.0)) < 3.0 * sigma
    alone = tilts[members[0]].sigma_rad / np.sqrt(2.0)
    assert alone < sigma < 1.1 * alone


def test_tilts_at_the_ends_are_left_to_the_graph():
    traverse = simulate(TraverseSpec(keyframes=6, tilt=True), seed=3)
    solution = filled(traverse, GraphConfig()).solve()
    assert uprights(solution, {0: Tilt(0.0, 0.0, 0.1), 5: Tilt(0.0, 0.0, 0.1)}) == (None, None)
