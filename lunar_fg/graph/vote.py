"""Which of many map measurements are true: graduated non-convexity on the fix keyframes alone.

The path between two fix keyframes is one planar motion, known to be true up to its covariance;
the start is known too. Places in the map, and loop-closing motions, are claims: each is true or
it is not, and of the claims of one group at most one is. What is sought is the least truncated
cost (truncated least squares, TLS),

    sum of chi-square of what is known + sum over groups of min(chi-square, barrier),

by graduated non-convexity (Yang et al. 2020, GTSAM's `GncLMOptimizer`), then by single changes
that still lower the cost. The barrier is the gate's: a claim that stands alone is believed if
and only if it passes the chi-square gate. What was believed until now, and what gates one after
another would believe, are improved in the same way; of the three the cheapest is taken, where
false ones that agree with each other count once (`stories`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from frontends.errors import EstimationError
from frontends.measurements import FloatArray
from lunar_fg.graph.planar import (
    Planar,
    carried,
    mahalanobis_squared,
    turned,
    updated,
    wrapped,
)
from lunar_fg.graph.stories import Refused, refused_cost

#: With a larger sigma, rad, a yaw is as good as not measured.
_NO_YAW_SIGMA = 0.5
_REST_FLOOR = 1e-9
_MOST_CHANGES_EACH = 3
_GTSAM_ERRORS = (RuntimeError, ValueError, IndexError, KeyError)

Choice = int | None
#: No claim of a group is true.
NONE = -1


@dataclass(frozen=True, slots=True)
class Claim:
    """A place of a station in map axes; or, with `base`, its motion from that earlier station."""

    station: int
    place: Planar
    base: int | None = None


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


@dataclass(frozen=True, slots=True)
class _Solved:
    values: gtsam.Values
    covariance: FloatArray
    #: Chi-square of what is known and of what is believed; `cost` has the barriers too.
    fit: float
    cost: float
    distance: tuple[FloatArray, ...]


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
        self._known = gtsam.NonlinearFactorGraph()
        self._initial = gtsam.Values()
        here = ballot.start
        self._known.add(_place_factor(0, here))
        self._initial.insert(0, gtsam.Pose2(*here.xyyaw))
        for i, motion in enumerate(ballot.motions, start=1):
            self._known.add(_motion_factor(i - 1, i, motion))
            here = carried(here, motion)
            self._initial.insert(i, gtsam.Pose2(*here.xyyaw))
        self._stations = len(ballot.motions) + 1
        self._factors = [[self._factor(claim) for claim in g.claims] for g in ballot.groups]

    def _factor(self, claim: Claim) -> gtsam.NoiseModelFactor:
        if claim.base is not None:
            return _motion_factor(claim.base, claim.station, claim.place)
        place = claim.place
        if np.sqrt(place.covariance[2, 2]) > _NO_YAW_SIGMA:
            # A yaw far from the truth would bend the error of x and y: take the path's.
            covariance, xyyaw = place.covariance.copy(), place.xyyaw.copy()
            covariance[2, :2] = covariance[:2, 2] = 0.0
            xyyaw[2] = self._initial.atPose2(claim.station).theta()
            place = Planar(xyyaw, covariance)
        return _place_factor(claim.station, place)

    def decide(self, incumbent: Sequence[Choice]) -> Outcome:
        """Judge all groups; `incumbent` is what was believed until now."""
        kept = [g.allowed(choice) for g, choice in zip(self._groups, incumbent, strict=True)]
        best, seen = self._improved(kept), set()
        seen.add(best.chosen)
        for start in (self._graduated(), self._gated()):
            if start is None or tuple(start) in seen:
                continue
            other = self._improved(start)
            seen.add(other.chosen)
            # The incumbent stays where nothing is better by more than rounding.
            if other.cost < best.cost - 1e-6:
                best = other
        return best

    def _gated(self) -> list[Choice]:
        """Believe what passes the gate, one station after the other from the start."""
        here, at = self._ballot.start, 0
        chosen = [group.allowed(None) for group in self._groups]
        order = sorted(range(len(chosen)), key=lambda g: _station(self._groups[g]))
        for g in order:
            group = self._groups[g]
            if not group.claims or any(claim.base is not None for claim in group.claims):
                continue
            while at < _station(group):
                here, at = carried(here, self._ballot.motions[at]), at + 1
            if group.forced is None:
                distance = [mahalanobis_squared(claim.place, here) for claim in group.claims]
                nearest = int(np.argmin(distance))
                chosen[g] = nearest if distance[nearest] <= self._barrier else None
            choice = chosen[g]
            if choice is not None:
                here = updated(here, group.claims[choice].place)
        return chosen

    def _graduated(self) -> list[Choice] | None:
        graph, members = gtsam.NonlinearFactorGraph(self._known), []
        known = list(range(graph.size()))
        for g, (group, factors) in enumerate(zip(self._groups, self._factors, strict=True)):
            for c, factor in enumerate(factors):
                if group.forced is None or group.forced == c:
                    if group.forced == c:
                        known.append(graph.size())
                    members.append((graph.size(), g, c))
                    graph.add(factor)
        lm = gtsam.LevenbergMarquardtParams()
        lm.setLinearSolverType("MULTIFRONTAL_QR")
        params = gtsam.GncLMParams(lm)
        params.setLossType(gtsam.GncLossType.TLS)
        params.setKnownInliers(known)
        try:
            optimizer = gtsam.GncLMOptimizer(graph, self._initial, params)
            # GTSAM's cost is half the chi-square.
            optimizer.setInlierCostThresholds(0.5 * self._barrier)
            values = optimizer.optimize()
            weights = np.asarray(optimizer.getWeights())
        except _GTSAM_ERRORS:
            return None
        chosen = [group.allowed(None) for group in self._groups]
        least: dict[int, float] = {}
        for i, g, c in members:
            if self._groups[g].forced is None and weights[i] > 0.5:
                cost = float(graph.at(i).error(values))
                if cost < least.get(g, np.inf):
                    least[g], chosen[g] = cost, c
        return chosen

    def _improved(self, chosen: list[Choice]) -> Outcome:
        """Change one verdict at a time while that lowers the cost."""
        solved = self._solve(chosen, self._initial)
        for _ in range(_MOST_CHANGES_EACH * max(len(chosen), 1)):
            gains = [self._gain(g, chosen[g], solved.distance[g]) for g in range(len(chosen))]
            best = int(np.argmax([gain for gain, _ in gains])) if gains else -1
            if best < 0 or gains[best][0] <= 1e-6:
                break
            changed = list(chosen)
            changed[best] = gains[best][1]
            after = self._solve(changed, solved.values)
            if after.cost >= solved.cost:
                break
            chosen, solved = changed, after
        return Outcome(tuple(chosen), solved.distance, self._cost(chosen, solved))

    def _cost(self, chosen: Sequence[Choice], solved: _Solved) -> float:
        """Truncated cost in which refused places that agree with each other count once."""
        group, station, off, covariance = [], [], [], []
        alone = 0
        for g, (choice, members) in enumerate(zip(chosen, self._groups, strict=True)):
            if choice is not None:
                continue
            places = [claim for claim in members.claims if claim.base is None]
            alone += not places
            for claim in places:
                pose = solved.values.atPose2(claim.station)
                gap = claim.place.xyyaw - [pose.x(), pose.y(), pose.theta()]
                group.append(g)
                station.append(claim.station)
                off.append([gap[0], gap[1], wrapped(gap[2])])
                covariance.append(claim.place.covariance)
        if not group:
            return solved.fit + self._barrier * alone
        refused = Refused(np.array(group), np.array(station), np.array(off), np.array(covariance))
        yaw = np.array([solved.values.atPose2(i).theta() for i in range(self._stations)])
        apart = refused_cost(refused, yaw, solved.covariance, self._barrier)
        return solved.fit + self._barrier * alone + apart

    def _gain(self, group: int, chosen: Choice, distance: FloatArray) -> tuple[float, Choice]:
        """What the best other verdict on a group would save, and which that is."""
        if self._groups[group].forced is not None or not len(distance):
            return 0.0, chosen
        now = self._barrier if chosen is None else distance[chosen]
        nearest = int(np.argmin(distance))
        if distance[nearest] < self._barrier:
            return float(now - distance[nearest]), nearest
        return float(now - self._barrier), None

    def _solve(self, chosen: Sequence[Choice], initial: gtsam.Values) -> _Solved:
        graph = gtsam.NonlinearFactorGraph(self._known)
        for factors, c in zip(self._factors, chosen, strict=True):
            if c is not None:
                graph.add(factors[c])
        params = gtsam.LevenbergMarquardtParams()
        params.setLinearSolverType("MULTIFRONTAL_QR")
        try:
            values = gtsam.LevenbergMarquardtOptimizer(graph, initial, params).optimize()
            ordering = gtsam.Ordering()
            for i in range(self._stations):
                ordering.push_back(i)
            information, _ = graph.linearize(values).hessian(ordering)
            covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        except (*_GTSAM_ERRORS, np.linalg.LinAlgError) as error:
            raise EstimationError(f"the fixes cannot be judged ({error})") from error
        out = sum(c is None for c in chosen)
        fit = 2.0 * float(graph.error(values))
        cost = fit + self._barrier * out
        distance = tuple(
            self._distances(factors, c, values, covariance)
            for factors, c in zip(self._factors, chosen, strict=True)
        )
        if not np.isfinite(cost):
            raise EstimationError("the fixes cannot be judged (the cost is not finite)")
        return _Solved(values, covariance, fit, cost, distance)

    def _distances(
        self,
        factors: list[gtsam.NoiseModelFactor],
        chosen: Choice,
        values: gtsam.Values,
        covariance: FloatArray,
    ) -> FloatArray:
        """Innovations of a group's claims against all other groups, each claim by itself."""
        linear = [self._linear(factor, values) for factor in factors]
        shift: FloatArray = np.zeros(0)
        if chosen is not None:
            columns, jacobian, residual = linear[chosen]
            # Take the believed claim out: a rank 3 downdate of covariance and estimate.
            reach = covariance[:, columns] @ jacobian.T
            rest = np.eye(3) - jacobian @ reach[columns]
            rest += _REST_FLOOR * np.eye(3)
            shift = reach @ np.linalg.solve(rest, residual)
            covariance = covariance + reach @ np.linalg.solve(rest, reach.T)
        result = np.empty(len(factors))
        for c, (columns, jacobian, residual) in enumerate(linear):
            spread = np.eye(3) + jacobian @ covariance[np.ix_(columns, columns)] @ jacobian.T
            off = residual if chosen is None else residual + jacobian @ shift[columns]
            result[c] = off @ np.linalg.solve(spread, off)
        return result

    @staticmethod
    def _linear(
        factor: gtsam.NoiseModelFactor, values: gtsam.Values
    ) -> tuple[list[int], FloatArray, FloatArray]:
        """Columns, whitened derivative (3, k) and whitened residual (3,) of a claim."""
        jacobian, target = factor.linearize(values).jacobian()
        columns = [3 * int(key) + i for key in list(factor.keys()) for i in range(3)]
        return columns, np.asarray(jacobian), -np.asarray(target)


def _station(group: Group) -> int:
    return group.claims[0].station if group.claims else 0


def _place_factor(key: int, place: Planar) -> gtsam.PriorFactorPose2:
    noise = gtsam.noiseModel.Gaussian.Covariance(_even(turned(place.covariance, place.xyyaw[2])))
    return gtsam.PriorFactorPose2(key, gtsam.Pose2(*place.xyyaw), noise)


def _motion_factor(first: int, second: int, motion: Planar) -> gtsam.BetweenFactorPose2:
    noise = gtsam.noiseModel.Gaussian.Covariance(_even(turned(motion.covariance, motion.xyyaw[2])))
    return gtsam.BetweenFactorPose2(first, second, gtsam.Pose2(*motion.xyyaw), noise)


def _even(covariance: FloatArray) -> FloatArray:
    return 0.5 * (covariance + covariance.T)
