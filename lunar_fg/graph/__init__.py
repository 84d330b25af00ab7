"""The factor graph: the only place that imports gtsam; it never sees a pixel or a file."""

from lunar_fg.graph.batch import BatchResult, optimize_batch
from lunar_fg.graph.config import GraphConfig
from lunar_fg.graph.convergence import ConvergenceReport
from lunar_fg.graph.feed import feed
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.graph.keyframe import Keyframe, PredictedPose, SmoothedTrajectory
from lunar_fg.graph.ledger import FixDecision, Height, LedgerEntry, LoopClosure, Ruling

__all__ = [
    "BatchResult",
    "ConvergenceReport",
    "FixDecision",
    "GraphConfig",
    "Height",
    "IncrementalSmoother",
    "Keyframe",
    "LedgerEntry",
    "LoopClosure",
    "PredictedPose",
    "Ruling",
    "SmoothedTrajectory",
    "feed",
    "optimize_batch",
]
