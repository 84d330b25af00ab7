"""Tilts measured within a segment, brought together at the keyframes that end it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

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
    ups = np.array([up_in_rover(tilts[i]) for i in members])
    turns = solution.first_T_rover[end, :3, :3].T @ solution.first_T_rover[members, :3, :3]
    total = weights @ np.einsum("kij,kj->ki", turns, ups)
    variance = _rotation_variances(solution, end, members, turns)
    # Readings are independent of each other; the rotations they are carried by are not.
    carried = float(weights @ np.sqrt(variance) / weights.sum())
    return total / np.linalg.norm(total), float(np.sqrt(1.0 / weights.sum() + carried**2))


def _rotation_variances(
    solution: SegmentSolution, end: int, members: list[int], turns: FloatArray
) -> FloatArray:
    """Largest variance of the rotation between each pose and an end of the segment, rad^2."""
    size = len(solution.covariance)
    of_poses = solution.covariance.reshape(size // 6, 6, size // 6, 6)[:, :3, :, :3]
    at = np.array(members) - 1
    own = of_poses[at, :, at]
    if end:
        own = turns @ own @ turns.transpose(0, 2, 1)
        cross = turns @ of_poses[at, :, -1]
        own = solution.last_covariance[:3, :3] + own - cross - cross.transpose(0, 2, 1)
    return np.asarray(np.linalg.eigvalsh(own)[:, -1].clip(min=0.0))
