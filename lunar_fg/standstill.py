"""Standing still: one statement that nothing moved, not a stack of measurements that say so.

Frames from one spot show the same landmarks with the same errors of calibration and surface;
entered as independent keyframes they would shrink the covariance without telling anything
new, and their noise would make the rover drift. So a frame that has not moved since the last
keyframe does not become evidence: its landmarks, wheels and tilt stay out, the keyframe's
landmarks stay the reference, and one zero-motion factor makes its pose a copy of the
keyframe's. When the rover drives on, the motion is measured from that keyframe, so a stop of
any length costs no accuracy. The test, too, is always against that keyframe: a creep adds up
until it counts as motion.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from frontends.geometry import se3_log
from frontends.measurements import RelativePose
from lunar_fg.graph.keyframe import floored

FloatArray = NDArray[np.float64]

#: A rover that stands still is taken for moving once in so many frames.
_FALSE_ALARM = 0.01
_GATE = float(chi2.isf(_FALSE_ALARM, 6))
#: A motion must be known at least this well (1-sigma of its worst direction) to be called zero.
_LARGEST_SIGMA_RAD = 2e-3
_LARGEST_SIGMA_M = 0.01
#: Motions surely smaller than these are none, though good images may tell them from zero:
#: a mast in the wind, a wheel that settles. It is also how exact a copied pose is.
STILL_RAD = 1e-3
STILL_M = 1e-3
_SURELY_SIGMAS = 2.0
_ROT, _TRANS = slice(0, 3), slice(3, 6)


def zero_motion(relative: RelativePose) -> RelativePose | None:
    """Return a zero motion in place of a measured one that is none, else None.

    Parameters
    ----------
    relative
        Measured since the last keyframe with landmarks.

    Returns
    -------
    RelativePose or None
        When a chi-square test cannot tell the six components from zero, or all are within
        `STILL_RAD` and `STILL_M` by two sigmas; its covariance is the graph's floor.
    """
    if not relative.accepted:
        return None
    motion = se3_log(relative.a_T_b)
    sigma_rad, sigma_m = (_largest_sigma(relative.covariance[p, p]) for p in (_ROT, _TRANS))
    if sigma_rad > _LARGEST_SIGMA_RAD or sigma_m > _LARGEST_SIGMA_M:
        return None
    small = (
        np.linalg.norm(motion[_ROT]) + _SURELY_SIGMAS * sigma_rad < STILL_RAD
        and np.linalg.norm(motion[_TRANS]) + _SURELY_SIGMAS * sigma_m < STILL_M
    )
    distance2 = motion @ np.linalg.solve(relative.covariance, motion)
    if not small and distance2 > _GATE:
        return None
    return replace(relative, a_T_b=np.eye(4), covariance=floored(np.zeros((6, 6))))


def _largest_sigma(covariance: FloatArray) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
