"""Simulated chains with honest covariances, for the tests of the evaluation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from frontends.geometry import adjoint, inverse, se3_exp, se3_log
from lunar_fg.trajectory import Trajectory

Simulate = Callable[..., tuple[Trajectory, Trajectory]]


def _simulate(
    rng: np.random.Generator,
    poses: int = 40,
    *,
    start_sigma: float = 1e-6,
    fix_every: int | None = None,
    covariance_scale: float = 1.0,
) -> tuple[Trajectory, Trajectory]:
    """Dead reckoning along an arc, with an absolute pose now and then; estimate, truth."""
    sigma = np.repeat([2e-3, 1e-2], 3)
    step = se3_exp([0.0, 0.0, 0.03, 0.3, 0.0, 0.0])
    truth = [np.eye(4)]
    estimate = [se3_exp(rng.normal(size=6) * start_sigma)]
    covariance = [np.eye(6) * start_sigma**2]
    for i in range(1, poses):
        truth.append(truth[-1] @ step)
        motion = step @ se3_exp(rng.normal(size=6) * sigma)
        carry = adjoint(inverse(motion))
        pose, spread = estimate[-1] @ motion, carry @ covariance[-1] @ carry.T + np.diag(sigma**2)
        if fix_every and i % fix_every == 0:
            noise = np.diag(np.repeat([0.01, 0.05], 3) ** 2)
            gain = spread @ np.linalg.inv(spread + noise)
            measured = se3_log(inverse(pose) @ truth[-1]) + rng.multivariate_normal(
                np.zeros(6), noise
            )
            pose, spread = pose @ se3_exp(gain @ measured), (np.eye(6) - gain) @ spread
        estimate.append(pose)
        covariance.append((spread + spread.T) / 2)
    stamps = np.arange(poses) * 0.1
    return (
        Trajectory(stamps, np.array(estimate), np.array(covariance) * covariance_scale),
        Trajectory(stamps, np.array(truth)),
    )


@pytest.fixture(scope="session")
def simulate() -> Simulate:
    return _simulate
