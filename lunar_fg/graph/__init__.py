"""The factor graph: the only place that imports gtsam; it never sees a pixel or a file."""

from lunar_fg.graph.batch import BatchResult, ConvergenceReport, optimize_batch
from lunar_fg.graph.config import GraphConfig
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.graph.keyframe import Keyframe, SmoothedTrajectory

__all__ = [
    "BatchResult",
    "ConvergenceReport",
    "GraphConfig",
    "IncrementalSmoother",
    "Keyframe",
    "SmoothedTrajectory",
    "optimize_batch",
]
