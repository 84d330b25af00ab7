"""Which of many map measurements are true: graduated non-convexity on the fix keyframes alone.

The path between two fix keyframes is one planar motion, known to be true up to its covariance;
the start is known too. Places in the map, and loop-closing motions, are claims: each is true or
it is not, and of the claims of one group at most one is. What is sought is the least truncated
cost (truncated least squares, TLS),

    sum of chi-square of what is known + sum over groups of min(chi-square, barrier),

by graduated non-convexity (Yang et al. 2020), then by single changes that still lower the cost.
The barrier is the gate's: a claim that stands alone is believed if and only if it passes the
chi-square gate. What was believed until now, and what gates one after another would believe,
are improved in the same way; of the three the cheapest is taken, where false ones that agree
with each other count once (`stories`). No single change leads from one such story to another:
each that was refused is believed in turn, and given what is believed but fits it better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from frontends.measurements import FloatArray, IntArray
from lunar_fg.graph import kernels
from lunar_fg.graph.ballot import Ballot, Choice, Outcome
from lunar_fg.graph.network import Network, squared
from lunar_fg.graph.stories import Refused, stories

_MOST_CHANGES_EACH = 3
#: Of the barrier between chi-square and truncated cost, a step (Yang et al. 2020).
_GRADUATION = 1.4
_MOST_GRADUATIONS = 100

#: How often what was refused may become what is believed.
_MOST_TURNS = 3
_MOST_DIVISIONS = 5


@dataclass(frozen=True, slots=True)
class _Solved:
    xyyaw: FloatArray
    covariance: FloatArray
    #: Chi-square of what is known and of what is believed; `cost` has the barriers too.
    fit: float
    cost: float
    #: Of each claim from what all others say, (C, 3), (C, 3, 3), and squared (C,).
    off: FloatArray
    spread: FloatArray
    distance: FloatArray


@dataclass(frozen=True, slots=True)
class _Found:
    """Verdicts with their cost, and the refused claims that tell a story, for each story."""

    chosen: tuple[Choice, ...]
    solved: _Solved
    cost: float
    stories: tuple[IntArray, ...]


class Vote:
    """One vote.

    Parameters
    ----------
    ballot
        What it is about.
    barrier
        Squared Mahalanobis distance past which a claim is not believed.

    Raises
    ------
    EstimationError
        When the stations cannot be solved for.
    """

    def __init__(self, ballot: Ballot, barrier: float) -> None:
        self._ballot = ballot
        self._groups = ballot.groups
        self._barrier = barrier
        claims = [claim for group in ballot.groups for claim in group.claims]
        self._network = Network(ballot.start, ballot.motions, claims)
        sizes = np.array([len(group.claims) for group in ballot.groups], dtype=np.int64)
        self._group: IntArray = np.repeat(np.arange(len(sizes)), sizes)
        #: Number of each group's first claim; one more at the end.
        self._first: IntArray = np.concatenate([[0], np.cumsum(sizes)])
        #: Groups that are voted on.
        self._open: IntArray = np.array(
            [g for g, group in enumerate(self._groups) if group.forced is None and group.claims],
            dtype=np.int64,
        )
        self._seen: dict[tuple[Choice, ...], _Found] = {}

    def decide(self, incumbent: Sequence[Choice]) -> Outcome:
        """Judge all groups; `incumbent` is what was believed until now."""
        kept = [g.allowed(choice) for g, choice in zip(self._groups, incumbent, strict=True)]
        best = self._improved(kept)
        for start in (self._graduated(), self._gated()):
            if tuple(start) not in self._seen:
                best = _cheaper(best, self._improved(start))
        for _ in range(_MOST_TURNS):
            before = best
            for story in before.stories:
                best = _cheaper(best, self._found(self._divided(before, story)))
                best = _cheaper(best, self._found(self._turned(before, story)))
            if best is before:
                break
        distance = best.solved.distance
        split = tuple(distance[a:b] for a, b in pairwise(self._first.tolist()))
        return Outcome(best.chosen, split, best.cost)

    def _turned(self, found: _Found, story: IntArray) -> list[Choice]:
        """Believe a refused story, and make one of what contradicts it."""
        chosen = [group.allowed(None) for group in self._groups]
        for claim in story.tolist():
            g = int(self._group[claim])
            chosen[g] = self._groups[g].allowed(claim - int(self._first[g]))
        turned = self._found(chosen)
        against = self._claims(found.chosen)
        against = against[turned.solved.distance[against] > self._barrier]
        return self._divided(turned, against) if len(against) else chosen

    def _divided(self, found: _Found, story: IntArray) -> list[Choice]:
        """Divide all places between the path and a story, by what each is nearer to.

        At first what may belong to either is left out: such places would hold each other in.
        """
        chosen, solved, undecided = list(found.chosen), found.solved, self._barrier
        for _ in range(_MOST_DIVISIONS):
            information = np.linalg.inv(solved.spread[story])
            covariance = np.linalg.inv(information.sum(axis=0))
            offset = covariance @ np.einsum("cij,cj->i", information, solved.off[story])
            by_path = squared(solved.off, solved.spread)
            by_story = squared(solved.off - offset, solved.spread + covariance)
            by_story[self._network.base >= 0] = np.inf
            before = list(chosen)
            told = []
            for g, (a, b) in enumerate(pairwise(self._first.tolist())):
                if self._groups[g].forced is not None or a == b:
                    continue
                nearest, teller = a + int(by_path[a:b].argmin()), a + int(by_story[a:b].argmin())
                if by_path[nearest] <= min(self._barrier, by_story[teller]) and (
                    by_story[teller] >= undecided
                ):
                    chosen[g] = nearest - a
                    continue
                chosen[g] = None
                if by_story[teller] <= self._barrier:
                    told.append(teller)
            if chosen == before or not told:
                break
            story, undecided = np.array(told, dtype=np.int64), 0.0
            solved = self._solve(chosen, solved.xyyaw)
        return chosen

    def _gated(self) -> list[Choice]:
        """Believe what passes the gate, one station after the other from the start."""
        chosen = [group.allowed(None) for group in self._groups]
        order = [
            g
            for g, group in enumerate(self._groups)
            if group.claims and all(claim.base is None for claim in group.claims)
        ]
        order.sort(key=lambda g: self._groups[g].claims[0].station)
        taken = kernels.gated(
            self._network.measured,
            self._network.noise,
            len(self._ballot.motions),
            np.array(order, dtype=np.int64),
            self._first,
            np.array([g.claims[0].station if g.claims else 0 for g in self._groups], np.int64),
            np.array([-2 if g.forced is None else g.forced for g in self._groups], np.int64),
            self._barrier,
        )
        for g in order:
            chosen[g] = int(taken[g]) if taken[g] >= 0 else None
        return chosen

    def _graduated(self) -> list[Choice]:
        """Graduated non-convexity: from least squares over all claims to the truncated cost."""
        network, barrier = self._network, self._barrier
        forced = np.array([group.forced is not None for group in self._groups], dtype=bool)
        fixed = forced[self._group]
        certain = self._weights([group.allowed(None) for group in self._groups])
        weight = np.where(fixed, certain, 1.0)
        path = network.solve(weight, network.dead_reckoned)
        square = network.chi_square(path.xyyaw)
        most = float(square[~fixed].max(initial=0.0))
        # How far the cost still is from the truncated one: convex where `share` is small.
        share = barrier / (2.0 * most - barrier) if 2.0 * most > barrier else np.inf
        for _ in range(_MOST_GRADUATIONS if np.isfinite(share) else 0):
            between = np.sqrt(barrier * share * (share + 1.0) / np.maximum(square, 1e-12)) - share
            weight = np.where(fixed, certain, np.clip(between, 0.0, 1.0))
            path = network.solve(weight, path.xyyaw)
            square = network.chi_square(path.xyyaw)
            if ((weight == 0.0) | (weight == 1.0)).all():
                break
            share *= _GRADUATION
        chosen = [group.allowed(None) for group in self._groups]
        least: dict[int, float] = {}
        for i in np.flatnonzero(~fixed & (weight > 0.5)).tolist():
            g = int(self._group[i])
            if square[i] < least.get(g, np.inf):
                least[g], chosen[g] = float(square[i]), i - int(self._first[g])
        return chosen

    def _improved(self, chosen: list[Choice]) -> _Found:
        """Change one verdict at a time while that lowers the cost."""
        solved = self._solve(chosen, self._network.dead_reckoned)
        for _ in range(_MOST_CHANGES_EACH * max(len(chosen), 1)):
            gain, other = self._gains(chosen, solved.distance)
            best = int(np.argmax(gain)) if len(gain) else -1
            if best < 0 or gain[best] <= 1e-6:
                break
            changed = list(chosen)
            changed[best] = None if other[best] < 0 else int(other[best])
            after = self._solve(changed, solved.xyyaw)
            if after.cost >= solved.cost:
                break
            chosen, solved = changed, after
        return self._found(chosen, solved)

    def _found(self, chosen: Sequence[Choice], solved: _Solved | None = None) -> _Found:
        """Truncated cost in which refused places that agree with each other count once."""
        found = self._seen.get(tuple(chosen))
        if found is None:
            found = self._seen[tuple(chosen)] = self._valued(chosen, solved)
        return found

    def _valued(self, chosen: Sequence[Choice], solved: _Solved | None) -> _Found:
        solved = solved or self._solve(chosen, self._network.dead_reckoned)
        out = np.array([choice is None for choice in chosen], dtype=bool)
        places = np.zeros(len(chosen), dtype=bool)
        places[self._group[self._network.base < 0]] = True
        cost = solved.fit + self._barrier * int((out & ~places).sum())
        rows = np.flatnonzero(out[self._group] & (self._network.base < 0))
        if not len(rows):
            return _Found(tuple(chosen), solved, cost, ())
        refused = Refused(
            self._group[rows],
            self._network.station[rows],
            -self._network.terms(solved.xyyaw)[0][rows],
            self._network.covariance[rows],
        )
        more, told = stories(refused, solved.covariance, self._barrier, int((~out).sum()))
        return _Found(tuple(chosen), solved, cost + more, tuple(rows[s] for s in told))

    def _gains(self, chosen: Sequence[Choice], distance: FloatArray) -> tuple[FloatArray, IntArray]:
        """What the best other verdict on each group would save, and which: -1 for none of it."""
        barrier, some = self._barrier, self._open
        gain, other = np.zeros(len(chosen)), np.full(len(chosen), -1, dtype=np.int64)
        if not len(some):
            return gain, other
        now = np.append(distance, barrier)[self._believed(chosen)[some]]
        least = np.full(len(chosen), np.inf)
        np.minimum.at(least, self._group, distance)
        nearest = np.flatnonzero(distance == least[self._group])[::-1]
        other[self._group[nearest]] = nearest - self._first[self._group[nearest]]
        other[least >= barrier] = -1
        gain[some] = now - np.minimum(least[some], barrier)
        return gain, other

    def _believed(self, chosen: Sequence[Choice]) -> IntArray:
        """Number of the believed claim of each group, -1 for none."""
        choice = np.array([-1 if c is None else c for c in chosen], dtype=np.int64)
        return np.where(choice < 0, -1, self._first[:-1] + choice)

    def _claims(self, chosen: Sequence[Choice]) -> IntArray:
        """Numbers of the believed claims."""
        believed = self._believed(chosen)
        return believed[believed >= 0]

    def _weights(self, chosen: Sequence[Choice]) -> FloatArray:
        """1 for each believed claim, 0 for all others, (C,)."""
        weight = np.zeros(len(self._group))
        weight[self._claims(chosen)] = 1.0
        return weight

    def _solve(self, chosen: Sequence[Choice], begin: FloatArray) -> _Solved:
        network, weight = self._network, self._weights(chosen)
        path = network.solve(weight, begin)
        covariance = network.path_covariance(weight, path.xyyaw)
        believed = self._believed(chosen)
        off, spread = network.innovations(path.xyyaw, covariance, believed[self._group])
        out = sum(c is None for c in chosen)
        fit = path.chi_square
        cost = fit + self._barrier * out
        return _Solved(path.xyyaw, covariance, fit, cost, off, spread, squared(off, spread))


def _cheaper(best: _Found, other: _Found) -> _Found:
    """The best stays where the other is not better by more than rounding."""
    return other if other.cost < best.cost - 1e-6 else best
