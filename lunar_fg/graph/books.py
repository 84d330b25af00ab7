"""What is in iSAM2, so that it can be rebuilt after any failure."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import gtsam

from lunar_fg.graph.descent import without


@dataclass(slots=True)
class Books:
    """Factors in iSAM2's slots, and the names of some of them.

    Attributes
    ----------
    factors
        By slot. iSAM2 keeps an empty slot for a factor that has gone; so do the books.
    named
        Slots of the factors that may be taken back.
    unnamed
        How many others there are; they never change their order.
    """

    factors: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    named: dict[str, int] = field(default_factory=dict)
    unnamed: int = 0
    _holes: bool = False

    def __len__(self) -> int:
        """Count the slots."""
        return int(self.factors.size())

    def copy(self) -> Books:
        """Copy them; what is entered into the one is not in the other."""
        factors = gtsam.NonlinearFactorGraph(self.factors)
        return Books(factors, dict(self.named), self.unnamed, self._holes)

    def add(self, factors: gtsam.NonlinearFactorGraph) -> None:
        """Put unnamed factors in."""
        self.factors.push_back(factors)
        self.unnamed += int(factors.size())

    def exchange(
        self, entering: Mapping[str, gtsam.NonlinearFactor], leaving: Collection[str]
    ) -> None:
        """Put named factors in, and take others out."""
        for name in leaving:
            self.factors.remove(self.named.pop(name))
            self._holes = True
        for name, factor in entering.items():
            self.named[name] = len(self)
            self.factors.add(factor)

    def slots_of(self, landmarks: set[int]) -> list[int]:
        """Slots of all factors on these landmarks."""
        return [
            i
            for i in range(len(self))
            if self.factors.exists(i) and not landmarks.isdisjoint(self.factors.at(i).keys())
        ]

    def remove(self, slots: Collection[int]) -> None:
        """Take unnamed factors out."""
        self._holes = True
        self.unnamed -= len(slots)
        for i in slots:
            self.factors.remove(i)

    def cleared(self, landmarks: Collection[int] = ()) -> Books:
        """Books without these landmarks and without empty slots, numbered anew."""
        gone = set(landmarks)
        if not gone and not self._holes:
            return self
        named: dict[str, int] = {}
        names, count = {slot: name for name, slot in self.named.items()}, 0
        for i in range(len(self) if names else 0):
            if self.factors.exists(i) and gone.isdisjoint(self.factors.at(i).keys()):
                if i in names:
                    named[names[i]] = count
                count += 1
        factors = without(self.factors, gone)
        return Books(factors, named, int(factors.size()) - len(named))

    def only_named(self, factors: gtsam.NonlinearFactorGraph) -> Books:
        """Other factors, and after them the named ones of these books."""
        books = Books()
        books.add(factors)
        books.exchange({name: self.factors.at(slot) for name, slot in self.named.items()}, ())
        return books

    def since(
        self,
        then: Books,
        entering: Mapping[str, gtsam.NonlinearFactor],
        wanted: Collection[str],
    ) -> tuple[gtsam.NonlinearFactorGraph, Books]:
        """What another state of the graph lacks, and the books of that with it.

        Parameters
        ----------
        then
            Books on the same graph, earlier or under other verdicts.
        entering
            Named factors that are not in yet.
        wanted
            Names of all factors that there shall be; `then` has no other.
        """
        names, books = {slot: name for name, slot in self.named.items()}, then.copy()
        lacking = [
            slot for name, slot in self.named.items() if name in wanted and name not in then.named
        ]
        slot, more = len(self), self.unnamed - then.unnamed
        while more > 0:
            slot -= 1
            if self.factors.exists(slot) and slot not in names:
                lacking.append(slot)
                more -= 1
        since = gtsam.NonlinearFactorGraph()
        for slot in sorted(lacking):
            factor, name = self.factors.at(slot), names.get(slot)
            since.add(factor)
            if name is None:
                books.factors.add(factor)
                books.unnamed += 1
            else:
                books.exchange({name: factor}, ())
        new = {name: factor for name, factor in entering.items() if name not in then.named}
        for factor in new.values():
            since.add(factor)
        books.exchange(new, ())
        return since, books
