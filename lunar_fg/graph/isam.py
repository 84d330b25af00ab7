"""iSAM2 behind a guard: a failed update costs its own factors, never the trajectory."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import gtsam
import numpy as np

from frontends.errors import EstimationError
from frontends.measurements import FloatArray
from lunar_fg.graph.descent import descend

_RELINEARIZE_SKIP = 10
_MOST_SETTLING_STEPS = 100
# What pybind11 turns GTSAM's C++ exceptions into.
_GTSAM_ERRORS = (RuntimeError, ValueError, IndexError, KeyError)

_POSE = ord("x")
_MANY_LANDMARKS = 200

_T = TypeVar("_T")

QR_WARNING = (
    "GTSAM's Cholesky refused the graph (loose directions have drifted past 4096 local sigmas, "
    "or nothing anchors the vertical); iSAM2 goes on with QR, which is slower"
)


class GuardedIsam:
    """An ISAM2 that can be rebuilt from its own books after any failure.

    Parameters
    ----------
    qr
        Factorise by QR from the start. QR has no limit on how far loose directions drift;
        Cholesky is faster with many landmarks.
    relinearize_threshold
        Change of a variable (rad, m) past which it is linearised again.
    """

    def __init__(self, *, qr: bool, relinearize_threshold: float = 0.05) -> None:
        self._qr = qr
        self._threshold = relinearize_threshold
        self._factors = gtsam.NonlinearFactorGraph()
        self._initial = gtsam.Values()
        self._isam = self._fresh()
        self._warnings: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user should know about the solver."""
        return self._warnings

    def _fresh(self) -> gtsam.ISAM2:
        params = gtsam.ISAM2Params()
        params.relinearizeSkip = _RELINEARIZE_SKIP
        params.enablePartialRelinearizationCheck = True
        params.setRelinearizeThreshold(self._threshold)
        params.setFactorization("QR" if self._qr else "CHOLESKY")
        return gtsam.ISAM2(params)

    def _rebuild(self, values: gtsam.Values) -> None:
        isam = self._fresh()
        try:
            if self._factors.size():
                isam.update(self._factors, values)
        except _GTSAM_ERRORS as error:
            if self._qr:
                raise EstimationError(
                    f"the graph cannot be solved ({_first_line(error)})"
                ) from error
            self._qr, self._warnings = True, (QR_WARNING,)
            self._rebuild(values)
            return
        self._isam = isam

    def update(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, frame: int) -> None:
        """Add checked factors and the initial values of their new variables.

        Raises
        ------
        EstimationError
            When they cannot be solved; the graph is as it was before the call.
        """
        try:
            self._isam.update(factors, values, [], _ordered_last(factors))
            self._check_finite(values)
        except _GTSAM_ERRORS as error:
            self._recover(factors, values, frame, error)
        self._factors.push_back(factors)
        self._initial.insert(values)

    def _check_finite(self, values: gtsam.Values) -> None:
        if not all(np.isfinite(self.pose(key)).all() for key in _pose_keys(values)):
            raise ValueError("the estimate is not finite")

    def _recover(
        self,
        factors: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        frame: int,
        error: Exception,
    ) -> None:
        if not self._qr:
            self._qr = True
            whole, all_values = (
                gtsam.NonlinearFactorGraph(self._factors),
                gtsam.Values(self._initial),
            )
            whole.push_back(factors)
            all_values.insert(values)
            isam = self._fresh()
            try:
                isam.update(whole, all_values)
            except _GTSAM_ERRORS:
                self._qr = False
            else:
                self._isam = isam
                self._warnings = (QR_WARNING,)
                return
        self._rebuild(self._initial)
        raise EstimationError(
            f"keyframe {frame}: its measurements could not be solved and are left out "
            f"({_first_line(error)})"
        ) from error

    def pose(self, key: int) -> FloatArray:
        """Return the current estimate, (4, 4)."""
        return np.asarray(self._isam.calculateEstimatePose3(key).matrix())

    def covariance(self, key: int) -> FloatArray:
        """Marginal covariance of a pose, (6, 6)."""
        return self._marginal(lambda isam: np.asarray(isam.marginalCovariance(key)))

    def joint_covariance(self, first: int, second: int) -> FloatArray:
        """Joint covariance of two poses, (12, 12), first then second."""

        def joint(isam: gtsam.ISAM2) -> FloatArray:
            marginal = isam.jointMarginalCovariance([first, second])
            keys = (first, second)
            return np.block([[marginal.at(a, b) for b in keys] for a in keys])

        return self._marginal(joint)

    def _marginal(self, query: Callable[[gtsam.ISAM2], _T]) -> _T:
        try:
            return query(self._isam)
        except _GTSAM_ERRORS as error:
            if self._qr:
                raise EstimationError(
                    f"the marginal covariance failed ({_first_line(error)})"
                ) from error
        self._qr = True
        self._warnings = (QR_WARNING,)
        self._rebuild(self._isam.calculateEstimate())
        return self._marginal(query)

    def settle(self) -> None:
        """Relinearise everything until no pose moves: where the batch optimiser would end.

        Raises
        ------
        EstimationError
            When the graph cannot be solved; the estimate stays as it was.
        """
        if not self._factors.size():
            return
        estimate = self._isam.calculateEstimate()
        self._initial = descend(self._factors, estimate, _MOST_SETTLING_STEPS).values
        self._rebuild(self._initial)


def _ordered_last(factors: gtsam.NonlinearFactorGraph) -> gtsam.KeyGroupMap | None:
    """Choose which variables iSAM2 eliminates last; None leaves all those just seen there.

    Its own choice grows least with the run, but makes one dense clique of all landmarks just
    seen: with hundreds, poses after landmarks cost less (18 times on KITTI-00).
    """
    keys = list(factors.keyVector())
    poses = [key for key in keys if gtsam.Symbol(key).chr() == _POSE]
    if len(keys) - len(poses) < _MANY_LANDMARKS:
        return None
    last = gtsam.KeyGroupMap()
    for key in poses:
        last.insert2(key, 1)
    return last


def _pose_keys(values: gtsam.Values) -> list[int]:
    return list(gtsam.utilities.allPose3s(values).keys())


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines[:2]) or type(error).__name__
