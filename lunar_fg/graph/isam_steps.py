"""Single steps of iSAM2: made, factors exchanged, estimates found finite; failures in a line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from frontends.measurements import FloatArray

#: What pybind11 turns GTSAM's C++ exceptions into.
GTSAM_ERRORS = (RuntimeError, ValueError, IndexError, KeyError)

#: Updates after a named factor came or went; each linearises anew what still moves.
_MOST_CARRYING_UPDATES = 6
_POSE, _LANDMARK = ord("x"), ord("l")
_MANY_LANDMARKS = 200


@dataclass(frozen=True, slots=True)
class Relinearization:
    """When iSAM2 linearises anew.

    Attributes
    ----------
    rad, m
        Changes of a pose past which it is linearised again; of a landmark the latter.
    skip
        At every which update that is looked at.
    """

    rad: float = 0.05
    m: float = 0.05
    skip: int = 10

    def fresh(self, *, qr: bool) -> gtsam.ISAM2:
        """Make an empty iSAM2 that factorises by QR or by Cholesky."""
        thresholds = gtsam.ISAM2ThresholdMap()
        thresholds.insert((chr(_POSE), np.array([self.rad] * 3 + [self.m] * 3)))
        thresholds.insert((chr(_LANDMARK), np.full(3, self.m)))
        params = gtsam.ISAM2Params()
        params.relinearizeSkip = self.skip
        params.enablePartialRelinearizationCheck = True
        params.setRelinearizeThreshold(thresholds)
        params.setFactorization("QR" if qr else "CHOLESKY")
        return gtsam.ISAM2(params)


def carry(
    isam: gtsam.ISAM2,
    factors: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    gone: list[int],
) -> None:
    """Exchange factors, and linearise anew what moves; raises what GTSAM raises, or ValueError."""
    result = isam.update(factors, values, gone, force_relinearize=True)
    for _ in range(_MOST_CARRYING_UPDATES):
        if not result.getVariablesRelinearized():
            break
        result = isam.update(force_relinearize=True)
    for key in factors.keyVector():
        if is_pose(key) and not np.isfinite(isam.calculateEstimatePose3(key).matrix()).all():
            raise ValueError("the estimate is not finite")


def linearization(isam: gtsam.ISAM2, initial: gtsam.Values) -> gtsam.Values:
    """Where iSAM2 stood, of the variables that have an initial value, also after a failed update.

    The initial values stand in for what is not finite, or for all where nothing can be read.
    """
    found = gtsam.Values()
    try:
        latest = isam.getLinearizationPoint()
        for key in initial.keys():  # noqa: SIM118
            if is_pose(key):
                pose = latest.atPose3(key)
                finite = np.isfinite(pose.matrix()).all()
                found.insert(key, pose if finite else initial.atPose3(key))
            else:
                point = latest.atPoint3(key)
                finite = np.isfinite(point).all()
                found.insert(key, point if finite else initial.atPoint3(key))
    except GTSAM_ERRORS:
        return gtsam.Values(initial)
    return found


def joint_covariance(isam: gtsam.ISAM2, keys: Sequence[int]) -> FloatArray:
    """Joint covariance of n poses, (6 n, 6 n), in the order given."""
    marginal = isam.jointMarginalCovariance(list(keys))
    return np.block([[marginal.at(a, b) for b in keys] for a in keys])


def ordered_last(factors: gtsam.NonlinearFactorGraph) -> gtsam.KeyGroupMap | None:
    """Choose which variables iSAM2 eliminates last; None leaves all those just seen there.

    Its own choice grows least with the run, but makes one dense clique of all landmarks just
    seen: with hundreds, poses after landmarks cost less (18 times on KITTI-00).
    """
    keys = list(factors.keyVector())
    poses = [key for key in keys if is_pose(key)]
    if len(keys) - len(poses) < _MANY_LANDMARKS:
        return None
    last = gtsam.KeyGroupMap()
    for key in poses:
        last.insert2(key, 1)
    return last


def require_finite(isam: gtsam.ISAM2, values: gtsam.Values) -> None:
    """Raise what GTSAM raises, or a ValueError, unless the poses among these have an estimate."""
    for key in pose_keys(values):
        if not np.isfinite(isam.calculateEstimatePose3(key).matrix()).all():
            raise ValueError("the estimate is not finite")


def is_pose(key: int) -> bool:
    """Whether a key is a pose's."""
    return bool(gtsam.Symbol(key).chr() == _POSE)


def pose_keys(values: gtsam.Values) -> list[int]:
    """Keys of all poses among the values."""
    return list(gtsam.utilities.allPose3s(values).keys())


def first_line(error: Exception) -> str:
    """What GTSAM says, on one line."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines[:2]) or type(error).__name__
