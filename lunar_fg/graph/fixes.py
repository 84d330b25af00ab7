"""Which absolute fixes and loop closures are in the graph: every verdict can be taken back."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import gtsam
import numpy as np
from scipy.stats import chi2

from frontends.errors import EstimationError, InputError
from frontends.measurements import AbsoluteFix, FloatArray, Verdict
from lunar_fg.graph.anchors import Anchor, height_factor
from lunar_fg.graph.ballot import NONE, Ballot, Choice, Group
from lunar_fg.graph.cases import Case, FixGraph, closure_case, fix_case, height_off
from lunar_fg.graph.ledger import FixDecision, Height, LedgerEntry, LoopClosure, Ruling
from lunar_fg.graph.network import NO_YAW_SIGMA, Claim
from lunar_fg.graph.planar import Planar, carried, planar_of, updated
from lunar_fg.graph.scale import FixedScale, fixed_scale
from lunar_fg.graph.setup import Setup
from lunar_fg.graph.vote import Vote


class FixJudge:
    """Judges every fix when it comes, and all recent ones anew with each new one.

    A new fix is first held against the predicted marginal of its keyframe (chi-square gate).
    Then the last `GraphConfig.fix_window` fixes vote (`vote`), and what the vote changes is
    carried into iSAM2 by factor index: iSAM2 itself holds plain Gaussian factors only.

    Parameters
    ----------
    graph
        Where the keyframes are.
    setup
        Prior of the first one; gate and window.
    """

    def __init__(self, graph: FixGraph, setup: Setup) -> None:
        start, config = setup.start, setup.config
        self._graph = graph
        self._barrier = float(chi2.ppf(config.fix_gate_probability, 3))
        self._height_gate = float(chi2.ppf(config.fix_gate_probability, 1))
        self._most = config.fix_window
        self._first = planar_of(start.map_T_rover, start.covariance())
        # Everything before the oldest fix of the window, at `_start_at`.
        self._start, self._start_at = self._first, 0
        self._cases: dict[str, Case] = {}
        self._rulings = 0
        self._window: list[Case] = []
        self._settled: list[Case] = []
        self._motions: dict[tuple[int, int], Planar] = {}

    @property
    def ledger(self) -> tuple[LedgerEntry, ...]:
        """Every measurement with its history, as they came."""
        return tuple(case.entry() for case in self._cases.values())

    def _require_new(self, name: str) -> int:
        if name in self._cases:
            raise InputError(
                "has been given already", source=name,
                remedy="give all places that a keyframe may be at as candidates of one fix",
            )  # fmt: skip
        return len(self._cases)

    def _ruling(
        self, case: Case, now: int, failure: str = "", gated: float | None = None
    ) -> Ruling:
        return case.ruling(now, self._tick(), self._barrier, failure, gated)

    def _tick(self) -> int:
        self._rulings += 1
        return self._rulings - 1

    def add_fix(self, fix: AbsoluteFix, ordinal: int, now: int) -> FixDecision:
        """Judge a checked fix of the keyframe `ordinal`; `now` is the latest frame."""
        number = self._require_new(f"fix {fix.frame}")
        if fix.candidates:
            return self._judge(fix_case(self._graph, number, fix, ordinal, self._height_gate), now)
        case = Case(number, f"fix {fix.frame}", fix, ordinal, Anchor(()))
        reason = fix.reason or "no place was found"
        case.history.append(Ruling(now, Verdict.REFUSED, None, float("nan"), reason, self._tick()))
        self._cases[case.name] = case
        return self._decision(case, [])

    def add_relative(self, closure: LoopClosure, base: int, ordinal: int, now: int) -> FixDecision:
        """Judge a checked loop closure between the keyframes `base` and `ordinal`."""
        number = self._require_new(f"closure {closure.base} to {closure.frame}")
        return self._judge(
            closure_case(self._graph, number, closure, base, ordinal, self._barrier), now
        )

    def add_height(self, height: Height, ordinal: int, now: int) -> FixDecision:
        """Hold a checked height against the prediction; there is no vote on heights."""
        name = f"height {height.frame}"
        number = self._require_new(name)
        case = Case(number, name, height, ordinal, self._graph.anchor(ordinal))
        pose, covariance = self._graph.at(ordinal)
        off = height_off(height.z_m, height.sigma_m, pose, covariance)
        verdict = Verdict.ACCEPTED if off <= self._height_gate else Verdict.REFUSED
        sigmas, gate = float(np.sqrt(off)), float(np.sqrt(self._height_gate))
        reason = f"{sigmas:.1f} sigma from the prediction (gate {gate:.1f})"
        if verdict is Verdict.ACCEPTED:
            factor = height_factor(case.anchor, height.z_m, height.sigma_m, pose)
            self._graph.exchange({name: factor}, (), height.frame, self._places({}))
            case.chosen = 0
        case.history.append(Ruling(now, verdict, case.chosen, sigmas, reason, self._tick()))
        self._cases[name] = case
        return self._decision(case, [])

    def overrule(self, name: str, choice: int, now: int) -> FixDecision:
        """Let a person decide: a place, or `NONE`; the others vote anew."""
        case = self._cases.get(name)
        if case is None or not NONE <= choice < len(case.places):
            raise InputError(
                "there is no such measurement" if case is None
                else f"has {len(case.places)} candidates, none is number {choice}",
                source=name, remedy="`lunar-fg fixes RUN` lists them",
            )  # fmt: skip
        case.overruled = choice
        wanted = {id(case): None if choice == NONE else choice}
        if case in self._settled:
            self._carry(wanted, now, case)
            self._resettle()
            return self._decision(case, self._vote(now, None, {}))
        return self._decision(case, self._vote(now, case, wanted))

    def revote(self, now: int) -> tuple[LedgerEntry, ...]:
        """Judge all fixes and closures together, also those that left the window."""
        self._window = sorted((*self._settled, *self._window), key=lambda c: c.ordinal)
        self._settled, self._start, self._start_at = [], self._first, 0
        changed = self._vote(now, None, {}) if self._window else []
        self._settle()
        return tuple(case.entry() for case in changed)

    def _judge(self, case: Case, now: int) -> FixDecision:
        late = case.ordinal < self._start_at
        self._cases[case.name] = case
        (self._settled if late else self._window).append(case)
        self._window.sort(key=lambda c: c.ordinal)
        if late:
            nearest = int(np.argmin(case.distance))
            passes = bool(case.distance[nearest] <= self._barrier) and not case.barred
            self._carry({id(case): nearest if passes else None}, now, case)
            self._settled.sort(key=lambda c: c.ordinal)
            self._resettle()
            changed: list[Case] = []
        else:
            changed = self._vote(now, case, {})
        self._settle()
        return self._decision(case, changed)

    def _vote(self, now: int, new: Case | None, wanted: dict[int, Choice]) -> list[Case]:
        """Vote on the window and carry out what changed; `wanted` is not voted on."""
        try:
            vote = Vote(self._ballot(), self._barrier)
            outcome = vote.decide([case.chosen for case in self._window])
        except EstimationError as error:
            return self._carry(wanted, now, new, str(error))
        gated = None
        if new is not None and new.base is None and not new.history and len(new.distance):
            gated = float(np.sqrt(new.distance.min()))
        for case, distance in zip(self._window, outcome.distance, strict=True):
            case.distance = distance
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

    def fixed_scale(self, scale_sigma: float) -> tuple[FixedScale | None, dict[int, FloatArray]]:
        """What the window's fixes say of the scale; how it moves the stations, by ordinal."""
        if not any(case.chosen is not None for case in self._window):
            return None, {}
        ballot = self._ballot()
        claims = [
            group.claims[case.chosen]
            for group, case in zip(ballot.groups, self._window, strict=True)
            if case.chosen is not None
        ]
        ordinals = sorted({station for pair in self._motions for station in pair})
        try:
            found = fixed_scale(ballot.start, ballot.motions, claims, scale_sigma)
        except EstimationError:  # a covariance then lacks the scale's share, nothing else
            return None, {}
        return found, dict(zip(ordinals, found.by_scale, strict=True))

    def _group(self, case: Case, number: Mapping[int, int]) -> Group:
        station = number[case.ordinal]
        places, base = case.places, None
        if case.base is not None:
            base = number.get(case.base)
            if base is None:
                # Its first keyframe is behind the window: what is known of it is not voted on.
                places = (carried(planar_of(*self._graph.at(case.base)), places[0]),)
        forced = NONE if case.barred and case.overruled is None else case.overruled
        return Group(tuple(Claim(station, place, base) for place in places), forced)

    def _carry(
        self,
        chosen: Mapping[int, Choice],
        now: int,
        new: Case | None,
        failure: str = "",
        gated: float | None = None,
    ) -> list[Case]:
        """Bring the graph to what was chosen, and write the rulings; the changed older cases."""
        entering: dict[str, gtsam.NonlinearFactor] = {}
        leaving: list[str] = []
        cases = [case for case in (*self._settled, *self._window) if id(case) in chosen]
        changing = [case for case in cases if chosen[id(case)] != case.chosen]
        try:
            for case in changing:
                factors, names = case.exchange(chosen[id(case)])
                entering |= factors
                leaving += names
            if changing:
                frame = changing[-1].measurement.frame
                self._graph.exchange(entering, leaving, frame, self._places(chosen))
        except (EstimationError, InputError) as error:
            failure, changing = str(error), []
        changed = []
        for case in changing:
            case.chosen = chosen[id(case)]
            if case is not new:
                case.history.append(self._ruling(case, now))
                changed.append(case)
        if new is not None:
            new.history.append(self._ruling(new, now, failure, gated))
        return changed

    def _places(self, chosen: Mapping[int, Choice]) -> dict[int, FloatArray]:
        """Where fixes with a yaw hold keyframes once these verdicts are carried out."""
        believed = {}
        for case in self._cases.values():
            choice = chosen.get(id(case), case.chosen)
            if choice is None or case.base is not None or not case.places:
                continue
            place = case.places[choice]
            if place.covariance[2, 2] < NO_YAW_SIGMA**2:
                believed[case.ordinal] = place.xyyaw
        return believed

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

    def _absorb(self, case: Case) -> None:
        if case.ordinal > self._start_at:
            motion = self._graph.motion(self._start_at, case.ordinal)
            self._start, self._start_at = carried(self._start, motion), case.ordinal
        if case.chosen is not None and case.base is None:
            self._start = updated(self._start, case.places[case.chosen])

    def _decision(self, case: Case, changed: list[Case]) -> FixDecision:
        fixes = [c for c in self._cases.values() if isinstance(c.measurement, AbsoluteFix)]
        fixes.sort(key=lambda c: c.ordinal)
        return FixDecision(
            case.entry(),
            tuple(c.entry() for c in changed),
            tuple(c.measurement.frame for c in fixes if c.chosen is not None),
            tuple(c.measurement.frame for c in fixes if c.chosen is None),
        )
