"""Which pose of an estimate belongs to which pose of the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frontends.errors import InputError, LunarFgError
from lunar_fg.trajectory import PositionTrack, Trajectory, Truth, travelled_m

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Stamps further apart than this are different moments (the default of `evo` too).
TOLERANCE_S = 0.01


class UndefinedMetricError(LunarFgError, ValueError):
    """A figure is not defined for this estimate and truth; the text says why."""


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """An estimate and the truth of the same moments, row by row.

    Attributes
    ----------
    estimate, truth
        Equally long; row i of one belongs to row i of the other.
    estimate_poses
        How many poses the estimate had before those without truth were left out.
    """

    estimate: Trajectory
    truth: Truth
    estimate_poses: int

    def __len__(self) -> int:
        """Count the pairs."""
        return len(self.estimate)

    @property
    def true_poses(self) -> FloatArray:
        """(N, 4, 4) of the truth.

        Raises
        ------
        UndefinedMetricError
            When the truth holds positions only.
        """
        if isinstance(self.truth, PositionTrack):
            raise UndefinedMetricError("the truth has positions only, no orientation")
        return self.truth.map_T_rover

    def travelled_m(self) -> FloatArray:
        """Distance along the true path up to each pose, (N,)."""
        return travelled_m(self.truth.positions)


def associate(estimate: Trajectory, truth: Truth, tolerance_s: float = TOLERANCE_S) -> Pair:
    """Pair up by stamp, or by row where one of the two has no stamps.

    Each pose of the shorter one takes the nearest in time of the longer one, if that is
    within `tolerance_s`; nothing is used twice and nothing is interpolated.

    Raises
    ------
    InputError
        When nothing fits, or rows without stamps differ in number.
    """
    if not len(estimate) or not len(truth):
        which = "truth" if len(estimate) else "estimate"
        raise InputError("holds no pose", source=which, remedy="give a non-empty trajectory")
    if estimate.indexed or truth.indexed:
        if len(estimate) != len(truth):
            raise InputError(
                f"{len(estimate)} estimated poses, {len(truth)} true ones, and no stamps to "
                "tell which belong together",
                source="evaluation",
                remedy="give both as TUM, or files of the same length",
            )
        return Pair(estimate, truth, len(estimate))
    if len(estimate) <= len(truth):
        i, j = _nearest(estimate.stamp_s, truth.stamp_s, tolerance_s)
    else:
        j, i = _nearest(truth.stamp_s, estimate.stamp_s, tolerance_s)
    if not len(i):
        raise InputError(
            f"no stamps agree within {tolerance_s:g} s: estimate {_span(estimate)}, "
            f"truth {_span(truth)}",
            source="evaluation",
            remedy="check units and time origin of both files, or widen the tolerance",
        )
    return Pair(estimate.select(i), truth.select(j), len(estimate))


def _nearest(few: FloatArray, many: FloatArray, tolerance_s: float) -> tuple[IntArray, IntArray]:
    """Rows of both, ascending, of the pairs within the tolerance, each row once."""
    right = np.clip(np.searchsorted(many, few), 1, max(len(many) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(many) - 1)
    nearest = np.where(np.abs(many[right] - few) < np.abs(few - many[left]), right, left)
    gap = np.abs(many[nearest] - few)
    rows = np.flatnonzero(gap <= tolerance_s)
    closest_first = rows[np.argsort(gap[rows], kind="stable")]
    _, first_use = np.unique(nearest[closest_first], return_index=True)
    rows = np.sort(closest_first[first_use])
    return rows.astype(np.int64), nearest[rows].astype(np.int64)


def _span(track: Truth) -> str:
    return f"{track.stamp_s[0]:.6g} to {track.stamp_s[-1]:.6g} s"
