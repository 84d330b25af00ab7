"""The smoother as it was before each of the last map measurements: to take one back is to go back.

iSAM2 takes a factor out in a millisecond; but a false fix has moved every pose by metres, and
linearising all of them anew, there and back, is what costs. Before it, nothing had moved. What
is left that way is kept, too: verdicts change more than once.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import gtsam

from lunar_fg.graph.books import Books
from lunar_fg.graph.isam_steps import carry, is_pose

_MOST_FACTORS_SINCE = 500


@dataclass(frozen=True, slots=True)
class Snapshot:
    """iSAM2 and the books on it at one moment.

    Attributes
    ----------
    isam
        A copy that nobody else has.
    books
        A copy, too.
    """

    isam: gtsam.ISAM2
    books: Books

    def leads_to(self, wanted: Collection[str]) -> bool:
        """Whether the wanted named factors are reached from here by adding some."""
        return all(name in wanted for name in self.books.named)

    def lacks(self, wanted: Collection[str], books: Books) -> int:
        """How many factors have to be added; `books` hold all the unnamed ones."""
        return books.unnamed - self.books.unnamed + len(wanted) - len(self.books.named)

    def grown(
        self,
        now: gtsam.ISAM2,
        books: Books,
        entering: Mapping[str, gtsam.NonlinearFactor],
        wanted: Collection[str],
    ) -> tuple[gtsam.ISAM2, Books]:
        """Add what this lacks; the snapshot is used up. Raises what GTSAM raises, or ValueError.

        Parameters
        ----------
        now, books
            The graph as it stands; it stays as it is.
        entering
            Named factors that are not in it yet.
        wanted
            Names of all factors that there shall be.
        """
        since, all_books = books.since(self.books, entering, wanted)
        keys = list(since.keyVector())
        if keys:  # else it is there already, to the last bit
            new = [key for key in keys if not self.isam.valueExists(key)]
            poses = {key for key in keys if is_pose(key)}
            carry(self.isam, since, moved_along(new, now, self.isam, poses), [])
        return self.isam, all_books


class Snapshots:
    """The last few.

    Parameters
    ----------
    most
        How many are kept; one of 1,000 poses takes 1 MB.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        #: What goes first is first.
        self._kept: list[Snapshot] = []

    def keep(self, snapshot: Snapshot) -> None:
        """Add the newest."""
        self._kept = [*self._kept, snapshot][-self._most :]

    def leave(self, snapshot: Snapshot, wanted: Collection[str]) -> None:
        """Add one that other factors are wanted than; such ones go first."""
        self._kept = sorted([*self._kept, snapshot], key=lambda kept: kept.leads_to(wanted))
        self._kept = self._kept[-self._most :]

    def clear(self) -> None:
        """Forget all: slots have been renumbered, or variables have gone."""
        self._kept = []

    def take(self, wanted: Collection[str], books: Books) -> Snapshot | None:
        """Find the nearest that has nothing but what is wanted, and give it away.

        None where there is none near, or where the graph is as near as it stands.

        Parameters
        ----------
        wanted
            Names of the factors that there shall be.
        books
            Of the graph as it stands.
        """
        near = [
            (lacks, -i)
            for i, snapshot in enumerate(self._kept)
            if (lacks := snapshot.lacks(wanted, books)) <= _MOST_FACTORS_SINCE
            and snapshot.leads_to(wanted)
        ]
        if not near:
            return None
        at = -min(near)[1]
        here = set(books.named)
        if here.issubset(wanted) and here.issuperset(self._kept[at].books.named):
            return None
        return self._kept.pop(at)


def moved_along(
    keys: Collection[int], now: gtsam.ISAM2, then: gtsam.ISAM2, poses: Collection[int]
) -> gtsam.Values:
    """Where variables that came since would be, had the others stayed where they were then.

    Parameters
    ----------
    keys
        Variables that neither or only `now` has.
    now, then
        Of the two moments.
    poses
        Keys of poses around the new variables; the latest one that both have carries them.
    """
    values = gtsam.Values()
    shared = [key for key in poses if then.valueExists(key)]
    if not keys or not shared:
        return values
    carrier = max(shared)
    shift = then.calculateEstimatePose3(carrier).compose(
        now.calculateEstimatePose3(carrier).inverse()
    )
    for key in keys:
        if key in poses:
            values.insert(key, shift.compose(now.calculateEstimatePose3(key)))
        else:
            values.insert(key, shift.transformFrom(now.calculateEstimatePoint3(key)))
    return values
