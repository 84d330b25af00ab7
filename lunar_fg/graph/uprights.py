"""Tilts measured within a segment, brought together at the keyframes that end it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from frontends.geometry import adjoint, inverse
from frontends.measurements import FloatArray, Tilt
from lunar_fg.graph.factors import up_in_rover
from lunar_fg.graph.segment import SegmentSolution


def uprights(
    solution: SegmentSolution, tilts: Mapping[int, Tilt]
) -> tuple[tuple[FloatArray, float] | None, tuple[FloatArray, float] | None]:
    """Bring each tilt between the ends to the nearer end, through the segment's rotations.

    Parameters
    ----------
    solution
        The closed segment.
    tilts
        By position in the segment; those of the ends are not looked at.

    Returns
    -------
    tuple
        For the first and the last keyframe: the vertical in rover axes (3,) and its sigma
        (rad), or None where there is none.
    """
    last = len(solution.first_T_rover) - 1
    inner = [i for i in tilts if 0 < i < last]
    return (
        _joined(solution, tilts, [i for i in inner if 2 * i <= last], 0),
        _joined(solution, tilts, [i for i in inner if 2 * i > last], last),
    )


def _joined(
    solution: SegmentSolution, tilts: Mapping[int, Tilt], members: list[int], end: int
) -> tuple[FloatArray, float] | None:
    if not members:
        return None
    weights = np.array([tilts[i].sigma_rad ** -2 for i in members])
    total, carried = np.zeros(3), 0.0
    for i, weight in zip(members, weights, strict=True):
        end_T_i = inverse(solution.first_T_rover[end]) @ solution.first_T_rover[i]
        total += weight * end_T_i[:3, :3] @ up_in_rover(tilts[i])
        carried += weight * np.sqrt(_rotation_variance(solution, end, i))
    # Readings are independent of each other; the rotations they are carried by are not.
    variance = 1.0 / weights.sum() + (carried / weights.sum()) ** 2
    return total / np.linalg.norm(total), float(np.sqrt(variance))


def _rotation_variance(solution: SegmentSolution, end: int, i: int) -> float:
    """Largest variance of the rotation between a pose and an end of the segment, rad^2."""
    rows = slice(6 * (i - 1), 6 * i)
    own = solution.covariance[rows, rows]
    if end:
        carry = adjoint(inverse(solution.first_T_last) @ solution.first_T_rover[i])
        cross = carry @ solution.covariance[rows, -6:]
        own = solution.last_covariance + carry @ own @ carry.T - cross - cross.T
    return float(np.linalg.eigvalsh(own[:3, :3])[-1].clip(min=0.0))
