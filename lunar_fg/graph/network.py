"""A path of planar poses with places and loop-closing motions on it, solved in milliseconds.

GTSAM solves the same graph of Pose2 (the tests hold the two equal); but a vote solves it some
ten times, on a long path each in tens of iterations, and what is voted on must not stall a run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frontends.errors import EstimationError
from frontends.measurements import FloatArray, IntArray
from lunar_fg.graph import kernels
from lunar_fg.graph.planar import Planar

#: With a larger sigma, rad, a yaw is as good as not measured, and tells nothing of x and y.
NO_YAW_SIGMA = 0.5
_NO_YAW_VARIANCE = 1e6
_REST_FLOOR = 1e-9
_MOST_ITERATIONS = 100


def squared(off: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squared Mahalanobis lengths (C,) of vectors (C, 3) with covariances (C, 3, 3)."""
    return kernels.squared_lengths(off, covariance)


@dataclass(frozen=True, slots=True)
class Claim:
    """A place of a station in map axes; or, with `base`, its motion from that earlier station."""

    station: int
    place: Planar
    base: int | None = None


@dataclass(frozen=True, slots=True)
class Path:
    """Where the stations are.

    Attributes
    ----------
    xyyaw
        (n, 3) m, rad, map axes.
    chi_square
        Of what is known and of the claims that were believed.
    """

    xyyaw: FloatArray
    chi_square: float


class Network:
    """Stations, the motions between them, and claims that may be believed or not.

    Parameters
    ----------
    start
        Station 0 as everything before it says, map axes.
    motions
        From each station to the next, in the level axes of the first.
    claims
        What is claimed of the stations.
    """

    def __init__(self, start: Planar, motions: Sequence[Planar], claims: Sequence[Claim]) -> None:
        known = [start, *motions]
        places = [*known, *(claim.place for claim in claims)]
        bases = [-1 if claim.base is None else claim.base for claim in claims]
        base = np.array([*range(-1, len(motions)), *bases], dtype=np.int64)
        station = np.array(
            [*range(len(known)), *(claim.station for claim in claims)], dtype=np.int64
        )
        #: Of the start, the motions and the claims as they are given, (m, 3) and (m, 3, 3).
        self.measured: FloatArray = np.array([place.xyyaw for place in places])
        self.noise: FloatArray = np.array([place.covariance for place in places])
        value, covariance = self.measured, self.noise
        #: (n, 3) by the motions alone.
        self.dead_reckoned: FloatArray = kernels.dead_reckoned(value[: len(known)])
        # Motions into the axes at their end.
        back = np.tile(np.eye(3), (len(base), 1, 1))
        moves, yaw = base >= 0, value[base >= 0, 2]
        back[moves, 0, 0] = back[moves, 1, 1] = np.cos(yaw)
        back[moves, 0, 1] = np.sin(yaw)
        back[moves, 1, 0] = -np.sin(yaw)
        #: (C, 3, 3) of the claims: of places in map axes, of motions in those at their end.
        self.covariance: FloatArray = back @ covariance @ back.transpose(0, 2, 1)
        self.covariance = 0.5 * (self.covariance + self.covariance.transpose(0, 2, 1))
        loose = self.covariance[:, 2, 2] > NO_YAW_SIGMA**2
        self.covariance[loose, 2, :2] = self.covariance[loose, :2, 2] = 0.0
        self.covariance[loose, 2, 2] = _NO_YAW_VARIANCE
        try:
            roots = np.linalg.cholesky(self.covariance)
        except np.linalg.LinAlgError as error:
            raise EstimationError(f"the fixes cannot be judged ({error})") from error
        root = np.ascontiguousarray(np.linalg.inv(roots))
        self._terms = kernels.Terms(base, station, value, root, np.ones(len(base)))
        self._known = len(known)
        self._claims = self._terms.after(self._known)
        self.covariance = self.covariance[self._known :]

    @property
    def station(self) -> IntArray:
        """(C,) of the claims."""
        return self._claims.station

    @property
    def base(self) -> IntArray:
        """(C,) of the claims, -1 for a place."""
        return self._claims.base

    def solve(self, weight: FloatArray, begin: FloatArray) -> Path:
        """Least squares over what is known and the claims, each with its weight (C,).

        Raises
        ------
        EstimationError
            It cannot be solved.
        """
        good, xyyaw, cost = kernels.solve_network(begin, self._weighted(weight), _MOST_ITERATIONS)
        if not good or not np.isfinite(cost):
            raise EstimationError("the fixes cannot be judged (their path has no solution)")
        return Path(xyyaw, cost)

    def path_covariance(self, weight: FloatArray, xyyaw: FloatArray) -> FloatArray:
        """Joint covariance (3n, 3n) of all stations, map axes.

        Raises
        ------
        EstimationError
            There is none.
        """
        good, covariance = kernels.network_covariance(xyyaw, self._weighted(weight))
        if not good:
            raise EstimationError("the fixes cannot be judged (their path has no covariance)")
        return covariance

    def _weighted(self, weight: FloatArray) -> kernels.Terms:
        return self._terms._replace(weight=np.concatenate([np.ones(self._known), weight]))

    def terms(self, xyyaw: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Error of each claim on a path (C, 3), and its derivatives (C, 3, 6).

        By the station, then by the base.
        """
        off, jacobian = kernels.network_terms(xyyaw, self._claims)
        return off, jacobian

    def chi_square(self, xyyaw: FloatArray) -> FloatArray:
        """Of each claim on a path, (C,)."""
        white = np.einsum("cij,cj->ci", self._claims.root, self.terms(xyyaw)[0])
        return np.asarray((white**2).sum(axis=1))

    def innovations(
        self, xyyaw: FloatArray, covariance: FloatArray, believed: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """How far each claim is from what all but its rival say: (C, 3) and covariance (C, 3, 3).

        Parameters
        ----------
        xyyaw, covariance
            (n, 3) and (3n, 3n) with all that is believed.
        believed
            (C,) for each claim the believed one of its group, which may be itself; -1 for none.
        """
        (residual, jacobian), columns = self.terms(xyyaw), self._columns()
        own = covariance[columns[:, :, None], columns[:, None, :]]
        spread = jacobian @ own @ jacobian.transpose(0, 2, 1)
        some = np.flatnonzero(believed >= 0)
        if len(some):
            # Take the believed claim out: a rank 3 downdate of covariance and estimate.
            rival = believed[some]
            cross = covariance[columns[some][:, :, None], columns[rival][:, None, :]]
            reach = jacobian[some] @ cross @ jacobian[rival].transpose(0, 2, 1)
            rest = self.covariance[rival] - spread[rival]
            rest += _REST_FLOOR * self.covariance[rival]
            back = np.linalg.solve(rest, residual[rival][..., None])
            shift = (reach @ back)[..., 0]
            grown = reach @ np.linalg.solve(rest, reach.transpose(0, 2, 1))
            residual[some] += shift
            spread[some] += grown
        return -residual, spread + self.covariance

    def distances(
        self, xyyaw: FloatArray, covariance: FloatArray, believed: IntArray
    ) -> FloatArray:
        """Squared Mahalanobis distances of the `innovations`, (C,)."""
        return squared(*self.innovations(xyyaw, covariance, believed))

    def _columns(self) -> IntArray:
        """(C, 6): of the station, then of the base (for a place those of station 0)."""
        ends = np.stack([self.station, np.maximum(self.base, 0)], axis=1)
        return np.asarray((3 * ends[:, :, None] + np.arange(3)).reshape(-1, 6))
