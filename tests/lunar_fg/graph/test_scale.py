"""A calibration that is wrong in scale: nothing shows it, the covariance holds it."""

import numpy as np

from frontends.measurements import AbsoluteFix, FixCandidate
from lunar_fg.graph import IncrementalSmoother, optimize_batch
from lunar_fg.graph.network import Claim
from lunar_fg.graph.planar import Planar, planar
from lunar_fg.graph.scale import Anchors, fixed_scale
from lunar_fg.simulation.measurements import INDEPENDENT, TraverseSpec, simulate

SHARE = 0.02
CONSIDERED = INDEPENDENT.model_copy(update={"scale_sigma": SHARE})


def drive(config, fixed=()):
    """A drive of 60 m of which everything that was measured is 2 % too long; truth, estimate."""
    spec = TraverseSpec(keyframes=120, landmarks=40, odometry=False, tilt=True)
    made = simulate(spec, 3)
    baseline_m = made.camera.baseline_m * (1.0 + SHARE)
    camera = type(made.camera)(
        made.camera.width, made.camera.height, made.camera.fx, made.camera.fy,
        made.camera.cx, made.camera.cy, baseline_m,
    )  # fmt: skip
    smoother = IncrementalSmoother(camera, made.rover_T_camera, made.start, config)
    latest = None
    for keyframe in made.keyframes:
        latest = smoother.add(keyframe)
        if keyframe.index in fixed:
            xyyaw = planar(made.map_T_rover[keyframe.index])
            place = FixCandidate(*xyyaw, np.diag([0.1, 0.1, 0.01]) ** 2)
            assert smoother.add_fix(AbsoluteFix(keyframe.index, (place,), 0.3)).accepted
    smoother.finish()
    return made, camera, smoother, latest


def sigmas_off(made, trajectory):
    """Distance from the truth in sigmas along the way, of each keyframe."""
    off = trajectory.map_T_rover[:, :3, 3] - made.map_T_rover[:, :3, 3]
    turned = np.einsum("nji,nj->ni", trajectory.map_T_rover[:, :3, :3], off)
    return np.sqrt(np.einsum("ni,nij,nj->n", turned, np.linalg.inv(
        trajectory.covariance[:, 3:, 3:]), turned))  # fmt: skip


def test_the_covariance_holds_what_the_images_cannot_show():
    made, camera, smoother, latest = drive(CONSIDERED)
    trajectory = smoother.trajectory()
    final = np.linalg.norm(trajectory.map_T_rover[-1, :3, 3] - made.map_T_rover[-1, :3, 3])
    assert final > 0.8
    assert np.mean(sigmas_off(made, trajectory) < 3.0) > 0.95
    # without it nothing of this is in the covariance
    assert np.mean(sigmas_off(made, drive(INDEPENDENT)[2].trajectory()) < 3.0) < 0.6
    assert np.sqrt(latest.covariance[3:, 3:].trace()) > 0.9 * SHARE * 55.0
    np.testing.assert_allclose(
        smoother.predicted(119).covariance, trajectory.covariance[-1], rtol=1e-6, atol=1e-12
    )
    batch = optimize_batch(camera, made.rover_T_camera, made.start, made.keyframes, CONSIDERED)
    assert np.mean(sigmas_off(made, batch.trajectory) < 3.0) > 0.95


def test_fixes_take_it_up_as_far_as_they_are_believed():
    made, _, smoother, _ = drive(CONSIDERED, fixed=(20, 50, 80, 110))
    trajectory = smoother.trajectory()
    assert np.mean(sigmas_off(made, trajectory) < 3.0) > 0.95
    # without a fix it would be all the way from the start
    sigma = np.sqrt(trajectory.covariance[:, 3:, 3:].trace(axis1=1, axis2=2))
    assert sigma[110] < 0.7 * SHARE * 55.0


def test_fixes_that_are_exact_leave_nothing_of_it_where_they_are():
    start = Planar(np.zeros(3), 1e-8 * np.eye(3))
    way = Planar(np.array([20.0, 0.0, 0.0]), 0.04 * np.eye(3))
    exact = Claim(1, Planar(np.array([20.0, 0.0, 0.0]), 1e-8 * np.eye(3)))
    np.testing.assert_allclose(
        fixed_scale(start, (way, way), (exact,), 0.0).by_scale, [[0, 0], [0, 0], [20, 0]], atol=1e-3
    )
    loose = Claim(1, Planar(np.array([20.0, 0.0, 0.0]), 1e4 * np.eye(3)))
    found = fixed_scale(start, (way,), (loose,), 0.0)
    np.testing.assert_allclose(found.by_scale[1], [20, 0], atol=1e-2)


def test_a_baseline_that_is_wrong_by_more_than_stated_is_found_by_the_fixes():
    stated = INDEPENDENT.model_copy(update={"scale_sigma": 0.005})
    made, _, smoother, _ = drive(stated, fixed=(20, 50, 80, 110))
    assert np.mean(sigmas_off(made, smoother.trajectory()) < 3.0) > 0.95
    assert any("% too long" in line for line in smoother.warnings)
    _, _, sound, _ = drive(stated)
    assert not any("too long" in line for line in sound.warnings)


def test_fixes_that_agree_leave_the_scale_as_it_is_stated():
    start = Planar(np.zeros(3), 1e-4 * np.eye(3))
    way = Planar(np.array([50.0, 0.0, 0.0]), np.diag([1e-2, 1e-2, 1e-4]))
    for length, excess in ((50.0, 0.0), (48.0, 0.042)):
        fix = Claim(1, Planar(np.array([length, 0.0, 0.0]), np.diag([1e-2, 1e-2, 1e-4])))
        found = fixed_scale(start, (way,), (fix,), 0.0)
        assert abs(found.excess - excess) < 2e-3
        assert np.isclose(found.sigma, np.sqrt(2.01e-2) / 50.0, rtol=0.05)
        assert found.contradicts(0.005, 0.999) == (excess > 0.0)
        assert np.isclose(found.considered(0.005), max(0.005, excess), rtol=0.15)


def test_between_two_fixes_it_is_spread_out():
    anchors = Anchors(
        np.array([0, 10]), np.array([[0.0, 0, 0], [20.0, 0, np.nan]]), np.array([[0, 0], [4.0, 0]])
    )
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = 0.0, 10.0, 20.0, 30.0
    found = anchors.considered(np.array([0, 5, 10, 15]), poses, np.zeros((4, 6, 6)), 1.0)
    np.testing.assert_allclose(np.sqrt(found[:, 3, 3]), [0.0, 2.0, 4.0, 14.0])
