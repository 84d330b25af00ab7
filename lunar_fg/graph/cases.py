"""A map measurement under judgement: its places, its factors, and all that was decided on it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import gtsam
import numpy as np

from frontends.geometry import inverse, se3_log
from frontends.measurements import AbsoluteFix, FloatArray, Verdict
from lunar_fg.graph.anchors import Anchor, fix_factor, height_factor, relative_factor
from lunar_fg.graph.ballot import Choice
from lunar_fg.graph.keyframe import floored
from lunar_fg.graph.ledger import LedgerEntry, LoopClosure, MapMeasurement, Ruling
from lunar_fg.graph.planar import (
    Planar,
    carried,
    mahalanobis_squared,
    planar_of,
    turn,
    wrapped,
)

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
class Case:
    """A measurement under judgement."""

    number: int
    name: str
    measurement: MapMeasurement
    ordinal: int
    anchor: Anchor
    places: tuple[Planar, ...] = ()
    base: int | None = None
    #: A loop closure's distance in roll, pitch and height, sigmas; past the gate no vote helps.
    off_plane: float = 0.0
    barred: bool = False
    #: Factor of one of its places.
    factor: Callable[[int], gtsam.NonlinearFactor] | None = None
    #: Factor of a fix's height, where that fits; it goes with the best place.
    height: gtsam.NonlinearFactor | None = None
    chosen: Choice = None
    #: A person's word: a place, or `NONE`.
    overruled: int | None = None
    distance: FloatArray = field(default_factory=lambda: np.empty(0))
    history: list[Ruling] = field(default_factory=list)

    def entry(self) -> LedgerEntry:
        """As the ledger has it."""
        return LedgerEntry(self.number, self.measurement, tuple(self.history))

    def exchange(self, choice: Choice) -> tuple[dict[str, gtsam.NonlinearFactor], list[str]]:
        """Factors by name that enter the graph, and names of those that leave, for a choice."""
        assert self.factor is not None
        entering: dict[str, gtsam.NonlinearFactor] = {}
        leaving: list[str] = []
        height = f"height of {self.name}"
        if self.chosen is not None:
            leaving.append(f"{self.name}, place {self.chosen}")
            if self.chosen == 0 and self.height is not None:
                leaving.append(height)
        if choice is not None:
            entering[f"{self.name}, place {choice}"] = self.factor(choice)
            if choice == 0 and self.height is not None:
                entering[height] = self.height
        return entering, leaving

    def ruling(
        self, now: int, number: int, barrier: float, failure: str = "", gated: float | None = None
    ) -> Ruling:
        """Put the verdict that holds into words.

        Parameters
        ----------
        now, number
            Latest frame, and number of the ruling.
        barrier
            Squared distance past which a place is not believed.
        failure
            Why the graph could not take it.
        gated
            Distance from the prediction when it came, sigmas.
        """
        accepted = self.chosen is not None
        places = self.distance
        nearest = float(np.nanmin(places)) if np.isfinite(places).any() else float("nan")
        square = nearest if self.chosen is None else float(places[self.chosen])
        distance, gate = float(np.sqrt(square)), float(np.sqrt(barrier))
        if failure:
            reason = failure
        elif self.overruled is not None:
            reason = f"{'accepted' if accepted else 'rejected'} by a person"
        elif self.barred:
            reason = f"{self.off_plane:.1f} sigma off in roll, pitch and height"
        elif self.history:
            reason = (
                f"{'let in' if accepted else 'taken back'}: {distance:.1f} sigma from what the "
                f"path and the other fixes say now"
            )
        else:
            reason = f"{distance:.1f} sigma from what the path and the other fixes say"
            if gated is not None and (gated <= gate) != accepted:
                reason += f"; {gated:.1f} from the prediction, before the vote"
        if not accepted and not failure and self.overruled is None:
            reason += f" (gate {gate:.1f})"
        verdict = Verdict.ACCEPTED if accepted else Verdict.REFUSED
        by_person = self.overruled is not None
        return Ruling(now, verdict, self.chosen, distance, reason, number, by_person)


def fix_case(
    graph: FixGraph, number: int, fix: AbsoluteFix, ordinal: int, height_gate: float
) -> Case:
    """Hold a checked fix, with a place or more, against the predicted marginal.

    Raises
    ------
    EstimationError
        Its keyframe cannot be solved for.
    """
    name = f"fix {fix.frame}"
    anchor = graph.anchor(ordinal)
    pose, covariance = graph.at(ordinal)
    places = tuple(
        Planar(np.array([c.x_m, c.y_m, wrapped(c.yaw_rad)]), np.asarray(c.covariance))
        for c in fix.candidates
    )
    case = Case(number, name, fix, ordinal, anchor, places)
    case.factor = lambda c: fix_factor(anchor, places[c], pose, f"keyframe {fix.frame}")
    predicted = planar_of(pose, covariance)
    case.distance = np.array([mahalanobis_squared(place, predicted) for place in places])
    if fix.height_m is not None and fix.sigma_height_m is not None:
        off = height_off(fix.height_m, fix.sigma_height_m, pose, covariance)
        if off <= height_gate:
            case.height = height_factor(anchor, fix.height_m, fix.sigma_height_m, pose)
    return case


def closure_case(
    graph: FixGraph, number: int, closure: LoopClosure, base: int, ordinal: int, barrier: float
) -> Case:
    """Hold a checked loop closure between two keyframes against the path.

    Raises
    ------
    EstimationError
        A keyframe cannot be solved for.
    """
    # The later one first: it may close the open segment.
    anchor, base_anchor = graph.anchor(ordinal), graph.anchor(base)
    pose, _ = graph.at(base)
    tilt = np.eye(4)
    tilt[:3, :3] = pose[:3, :3]
    tilt[:2, :3] = turn(np.arctan2(pose[1, 0], pose[0, 0])).T @ pose[:2, :3]
    covariance = floored(closure.covariance)
    place = planar_of(tilt @ closure.a_T_b, covariance)
    name = f"closure {closure.base} to {closure.frame}"
    case = Case(number, name, closure, ordinal, anchor, (place,), base)
    case.factor = lambda _: relative_factor(base_anchor, anchor, closure.a_T_b, covariance, name)
    case.off_plane = _off_plane(closure.a_T_b, covariance, *graph.between(base, ordinal))
    case.barred = case.off_plane**2 > barrier
    # Taken as independent: the vote knows better.
    seen = carried(planar_of(*graph.at(base)), place)
    case.distance = np.array([mahalanobis_squared(seen, planar_of(*graph.at(ordinal)))])
    return case


def _off_plane(
    a_T_b: FloatArray, noise: FloatArray, predicted: FloatArray, covariance: FloatArray
) -> float:
    """Distance, in sigmas, of a measured motion from a predicted one in what no map fixes."""
    off = se3_log(inverse(a_T_b) @ predicted)[_OFF_PLANE]
    spread = (noise + covariance)[np.ix_(_OFF_PLANE, _OFF_PLANE)]
    return float(np.sqrt(off @ np.linalg.solve(spread, off)))


def height_off(z_m: float, sigma_m: float, pose: FloatArray, covariance: FloatArray) -> float:
    """Squared distance, in sigmas, of a height from a predicted pose."""
    up = pose[2, :3]
    variance = float(up @ covariance[3:, 3:] @ up) + sigma_m**2
    return float((z_m - pose[2, 3]) ** 2 / variance)
