"""Whether the covariances tell the truth: normalised estimation error squared (NEES).

**Value.** For each pose ``e' P^-1 e / dof``, averaged: 1 is honest, more is over-confident.
``e`` is the right-perturbation error ``log(estimate^-1 truth)`` (6 dof), or the position
error in map axes (3 dof; 2 when the truth has no z) for a truth without orientation.

**Frame.** In `SAME_MAP` estimate and truth are in one frame and the covariances are used
as they are. In `FROM_START` both are expressed relative to their own first pose, and the
start's covariance, carried along the path, is subtracted from each later one; that is
exact for dead reckoning from the start, and refused where it leaves no positive-definite
covariance (absolute fixes have made a pose better known than the start).
In both, the first pose is not counted: it was given, not estimated.

**Band.** The errors of successive poses are almost the same error, so the mean over N poses
is worth far fewer independent ones: a whole random walk is worth about two. The number `n`
follows from the reported covariances alone: the error of pose k is carried to pose k+1, and
whatever variance is added or removed there is taken as new, independent information. With
the resulting correlations ``C_ij`` of the whitened errors, ``n = dof N^2 / sum |C_ij|^2``,
and the mean of honest errors has the mean and variance of ``chi2(dof n) / (dof n)``, whose
95 % interval is the band. For dead reckoning, filtered or smoothed, this is exact. Where
absolute fixes come in, a step that both loses and gains information counts as less new than
it is, most of all in smoothed estimates: `n` is then too small and the band too wide, which
errs on the side of not crying wolf.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from frontends.geometry import adjoint, inverse, se3_log
from lunar_fg.evaluation.association import Pair, UndefinedMetricError
from lunar_fg.trajectory import PositionTrack

FloatArray = NDArray[np.float64]

BAND = 0.95


class NeesFrame(StrEnum):
    """In which frame errors are taken; see the module's text."""

    SAME_MAP = "same map"
    FROM_START = "from start"


@dataclass(frozen=True, slots=True)
class Nees:
    """Mean NEES per degree of freedom, and the band it lies in when covariances are honest.

    Attributes
    ----------
    mean
        1 is honest, above `upper95` over-confident, below `lower95` over-cautious.
    lower95, upper95
        Two-sided 95 % chi-square band of `mean` for `n` independent poses.
    n
        Independent poses that the correlated ones are worth; not an integer.
    dof
        Degrees of freedom a pose: 6, 3 or 2.
    poses
        Poses averaged.
    """

    mean: float
    lower95: float
    upper95: float
    n: float
    dof: int
    poses: int

    @property
    def honest(self) -> bool:
        """Whether the mean lies in the band."""
        return self.lower95 <= self.mean <= self.upper95


def nees(pair: Pair, frame: NeesFrame) -> Nees:
    """NEES of an estimate with covariance.

    Raises
    ------
    UndefinedMetricError
        Without covariances, without a common frame, or with fewer than two poses.
    """
    errors, poses, factors, weights = _whitened(pair, frame)
    dof = errors.shape[1]
    n = _independent(poses, factors, weights)
    return _with_band(float((errors**2).sum(axis=1).mean() / dof), n, dof, len(errors))


def nees_profile(pair: Pair, frame: NeesFrame) -> tuple[FloatArray, int]:
    """NEES per degree of freedom of every pose but the first, (N - 1,), and the degrees.

    Raises
    ------
    UndefinedMetricError
        As for `nees`.
    """
    errors, *_ = _whitened(pair, frame)
    return np.asarray((errors**2).mean(axis=1)), errors.shape[1]


def single_pose_band(dof: int) -> tuple[float, float]:
    """95 % of the poses have a NEES per degree of freedom in this band when honest."""
    lower, upper = chi2.interval(BAND, dof)
    return float(lower) / dof, float(upper) / dof


def coverage(pair: Pair, frame: NeesFrame, sigmas: float = 3.0) -> NDArray[np.bool_]:
    """Whether each pose but the first is within so many sigmas of the truth on every map axis.

    Raises
    ------
    UndefinedMetricError
        As `nees`.
    """
    if pair.estimate.covariance is None:
        raise UndefinedMetricError("the estimate has no covariance")
    poses, covariance = pair.estimate.map_T_rover, pair.estimate.covariance
    truth = pair.truth.positions
    if frame is NeesFrame.FROM_START:
        if isinstance(pair.truth, PositionTrack):
            raise UndefinedMetricError("the truth has positions only: no common start is known")
        poses, covariance = _relative_to_start(poses, covariance)
        truth = (inverse(pair.true_poses[0]) @ pair.true_poses)[:, :3, 3]
    axes = truth.shape[1]
    turn = poses[1:, :axes, :3]
    spread = turn @ covariance[1:, 3:, 3:] @ turn.transpose(0, 2, 1)
    sigma = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    error = np.abs(poses[1:, :axes, 3] - truth[1:])
    return np.asarray((error <= sigmas * sigma).all(axis=1))


