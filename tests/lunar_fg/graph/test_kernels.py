"""Compiled pieces against their plain definitions."""

import numpy as np
import pytest

from frontends.geometry import inverse, se3_exp, se3_log
from lunar_fg.graph import kernels
from lunar_fg.graph.kernels import motions


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
