"""Factors in map axes: their derivatives, their agreement, and a rover that is tilted."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from frontends.geometry import inverse, se3_exp, se3_log
from lunar_fg.graph.anchors import Anchor, fix_factor, height_factor, relative_factor
from lunar_fg.graph.planar import Planar, PlanarChain, planar, planar_jacobian, planar_of
from lunar_fg.graph.segment import SegmentSolution
from lunar_fg.graph.spread import spread

RNG = np.random.default_rng(0)
X0, X1, X2 = (gtsam.symbol("x", i) for i in range(3))


def random_pose(scale=1.0):
    return se3_exp(scale * RNG.normal(size=6) * [0.3, 0.3, 1.0, 5.0, 5.0, 1.0])


def segment():
    poses = [np.eye(4)]
    for _ in range(4):
        poses.append(poses[-1] @ se3_exp([0.02, 0.03, 0.1, 0.5, 0.0, 0.0]))
    root = RNG.normal(size=(24, 24))
    return SegmentSolution(np.stack(poses), 1e-4 * root @ root.T, 100, 0.0, 0, converged=True)


def values(first, last, third=None):
    result = gtsam.Values()
    for key, pose in ((X0, first), (X1, last), (X2, third)):
        if pose is not None:
            result.insert(key, gtsam.Pose3(pose))
    return result


def numeric(factor, at):
    columns = []
    for key in factor.keys():  # noqa: SIM118
        for axis in range(6):
            sides = []
            for sign in (1.0, -1.0):
                moved = gtsam.Values(at)
                step = np.zeros(6)
                step[axis] = sign * 1e-6
                moved.update(key, at.atPose3(key).compose(gtsam.Pose3.Expmap(step)))
                sides.append(factor.unwhitenedError(moved))
            columns.append((sides[0] - sides[1]) / 2e-6)
    return np.stack(columns, axis=1)


def analytic(factor, at):
    whitened, _ = factor.linearize(at).jacobian()
    # Undo the whitening.
    return np.linalg.solve(factor.noiseModel().R(), whitened)


def test_planar_jacobian_is_the_derivative():
    pose = random_pose()
    columns = [
        (planar(pose @ se3_exp(1e-6 * e)) - planar(pose @ se3_exp(-1e-6 * e))) / 2e-6
        for e in np.eye(6)
    ]
    np.testing.assert_allclose(planar_jacobian(pose), np.stack(columns, 1), atol=1e-8)


@pytest.mark.parametrize("position", [0, 2])
def test_fix_and_height_have_the_derivatives_they_say(position):
    solution, first = segment(), random_pose()
    last = first @ solution.first_T_last @ se3_exp(1e-3 * RNG.normal(size=6))
    at = values(first, last)
    anchor = Anchor((X0,)) if position == 0 else Anchor((X0, X1), spread(solution, position))
    pose = anchor.pose(at)
    place = Planar(planar(pose) + np.array([0.3, -0.2, 0.05]), np.diag([1.0, 2.0, 0.1]))
    for factor in (
        fix_factor(anchor, place, pose, "here"),
        height_factor(anchor, 1.0, 0.5, pose),
    ):
        got = analytic(factor, at) if factor.dim() > 1 else numeric(factor, at)
        np.testing.assert_allclose(got, numeric(factor, at), atol=2e-3)


def test_relative_factor_within_and_across_segments():
    solution, first = segment(), random_pose()
    last = first @ solution.first_T_last
    third = last @ random_pose(0.3)
    at = values(first, last, third)
    inside = Anchor((X0, X1), spread(solution, 2))
    for other in (Anchor((X2,)), Anchor((X1,)), Anchor((X0, X1), spread(solution, 3))):
        motion = inverse(inside.pose(at)) @ other.pose(at)
        off = motion @ se3_exp(1e-3 * RNG.normal(size=6))
        factor = relative_factor(inside, other, off, 1e-2 * np.eye(6), "here")
        # Not in the order of the keys, so compare by what a step does.
        assert len(set(factor.keys())) == len(factor.keys())
        np.testing.assert_allclose(analytic(factor, at), numeric(factor, at), atol=5e-3)
        exact = relative_factor(inside, other, motion, 1e-2 * np.eye(6), "here")
        assert exact.error(at) < 1e-12


def test_an_interior_keyframe_is_where_its_segment_says():
    solution, first = segment(), random_pose()
    at = values(first, first @ solution.first_T_last)
    inner = Anchor((X0, X1), spread(solution, 3))
    np.testing.assert_allclose(inner.pose(at), first @ solution.first_T_rover[3], atol=1e-9)
    assert np.linalg.eigvalsh(inner.rest())[0] > 0.0


def test_fixes_of_a_tilted_rover_are_honest():
    """NEES of x, y and yaw, correlated fixes, tilt to 20 degrees; a level prior fails this."""
    squared = []
    for _ in range(200):
        truth = se3_exp([0.0, 0.0, RNG.uniform(-3, 3), *RNG.normal(size=3) * 10])
        truth = truth @ se3_exp([*np.deg2rad(RNG.uniform(-20, 20, 2)), 0, 0, 0, 0])
        sigmas = np.array([0.01, 0.01, 0.2, 1.0, 1.0, 1.0])
        start = truth @ se3_exp(sigmas * RNG.normal(size=6))
        covariance = np.array([[1.0, 0.2, 0.15], [0.2, 0.5, 0.0], [0.15, 0.0, 0.04]])
        seen = planar(truth) + np.linalg.cholesky(covariance) @ RNG.normal(size=3)
        graph = gtsam.NonlinearFactorGraph()
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        graph.add(gtsam.PriorFactorPose3(X0, gtsam.Pose3(start), noise))
        graph.add(fix_factor(Anchor((X0,)), Planar(seen, covariance), start, "here"))
        initial = gtsam.Values()
        initial.insert(X0, gtsam.Pose3(start))
        end = gtsam.LevenbergMarquardtOptimizer(graph, initial).optimize()
        marginal = gtsam.Marginals(graph, end).marginalCovariance(X0)
        error = se3_log(inverse(end.atPose3(X0).matrix()) @ truth)
        squared.append(error @ np.linalg.solve(marginal, error))
    assert 5.4 < np.mean(squared) < 6.7


def test_the_chain_adds_up():
    """Monte Carlo: a motion across links has the mean and the covariance the chain says."""
    solution = segment()
    # Small turns, little tilt: how an error of the attitude bends the next link is left out.
    solution = replace(solution, covariance=0.05 * solution.covariance)
    root = np.linalg.cholesky(solution.covariance)
    first = random_pose(0.1)
    chain = PlanarChain()
    at = first
    for _ in range(3):
        chain.add(at, solution.first_T_rover, solution.covariance)
        at = at @ solution.first_T_last
    assert chain.end == 12
    for begin, end in ((0, 12), (0, 2), (4, 8), (1, 3), (4, 10)):
        said = chain.between(begin, end)
        ends = []
        for _ in range(1000):
            pose, path = first, [first]
            for _ in range(3):
                noise = root @ RNG.normal(size=24)
                members = [
                    pose @ solution.first_T_rover[i] @ se3_exp(noise[6 * i - 6 : 6 * i])
                    for i in range(1, 5)
                ]
                path.extend(members)
                pose = members[-1]
            a, b = planar(path[begin]), planar(path[end])
            turned = np.array([[np.cos(a[2]), np.sin(a[2])], [-np.sin(a[2]), np.cos(a[2])]])
            ends.append([*(turned @ (b[:2] - a[:2])), np.arctan2(*_sin_cos(b[2] - a[2]))])
        ends = np.array(ends)
        np.testing.assert_allclose(ends.mean(axis=0), said.xyyaw, atol=0.01)
        sampled = np.sqrt(np.diag(np.cov(ends.T)))
        np.testing.assert_allclose(np.sqrt(np.diag(said.covariance)), sampled, rtol=0.15)


def _sin_cos(angle):
    return np.sin(angle), np.cos(angle)


def test_planar_of_turns_the_covariance_into_map_axes():
    pose = se3_exp([0.0, 0.0, np.pi / 2, 1.0, 2.0, 3.0])
    covariance = np.diag([1.0, 1.0, 0.01, 4.0, 9.0, 1.0])
    said = planar_of(pose, covariance)
    np.testing.assert_allclose(said.covariance, np.diag([9.0, 4.0, 0.01]), atol=1e-12)
