"""Faults injected into any dataset: what a rover's sensors do wrong, on purpose and by seed."""

from lunar_fg.faults.catalogue import FAULTS, parse_fault
from lunar_fg.faults.dataset import FaultyDataset

__all__ = ["FAULTS", "FaultyDataset", "parse_fault"]
