"""The part of a pose that a map fixes: x, y and yaw, in map axes."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from frontends.measurements import FloatArray

_LEAST_SIGMA = (1e-4, 1e-4, 1e-6)
_QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
_LEAST_LEVEL_SHARE = 1e-9


@dataclass(frozen=True, slots=True)
class Planar:
    """x, y (m), yaw (rad) and their covariance (3, 3), both in the axes they are given in."""

    xyyaw: FloatArray
    covariance: FloatArray


def planar(map_T_rover: FloatArray) -> FloatArray:
    """x, y and yaw (ccw from map x) of a pose, (3,)."""
    yaw = np.arctan2(map_T_rover[1, 0], map_T_rover[0, 0])
    return np.array([map_T_rover[0, 3], map_T_rover[1, 3], yaw])


def planar_jacobian(map_T_rover: FloatArray) -> FloatArray:
    """Derivative of x, y, yaw by a right perturbation of the pose, (3, 6)."""
    rotation = map_T_rover[:3, :3]
    cosine, sine = rotation[0, 0], rotation[1, 0]
    level = max(cosine * cosine + sine * sine, _LEAST_LEVEL_SHARE)
    result = np.zeros((3, 6))
    result[:2, 3:] = rotation[:2]
    result[2, 1] = (sine * rotation[0, 2] - cosine * rotation[1, 2]) / level
    result[2, 2] = (cosine * rotation[1, 1] - sine * rotation[0, 1]) / level
    return result


def planar_of(map_T_rover: FloatArray, covariance: FloatArray) -> Planar:
    """Planar part of a pose and of its covariance (6, 6, rover axes)."""
    jacobian = planar_jacobian(map_T_rover)
    return Planar(planar(map_T_rover), jacobian @ covariance @ jacobian.T)


def turn(yaw_rad: float) -> FloatArray:
    """Rotation by a yaw, (2, 2)."""
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[cosine, -sine], [sine, cosine]])


def turned(covariance: FloatArray, yaw_rad: float) -> FloatArray:
    """Covariance of (x, y, yaw) along axes that are turned by `yaw_rad` from its own."""
    back = np.eye(3)
    back[:2, :2] = turn(yaw_rad).T
    return np.asarray(back @ covariance @ back.T)


def wrapped(angle_rad: float) -> float:
    """Angle in (-pi, pi]."""
    return float(np.arctan2(np.sin(angle_rad), np.cos(angle_rad)))


def composed(a: FloatArray, b: FloatArray) -> FloatArray:
    """Planar pose `b`, given in `a`, in the axes that `a` is given in; (3,)."""
    result = np.asarray(a + b)
    result[:2] = a[:2] + turn(a[2]) @ b[:2]
    return result


def carried(a: Planar, a_to_b: Planar) -> Planar:
    """Planar pose of `b` from independent `a` and motion ``a_to_b`` (axes of `a`)."""
    by_a, by_motion = np.eye(3), np.eye(3)
    by_motion[:2, :2] = turn(a.xyyaw[2])
    by_a[:2, 2] = by_motion[:2, :2] @ _QUARTER_TURN @ a_to_b.xyyaw[:2]
    return Planar(
        composed(a.xyyaw, a_to_b.xyyaw),
        by_a @ a.covariance @ by_a.T + by_motion @ a_to_b.covariance @ by_motion.T,
    )


@dataclass(frozen=True, slots=True)
class _Link:
    """Keyframes that were measured together.

    Poses (n, 3) in the level axes of the first, and their joint covariance (3n, 3n), in which
    the first is exact.
    """

    begin: int
    xyyaw: FloatArray
    covariance: FloatArray


class PlanarChain:
    """The path by the rover's own measurements alone, no fix in it, as planar motions.

    Parameters
    ----------
    scale_sigma
        Share by which all of it may be too long; see `lunar_fg.graph.scale`.
    """

    def __init__(self, scale_sigma: float = 0.0) -> None:
        self._scale_sigma = scale_sigma
        self._links: list[_Link] = []
        self._begins: list[int] = []

    @property
    def end(self) -> int:
        """Ordinal of the last keyframe in the chain."""
        return self._links[-1].begin + len(self._links[-1].xyyaw) - 1 if self._links else 0

    def add(
        self, map_T_first: FloatArray, first_T_rover: FloatArray, covariance: FloatArray
    ) -> None:
        """Append keyframes that were measured together.

        Parameters
        ----------
        map_T_first
            (4, 4) of the keyframe that ends the chain so far; roll and pitch are taken.
        first_T_rover
            (n, 4, 4); the first is the identity.
        covariance
            (6 (n-1), 6 (n-1)) of all but the first, each in its own rover axes.
        """
        tilt = map_T_first.copy()
        tilt[:3, 3] = 0.0
        tilt[:2, :3] = turn(planar(map_T_first)[2]).T @ map_T_first[:2, :3]
        poses = tilt @ first_T_rover
        n = len(poses)
        jacobian = np.zeros((3 * n, 6 * (n - 1)))
        for i in range(1, n):
            jacobian[3 * i : 3 * i + 3, 6 * i - 6 : 6 * i] = planar_jacobian(poses[i])
        joint = jacobian @ covariance @ jacobian.T
        self._begins.append(self.end)
        self._links.append(
            _Link(self._begins[-1], np.array([planar(pose) for pose in poses]), joint)
        )

    def between(self, first: int, second: int) -> Planar:
        """Motion from one keyframe to a later one, in the level axes of the first.

        Where an end lies within a link, its two parts are taken as independent.
        """
        total = Planar(np.zeros(3), np.zeros((3, 3)))
        at = bisect_right(self._begins, first) - 1
        while at < len(self._links) and self._links[at].begin < second:
            link = self._links[at]
            last = len(link.xyyaw) - 1
            total = carried(
                total, _within(link, max(first - link.begin, 0), min(second - link.begin, last))
            )
            at += 1
        covariance = total.covariance + np.diag(np.square(_LEAST_SIGMA))
        by_scale = self._scale_sigma * total.xyyaw[:2]
        covariance[:2, :2] += np.outer(by_scale, by_scale)
        return Planar(total.xyyaw, covariance)


def _within(link: _Link, a: int, b: int) -> Planar:
    end = slice(3 * b, 3 * b + 3)
    if a == 0:
        return Planar(link.xyyaw[b], link.covariance[end, end])
    begin = slice(3 * a, 3 * a + 3)
    back = np.eye(3)
    back[:2, :2] = turn(link.xyyaw[a, 2]).T
    offset = link.xyyaw[b] - link.xyyaw[a]
    by_a = -np.eye(3)
    by_a[:2, 2] = -_QUARTER_TURN @ offset[:2]
    joint = np.block(
        [
            [link.covariance[begin, begin], link.covariance[begin, end]],
            [link.covariance[end, begin], link.covariance[end, end]],
        ]
    )
    jacobian = back @ np.hstack([by_a, np.eye(3)])
    return Planar(back @ offset, jacobian @ joint @ jacobian.T)


def updated(prior: Planar, measured: Planar) -> Planar:
    """Planar pose from two independent ones of the same keyframe, map axes."""
    off = measured.xyyaw - prior.xyyaw
    off[2] = wrapped(off[2])
    gain = np.linalg.solve(prior.covariance + measured.covariance, prior.covariance).T
    covariance = prior.covariance - gain @ prior.covariance
    return Planar(prior.xyyaw + gain @ off, 0.5 * (covariance + covariance.T))


def mahalanobis_squared(place: Planar, predicted: Planar) -> float:
    """Squared Mahalanobis distance of a measured place from an independent prediction."""
    off = place.xyyaw - predicted.xyyaw
    off[2] = wrapped(off[2])
    return float(off @ np.linalg.solve(place.covariance + predicted.covariance, off))
