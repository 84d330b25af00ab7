"""Offline: Levenberg-Marquardt on a pose graph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import gtsam
import numpy as np

from frontends.errors import EstimationError, InputError
from frontends.measurements import FloatArray
from lunar_fg.graph.checks import check_covariance, check_pose
from lunar_fg.graph.descent import Descent, descend
from lunar_fg.graph.factors import between_factor, pose_key

_MOST_ITERATIONS = 500
_HELD_SIGMA = 1e-6


class Edge(Protocol):
    """A measured motion between the vertices `a` and `b`."""

    @property
    def a(self) -> int:
        """Id of the first vertex."""
        ...

    @property
    def b(self) -> int:
        """Id of the second vertex."""
        ...

    @property
    def a_T_b(self) -> FloatArray:
        """(4, 4)."""
        ...

    @property
    def covariance(self) -> FloatArray:
        """(6, 6), rotation then translation, axes of `b`."""
        ...


def optimize_poses(
    ids: Sequence[int], map_T_body: FloatArray, edges: Sequence[Edge], fixed: Sequence[int] = ()
) -> tuple[FloatArray, Descent]:
    """Optimise poses between which motions were measured.

    Parameters
    ----------
    ids, map_T_body
        Vertex ids, each once, and initial poses (N, 4, 4).
    edges
        Measured motions.
    fixed
        Vertices that stay; the first one where none is named.

    Returns
    -------
    tuple of FloatArray and Descent
        Poses (N, 4, 4) in the order of `ids`, and how the optimiser came to rest.

    Raises
    ------
    InputError
        An unknown or repeated id, a bad pose or covariance, or vertices that no chain of
        edges connects with a fixed one.
    EstimationError
        The graph cannot be solved.
    """
    key = {vertex: pose_key(row) for row, vertex in enumerate(ids)}
    if len(key) != len(ids):
        raise InputError("holds an id twice", source="pose graph", field="ids")
    if not ids:
        raise InputError("is empty", source="pose graph")
    held = tuple(fixed) or (ids[0],)
    _check_connected(ids, edges, held)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for vertex, transform in zip(ids, map_T_body, strict=True):
        check_pose(transform, f"vertex {vertex}", "pose")
        values.insert(key[vertex], gtsam.Pose3(transform))
    for edge in edges:
        source = f"edge {edge.a} {edge.b}"
        check_covariance(edge.covariance, 6, source, "covariance")
        graph.add(between_factor(key[edge.a], key[edge.b], edge.a_T_b, edge.covariance, source))
    noise = gtsam.noiseModel.Isotropic.Sigma(6, _HELD_SIGMA)
    for vertex in held:
        graph.add(gtsam.PriorFactorPose3(key[vertex], values.atPose3(key[vertex]), noise))
    end = descend(graph, values, _MOST_ITERATIONS)
    poses = np.stack([np.asarray(end.values.atPose3(key[vertex]).matrix()) for vertex in ids])
    if not np.isfinite(poses).all():
        raise EstimationError("the pose graph has no finite solution")
    return poses, end


def _check_connected(ids: Sequence[int], edges: Sequence[Edge], held: Sequence[int]) -> None:
    near: dict[int, list[int]] = {vertex: [] for vertex in ids}
    for a, b in [(edge.a, edge.b) for edge in edges] + [(vertex, vertex) for vertex in held]:
        for vertex in (a, b):
            if vertex not in near:
                raise InputError(f"vertex {vertex} does not exist", source="pose graph")
        near[a].append(b)
        near[b].append(a)
    reached, waiting = set(held), list(held)
    while waiting:
        for vertex in near[waiting.pop()]:
            if vertex not in reached:
                reached.add(vertex)
                waiting.append(vertex)
    loose = [vertex for vertex in ids if vertex not in reached]
    if loose:
        raise InputError(
            f"{len(loose)} vertices are not connected with a fixed one, the first is {loose[0]}",
            source="pose graph",
            remedy="add an edge, or fix one vertex of each part",
        )
