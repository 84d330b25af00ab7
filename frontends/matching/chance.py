"""Could chance explain the inliers? An a-contrario test (Desolneux, Moisan & Morel 2008).

RANSAC always finds some model. Under the hypothesis that every match is wrong, each falls
within the threshold of a given model independently with a probability ``alpha``. Of all
models that minimal samples of ``s`` among ``n`` matches define, the expected number with
``k`` inliers or more is the number of false alarms (Moisan & Stival 2004, with the
threshold fixed)

    NFA = C(n, s) P(B(n - s, alpha) >= k - s).

Matches are independent only where they do not share pixels: a rock found at several scales
is one match, and so are neighbouring features whose descriptors mostly overlap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import gammaln
from scipy.stats import binom

FloatArray = NDArray[np.float64]

#: Models that may be accepted by mistake, expected for one pair of unrelated images.
FALSE_ALARMS = 1e-6
#: Half the side of the smallest region that a SURF descriptor covers (20 s at s = 1.2), px:
#: nearer features share most of their pixels.
SUPPORT_PX = 12.0
#: Radius in which the density of the matches is measured, as a share of their box.
_NEIGHBOURHOOD = 0.125


@dataclass(frozen=True, slots=True)
class Agreement:
    """How many independent matches agree with a model, and how many must.

    Attributes
    ----------
    inliers, matches
        Independent ones.
    needed
        Least number of inliers that chance does not explain; may exceed `matches`.
    given
        All matches.
    """

    inliers: int
    matches: int
    needed: int
    given: int

    @property
    def reason(self) -> str:
        """Why the model is refused; empty when it is not."""
        if self.inliers >= self.needed:
            return ""
        return (
            f"inliers at {self.inliers} separate places of {self.given} matches, "
            f"{self.needed} are needed"
        )


def agreement(
    first_xy: FloatArray,
    second_xy: FloatArray,
    inlier: NDArray[np.bool_],
    sample: int,
    alpha: float,
) -> Agreement:
    """Weigh the inliers of a model against chance.

    Parameters
    ----------
    first_xy, second_xy
        (M, 2) matched pixels.
    inlier
        (M,) which agree with the model.
    sample
        Matches that define a model.
    alpha
        Probability that a wrong match agrees with a given model: `point_chance` or
        `line_chance`.
    """
    order = np.argsort(~inlier, kind="stable")  # inliers first: they stand for their place
    kept = order[separate(first_xy[order], second_xy[order])]
    matches = len(kept)
    counts = np.arange(sample + 1, matches + 1)
    tail = binom.logsf(counts - sample - 1, max(matches - sample, 0), alpha)
    enough = counts[_log_choose(matches, sample) + tail <= np.log(FALSE_ALARMS)]
    needed = int(enough[0]) if enough.size else max(matches, sample) + 1
    return Agreement(int(inlier[kept].sum()), matches, needed, len(inlier))


def separate(
    first_xy: FloatArray, second_xy: FloatArray, support_px: float = SUPPORT_PX
) -> NDArray[np.int64]:
    """Indices of matches no two of which are nearer than `support_px` in either image.

    Parameters
    ----------
    first_xy, second_xy
        (M, 2) matched pixels; the earlier of two neighbours stays.
    """
    kept = np.ones(len(first_xy), dtype=np.bool_)
    if len(first_xy) == 0:
        return np.flatnonzero(kept)
    near = [cKDTree(xy).query_ball_point(xy, support_px) for xy in (first_xy, second_xy)]
    for i in range(len(first_xy)):
        if kept[i]:
            kept[near[0][i]] = kept[near[1][i]] = False
            kept[i] = True
    return np.flatnonzero(kept)


def point_chance(second_xy: FloatArray, threshold_px: float) -> float:
    """Probability that a wrong match falls within a radius of a given point.

    Matches crowd where the texture is (a horizon, a rock field): the chance is that of two
    of them to meet, from the share of pairs within a neighbourhood, and not less than that
    of points spread evenly over their bounding box.
    """
    if len(second_xy) == 0:
        return 1.0
    box = float(np.prod(np.maximum(np.ptp(second_xy, axis=0), 1.0)))
    even = np.pi * threshold_px**2 / box
    radius = max(_NEIGHBOURHOOD * float(np.sqrt(box)), threshold_px)
    count = len(second_xy)
    close = len(cKDTree(second_xy).query_pairs(radius, output_type="ndarray"))
    share = close / max(count * (count - 1) / 2, 1.0)
    return min(1.0, max(even, share * (threshold_px / radius) ** 2))


def line_chance(second_xy: FloatArray, threshold_px: float) -> float:
    """Probability that a wrong match falls within a distance of a given line.

    A line crosses the bounding box of the matches over its diagonal at most.
    """
    if len(second_xy) == 0:
        return 1.0
    extent = np.maximum(np.ptp(second_xy, axis=0), 1.0)
    return min(1.0, float(2.0 * threshold_px * np.hypot(*extent) / np.prod(extent)))


def _log_choose(n: int, k: int) -> float:
    return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)) if n >= k else 0.0
