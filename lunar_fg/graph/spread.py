"""How keyframes within a segment follow the segment's ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frontends.geometry import adjoint, inverse, se3_exp, se3_log
from frontends.measurements import FloatArray
from lunar_fg.graph.segment import SegmentSolution


@dataclass(frozen=True, slots=True)
class Spread:
    """How a keyframe within a segment follows the segment's ends.

    The segment's joint Gaussian is conditioned on its last pose: what pulls at the ends is
    spread over the segment.

    Attributes
    ----------
    local, last
        (4, 4) of the keyframe and of the segment's end, in the segment's first keyframe.
    gain
        (6, 6) share of the end's displacement.
    rest
        (6, 6) covariance that is left when the ends are known, rover axes.
    """

    local: FloatArray
    last: FloatArray
    gain: FloatArray
    rest: FloatArray

    def pose(self, map_T_first: FloatArray, map_T_last: FloatArray) -> FloatArray:
        """(4, 4) of the keyframe."""
        pull = se3_log(inverse(self.last) @ inverse(map_T_first) @ map_T_last)
        return np.asarray(map_T_first @ self.local @ se3_exp(self.gain @ pull))

    def by_ends(self) -> FloatArray:
        """Derivative of the keyframe's pose by the two ends, (6, 12), each in its own axes."""
        by_first = adjoint(inverse(self.local)) - self.gain @ adjoint(inverse(self.last))
        return np.hstack([by_first, self.gain])


def spread(solution: SegmentSolution, position: int) -> Spread:
    """How the keyframe at a position strictly inside a segment follows its ends."""
    rows = slice(6 * (position - 1), 6 * position)
    cross = solution.covariance[-6:, rows]
    gain = np.asarray(np.linalg.solve(solution.last_covariance, cross).T, dtype=np.float64)
    rest = solution.covariance[rows, rows] - gain @ cross
    return Spread(
        solution.first_T_rover[position], solution.first_T_last, gain, 0.5 * (rest + rest.T)
    )


def interior(
    solution: SegmentSolution,
    map_T_first: FloatArray,
    map_T_last: FloatArray,
    joint: FloatArray,
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Poses between a segment's ends, given what the whole graph says about the ends.

    The segment's joint Gaussian is conditioned on its last pose, so that what fixes or
    tilts pulled at the ends is spread over the segment, and covariances shrink with it.

    Parameters
    ----------
    solution
        The segment.
    map_T_first, map_T_last, joint
        Smoothed ends and their joint covariance (12, 12).

    Returns
    -------
    tuple of list of FloatArray
        Poses (4, 4) and covariances (6, 6) of the keyframes strictly between the ends.
    """
    poses, covariances = [], []
    for i in range(1, len(solution.first_T_rover) - 1):
        inner = spread(solution, i)
        by_ends = inner.by_ends()
        poses.append(inner.pose(map_T_first, map_T_last))
        total = by_ends @ joint @ by_ends.T + inner.rest
        covariances.append(0.5 * (total + total.T))
    return poses, covariances
