"""Absolute adjustment: the rover's own ground found in a map from orbit."""

from frontends.absolute.adjustment import AbsoluteAdjustment, AbsoluteConfig, Adjustment
from frontends.absolute.correlating import ReliefInDem, RelitRelief
from frontends.absolute.everywhere import EverywhereRelief, locate_everywhere
from frontends.absolute.features import LayerMatch, SurfMatching, match_layers
from frontends.absolute.light import SunEstimate, estimate_sun
from frontends.absolute.patch import ReliefPatch, make_patch
from frontends.absolute.peak import Peak
from frontends.absolute.proposal import Proposal, Proposer
from frontends.absolute.search import Search

__all__ = [
    "AbsoluteAdjustment",
    "AbsoluteConfig",
    "Adjustment",
    "EverywhereRelief",
    "LayerMatch",
    "Peak",
    "Proposal",
    "Proposer",
    "ReliefInDem",
    "ReliefPatch",
    "RelitRelief",
    "Search",
    "SunEstimate",
    "SurfMatching",
    "estimate_sun",
    "locate_everywhere",
    "make_patch",
    "match_layers",
]
