"""A run held against its ground truth, in the forms that the evaluation takes."""

from __future__ import annotations

from lunar_fg.datasets.base import GroundTruth
from lunar_fg.evaluation import Accuracy, evaluate, share_start, without_truth
from lunar_fg.graph.keyframe import SmoothedTrajectory
from lunar_fg.trajectory import PositionTrack, Trajectory, Truth


def compare(estimate: Trajectory, truth: Truth | None) -> Accuracy:
    """Accuracy against the truth, or what can be said without one.

    Where the truth begins where the estimate says it does, within its covariance, both are in
    one map and nothing is aligned.
    """
    if truth is None:
        return without_truth(estimate)
    return evaluate(estimate, truth, same_map=share_start(estimate, truth))


def truth_of(ground_truth: GroundTruth | None) -> Truth | None:
    """Ground truth of a dataset in the form that the evaluation takes."""
    if ground_truth is None:
        return None
    if ground_truth.map_T_rover is not None:
        return Trajectory(ground_truth.stamp_s, ground_truth.map_T_rover)
    columns = 3 if ground_truth.has_height else 2
    return PositionTrack(ground_truth.stamp_s, ground_truth.position_m[:, :columns])


def as_trajectory(smoothed: SmoothedTrajectory) -> Trajectory:
    """Trajectory of the graph in the form that the evaluation takes."""
    return Trajectory(smoothed.stamp_s, smoothed.map_T_rover, smoothed.covariance)
