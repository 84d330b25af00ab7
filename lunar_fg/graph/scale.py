"""A calibration that is wrong in scale: considered in every covariance, not estimated.

A baseline that is off by a share makes every motion longer by that share, in the same direction
for good: the error grows with the distance from where the rover was last fixed, and no image
contradicts it. As a consider parameter (Schmidt 1966) it leaves the estimate alone and adds
``sigma^2 J J^T``, with J the derivative of a position by the scale: the way from there. With
fixes J is exact where these are known better than the way between them; where they are not, it is
too small, and the fixes share the error out among themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frontends.measurements import AbsoluteFix, FloatArray, IntArray, Verdict
from lunar_fg.graph.ledger import LedgerEntry


@dataclass(frozen=True, slots=True)
class Anchors:
    """Where the way was fixed: from there on the error of the scale grows anew.

    Attributes
    ----------
    frame
        (M,) indices of the keyframes, increasing.
    position
        (M, 3) m, map; the height is NaN where a fix says nothing about it.
    """

    frame: IntArray
    position: FloatArray

    @classmethod
    def of(cls, first: int, start: FloatArray, ledger: Sequence[LedgerEntry]) -> Anchors:
        """The start, at keyframe `first`, and all fixes that are believed."""
        rows = {first: (start[0, 3], start[1, 3], start[2, 3])}
        for entry in ledger:
            fix, ruling = entry.measurement, entry.ruling
            if not isinstance(fix, AbsoluteFix) or ruling.verdict is not Verdict.ACCEPTED:
                continue
            assert ruling.candidate is not None
            place = fix.candidates[ruling.candidate]
            rows[fix.frame] = (place.x_m, place.y_m, np.nan)
        frames = sorted(rows)
        return cls(np.array(frames, dtype=np.int64), np.array([rows[frame] for frame in frames]))

    def considered(
        self, frame: IntArray, poses: FloatArray, covariances: FloatArray, sigma: float
    ) -> FloatArray:
        """Covariances with the scale's share, (N, 6, 6).

        Parameters
        ----------
        frame
            (N,) indices of the keyframes; each takes the anchor that is nearest by index.
        poses, covariances
            (N, 4, 4) and (N, 6, 6), rotation then translation, rover axes.
        sigma
            1-sigma of the scale.
        """
        after = np.searchsorted(self.frame, frame).clip(0, len(self.frame) - 1)
        before = np.maximum(after - 1, 0)
        nearer = np.abs(self.frame[after] - frame) <= np.abs(frame - self.frame[before])
        way = poses[:, :3, 3] - self.position[np.where(nearer, after, before)]
        in_rover = np.einsum("nji,nj->ni", poses[:, :3, :3], np.nan_to_num(way))
        considered = covariances.copy()
        considered[:, 3:, 3:] += sigma**2 * in_rover[:, :, None] * in_rover[:, None, :]
        return considered
