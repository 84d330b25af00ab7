"""Accuracy, consistency and pictures of a trajectory against the truth."""

from lunar_fg.evaluation.comparison import evaluate, share_start, without_truth
from lunar_fg.evaluation.metrics import Accuracy, Metrics

__all__ = ["Accuracy", "Metrics", "evaluate", "share_start", "without_truth"]
