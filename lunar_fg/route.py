"""The planned route and where the rover is on it (paper, 2.3 and figure 7).

The corridor is everything within `half_width_m` of the route. Whether the rover is in it is a
probability, since its position is a Gaussian: the share of a fixed low-discrepancy sample of
that Gaussian that lies outside, which holds at bends as well as on straights.
"""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from scipy.stats import norm, qmc

from frontends.errors import InputError
from frontends.measurements import Estimate
from lunar_fg.covariance_growth import CovarianceGrowth

FloatArray = NDArray[np.float64]

logger = logging.getLogger("lunar_fg.route")

#: Points of the sample: a probability is known to about a thousandth.
_SAMPLE = 1024


class RouteConfig(BaseModel):
    """When a drive along a planned route calls for attention.

    Attributes
    ----------
    half_width_m
        Of the corridor, to each side; a route's own ``half_width_m`` goes before it.
    bound_m
        What 3 sigma of the position, along or across the route, must not exceed.
    alarm_probability
        Of being outside the corridor, above which it is said.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    half_width_m: float = Field(default=5.0, gt=0.0)
    bound_m: float = Field(default=5.0, gt=0.0)
    alarm_probability: float = Field(default=0.05, gt=0.0, lt=1.0)


@dataclass(frozen=True, slots=True, eq=False)
class PlannedRoute:
    """A polyline in the map frame.

    Attributes
    ----------
    points_m
        (M, 2), M at least 2, successive ones apart.
    half_width_m
        Of its corridor; None to take the configured one.
    name
        For texts.
    """

    points_m: FloatArray
    half_width_m: float | None = None
    name: str = "route"

    def __post_init__(self) -> None:
        """Check the points."""
        points = np.asarray(self.points_m, dtype=np.float64)
        object.__setattr__(self, "points_m", points)
        if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
            raise InputError("needs finite points (M, 2)", source=self.name, field="points_m")
        if len(points) < 2 or (np.linalg.norm(np.diff(points, axis=0), axis=1) <= 0.0).any():
            raise InputError("needs two or more points, no two in a row equal", source=self.name)

    @property
    def stations_m(self) -> FloatArray:
        """(M,) distance along the route of each point."""
        steps = np.linalg.norm(np.diff(self.points_m, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def length_m(self) -> float:
        """Length of the route."""
        return float(self.stations_m[-1])


@dataclass(frozen=True, slots=True)
class RouteState:
    """Where the rover is on its route after one frame.

    Attributes
    ----------
    frame, stamp_s
        Of the estimate.
    station_m, remaining_m
        Along the route to the nearest point, and from there to its end.
    cross_track_m, sigma_cross_m
        Distance from the route, positive to its left, 1-sigma.
    along_track_m, sigma_along_m
        Progress along the route less distance driven since the first frame (negative after
        a detour), and the 1-sigma of the position along the route.
    outside_probability
        Of being outside the corridor.
    range_m
        Distance until 3 sigma exceeds the bound, straight on, without a fix; infinite when
        the covariance does not grow, NaN while its growth is not known yet.
    """

    frame: int
    stamp_s: float
    station_m: float
    remaining_m: float
    cross_track_m: float
    sigma_cross_m: float
    along_track_m: float
    sigma_along_m: float
    outside_probability: float
    range_m: float


@dataclass(frozen=True, slots=True)
class RouteSummary:
    """A whole drive along its route, for ``metrics.json``."""

    length_m: float
    half_width_m: float
    bound_m: float
    station_m: float
    cross_track_max_m: float
    outside_probability_max: float
    range_m: float | None
    alarms: tuple[str, ...]


class RouteMonitor:
    """Watches estimates against the planned route and says when attention is due.

    Parameters
    ----------
    route
        In the map frame of the estimates.
    config
        Corridor, bound and alarm probability.
    """

    def __init__(self, route: PlannedRoute, config: RouteConfig | None = None) -> None:
        self.route = route
        self.config = config or RouteConfig()
        self.half_width_m = route.half_width_m or self.config.half_width_m
        self.states: list[RouteState] = []
        self.alarms: list[str] = []
        self._line = shapely.LineString(route.points_m)
        shapely.prepare(self._line)
        uniform = qmc.Sobol(2, scramble=False).random(_SAMPLE) + 0.5 / _SAMPLE
        self._normal: FloatArray = norm.ppf(uniform)
        self._driven_m = 0.0
        self._last: Estimate | None = None
        self._growth = CovarianceGrowth()
        self._outside = self._short = False

    def observe(self, estimate: Estimate) -> RouteState:
        """Take in the estimate of the next frame."""
        start_m = self.states[0].station_m if self.states else None
        if self._last is not None:
            self._driven_m += self._growth.observe(self._last, estimate)
        self._last = estimate
        position = estimate.map_T_rover[:2, 3]
        covariance, yaw_variance, yaw_cross = _planar(estimate)
        spread = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
        station, foot, along = self._locate(position, 3.0 * spread)
        left = np.array([-along[1], along[0]])
        variance_c, variance_a = left @ covariance @ left, along @ covariance @ along
        state = RouteState(
            estimate.index,
            estimate.stamp_s,
            station,
            self.route.length_m - station,
            float(left @ (position - foot)),
            float(np.sqrt(variance_c)),
            0.0 if start_m is None else station - start_m - self._driven_m,
            float(np.sqrt(variance_a)),
            self._outside_probability(position, covariance),
            self._growth.range_m(
                self.config.bound_m,
                (float(variance_a), float(variance_c), yaw_variance, float(left @ yaw_cross)),
            ),
        )
        self.states.append(state)
        self._judge(state)
        return state

    def summary(self) -> RouteSummary:
        """Figures of the drive so far."""
        last = self.states[-1] if self.states else None
        range_m = float("nan") if last is None else last.range_m
        return RouteSummary(
            self.route.length_m,
            self.half_width_m,
            self.config.bound_m,
            0.0 if last is None else last.station_m,
            max((abs(state.cross_track_m) for state in self.states), default=0.0),
            max((state.outside_probability for state in self.states), default=0.0),
            range_m if np.isfinite(range_m) else None,
            tuple(self.alarms),
        )

    def _locate(self, position: FloatArray, slack_m: float) -> tuple[float, FloatArray, FloatArray]:
        """Station, foot point and direction: near the last station where routes cross."""
        points, stations = self.route.points_m, self.route.stations_m
        steps = np.diff(points, axis=0)
        lengths = np.diff(stations)
        t = np.einsum("ij,ij->i", position - points[:-1], steps) / lengths**2
        t = np.clip(t, 0.0, 1.0)
        feet = points[:-1] + t[:, None] * steps
        distance = np.linalg.norm(position - feet, axis=1)
        at = stations[:-1] + t * lengths
        best = int(np.argmin(distance))
        if self.states:
            reach = slack_m + self.half_width_m
            near = np.abs(at - self.states[-1].station_m) <= reach
            if near.any():
                candidate = int(np.argmin(np.where(near, distance, np.inf)))
                # Unless the rover has plainly joined another part of its route.
                if distance[candidate] <= distance[best] + reach:
                    best = candidate
        return float(at[best]), feet[best], np.asarray(steps[best] / lengths[best])

    def _outside_probability(self, position: FloatArray, covariance: FloatArray) -> float:
        values, vectors = np.linalg.eigh(covariance)
        sample = position + (self._normal * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
        inside = shapely.dwithin(self._line, shapely.points(sample), self.half_width_m)
        return float(1.0 - np.mean(inside))

    def _judge(self, state: RouteState) -> None:
        """Say once when a limit is passed, and again after it has been kept for a while."""
        where = f"frame {state.frame}, {state.station_m:.1f} m along {self.route.name}"
        outside = state.outside_probability > self.config.alarm_probability
        if outside and not self._outside:
            self._say(
                f"{where}: outside the corridor of +-{self.half_width_m:g} m with a probability "
                f"of {state.outside_probability:.0%} (cross-track {state.cross_track_m:+.2f} m, "
                f"1-sigma {state.sigma_cross_m:.2g} m)"
            )
        short = state.range_m < state.remaining_m
        if short and not self._short:
            self._say(
                f"{where}: 3 sigma exceeds {self.config.bound_m:g} m after another "
                f"{state.range_m:.0f} m, and {state.remaining_m:.0f} m are left: "
                "an absolute fix is needed on the way"
            )
        self._outside, self._short = outside, short

    def _say(self, text: str) -> None:
        self.alarms.append(text)
        logger.warning(text)


def states_text(states: Sequence[RouteState]) -> str:
    """CSV of the states, a row a frame."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, [f.name for f in fields(RouteState)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(state) for state in states)
    return buffer.getvalue()


def route_columns(path: Path) -> dict[str, FloatArray] | None:
    """Columns of the CSV that `states_text` made; None where there is none, or it is damaged."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        names = [field.name for field in fields(RouteState)]
        return {name: np.array([float(row[name]) for row in rows]) for name in names}
    except (OSError, ValueError, KeyError, TypeError, csv.Error):
        return None


def _planar(estimate: Estimate) -> tuple[FloatArray, float, FloatArray]:
    """Covariance of x and y, variance of the yaw, covariance of both; map axes."""
    turn = np.kron(np.eye(2), estimate.map_T_rover[:3, :3])
    matrix = turn @ estimate.covariance @ turn.T
    return matrix[3:5, 3:5], float(matrix[2, 2]), matrix[3:5, 2]
