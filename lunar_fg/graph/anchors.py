"""Map measurements on any keyframe: on a pose of the graph, or on one between two of them.

A map fixes x, y, yaw and height in its own axes, a pose of the graph moves in the rover's; a
level prior on the pose would confuse the two wherever the rover is tilted. These factors have
the analytic derivative, so that a correlation of position and yaw is kept too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from frontends.geometry import adjoint, inverse, se3_log
from frontends.measurements import FloatArray
from lunar_fg.graph.factors import between_factor, gaussian
from lunar_fg.graph.planar import Planar, planar, planar_jacobian, wrapped
from lunar_fg.graph.spread import Spread


@dataclass(frozen=True, slots=True)
class Anchor:
    """Where in the graph a keyframe is: its own pose, or two ends and how it follows them."""

    keys: tuple[int, ...]
    spread: Spread | None = None

    def pose(self, values: gtsam.Values) -> FloatArray:
        """(4, 4) of the keyframe."""
        return self.at({key: np.asarray(values.atPose3(key).matrix()) for key in self.keys})

    def at(self, map_T: Mapping[int, FloatArray]) -> FloatArray:
        """(4, 4) of the keyframe, from the poses of its keys."""
        ends = [map_T[key] for key in self.keys]
        return ends[0] if self.spread is None else self.spread.pose(ends[0], ends[1])

    def by_keys(self) -> FloatArray:
        """Derivative of its pose by those of `keys`, (6, 6 k)."""
        return np.eye(6) if self.spread is None else self.spread.by_ends()

    def rest(self) -> FloatArray:
        """(6, 6) covariance that the keys do not explain."""
        return np.zeros((6, 6)) if self.spread is None else self.spread.rest


def fix_factor(
    anchor: Anchor, place: Planar, map_T_rover: FloatArray, source: str
) -> gtsam.CustomFactor:
    """x, y and yaw of a keyframe in map axes, correlated as `place` says.

    `map_T_rover` is about where the keyframe is.
    """
    jacobian = planar_jacobian(map_T_rover)
    rest = jacobian @ anchor.rest() @ jacobian.T
    noise = gaussian(place.covariance + rest, source, "covariance")
    by_keys = anchor.by_keys()

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        pose = anchor.pose(values)
        if jacobians is not None:
            _fill(jacobians, planar_jacobian(pose) @ by_keys)
        result = planar(pose) - place.xyyaw
        result[2] = wrapped(result[2])
        return np.asarray(result)

    return gtsam.CustomFactor(noise, list(anchor.keys), error)


def height_factor(
    anchor: Anchor, height_m: float, sigma_m: float, map_T_rover: FloatArray
) -> gtsam.CustomFactor:
    """Height of a keyframe in the map."""
    up = np.concatenate([np.zeros(3), map_T_rover[2, :3]])
    sigma = float(np.sqrt(sigma_m**2 + up @ anchor.rest() @ up))
    noise, by_keys = gtsam.noiseModel.Isotropic.Sigma(1, sigma), anchor.by_keys()

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        pose = anchor.pose(values)
        if jacobians is not None:
            _fill(jacobians, np.concatenate([np.zeros(3), pose[2, :3]])[None] @ by_keys)
        return np.array([pose[2, 3] - height_m])

    return gtsam.CustomFactor(noise, list(anchor.keys), error)


def motion_between(
    first: Anchor, second: Anchor, map_T: Mapping[int, FloatArray], joint: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Motion between two keyframes as the whole graph has it, and its covariance.

    Parameters
    ----------
    first, second
        Where they are.
    map_T
        (4, 4) poses by key, of all their keys.
    joint
        (6 n, 6 n) joint covariance of these n keys, in the order of `map_T`.

    Returns
    -------
    tuple of FloatArray
        (4, 4) pose of the second in the first, and (6, 6), axes of the second.
    """
    motion = inverse(first.at(map_T)) @ second.at(map_T)
    back = adjoint(inverse(motion))
    whole = np.zeros((6, 6 * len(map_T)))
    keys = list(map_T)
    for anchor, by in ((first, -back @ first.by_keys()), (second, second.by_keys())):
        for i, key in enumerate(anchor.keys):
            at = 6 * keys.index(key)
            whole[:, at : at + 6] += by[:, 6 * i : 6 * i + 6]
    covariance = whole @ joint @ whole.T + back @ first.rest() @ back.T + second.rest()
    return motion, 0.5 * (covariance + covariance.T)


def _fill(jacobians: list[FloatArray], whole: FloatArray) -> None:
    for i in range(whole.shape[1] // 6):
        jacobians[i] = np.asfortranarray(whole[:, 6 * i : 6 * i + 6])


def relative_factor(
    first: Anchor, second: Anchor, a_T_b: FloatArray, covariance: FloatArray, source: str
) -> gtsam.NonlinearFactor:
    """Motion between any two keyframes, covariance in the axes of the second."""
    if first.spread is None and second.spread is None:
        return between_factor(first.keys[0], second.keys[0], a_T_b, covariance, source)
    back = adjoint(inverse(a_T_b))
    rest = back @ first.rest() @ back.T + second.rest()
    noise = gaussian(covariance + rest, source, "covariance")
    keys = list(dict.fromkeys((*first.keys, *second.keys)))
    by_first, by_second = first.by_keys(), second.by_keys()

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        measured = inverse(first.pose(values)) @ second.pose(values)
        off = se3_log(inverse(a_T_b) @ measured)
        if jacobians is not None:
            whole = np.zeros((6, 6 * len(keys)))
            # The error is small where it counts: its own logarithm's derivative is taken as one.
            for anchor, by in ((first, -adjoint(inverse(measured)) @ by_first),
                               (second, by_second)):  # fmt: skip
                for i, key in enumerate(anchor.keys):
                    at = 6 * keys.index(key)
                    whole[:, at : at + 6] += by[:, 6 * i : 6 * i + 6]
            _fill(jacobians, whole)
        return off

    return gtsam.CustomFactor(noise, keys, error)
