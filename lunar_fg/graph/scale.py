"""A calibration that is wrong in scale: considered in every covariance, not estimated.

A baseline that is off by a share makes every motion longer by that share, for good: the error
grows with the way, and no image contradicts it. As a consider parameter (Schmidt 1966) it leaves
the estimate alone and adds ``sigma^2 J J^T``, with J the derivative of a position by the scale.
From the start on J is the way from there. Where the rover was fixed, it is what is left of it when
the path is stretched and laid on the fixes again: little where these are known better than the
way between them, more where they are not.

Fixes do show it, though: they say how long the way between them is. Where they contradict the
calibration, its sigma is not believed: it is taken as that of Student's t with three degrees of
freedom, the heaviest tail that has a variance, and sigma becomes the rms of what is left of the
scale's error once the fixes are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm, t

from frontends.measurements import AbsoluteFix, FloatArray, IntArray, Verdict
from lunar_fg.graph.ledger import LedgerEntry
from lunar_fg.graph.network import Claim, Network
from lunar_fg.graph.planar import Planar

#: Step of the derivatives.
_STRETCH = 5e-3
#: The least whole number with which Student's t has a variance.
_HEAVY_TAIL = 3


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


@dataclass(frozen=True, slots=True)
class FixedScale:
    """What the fixes of a path say of its scale, and what the scale does to the path.

    Attributes
    ----------
    excess, sigma
        Share by which the path is longer than the fixes have it, and its 1-sigma, from the
        fixes and the path alone; sigma is infinite where they say nothing.
    by_scale
        (n, 2) how the scale moves the path's stations, m a unit.
    """

    excess: float
    sigma: float
    by_scale: FloatArray

    def considered(self, scale_sigma: float) -> float:
        """1-sigma of the scale by the calibration, stated as `scale_sigma`, and the fixes."""
        if scale_sigma <= 0.0 or not np.isfinite(self.sigma):
            return scale_sigma
        reach = max(abs(self.excess) + 8.0 * self.sigma, 20.0 * scale_sigma)
        scale = np.linspace(-reach, reach, 4001)
        believed = t.pdf(scale, _HEAVY_TAIL, scale=scale_sigma / np.sqrt(_HEAVY_TAIL))
        believed *= norm.pdf(scale, self.excess, max(self.sigma, reach / 1000.0))
        if not believed.sum() > 0.0:
            return max(scale_sigma, abs(self.excess))
        rms = float(np.sqrt((believed * scale**2).sum() / believed.sum()))
        # fixes that agree with the calibration do not make it better than it says
        return max(scale_sigma, rms)

    def contradicts(self, scale_sigma: float, probability: float) -> bool:
        """Whether a calibration as good as stated would be off by less with this probability."""
        if not np.isfinite(self.sigma):
            return False
        return abs(self.excess) > float(norm.isf(0.5 * (1.0 - probability))) * float(
            np.hypot(scale_sigma, self.sigma)
        )


def fixed_scale(
    start: Planar, motions: Sequence[Planar], claims: Sequence[Claim], scale_sigma: float
) -> FixedScale:
    """Stretch a path that claims hold, and see how it moves and how well it fits.

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
    for stretch in (-_STRETCH, 0.0, _STRETCH):
        ways = []
        for motion in motions:
            xyyaw, covariance = motion.xyyaw.copy(), motion.covariance.copy()
            by_scale = scale_sigma * xyyaw[:2]
            covariance[:2, :2] -= np.outer(by_scale, by_scale)
            xyyaw[:2] *= 1.0 + stretch
            ways.append(replace(motion, xyyaw=xyyaw, covariance=covariance))
        network = Network(start, ways, claims)
        paths.append(network.solve(np.ones(len(claims)), network.dead_reckoned))
    shorter, same, longer = (path.chi_square for path in paths)
    curvature = (longer - 2.0 * same + shorter) / _STRETCH**2
    excess, sigma = 0.0, float("inf")
    if curvature > 0.0:
        excess = float((longer - shorter) / (2.0 * _STRETCH * curvature))
        sigma = float(np.sqrt(2.0 / curvature))
    moved = (paths[-1].xyyaw - paths[0].xyyaw)[:, :2] / (2.0 * _STRETCH)
    return FixedScale(excess, sigma, np.asarray(moved))
