"""A calibration that is wrong in scale: considered in every covariance, not estimated.

A baseline that is off by a share makes every motion longer by that share, for good: the error
grows with the way, and no image contradicts it. As a consider parameter (Schmidt 1966) it leaves
the estimate alone and adds ``sigma^2 J J^T``, with J the derivative of a position by the scale.
From the start on J is the way from there. Where the rover was fixed, it is what is left of it when
the path is stretched and laid on the fixes again: little where these are known better than the
way between them, more where they are not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from frontends.measurements import AbsoluteFix, FloatArray, IntArray, Verdict
from lunar_fg.graph.ledger import LedgerEntry
from lunar_fg.graph.network import Claim, Network
from lunar_fg.graph.planar import Planar

#: Step of the derivative.
_STRETCH = 1e-3


@dataclass(frozen=True, slots=True)
class Anchors:
    """Where the way was fixed: between them the error of the scale is spread out.

    Attributes
    ----------
    frame
        (M,) indices of the keyframes, increasing.
    position
        (M, 3) m, map; the height is NaN where a fix says nothing about it.
    by_scale
        (M, 2) how the scale moves them, m a unit, map axes.
    """

    frame: IntArray
    position: FloatArray
    by_scale: FloatArray

    @classmethod
    def of(
        cls,
        first: int,
        start: FloatArray,
        ledger: Sequence[LedgerEntry],
        by_scale: dict[int, FloatArray] | None = None,
    ) -> Anchors:
        """The start, at keyframe `first`, and all fixes that are believed.

        `by_scale` holds what is known of the attribute of that name, by frame; else it is 0.
        """
        rows = {first: (start[0, 3], start[1, 3], start[2, 3])}
        for entry in ledger:
            fix, ruling = entry.measurement, entry.ruling
            if not isinstance(fix, AbsoluteFix) or ruling.verdict is not Verdict.ACCEPTED:
                continue
            assert ruling.candidate is not None
            place = fix.candidates[ruling.candidate]
            rows[fix.frame] = (place.x_m, place.y_m, np.nan)
        frames, known = sorted(rows), by_scale or {}
        return cls(
            np.array(frames, dtype=np.int64),
            np.array([rows[frame] for frame in frames]),
            np.array([known.get(frame, np.zeros(2)) for frame in frames]),
        )

    def considered(
        self, frame: IntArray, poses: FloatArray, covariances: FloatArray, sigma: float
    ) -> FloatArray:
        """Covariances with the scale's share, (N, 6, 6).

        Parameters
        ----------
        frame
            (N,) indices of the keyframes.
        poses, covariances
            (N, 4, 4) and (N, 6, 6), rotation then translation, rover axes.
        sigma
            1-sigma of the scale.
        """
        if sigma == 0.0:
            return covariances
        count = len(self.frame)
        before = np.maximum(np.searchsorted(self.frame, frame, "right") - 1, 0)
        after = np.minimum(before + 1, count - 1)
        from_before = poses[:, :3, 3] - self.position[before]
        from_after = poses[:, :3, 3] - self.position[after]
        for way in (from_before, from_after):
            way[np.isnan(way)] = 0.0
        free = np.zeros((count, 3))
        free[:, :2] = self.by_scale
        a, b = (np.sqrt(np.einsum("ni,ni->n", way, way)) for way in (from_before, from_after))
        share = np.where(after > before, a / np.maximum(a + b, 1e-9), 0.0)[:, None]
        by_scale = (1.0 - share) * (free[before] + from_before)
        by_scale += share * (free[after] + from_after)
        in_rover = np.einsum("nji,nj->ni", poses[:, :3, :3], by_scale)
        considered = covariances.copy()
        considered[:, 3:, 3:] += sigma**2 * in_rover[:, :, None] * in_rover[:, None, :]
        return considered


def stretched(
    start: Planar, motions: Sequence[Planar], claims: Sequence[Claim], scale_sigma: float
) -> FloatArray:
    """How the scale moves the stations of a path that claims hold, (n, 2), m a unit.

    Parameters
    ----------
    start, motions, claims
        As for `Network`; the claims are those that are believed.
    scale_sigma
        What the motions' covariances hold of the scale already: the graph's do not.

    Raises
    ------
    EstimationError
        The path cannot be solved for.
    """
    paths = []
    for stretch in (0.0, _STRETCH):
        ways = []
        for motion in motions:
            xyyaw, covariance = motion.xyyaw.copy(), motion.covariance.copy()
            by_scale = scale_sigma * xyyaw[:2]
            covariance[:2, :2] -= np.outer(by_scale, by_scale)
            xyyaw[:2] *= 1.0 + stretch
            ways.append(replace(motion, xyyaw=xyyaw, covariance=covariance))
        network = Network(start, ways, claims)
        paths.append(network.solve(np.ones(len(claims)), network.dead_reckoned).xyyaw)
    return np.asarray((paths[1] - paths[0])[:, :2] / _STRETCH)
