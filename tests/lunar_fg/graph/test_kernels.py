"""Compiled pieces against their plain definitions."""

import numpy as np
import pytest

from frontends.geometry import inverse, se3_exp, se3_log
from lunar_fg.graph import kernels
from lunar_fg.graph.kernels import motions
from lunar_fg.graph.planar import Planar, carried, mahalanobis_squared, updated


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 1e-2, 1.0, 3.0, np.pi - 1e-9])
def test_logarithm(angle):
    rng = np.random.default_rng(3)
    xi = rng.normal(size=6)
    xi[:3] *= angle / np.linalg.norm(xi[:3])
    result = np.empty(6)
    motions._log(se3_exp(xi), result)
    np.testing.assert_allclose(se3_exp(result), se3_exp(xi), atol=1e-6)


def test_motions_cost_and_gradient():
    rng = np.random.default_rng(0)
    poses = np.stack([se3_exp(0.3 * rng.normal(size=6)) for _ in range(3)])
    measured = inverse(poses[0]) @ poses[2] @ se3_exp(0.003 * rng.normal(size=6))
    root = np.tril(rng.normal(size=(6, 6))) + 3.0 * np.eye(6)
    hessian, gradient = np.zeros((18, 18)), np.zeros(18)
    cost = kernels.add_motions(
        poses, np.array([0]), np.array([2]), inverse(measured)[None], root[None], hessian, gradient
    )

    def expected(x):
        first, last = poses[0] @ se3_exp(x[:6]), poses[2] @ se3_exp(x[12:])
        error = root @ se3_log(inverse(measured) @ inverse(first) @ last)
        return 0.5 * error @ error

    slope = [(expected(d) - expected(-d)) / 2e-6 for d in 1e-6 * np.eye(18)]
    assert cost == pytest.approx(expected(np.zeros(18)))
    np.testing.assert_allclose(gradient, slope, atol=1e-4 * np.abs(slope).max())
    np.testing.assert_allclose(hessian, hessian.T)
    assert np.linalg.matrix_rank(hessian, tol=1e-9) == 6
    assert not hessian[6:12].any()


def test_the_forward_gate_is_the_filter_step_by_step():
    rng = np.random.default_rng(1)
    roots = [np.tril(rng.normal(size=(3, 3))) + 2.0 * np.eye(3) for _ in range(9)]
    scale = np.diag([1.0, 2.0, 0.03])
    noise = np.array([scale @ root @ root.T @ scale for root in roots])
    value = rng.normal(size=(9, 3)) * [1.0, 1.0, 0.1]
    value[1:3, 0] += 30.0
    value[3:, 0] += [30.0, 31.0, 60.0, 300.0, 61.0, 59.0]
    here = Planar(value[0], noise[0])
    expected = []
    # Two stations; groups of two, three and one claims, the last one forced.
    for station, rows, forced in ((1, (3, 4), False), (2, (5, 6, 7), False), (2, (8,), True)):
        if station > len(expected):
            here = carried(here, Planar(value[station], noise[station]))
        places = [Planar(value[row], noise[row]) for row in rows]
        distance = [mahalanobis_squared(place, here) for place in places]
        expected.append(0 if forced else int(np.argmin(distance)))
        assert forced or min(distance) < 16.0
        here = updated(here, places[expected[-1]])
    arguments = np.array([0, 1, 2]), np.array([0, 2, 5, 6]), np.array([1, 2, 2])
    found = kernels.gated(value, noise, 2, *arguments, np.array([-2, -2, 0]), 16.0)
    assert found.tolist() == expected
    found = kernels.gated(value, noise, 2, *arguments, np.array([-1, 1, -2]), 1e-9)
    assert found.tolist() == [-1, 1, -1]


def test_squared_lengths_are_those_of_numpy():
    rng = np.random.default_rng(4)
    root = rng.normal(size=(50, 3, 3)) * [1e-3, 10.0, 1e3]
    covariance = root.transpose(0, 2, 1) @ root + np.diag([1e-8, 1e-2, 1.0])
    off = rng.normal(size=(50, 3)) * [1e-3, 10.0, 1e3]
    expected = [x @ np.linalg.solve(c, x) for x, c in zip(off, covariance, strict=True)]
    np.testing.assert_allclose(kernels.squared_lengths(off, covariance), expected, rtol=1e-6)
