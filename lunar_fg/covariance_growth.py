"""How far a rover can still drive before its position is too uncertain.

It follows from how its covariance has grown lately. Driving a further ``d`` straight on turns the
yaw error into a cross-track error::

    var_cross(d) = s_c^2 + (2 s_cy + q_c) d + s_y^2 d^2 + q_y d^3 / 3
    var_along(d) = s_a^2 + q_a d

with the present (co)variances ``s`` and the growth a metre ``q`` of cross-track, along-track
and yaw variance, measured over the last steps.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from frontends.geometry import adjoint, inverse
from frontends.measurements import Estimate

FloatArray = NDArray[np.float64]

#: Steps over which the growth of the covariance is measured, and the least distance, m.
_STEPS = 50
_LEAST_M = 1.0
#: A step after which the position variance has shrunk by this share has brought a fix.
_FIX_SHARE = 0.1


class CovarianceGrowth:
    """How fast the covariance has grown over the last steps, a metre."""

    def __init__(self) -> None:
        self._steps: deque[FloatArray] = deque(maxlen=_STEPS)

    def observe(self, before: Estimate, after: Estimate) -> float:
        """Take in one step; returns its length, m."""
        a_T_b = inverse(before.map_T_rover) @ after.map_T_rover
        length = float(np.linalg.norm(a_T_b[:3, 3]))
        carry = adjoint(inverse(a_T_b))
        carried = carry @ before.covariance @ carry.T
        added = np.diag(after.covariance - carried)
        trace = float(np.trace(carried[3:5, 3:5]))
        if added[3] + added[4] > -_FIX_SHARE * trace:
            self._steps.append(np.array([length, added[3], added[4], added[2]]))
        return length

    def range_m(self, bound_m: float, now: tuple[float, float, float, float]) -> float:
        """Distance until 3 sigma exceeds the bound; NaN before enough was driven to tell.

        Parameters
        ----------
        bound_m
            What 3 sigma of the position must not exceed.
        now
            Variances along and across the route and of the yaw, and the covariance of
            cross-track and yaw.
        """
        along, cross, yaw, cross_yaw = now
        limit = (bound_m / 3.0) ** 2
        if along >= limit or cross >= limit:
            return 0.0
        total = np.sum(self._steps, axis=0) if self._steps else np.zeros(4)
        if total[0] < _LEAST_M:
            return float("nan")
        q_along, q_cross, q_yaw = np.maximum(total[1:] / total[0], 0.0)
        roots = np.roots([q_yaw / 3.0, yaw, 2.0 * cross_yaw + q_cross, cross - limit])
        real = [root.real for root in roots if abs(root.imag) < 1e-9 and root.real > 0.0]
        reach = min(real, default=float("inf"))
        return min(reach, (limit - along) / q_along) if q_along > 0.0 else reach
