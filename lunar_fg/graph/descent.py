"""Levenberg-Marquardt to rest: by Cholesky, and by QR where the 4096 rule stops that."""

from __future__ import annotations

import re
from collections.abc import Callable
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
_MOST_DESCENTS = 4


@dataclass(frozen=True, slots=True)
class Descent:
    """Where the optimiser came to rest, and why there.

    Attributes
    ----------
    graph, values
        What was optimised, without the landmarks that were set aside.
    iterations, cost_before, cost_after, converged, reason
        Of the last descent.
    set_aside
        Keys of landmarks that had no place in front of the cameras.
    """

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    iterations: int
    cost_before: float
    cost_after: float
    converged: bool
    reason: str
    set_aside: set[int]


def descend(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    most: int,
    unsound: Callable[[gtsam.Values], set[int]] | None = None,
) -> Descent:
    """Minimise `graph` from `values` in at most `most` iterations.

    Parameters
    ----------
    graph, values, most
        As said.
    unsound
        Names landmarks that make the system with these values indeterminate; they are set
        aside before and after the descent.

    Raises
    ------
    EstimationError
        Neither solver can solve it.
    """
    find = unsound or (lambda _: set())
    aside = find(values)
    for _ in range(_MOST_DESCENTS):
        if aside:
            graph, values = without(graph, aside), values_without(values, aside)
        end = _descend(graph, values, most, aside)
        more = find(end.values)
        if not more:
            return end
        aside = aside | more
        values = end.values
    graph, values = without(graph, aside), values_without(values, aside)
    return _descend(graph, values, most, aside)


def _descend(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, most: int, aside: set[int]
) -> Descent:
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
            return Descent(
                graph,
                optimizer.values(),
                int(optimizer.iterations()),
                before,
                after,
                converged,
                reason,
                aside,
            )
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


def without(graph: gtsam.NonlinearFactorGraph, landmarks: set[int]) -> gtsam.NonlinearFactorGraph:
    """Copy a graph without the factors of these landmarks, and without empty slots."""
    result = gtsam.NonlinearFactorGraph()
    for i in range(graph.size()):
        if graph.exists(i) and landmarks.isdisjoint(graph.at(i).keys()):
            result.push_back(graph.at(i))
    return result


def values_without(values: gtsam.Values, landmarks: set[int]) -> gtsam.Values:
    """Copy values without these landmarks."""
    result = gtsam.Values(values)
    for key in landmarks:
        if result.exists(key):
            result.erase(key)
    return result


def named_landmark(error: Exception) -> set[int]:
    """Landmark that GTSAM's message blames, if any."""
    found = re.search(r"variable\s+(\d+)\s+\(Symbol: l\d+\)", str(error))
    return {int(found[1])} if found else set()
