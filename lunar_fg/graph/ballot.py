"""What a vote is about, and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass

from frontends.measurements import FloatArray
from lunar_fg.graph.network import Claim
from lunar_fg.graph.planar import Planar

#: The number of a claim in its group, or that none is believed.
Choice = int | None
#: No claim of a group is true.
NONE = -1


@dataclass(frozen=True, slots=True)
class Group:
    """Claims of which at most one is true; `forced` says which one, or `NONE`, without a vote."""

    claims: tuple[Claim, ...]
    forced: int | None = None

    def allowed(self, choice: Choice) -> Choice:
        """What is believed when the vote is for `choice`."""
        if self.forced is None:
            return choice
        return None if self.forced == NONE else self.forced


@dataclass(frozen=True, slots=True)
class Ballot:
    """What the vote is about.

    Attributes
    ----------
    start
        Station 0 as everything before it says, map axes.
    motions
        From each station to the next, in the level axes of the first.
    groups
        To be judged.
    """

    start: Planar
    motions: tuple[Planar, ...]
    groups: tuple[Group, ...]


@dataclass(frozen=True, slots=True)
class Outcome:
    """The verdicts.

    Attributes
    ----------
    chosen
        Of each group the claim that is believed, or None.
    distance
        Of each group and claim the squared Mahalanobis distance from what all others say.
    cost
        Truncated cost.
    """

    chosen: tuple[Choice, ...]
    distance: tuple[FloatArray, ...]
    cost: float
