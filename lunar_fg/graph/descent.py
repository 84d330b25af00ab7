"""Levenberg-Marquardt to rest: by Cholesky, and by QR where the 4096 rule stops that."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from frontends.errors import EstimationError
from frontends.measurements import FloatArray

# GTSAM's default, 1e-5, stops early on long traverses.
_RELATIVE_TOLERANCE = 1e-9
_ABSOLUTE_TOLERANCE = 1e-7
#: m, and of the rotation matrix.
_STILL = 1e-5


@dataclass(frozen=True, slots=True)
class Descent:
    """Where the optimiser came to rest, and why there."""

    values: gtsam.Values
    iterations: int
    cost_before: float
    cost_after: float
    converged: bool
    reason: str


def descend(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, most: int) -> Descent:
    """Minimise `graph` from `values` in at most `most` iterations.

    Raises
    ------
    EstimationError
        Neither solver can solve it.
    """
    failures = []
    for solver in ("MULTIFRONTAL_CHOLESKY", "MULTIFRONTAL_QR"):
        params = gtsam.LevenbergMarquardtParams()
        params.setLinearSolverType(solver)
        try:
            before = float(graph.error(values))
            optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
            reason, converged = _iterate(optimizer, before, most)
        except RuntimeError as error:
            failures.append(" ".join(str(error).split("\n")[:3]).strip())
            continue
        after = float(optimizer.error())
        if np.isfinite(after):
            iterations = int(optimizer.iterations())
            return Descent(optimizer.values(), iterations, before, after, converged, reason)
        failures.append("the cost is not finite")
    raise EstimationError(f"the whole graph could not be solved ({'; '.join(failures)})")


def _iterate(
    optimizer: gtsam.LevenbergMarquardtOptimizer, cost: float, most: int
) -> tuple[str, bool]:
    """Iterate to rest; GTSAM's own test of the cost waits for landmarks that are outliers."""
    poses = _poses(optimizer.values())
    for _ in range(most):
        optimizer.iterate()
        new_cost, new_poses = float(optimizer.error()), _poses(optimizer.values())
        if cost - new_cost <= _ABSOLUTE_TOLERANCE + _RELATIVE_TOLERANCE * abs(cost):
            return "the cost no longer falls", True
        if np.abs(new_poses - poses).max() < _STILL:
            return f"no pose moves by more than {_STILL:g}", True
        cost, poses = new_cost, new_poses
    return f"stopped after {most} iterations", False


def _poses(values: gtsam.Values) -> FloatArray:
    poses = gtsam.utilities.allPose3s(values)
    return np.stack([np.asarray(poses.atPose3(key).matrix()) for key in poses.keys()])  # noqa: SIM118
