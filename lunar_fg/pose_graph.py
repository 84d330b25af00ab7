"""A pose graph as data, and its g2o file.

Vertices ``VERTEX_SE3:QUAT id x y z qx qy qz qw``, edges ``EDGE_SE3:QUAT i j x y z qx qy qz qw``
and the upper triangle of the information matrix, translation before rotation. The rotation's
information is that of the rotation vector in radians, as GTSAM and Ceres take it (g2o itself
counts half angles).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from frontends.errors import InputError
from frontends.geometry import pose
from lunar_fg.datasets.tables import parse_number, read_text

FloatArray = NDArray[np.float64]

_VERTEX, _EDGE, _FIX = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", "FIX"
_CELLS = {_VERTEX: 8, _EDGE: 30, _FIX: 1}
_UPPER = np.triu_indices(6)
#: From the file's order, translation then rotation, to ours.
_SWAP = [3, 4, 5, 0, 1, 2]
_QUATERNION_TOLERANCE = 1e-2


@dataclass(frozen=True, slots=True, eq=False)
class PoseEdge:
    """A measured motion: ``a_T_b`` (4, 4), covariance (6, 6) rotation then translation, axes of b.

    `a` and `b` are vertex ids.
    """

    a: int
    b: int
    a_T_b: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraph:
    """Poses and the motions measured between them.

    Attributes
    ----------
    ids
        Vertex ids, each once.
    map_T_body
        (N, 4, 4), initial or solved.
    edges
        Measured motions.
    fixed
        Ids of vertices that stay where they are; the first one where empty.
    """

    ids: tuple[int, ...]
    map_T_body: FloatArray
    edges: tuple[PoseEdge, ...]
    fixed: tuple[int, ...] = ()


def g2o_text(graph: PoseGraph) -> str:
    """Whole g2o file of a pose graph."""
    lines = [
        f"{_VERTEX} {i} {_numbers(transform)}"
        for i, transform in zip(graph.ids, graph.map_T_body, strict=True)
    ]
    lines += [f"{_FIX} {i}" for i in graph.fixed]
    for edge in graph.edges:
        information = np.linalg.inv(edge.covariance)[np.ix_(_SWAP, _SWAP)]
        upper = " ".join(repr(float(value)) for value in information[_UPPER])
        lines.append(f"{_EDGE} {edge.a} {edge.b} {_numbers(edge.a_T_b)} {upper}")
    return "\n".join([*lines, ""])


def read_g2o(path: Path) -> PoseGraph:
    """Read a g2o file of 3-D poses.

    Raises
    ------
    InputError
        Names the line: an unknown entry, a number missing or wrong, a vertex twice or
        unknown, an information matrix that is not positive definite.
    """
    poses: dict[int, FloatArray] = {}
    edges: list[PoseEdge] = []
    lines: list[int] = []
    fixed: list[int] = []
    for line, text in enumerate(read_text(path).splitlines(), start=1):
        cells = text.split("#", maxsplit=1)[0].split()
        if not cells:
            continue
        kind, values = cells[0], cells[1:]
        where = f"line {line}"
        if kind not in _CELLS:
            raise InputError(
                f"{kind[:40]!r} is not known", source=path, field=where,
                remedy=f"known: {', '.join(_CELLS)}",
            )  # fmt: skip
        if len(values) != _CELLS[kind]:
            raise InputError(
                f"{kind} has {len(values)} values, must have {_CELLS[kind]}", source=path,
                field=where, remedy="the file may be cut off",
            )  # fmt: skip
        numbers = [parse_number(value, path, line, kind) for value in values]
        if kind == _FIX:
            fixed.append(int(numbers[0]))
        elif kind == _VERTEX:
            if int(numbers[0]) in poses:
                raise InputError(f"vertex {values[0]} is there twice", source=path, field=where)
            poses[int(numbers[0])] = _transform(numbers[1:], path, where)
        else:
            edges.append(_edge(numbers, path, where))
            lines.append(line)
    if not poses:
        raise InputError("holds no vertex", source=path, remedy=f"give lines of {_VERTEX}")
    for ends, where in [
        *(((edge.a, edge.b), f"line {line}") for edge, line in zip(edges, lines, strict=True)),
        (tuple(fixed), _FIX),
    ]:
        for end in ends:
            if end not in poses:
                raise InputError(f"vertex {end} does not exist", source=path, field=where)
    return PoseGraph(tuple(poses), np.stack(list(poses.values())), tuple(edges), tuple(fixed))


def _edge(numbers: list[float], path: Path, where: str) -> PoseEdge:
    a, b = int(numbers[0]), int(numbers[1])
    if a == b:
        raise InputError(f"leads from {a} to itself", source=path, field=where)
    information = np.zeros((6, 6))
    information[_UPPER] = numbers[9:]
    information = (information + np.triu(information, 1).T)[np.ix_(_SWAP, _SWAP)]
    if np.linalg.eigvalsh(information)[0] <= 0.0:
        raise InputError(
            "its information matrix is not positive definite", source=path, field=where,
            remedy="the upper triangle goes row by row, x y z then the rotation",
        )  # fmt: skip
    covariance = np.linalg.inv(information)
    motion = _transform(numbers[2:9], path, where)
    return PoseEdge(a, b, motion, 0.5 * (covariance + covariance.T))


def _transform(values: list[float], path: Path, where: str) -> FloatArray:
    norm = float(np.linalg.norm(values[3:]))
    if abs(norm - 1.0) > _QUATERNION_TOLERANCE:
        raise InputError(f"quaternion has norm {norm:.3g}, must be 1", source=path, field=where)
    return pose(Rotation.from_quat(values[3:]).as_matrix(), values[:3])


def _numbers(transform: FloatArray) -> str:
    quaternion = Rotation.from_matrix(transform[:3, :3]).as_quat(canonical=True)
    return " ".join(repr(float(value)) for value in (*transform[:3, 3], *quaternion))
