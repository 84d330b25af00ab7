"""Which absolute fixes and loop closures are in the graph: every verdict can be taken back."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Protocol

import gtsam
import numpy as np
from scipy.stats import chi2

from frontends.errors import EstimationError, InputError
from frontends.measurements import AbsoluteFix, FloatArray, StartPrior, Verdict
from lunar_fg.graph.anchors import Anchor, fix_factor, height_factor, relative_factor
from lunar_fg.graph.config import GraphConfig
from lunar_fg.graph.ledger import FixDecision, LedgerEntry, LoopClosure, Ruling
from lunar_fg.graph.planar import (
    Planar,
    carried,
    planar_of,
    turn,
    updated,
    wrapped,
)
from lunar_fg.graph.vote import NONE, Ballot, Choice, Claim, Group, Vote


class FixGraph(Protocol):
    """What the judge needs of the graph; keyframes by ordinal."""

    def anchor(self, ordinal: int) -> Anchor:
        """Where in the graph a keyframe is."""
        ...

    def at(self, ordinal: int) -> tuple[FloatArray, FloatArray]:
        """Pose (4, 4) and covariance (6, 6) of a keyframe."""
        ...

    def motion(self, first: int, second: int) -> Planar:
        """Planar motion between two keyframes that have an anchor, no fix in it."""
        ...

    def exchange(
        self, entering: Mapping[str, gtsam.NonlinearFactor], leaving: Collection[str], frame: int
    ) -> None:
        """Put named factors in and take others out."""
        ...


@dataclass(slots=True)
class _Case:
    """A measurement under judgement."""

    name: str
    measurement: AbsoluteFix | LoopClosure
    ordinal: int
    anchor: Anchor
    places: tuple[Planar, ...] = ()
    base: int | None = None
    height_fits: bool = False
    #: Factor of one of its places.
    factor: Callable[[int], gtsam.NonlinearFactor] | None = None
    chosen: Choice = None
    #: A person's word: a place, or `NONE`.
    overruled: int | None = None
    distance: FloatArray = field(default_factory=lambda: np.empty(0))
    history: list[Ruling] = field(default_factory=list)

    def entry(self) -> LedgerEntry:
        return LedgerEntry(self.measurement, tuple(self.history))


class FixJudge:
    """Judges every fix when it comes, and all recent ones anew with each new one.

    A new fix is first held against the predicted marginal of its keyframe (chi-square gate).
    Then the last `GraphConfig.fix_window` fixes vote (`vote`), and what the vote changes is
    carried into iSAM2 by factor index: iSAM2 itself holds plain Gaussian factors only.

    Parameters
    ----------
    graph
        Where the keyframes are.
    start
        Prior of the first one.
    config
        Gate and window.
    """

    def __init__(self, graph: FixGraph, start: StartPrior, config: GraphConfig) -> None:
        self._graph = graph
        self._barrier = float(chi2.ppf(config.fix_gate_probability, 3))
        self._height_gate = float(chi2.ppf(config.fix_gate_probability, 1))
        self._most = config.fix_window
        self._first = planar_of(start.map_T_rover, start.covariance())
        # Everything before the oldest fix of the window, at `_start_at`.
        self._start, self._start_at = self._first, 0
        self._window: list[_Case] = []
        self._settled: list[_Case] = []
        self._empty: list[_Case] = []
        self._motions: dict[tuple[int, int], Planar] = {}

    @property
    def ledger(self) -> tuple[LedgerEntry, ...]:
        """Every measurement with its history, by keyframe."""
        return tuple(case.entry() for case in self._cases())

    def _cases(self) -> list[_Case]:
        return sorted((*self._settled, *self._window, *self._empty), key=lambda case: case.ordinal)

    def add_fix(self, fix: AbsoluteFix, ordinal: int, now: int) -> FixDecision:
        """Judge a checked fix of the keyframe `ordinal`; `now` is the latest frame."""
        if any(case.base is None and case.ordinal == ordinal for case in self._cases()):
            raise InputError(
                "has been given a fix already", source=f"keyframe {fix.frame}",
                remedy="give all places that it may be at as candidates of one fix",
            )  # fmt: skip
        name = f"fix {fix.frame}"
        if not fix.candidates:
            case = _Case(name, fix, ordinal, Anchor(()))
            reason = fix.reason or "no place was found"
            case.history.append(Ruling(now, Verdict.REFUSED, None, float("nan"), reason))
            self._empty.append(case)
            return self._decision(case, [])
        anchor = self._graph.anchor(ordinal)
        pose, covariance = self._graph.at(ordinal)
        places = tuple(
            Planar(np.array([c.x_m, c.y_m, wrapped(c.yaw_rad)]), np.asarray(c.covariance))
            for c in fix.candidates
        )
        case = _Case(name, fix, ordinal, anchor, places)
        case.factor = lambda c: fix_factor(anchor, places[c], pose, f"keyframe {fix.frame}")
        predicted = planar_of(pose, covariance)
        case.distance = np.array([_distance(place, predicted) for place in places])
        if fix.height_m is not None and fix.sigma_height_m is not None:
            up = pose[2, :3]
            variance = up @ covariance[3:, 3:] @ up + fix.sigma_height_m**2
            off = (fix.height_m - pose[2, 3]) ** 2 / variance
            case.height_fits = bool(off <= self._height_gate)
        return self._judge(case, now)

    def add_relative(self, closure: LoopClosure, base: int, ordinal: int, now: int) -> FixDecision:
        """Judge a checked loop closure between the keyframes `base` and `ordinal`."""
        # The later one first: it may close the open segment.
        anchor, base_anchor = self._graph.anchor(ordinal), self._graph.anchor(base)
        pose, _ = self._graph.at(base)
        tilt = np.eye(4)
        tilt[:3, :3] = pose[:3, :3]
        tilt[:2, :3] = turn(np.arctan2(pose[1, 0], pose[0, 0])).T @ pose[:2, :3]
        place = planar_of(tilt @ closure.a_T_b, closure.covariance)
        name = f"closure {closure.base} to {closure.frame}"
        case = _Case(name, closure, ordinal, anchor, (place,), base)
        case.factor = lambda _: relative_factor(
            base_anchor, anchor, closure.a_T_b, closure.covariance, name
        )
        # Taken as independent: the vote knows better.
        seen = carried(planar_of(*self._graph.at(base)), place)
        case.distance = np.array([_distance(seen, planar_of(*self._graph.at(ordinal)))])
        return self._judge(case, now)

    def overrule(self, ordinal: int, base: int | None, choice: int, now: int) -> FixDecision:
        """Let a person decide: a place, or `NONE`; the others vote anew."""
        found = [c for c in self._cases() if c.ordinal == ordinal and c.base == base]
        if not found or not NONE <= choice < len(found[0].places):
            raise InputError(
                "there is no such measurement to decide on" if not found
                else f"has {len(found[0].places)} candidates, not a number {choice}",
                source="fixes", remedy="`lunar-fg fixes RUN` lists them",
            )  # fmt: skip
        case = found[0]
        case.overruled = choice
        wanted = {id(case): None if choice == NONE else choice}
        if case in self._settled:
            self._carry(wanted, now, case)
            self._resettle()
        changed = self._vote(now, case, wanted)
        return self._decision(case, changed)

    def _judge(self, case: _Case, now: int) -> FixDecision:
        late = case.ordinal < self._start_at
        (self._settled if late else self._window).append(case)
        self._window.sort(key=lambda c: c.ordinal)
        if late:
            nearest = int(np.argmin(case.distance))
            passes = bool(case.distance[nearest] <= self._barrier)
            self._carry({id(case): nearest if passes else None}, now, case)
            self._settled.sort(key=lambda c: c.ordinal)
            changed: list[_Case] = []
        else:
            changed = self._vote(now, case, {})
        self._settle()
        return self._decision(case, changed)

    def _vote(self, now: int, new: _Case, wanted: dict[int, Choice]) -> list[_Case]:
        """Vote on the window and carry out what changed."""
        try:
            vote = Vote(self._ballot(), self._barrier)
            outcome = vote.decide([case.chosen for case in self._window])
        except EstimationError as error:
            return self._carry({id(new): None, **wanted}, now, new, str(error))
        arrival = new.distance
        for case, distance in zip(self._window, outcome.distance, strict=True):
            case.distance = distance
        gated = None
        if new.base is None and not new.history and len(arrival):
            gated = float(np.sqrt(arrival.min()))
        chosen = {id(c): k for c, k in zip(self._window, outcome.chosen, strict=True)}
        return self._carry({**chosen, **wanted}, now, new, gated=gated)

    def _ballot(self) -> Ballot:
        ordinals = {self._start_at}
        for case in self._window:
            ordinals.add(case.ordinal)
            if case.base is not None and case.base >= self._start_at:
                ordinals.add(case.base)
        stations = sorted(ordinals)
        number = {ordinal: i for i, ordinal in enumerate(stations)}
        pairs = list(pairwise(stations))
        self._motions = {
            pair: self._motions.get(pair) or self._graph.motion(*pair) for pair in pairs
        }
        return Ballot(
            self._start,
            tuple(self._motions[pair] for pair in pairs),
            tuple(self._group(case, number) for case in self._window),
        )

    def _group(self, case: _Case, number: Mapping[int, int]) -> Group:
        station = number[case.ordinal]
        places, base = case.places, None
        if case.base is not None:
            base = number.get(case.base)
            if base is None:
                # Its first keyframe is behind the window: what is known of it is not voted on.
                places = (carried(planar_of(*self._graph.at(case.base)), places[0]),)
        return Group(tuple(Claim(station, place, base) for place in places), case.overruled)

    def _carry(
        self,
        chosen: Mapping[int, Choice],
        now: int,
        new: _Case,
        failure: str = "",
        gated: float | None = None,
    ) -> list[_Case]:
        """Bring the graph to what was chosen, and write the rulings; the changed older cases."""
        entering: dict[str, gtsam.NonlinearFactor] = {}
        leaving: list[str] = []
        cases = [case for case in self._cases() if id(case) in chosen]
        changing = [case for case in cases if chosen[id(case)] != case.chosen]
        try:
            for case in changing:
                self._exchange(case, chosen[id(case)], entering, leaving)
            if changing:
                self._graph.exchange(entering, leaving, new.measurement.frame)
        except (EstimationError, InputError) as error:
            failure, changing = str(error), []
        changed = []
        for case in changing:
            case.chosen = chosen[id(case)]
            if case is not new:
                case.history.append(self._ruling(case, now))
                changed.append(case)
        new.history.append(self._ruling(new, now, failure, gated))
        return changed

    def _exchange(
        self,
        case: _Case,
        choice: Choice,
        entering: dict[str, gtsam.NonlinearFactor],
        leaving: list[str],
    ) -> None:
        assert case.factor is not None
        height = f"height of {case.name}"
        if case.chosen is not None:
            leaving.append(case.name)
            if case.chosen == 0 and case.height_fits:
                leaving.append(height)
        if choice is not None:
            entering[case.name] = case.factor(choice)
            fix = case.measurement
            if choice == 0 and case.height_fits and isinstance(fix, AbsoluteFix):
                assert fix.height_m is not None
                assert fix.sigma_height_m is not None
                pose, _ = self._graph.at(case.ordinal)
                entering[height] = height_factor(
                    case.anchor, fix.height_m, fix.sigma_height_m, pose
                )

    def _ruling(
        self, case: _Case, now: int, failure: str = "", gated: float | None = None
    ) -> Ruling:
        accepted = case.chosen is not None
        places = case.distance
        nearest = float(np.nanmin(places)) if np.isfinite(places).any() else float("nan")
        square = nearest if case.chosen is None else float(places[case.chosen])
        distance, gate = float(np.sqrt(square)), float(np.sqrt(self._barrier))
        if failure:
            reason = failure
        elif case.overruled is not None:
            reason = f"{'accepted' if accepted else 'rejected'} by a person"
        elif case.history:
            reason = (
                f"{'let in' if accepted else 'taken back'}: {distance:.1f} sigma from what the "
                f"path and the other fixes say now"
            )
        else:
            reason = f"{distance:.1f} sigma from what the path and the other fixes say"
            if gated is not None and (gated <= gate) != accepted:
                reason += f"; {gated:.1f} from the prediction, before the vote"
        if not accepted and not failure and case.overruled is None:
            reason += f" (gate {gate:.1f})"
        verdict = Verdict.ACCEPTED if accepted else Verdict.REFUSED
        return Ruling(now, verdict, case.chosen, distance, reason)

    def _settle(self) -> None:
        """Let the oldest cases leave the window: their verdicts are final."""
        while len(self._window) > self._most:
            case = self._window.pop(0)
            self._settled.append(case)
            self._absorb(case)

    def _resettle(self) -> None:
        """Work out anew what everything before the window says."""
        self._start, self._start_at = self._first, 0
        for case in self._settled:
            self._absorb(case)

    def _absorb(self, case: _Case) -> None:
        if case.ordinal > self._start_at:
            motion = self._graph.motion(self._start_at, case.ordinal)
            self._start, self._start_at = carried(self._start, motion), case.ordinal
        if case.chosen is not None and case.base is None:
            self._start = updated(self._start, case.places[case.chosen])

    def _decision(self, case: _Case, changed: list[_Case]) -> FixDecision:
        fixes = [c for c in self._cases() if c.base is None]
        return FixDecision(
            case.entry(),
            tuple(c.entry() for c in changed),
            tuple(c.measurement.frame for c in fixes if c.chosen is not None),
            tuple(c.measurement.frame for c in fixes if c.chosen is None),
        )


def _distance(place: Planar, predicted: Planar) -> float:
    """Squared Mahalanobis distance of a place from a prediction."""
    off = place.xyyaw - predicted.xyyaw
    off[2] = wrapped(off[2])
    return float(off @ np.linalg.solve(place.covariance + predicted.covariance, off))
