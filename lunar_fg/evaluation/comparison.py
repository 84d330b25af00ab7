"""Comparing an estimate with the truth: all that can be computed, and why the rest cannot."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np
from scipy.stats import chi2

from frontends.geometry import inverse, se3_log
from lunar_fg.evaluation.alignment import (
    Alignment,
    AlignmentKind,
    align,
    common_frame,
)
from lunar_fg.evaluation.association import (
    TOLERANCE_S,
    Pair,
    UndefinedMetricError,
    associate,
)
from lunar_fg.evaluation.consistency import Nees, NeesFrame, nees
from lunar_fg.evaluation.drift import (
    KITTI_LENGTHS_M,
    ate_rmse_m,
    position_errors,
    relative_pose_error,
    segment_errors,
)
from lunar_fg.evaluation.metrics import Accuracy, AteRmse, KittiDrift, NeesBand, Rpe
from lunar_fg.trajectory import PositionTrack, Trajectory, Truth

T = TypeVar("T")

_AXES_DIFFER_DEG = 45.0
_ONE_IN_A_MILLION = 1e-6


def evaluate(
    estimate: Trajectory,
    truth: Truth,
    *,
    same_map: bool = False,
    tolerance_s: float = TOLERANCE_S,
) -> Accuracy:
    """All accuracy figures of an estimate.

    Parameters
    ----------
    estimate
        With covariances for the NEES.
    truth
        Poses, or positions only; of the same body as the estimate.
    same_map
        True when both are in one and the same frame, e.g. a simulated traverse whose start
        pose was given. The final error is then taken as it is, and the NEES covers the
        start's uncertainty; otherwise both are taken from a common first pose.
    tolerance_s
        Poses further apart in time are not compared.

    Returns
    -------
    Accuracy
        None for what is not defined, with the reason in its warnings.

    Raises
    ------
    InputError
        When no pose of the estimate has a truth.
    """
    pair = associate(estimate, truth, tolerance_s)
    notes = _Notes()
    notes.warnings += _remarks(pair, tolerance_s)
    alignments: dict[AlignmentKind, Alignment] = {}
    for kind in AlignmentKind:
        found = notes.attempt(f"ate_rmse_m.{kind}", partial(align, kind, pair))
        if found is not None:
            alignments[kind] = found
    ate = {str(kind): ate_rmse_m(pair, found) for kind, found in alignments.items()}
    segments = notes.attempt("kitti", partial(segment_errors, pair))
    if segments is not None and not set(segments.lengths_m) <= set(KITTI_LENGTHS_M):
        lengths = ", ".join(f"{length:.3g}" for length in segments.lengths_m)
        notes.warnings.append(
            f"kitti: a short path, so over {segments.segments} segments of {lengths} m"
        )
    rpe = notes.attempt("rpe", partial(relative_pose_error, pair))
    frame = NeesFrame.SAME_MAP if same_map else NeesFrame.FROM_START
    consistency = notes.attempt("nees", partial(nees, pair, frame))
    sim3 = alignments.get(AlignmentKind.SIM3)
    return Accuracy(
        distance_m=pair.truth.distance_m,
        ate_rmse_m=AteRmse(**ate),
        scale_sim3=None if sim3 is None else sim3.scale,
        kitti=KittiDrift()
        if segments is None
        else KittiDrift(segments.translation_percent, segments.rotation_deg_per_m),
        rpe=Rpe() if rpe is None else Rpe(*rpe),
        final_error_m=_final_error(pair, alignments, same_map, notes),
        nees=_band(consistency),
        warnings=tuple(notes.warnings),
    )


def share_start(estimate: Trajectory, truth: Truth) -> bool:
    """Whether estimate and truth are in one map, as far as their first common poses tell.

    A start that was given with its uncertainty lies within it (chi-square, all but one in a
    million); a truth in a frame of its own hardly ever does.
    """
    if estimate.covariance is None or isinstance(truth, PositionTrack):
        return False
    pair = associate(estimate, truth)
    covariance = pair.estimate.covariance
    assert covariance is not None
    error = se3_log(inverse(pair.estimate.map_T_rover[0]) @ pair.true_poses[0])
    distance2 = float(error @ np.linalg.solve(covariance[0], error))
    return distance2 < chi2.isf(_ONE_IN_A_MILLION, 6)


def without_truth(estimate: Trajectory) -> Accuracy:
    """Give what is left when a dataset has no truth: the length of the estimate."""
    return Accuracy(
        distance_m=estimate.distance_m,
        warnings=("the dataset has no truth: no accuracy; distance_m is the estimate's own",),
    )


class _Notes:
    """Collects the reasons for what could not be computed."""

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def attempt(self, name: str, compute: Callable[[], T]) -> T | None:
        try:
            return compute()
        except UndefinedMetricError as reason:
            self.warnings.append(f"{name}: not computed: {reason}")
            return None


def _band(consistency: Nees | None) -> NeesBand:
    if consistency is None:
        return NeesBand()
    return NeesBand(
        consistency.mean, consistency.lower95, consistency.upper95, round(consistency.n, 2)
    )


def _final_error(
    pair: Pair, alignments: dict[AlignmentKind, Alignment], same_map: bool, notes: _Notes
) -> float | None:
    wanted = common_frame(pair, same_map=same_map)
    if wanted not in alignments:
        notes.warnings.append(f"final_error_m: not computed: there is no {wanted} alignment")
        return None
    if wanted is AlignmentKind.SE3:
        notes.warnings.append(
            "final_error_m: after SE(3) alignment, for want of an orientation at the start"
        )
    return float(position_errors(pair, alignments[wanted])[-1])


def _remarks(pair: Pair, tolerance_s: float) -> list[str]:
    remarks = []
    if len(pair) < pair.estimate_poses:
        remarks.append(
            f"{len(pair)} of {pair.estimate_poses} poses have truth within {tolerance_s:g} s"
        )
    if pair.estimate.indexed or pair.truth.indexed:
        remarks.append("poses were paired by row, for want of stamps")
    if isinstance(pair.truth, PositionTrack):
        if pair.truth.planar:
            remarks.append("the truth has no z: flat ground at z = 0 is taken for it")
        return remarks
    turn = _body_axes_differ_deg(pair.estimate, pair.truth)
    if turn is not None and turn > _AXES_DIFFER_DEG:
        remarks.append(
            f"estimate and truth move along body axes {turn:.0f} deg apart: one is of the rover "
            "(x forward), the other of a camera (z forward)? origin and rotation figures are "
            "meaningless then"
        )
    return remarks


def _body_axes_differ_deg(estimate: Trajectory, truth: Trajectory) -> float | None:
    """Angle between the mean directions of motion in body axes; None when standing."""
    directions = []
    for track in (estimate, truth):
        poses = track.map_T_rover
        motion = (inverse(poses[:-1]) @ poses[1:])[:, :3, 3].sum(axis=0)
        length = float(np.linalg.norm(motion))
        if length < 0.5 * track.distance_m or length < 0.5:
            return None
        directions.append(motion / length)
    return float(np.rad2deg(np.arccos(np.clip(directions[0] @ directions[1], -1.0, 1.0))))
