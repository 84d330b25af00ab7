"""A rover that is carried: said, its covariance opened, and navigation goes on."""

from __future__ import annotations

import numpy as np
import pytest

from frontends.geometry import pose
from frontends.measurements import StartPrior, StereoFrame, WheelOdometry
from lunar_fg.navigator import Navigator
from lunar_fg.simulation.camera import camera_mount, stereo_camera, take_pair
from lunar_fg.simulation.simulate import World, ground_height
from lunar_fg.simulation.spec import SimulationSpec

STEP_M = 0.4
#: Where the rover is set down: place and heading.
ELSEWHERE = [(1.0, 0.0, 0.0), (9.0, 3.0, 2.8)]


def stops(world: World) -> list[np.ndarray]:
    """Poses of two straight drives of four frames each, far apart."""
    found = []
    for x, y, yaw in ELSEWHERE:
        ahead = np.array([np.cos(yaw), np.sin(yaw)])
        for k in range(4):
            at = np.array([x, y]) + k * STEP_M * ahead
            z = float(ground_height(world.scene.levels, at[None, :])[0])
            turn = [[ahead[0], -ahead[1], 0.0], [ahead[1], ahead[0], 0.0], [0.0, 0.0, 1.0]]
            found.append(pose(turn, [*at, z]))
    return found


@pytest.mark.parametrize("carried", [True, False])
def test_views_with_nothing_in_common_open_the_covariance(
    world: World, spec: SimulationSpec, carried: bool
) -> None:
    camera, mount = spec.camera, camera_mount(spec.camera)
    truth = stops(world) if carried else stops(world)[:4]
    start = StartPrior(truth[0], (1e-3,) * 3, (1e-2,) * 3)
    navigator = Navigator(stereo_camera(camera), None, mount, start)
    estimates = []
    for k, map_T_rover in enumerate(truth):
        pair = take_pair(
            world.scene, map_T_rover @ mount, camera, spec.sun.direction(),
            np.random.default_rng(k),
        )  # fmt: skip
        wheels = WheelOdometry(STEP_M, 0.0, 0.0) if k else None
        estimates.append(
            navigator.step(
                StereoFrame(k, float(k), pair.left, pair.right, navigator.camera, odometry=wheels)
            )
        )
    trajectory = navigator.trajectory()
    off = np.linalg.norm(trajectory.positions - np.array([t[:3, 3] for t in truth]), axis=1)
    assert off[:4].max() < 0.1
    assert any("carried" in line for line in navigator.warnings) == carried
    assert [e.lost for e in estimates] == [k == 4 for k in range(len(truth))]
    if not carried:
        return
    assert off[4:].min() > 5.0
    for k in range(4, 8):
        sigma = np.sqrt(np.diag(trajectory.covariance[k])[3:])
        assert off[k] < 3.0 * sigma.max()
    # from there on the motion is seen again
    step = np.linalg.norm(np.diff(trajectory.positions[4:], axis=0), axis=1)
    assert step == pytest.approx([STEP_M] * 3, abs=0.05)
