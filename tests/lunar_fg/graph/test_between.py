"""The motion between two keyframes as the graph has it: what a loop closure is held against."""

import numpy as np
import pytest

from frontends.errors import EstimationError
from frontends.geometry import inverse, se3_log
from lunar_fg.graph import IncrementalSmoother
from lunar_fg.simulation.measurements import INDEPENDENT, TraverseSpec, simulate

SPEC = TraverseSpec(keyframes=34, landmarks=60, odometry=True, tilt=True)
#: On a boundary and inside of segments of 10, the last of them within the open one.
PAIRS = [(0, 20), (3, 17), (10, 33), (4, 30), (7, 32)]


def smoothed(seed, **config):
    run = simulate(SPEC, seed)
    settings = INDEPENDENT.model_copy(update=config)
    smoother = IncrementalSmoother(run.camera, run.rover_T_camera, run.start, settings)
    for keyframe in run.keyframes:
        smoother.add(keyframe)
    return run, smoother


@pytest.mark.parametrize("landmarks", ["segments", "full"])
def test_the_motion_is_that_of_the_poses_and_its_covariance_holds_the_error(landmarks):
    nees = []
    for seed in range(6):
        run, smoother = smoothed(seed, landmarks=landmarks)
        for i, j in PAIRS:
            motion = smoother.between(i, j)
            poses = inverse(smoother.pose(i)) @ smoother.pose(j)
            np.testing.assert_allclose(motion.a_T_b, poses, atol=1e-9)
            off = se3_log(inverse(motion.a_T_b) @ inverse(run.map_T_rover[i]) @ run.map_T_rover[j])
            nees.append(off @ np.linalg.solve(motion.covariance, off) / 6.0)
    assert 0.6 < np.mean(nees) < 1.6


def test_from_a_known_start_it_is_the_pose_itself():
    _, smoother = smoothed(3)
    motion = smoother.between(0, 20)
    pose = smoother.predicted(20)
    spread = [np.sqrt(np.trace(c[3:, 3:])) for c in (motion.covariance, pose.covariance)]
    assert spread[0] <= spread[1] * 1.001


def test_asking_leaves_the_open_segment_open():
    _, asked = smoothed(5)
    _, plain = smoothed(5)
    for i, j in PAIRS:
        asked.between(i, j)
        asked.pose(j)
    asked.finish()
    plain.finish()
    np.testing.assert_array_equal(asked.trajectory().map_T_rover, plain.trajectory().map_T_rover)


def test_within_the_open_segment_there_is_no_answer_yet():
    _, smoother = smoothed(1)
    with pytest.raises(EstimationError, match="open"):
        smoother.between(31, 33)
