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
from frontends.geometry import inverse, se3_log
from frontends.measurements import AbsoluteFix, FloatArray, Verdict
from lunar_fg.graph.anchors import Anchor, fix_factor, height_factor, relative_factor
from lunar_fg.graph.keyframe import floored
from lunar_fg.graph.ledger import (
    FixDecision,
    Height,
    LedgerEntry,
    LoopClosure,
    MapMeasurement,
    Ruling,
)
from lunar_fg.graph.network import NO_YAW_SIGMA, Claim
from lunar_fg.graph.planar import (
    Planar,
    carried,
    mahalanobis_squared,
    planar_of,
    turn,
    updated,
    wrapped,
)
from lunar_fg.graph.scale import FixedScale, fixed_scale
from lunar_fg.graph.setup import Setup
from lunar_fg.graph.vote import NONE, Ballot, Choice, Group, Vote

#: Roll, pitch and height of a tangent vector; the vote is on the others.
_OFF_PLANE = [0, 1, 5]


class FixGraph(Protocol):
    """What the judge needs of the graph; keyframes by ordinal."""

    def anchor(self, ordinal: int) -> Anchor:
        """Where in the graph a keyframe is."""
        ...

    def at(self, ordinal: int) -> tuple[FloatArray, FloatArray]:
        """Pose (4, 4) and covariance (6, 6) of a keyframe."""
        ...

    def between(self, first: int, second: int) -> tuple[FloatArray, FloatArray]:
        """Motion (4, 4) and covariance (6, 6) between two keyframes that have an anchor."""
        ...

    def motion(self, first: int, second: int) -> Planar:
        """Planar motion between two keyframes that have an anchor, no fix in it."""
        ...

    def exchange(
        self,
        entering: Mapping[str, gtsam.NonlinearFactor],
        leaving: Collection[str],
        frame: int,
        places: Mapping[int, FloatArray],
    ) -> None:
        """Put named factors in and take others out.

        `places` are x, y, yaw of all keyframes that are fixed then, by ordinal.
        """
        ...


