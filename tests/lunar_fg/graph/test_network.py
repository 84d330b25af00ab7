"""The solver of the vote against GTSAM on the same graph."""

import gtsam
import numpy as np
import pytest

from lunar_fg.graph.network import Claim, Network
from lunar_fg.graph.planar import Planar, composed, turn, turned

STEP = Planar(np.array([90.0, 10.0, 0.3]), np.diag([2.0, 50.0, 0.02]))


def covariance(rng, scale):
    root = np.tril(rng.normal(size=(3, 3))) + 2.0 * np.eye(3)
    return np.diag(scale) @ root @ root.T @ np.diag(scale)


def problem(seed, n=12):
    rng = np.random.default_rng(seed)
    motions = [Planar(STEP.xyyaw + rng.normal(size=3) * [1, 1, 0.2], STEP.covariance)
               for _ in range(n - 1)]  # fmt: skip
    poses = [np.zeros(3)]
    for motion in motions:
        poses.append(composed(poses[-1], motion.xyyaw + rng.normal(size=3) * [1, 5, 0.1]))
    claims = [
        Claim(i, Planar(poses[i] + rng.normal(size=3) * [1, 1, 0.02],
                        covariance(rng, [0.5, 0.5, 0.01])))
        for i in range(2, n, 3)
    ]  # fmt: skip
    back = np.array([*(turn(poses[1][2]).T @ (poses[n - 2] - poses[1])[:2]),
                     poses[n - 2][2] - poses[1][2]])  # fmt: skip
    claims.append(Claim(n - 2, Planar(back, covariance(rng, [0.1, 0.1, 0.01])), 1))
    start = Planar(np.zeros(3), np.diag([0.01, 0.01, 1e-4]))
    return start, motions, claims


def by_gtsam(start, motions, claims, begin):
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def noise(place):
        return gtsam.noiseModel.Gaussian.Covariance(turned(place.covariance, place.xyyaw[2]))

    def place(key, what):
        return gtsam.PriorFactorPose2(key, gtsam.Pose2(*what.xyyaw), noise(what))

    def motion(a, b, what):
        return gtsam.BetweenFactorPose2(a, b, gtsam.Pose2(*what.xyyaw), noise(what))

    graph.add(place(0, start))
    for i, step in enumerate(motions):
        graph.add(motion(i, i + 1, step))
    for c in claims:
        graph.add(place(c.station, c.place) if c.base is None
                  else motion(c.base, c.station, c.place))  # fmt: skip
    for i, pose in enumerate(begin):
        values.insert(i, gtsam.Pose2(*pose))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    params.setMaxIterations(500)
    end = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    marginals = gtsam.Marginals(graph, end)
    poses = [end.atPose2(i) for i in range(len(begin))]
    xyyaw = np.array([[p.x(), p.y(), p.theta()] for p in poses])
    spread = [turned(marginals.marginalCovariance(i), -p.theta()) for i, p in enumerate(poses)]
    return xyyaw, np.array(spread), 2.0 * graph.error(end)


@pytest.mark.parametrize("seed", range(4))
def test_same_solution_as_gtsam(seed):
    start, motions, claims = problem(seed)
    network, ones = Network(start, motions, claims), np.ones(len(claims))
    path = network.solve(ones, network.dead_reckoned)
    xyyaw, spread, cost = by_gtsam(start, motions, claims, network.dead_reckoned)
    off = path.xyyaw - xyyaw
    off[:, 2] = np.arctan2(np.sin(off[:, 2]), np.cos(off[:, 2]))
    # GTSAM takes places by their logarithm too; the difference is within a hundredth of a sigma.
    assert np.abs(off / np.sqrt(np.diagonal(spread, axis1=1, axis2=2))).max() < 0.02
    assert path.chi_square == pytest.approx(cost, rel=0.01)
    joint = network.path_covariance(ones, path.xyyaw)
    blocks = np.array([joint[i : i + 3, i : i + 3] for i in range(0, len(joint), 3)])
    scale = np.sqrt(np.einsum("ni,nj->nij", *[np.diagonal(spread, axis1=1, axis2=2)] * 2))
    assert np.abs((blocks - spread) / scale).max() < 0.05
    np.testing.assert_allclose(joint, joint.T, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_derivatives(seed):
    start, motions, claims = problem(seed)
    network = Network(start, motions, claims)
    xyyaw = network.dead_reckoned
    _, jacobian = network.terms(xyyaw)
    for c, claim in enumerate(claims):
        for at, station in ((0, claim.station), (3, claim.base)):
            if station is None:
                continue
            for k in range(3):
                step = np.zeros_like(xyyaw)
                step[station, k] = 1e-6
                slope = (network.terms(xyyaw + step)[0] - network.terms(xyyaw - step)[0])[c] / 2e-6
                np.testing.assert_allclose(jacobian[c, :, at + k], slope, atol=1e-5)


def test_left_out_is_what_a_network_without_it_says():
    start, motions, claims = problem(5)
    network = Network(start, motions, claims)
    everything = np.ones(len(claims))
    path = network.solve(everything, network.dead_reckoned)
    joint = network.path_covariance(everything, path.xyyaw)
    inside = network.distances(path.xyyaw, joint, np.arange(len(claims)))
    for c in range(len(claims)):
        others = np.where(np.arange(len(claims)) == c, 0.0, 1.0)
        rest = network.solve(others, path.xyyaw)
        spread = network.path_covariance(others, rest.xyyaw)
        outside = network.distances(rest.xyyaw, spread, np.full(len(claims), -1))
        assert inside[c] == pytest.approx(outside[c], rel=0.15, abs=0.05)


def test_a_loose_yaw_does_not_bend_the_place():
    start, motions, claims = problem(0)
    covariance = np.diag([1.0, 1.0, 1.0])
    covariance[0, 2] = covariance[2, 0] = 0.9
    loose = Claim(5, Planar(np.array([400.0, 100.0, 3.0]), covariance))
    other = Claim(5, Planar(np.array([400.0, 100.0, -1.0]), covariance))
    ends = []
    for claim in (loose, other):
        network = Network(start, motions, [*claims, claim])
        ends.append(network.solve(np.ones(len(claims) + 1), network.dead_reckoned).xyyaw)
    np.testing.assert_allclose(*ends, atol=1e-3)
