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
    """

    factors: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    named: dict[str, int] = field(default_factory=dict)
    _holes: bool = False

    def __len__(self) -> int:
        """Count the slots."""
        return int(self.factors.size())

    def copy(self) -> Books:
        """Copy them; what is entered into the one is not in the other."""
        return Books(gtsam.NonlinearFactorGraph(self.factors), dict(self.named), self._holes)

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
        return Books(without(self.factors, gone), named)

    def only_named(self, factors: gtsam.NonlinearFactorGraph) -> Books:
        """Other factors, and after them the named ones of these books."""
        books = Books(gtsam.NonlinearFactorGraph(factors))
        books.exchange({name: self.factors.at(slot) for name, slot in self.named.items()}, ())
        return books

    def since(
        self,
        then: Books,
        entering: Mapping[str, gtsam.NonlinearFactor],
        wanted: Collection[str],
    ) -> tuple[gtsam.NonlinearFactorGraph, Books]:
        """What came since and is wanted, and the books of then with it.

        Parameters
        ----------
        then
            An earlier copy of these books.
        entering
            Named factors that are not in yet.
        wanted
            Names of all factors that there shall be.
        """
        names = {slot: name for name, slot in self.named.items()}
        since, books = gtsam.NonlinearFactorGraph(), then.copy()

        def enter(factor: gtsam.NonlinearFactor, name: str | None) -> None:
            if name is not None:
                books.named[name] = len(books)
            books.factors.add(factor)
            since.add(factor)

        for slot in range(len(then), len(self)):
            name = names.get(slot)
            if self.factors.exists(slot) and (
                name is None or (name in wanted and name not in books.named)
            ):
                enter(self.factors.at(slot), name)
        for name, factor in entering.items():
            if name not in books.named:
                enter(factor, name)
        return since, books