def pooled(runs: Sequence[Nees]) -> Nees:
    """NEES over independent runs, e.g. a Monte Carlo campaign: each counts its `n`."""
    if not runs or len({run.dof for run in runs}) != 1:
        raise UndefinedMetricError("pooling needs runs of equal degrees of freedom")
    n = sum(run.n for run in runs)
    mean = sum(run.mean * run.n for run in runs) / n
    return _with_band(mean, n, runs[0].dof, sum(run.poses for run in runs))


def _with_band(mean: float, n: float, dof: int, poses: int) -> Nees:
    lower, upper = (float(bound) / (dof * n) for bound in chi2.interval(BAND, dof * n))
    return Nees(mean, lower, upper, n, dof, poses)


def _whitened(
    pair: Pair, frame: NeesFrame
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Whitened errors (N, d); poses, covariance factors and weights for `_independent`."""
    if pair.estimate.covariance is None:
        raise UndefinedMetricError("the estimate has no covariance")
    if len(pair) < 2:
        raise UndefinedMetricError("fewer than two poses have truth")
    poses, covariance = pair.estimate.map_T_rover, pair.estimate.covariance
    if frame is NeesFrame.FROM_START:
        if isinstance(pair.truth, PositionTrack):
            raise UndefinedMetricError(
                "the truth has positions only and is not stated to be in the same map, so no "
                "common frame is known without a fit that would hide the errors"
            )
        poses, covariance = _relative_to_start(poses, covariance)
    factors = _cholesky(covariance[1:])
    if isinstance(pair.truth, PositionTrack):
        errors, weights = _position_errors(pair, poses[1:], covariance[1:], factors)
    else:
        truth = pair.true_poses
        if frame is NeesFrame.FROM_START:
            truth = inverse(truth[0]) @ truth
        motions = inverse(poses[1:]) @ truth[1:]
        logs = np.array([se3_log(motion) for motion in motions])
        errors = np.asarray(np.linalg.solve(factors, logs[..., None])[..., 0])
        weights = np.tile(np.eye(6), (len(errors), 1, 1))
    return errors, poses[1:], factors, weights


def _relative_to_start(poses: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses in the frame of the first, and their covariances given the first."""
    relative = inverse(poses[0]) @ poses
    carried = np.array([adjoint(inverse(pose)) for pose in relative])
    start = carried @ covariance[0] @ carried.transpose(0, 2, 1)
    return relative, covariance - start


def _cholesky(covariance: FloatArray) -> FloatArray:
    try:
        return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise UndefinedMetricError(
            "covariances are not positive definite (from the start: once the start's is taken "
            "off; compare in the same map where absolute fixes were used)"
        ) from error


def _position_errors(
    pair: Pair, poses: FloatArray, covariance: FloatArray, factors: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Whitened position errors (N, d), and what picks them from whitened poses (N, d, 6)."""
    assert isinstance(pair.truth, PositionTrack)
    dof = 2 if pair.truth.planar else 3
    pick = np.zeros((len(poses), dof, 6))
    pick[:, :, 3:] = poses[:, :dof, :3]
    factor = _cholesky(pick @ covariance @ pick.transpose(0, 2, 1))
    offset = (pair.estimate.positions - pair.truth.positions)[1:, :dof]
    errors = np.asarray(np.linalg.solve(factor, offset[..., None])[..., 0])
    return errors, np.asarray(np.linalg.solve(factor, pick @ factors))


def _independent(poses: FloatArray, factors: FloatArray, weights: FloatArray) -> float:
    """Count the independent poses that correlated ones are worth; see the module's text.

    `weights` (N, d, 6) pick the counted errors from the whitened pose errors.
    """
    dof = weights.shape[1]
    count = len(poses)
    history = np.zeros((6, 6))
    total = 0.0
    for k in range(count):
        if k:
            carry = adjoint(inverse(inverse(poses[k - 1]) @ poses[k]))
            u, s, vt = np.linalg.svd(np.linalg.solve(factors[k], carry @ factors[k - 1]))
            correlation = (u * np.minimum(s, 1.0 / np.maximum(s, 1e-300))) @ vt
            history = correlation @ history @ correlation.T
        history = history + weights[k].T @ weights[k]
        total += 2.0 * float(np.trace(weights[k] @ history @ weights[k].T)) - dof
    return float(dof * count**2 / total)