@dataclass(slots=True, eq=False)
class _Case:
    """A measurement under judgement."""

    number: int
    name: str
    measurement: MapMeasurement
    ordinal: int
    anchor: Anchor
    places: tuple[Planar, ...] = ()
    base: int | None = None
    height_fits: bool = False
    #: A loop closure's distance in roll, pitch and height, sigmas; past the gate no vote helps.
    off_plane: float = 0.0
    barred: bool = False
    #: Factor of one of its places.
    factor: Callable[[int], gtsam.NonlinearFactor] | None = None
    chosen: Choice = None
    #: A person's word: a place, or `NONE`.
    overruled: int | None = None
    distance: FloatArray = field(default_factory=lambda: np.empty(0))
    history: list[Ruling] = field(default_factory=list)

    def entry(self) -> LedgerEntry:
        return LedgerEntry(self.number, self.measurement, tuple(self.history))


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
        self._cases: dict[str, _Case] = {}
        self._rulings = 0
        self._window: list[_Case] = []
        self._settled: list[_Case] = []
        self._motions: dict[tuple[int, int], Planar] = {}

    @property
    def ledger(self) -> tuple[LedgerEntry, ...]:
        """Every measurement with its history, as they came."""
        return tuple(case.entry() for case in self._cases.values())

    def _case(self, name: str, measurement: MapMeasurement, ordinal: int, anchor: Anchor) -> _Case:
        if name in self._cases:
            raise InputError(
                "has been given already", source=name,
                remedy="give all places that a keyframe may be at as candidates of one fix",
            )  # fmt: skip
        return _Case(len(self._cases), name, measurement, ordinal, anchor)

    def _tick(self) -> int:
        self._rulings += 1
        return self._rulings - 1

    def add_fix(self, fix: AbsoluteFix, ordinal: int, now: int) -> FixDecision:
        """Judge a checked fix of the keyframe `ordinal`; `now` is the latest frame."""
        name = f"fix {fix.frame}"
        if not fix.candidates:
            case = self._case(name, fix, ordinal, Anchor(()))
            reason = fix.reason or "no place was found"
            case.history.append(
                Ruling(now, Verdict.REFUSED, None, float("nan"), reason, self._tick())
            )
            self._cases[name] = case
            return self._decision(case, [])
        anchor = self._graph.anchor(ordinal)
        pose, covariance = self._graph.at(ordinal)
        places = tuple(
            Planar(np.array([c.x_m, c.y_m, wrapped(c.yaw_rad)]), np.asarray(c.covariance))
            for c in fix.candidates
        )
        case = self._case(name, fix, ordinal, anchor)
        case.places = places
        case.factor = lambda c: fix_factor(anchor, places[c], pose, f"keyframe {fix.frame}")
        predicted = planar_of(pose, covariance)
        case.distance = np.array([mahalanobis_squared(place, predicted) for place in places])
        if fix.height_m is not None and fix.sigma_height_m is not None:
            off = _height_off(fix.height_m, fix.sigma_height_m, pose, covariance)
            case.height_fits = off <= self._height_gate
        return self._judge(case, now)

    def add_relative(self, closure: LoopClosure, base: int, ordinal: int, now: int) -> FixDecision:
        """Judge a checked loop closure between the keyframes `base` and `ordinal`."""
        # The later one first: it may close the open segment.
        anchor, base_anchor = self._graph.anchor(ordinal), self._graph.anchor(base)
        pose, _ = self._graph.at(base)
        tilt = np.eye(4)
        tilt[:3, :3] = pose[:3, :3]
        tilt[:2, :3] = turn(np.arctan2(pose[1, 0], pose[0, 0])).T @ pose[:2, :3]
        covariance = floored(closure.covariance)
        place = planar_of(tilt @ closure.a_T_b, covariance)
        name = f"closure {closure.base} to {closure.frame}"
        case = self._case(name, closure, ordinal, anchor)
        case.places, case.base = (place,), base
        case.factor = lambda _: relative_factor(
            base_anchor, anchor, closure.a_T_b, covariance, name
        )
        case.off_plane = _off_plane(closure.a_T_b, covariance, *self._graph.between(base, ordinal))
        case.barred = case.off_plane**2 > self._barrier
        # Taken as independent: the vote knows better.
        seen = carried(planar_of(*self._graph.at(base)), place)
        case.distance = np.array([mahalanobis_squared(seen, planar_of(*self._graph.at(ordinal)))])
        return self._judge(case, now)

    def add_height(self, height: Height, ordinal: int, now: int) -> FixDecision:
        """Hold a checked height against the prediction; there is no vote on heights."""
        name = f"height {height.frame}"
        case = self._case(name, height, ordinal, self._graph.anchor(ordinal))
        pose, covariance = self._graph.at(ordinal)
        off = _height_off(height.z_m, height.sigma_m, pose, covariance)
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

    def _judge(self, case: _Case, now: int) -> FixDecision:
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
            changed: list[_Case] = []
        else:
            changed = self._vote(now, case, {})
        self._settle()
        return self._decision(case, changed)

    def _vote(self, now: int, new: _Case | None, wanted: dict[int, Choice]) -> list[_Case]:
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

    def _group(self, case: _Case, number: Mapping[int, int]) -> Group:
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
        new: _Case | None,
        failure: str = "",
        gated: float | None = None,
    ) -> list[_Case]:
        """Bring the graph to what was chosen, and write the rulings; the changed older cases."""
        entering: dict[str, gtsam.NonlinearFactor] = {}
        leaving: list[str] = []
        cases = [case for case in (*self._settled, *self._window) if id(case) in chosen]
        changing = [case for case in cases if chosen[id(case)] != case.chosen]
        try:
            for case in changing:
                self._exchange(case, chosen[id(case)], entering, leaving)
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
            leaving.append(_factor_name(case, case.chosen))
            if case.chosen == 0 and case.height_fits:
                leaving.append(height)
        if choice is not None:
            entering[_factor_name(case, choice)] = case.factor(choice)
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
        elif case.barred:
            reason = f"{case.off_plane:.1f} sigma off in roll, pitch and height"
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
        by_person = case.overruled is not None
        return Ruling(now, verdict, case.chosen, distance, reason, self._tick(), by_person)

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
        fixes = [c for c in self._cases.values() if isinstance(c.measurement, AbsoluteFix)]
        fixes.sort(key=lambda c: c.ordinal)
        return FixDecision(
            case.entry(),
            tuple(c.entry() for c in changed),
            tuple(c.measurement.frame for c in fixes if c.chosen is not None),
            tuple(c.measurement.frame for c in fixes if c.chosen is None),
        )


def _factor_name(case: _Case, choice: int) -> str:
    return f"{case.name}, place {choice}"


def _off_plane(
    a_T_b: FloatArray, noise: FloatArray, predicted: FloatArray, covariance: FloatArray
) -> float:
    """Distance, in sigmas, of a measured motion from a predicted one in what no map fixes."""
    off = se3_log(inverse(a_T_b) @ predicted)[_OFF_PLANE]
    spread = (noise + covariance)[np.ix_(_OFF_PLANE, _OFF_PLANE)]
    return float(np.sqrt(off @ np.linalg.solve(spread, off)))


def _height_off(z_m: float, sigma_m: float, pose: FloatArray, covariance: FloatArray) -> float:
    """Squared distance, in sigmas, of a height from a predicted pose."""
    up = pose[2, :3]
    variance = float(up @ covariance[3:, 3:] @ up) + sigma_m**2
    return float((z_m - pose[2, 3]) ** 2 / variance)
