"""A rover that was carried: the first fix after it brings it back, from however far."""

from dataclasses import replace

import numpy as np
import pytest

from frontends.geometry import inverse, pose, se3_log
from frontends.measurements import AbsoluteFix, FixCandidate, Verdict
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.graph.planar import planar
from lunar_fg.motion_config import MotionConfig
from lunar_fg.simulation.measurements import INDEPENDENT, TraverseSpec, simulate

AT, FIXED_AT = 15, 25
RUN = simulate(TraverseSpec(keyframes=34, landmarks=60, odometry=True, tilt=True), seed=4)


def carried(yaw, x, y):
    """Keyframes and truth of a rover that is set down elsewhere before frame AT."""
    c, s = np.cos(yaw), np.sin(yaw)
    jump = pose(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), [x, y, 0.3])
    about = np.eye(4)
    about[:3, 3] = RUN.map_T_rover[AT, :3, 3]
    truth = RUN.map_T_rover.copy()
    truth[AT:] = about @ jump @ inverse(about) @ truth[AT:]
    config = MotionConfig()
    sigmas = np.array([config.carried_sigma_rad] * 3 + [config.carried_sigma_m] * 3)
    keyframes = []
    for k, keyframe in enumerate(RUN.keyframes):
        if k >= AT:
            seen = keyframe.observations
            seen = replace(seen, landmark_id=seen.landmark_id + 1_000_000)
            keyframe = replace(keyframe, observations=seen)
        if k == AT:
            covariance = keyframe.odometry.covariance + np.diag(sigmas**2)
            keyframe = replace(
                keyframe,
                relative=replace(keyframe.relative, verdict=Verdict.REFUSED),
                odometry=replace(keyframe.odometry, covariance=covariance),
            )
        keyframes.append(keyframe)
    return keyframes, truth


@pytest.mark.parametrize("mode", ["segments", "full"])
@pytest.mark.parametrize("yaw", [0.7, 1.6, -2.0, 3.1])
def test_a_fix_brings_a_carried_rover_back(mode, yaw):
    keyframes, truth = carried(yaw, -12.0, 9.0)
    config = INDEPENDENT.model_copy(update={"landmarks": mode})
    graph = IncrementalSmoother(RUN.camera, RUN.rover_T_camera, RUN.start, config)
    for keyframe in keyframes[: FIXED_AT + 5]:
        graph.add(keyframe)
    place = planar(truth[FIXED_AT]) + np.array([0.05, -0.05, 0.003])
    fix = AbsoluteFix(FIXED_AT, (FixCandidate(*place, np.diag([0.01, 0.01, 2.5e-5])),))
    assert graph.add_fix(fix).accepted
    for keyframe in keyframes[FIXED_AT + 5 :]:
        graph.add(keyframe)
    for _ in range(2):  # as it comes, and at the end
        trajectory = graph.trajectory()
        off = np.array(
            [
                se3_log(inverse(estimate) @ true)
                for estimate, true in zip(trajectory.map_T_rover, truth, strict=True)
            ]
        )
        assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.4
        nees = np.einsum(
            "ni,ni->n", off, np.linalg.solve(trajectory.covariance, off[..., None])[..., 0]
        )
        assert nees[:AT].mean() / 6.0 < 3.0
        assert nees[AT:].mean() / 6.0 < 3.0
        graph.finish()
    assert not any("set aside" in line for line in graph.warnings)
