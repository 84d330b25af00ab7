"""Stereo landmark factors and motions of a few poses, solved together, landmarks eliminated.

The factors are those of GTSAM's GenericStereoFactor3D and BetweenFactorPose3 with Huber's
loss; the solver is Gauss-Newton on the poses after the Schur complement over all landmarks
at once, compiled (`kernels`). For windows of some ten poses it takes a fraction of the time that
GTSAM's per-factor elimination takes (`benchmarks/graph.py`); the tests hold the two equal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frontends.camera import StereoCamera
from frontends.errors import EstimationError
from frontends.geometry import inverse
from frontends.measurements import FloatArray, IntArray
from lunar_fg.graph import kernels
from lunar_fg.graph.tracks import Sightings, homogeneous, lens

#: Rest: a step of this share of the poses' own sigmas, root mean square.
_STEP_SIGMA = 0.02
#: Reweighted least squares falls short of the minimum by a third to a half in each step, and
#: descends with any factor below 2.
_STRETCH = 1.4
_LARGEST_DAMPING = 1e8
_LOOSE = "its measurements do not fix all poses"
#: Step of the derivative by an error of all disparities, px.
_SHIFT_PX = 0.05


@dataclass(frozen=True, slots=True)
class Motion:
    """A measured motion between two poses of the window, with its covariance (6, 6)."""

    first: int
    second: int
    a_T_b: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class Window:
    """What a window holds: each landmark sighted at least twice.

    Attributes
    ----------
    sightings
        All of them, sorted by `landmark`.
    pose, landmark
        (M,) which pose and which landmark (0 ... L-1) each sighting belongs to.
    motions
        Measured motions that are independent of the pixels.
    """

    sightings: Sightings
    pose: IntArray
    landmark: IntArray
    motions: tuple[Motion, ...]


@dataclass(frozen=True, slots=True)
class Adjusted:
    """A solved window.

    Attributes
    ----------
    poses
        (n, 4, 4), the first one unchanged.
    covariance
        (6 (n-1), 6 (n-1)) of all poses but the first, each in its own body axes, relative
        to the first.
    by_disparity
        (6 (n-1),) how they change with an error of all disparities alike, per px.
    chi_square, degrees_of_freedom
        Robust cost doubled, and residuals less unknowns.
    iterations, converged
        Of the solver.
    """

    poses: FloatArray
    covariance: FloatArray
    by_disparity: FloatArray
    chi_square: float
    degrees_of_freedom: int
    iterations: int
    converged: bool


@dataclass(frozen=True, slots=True)
class _System:
    """Where the solver stands: cost, reduced normal equations, what recovers the landmarks.

    The cost is minimised; `unshared` is that of landmarks whose errors have nothing in common.
    """

    cost: float
    unshared: float
    hessian: FloatArray
    gradient: FloatArray
    landmarks: tuple[FloatArray, FloatArray, FloatArray]


class WindowSolver:
    """Gauss-Newton with damping on a failed step, over one `Window`.

    Parameters
    ----------
    camera
        Of all poses.
    window
        The measurements.
    poses
        (n, 4, 4) initial poses of the camera in the window's frame; the first stays.
    robust_threshold_sigma
        Huber's threshold on the whitened residual of a sighting.
    landmark_correlation
        Between the errors of any two landmarks; see `GraphConfig`.
    """

    def __init__(
        self,
        camera: StereoCamera,
        window: Window,
        poses: FloatArray,
        robust_threshold_sigma: float,
        landmark_correlation: float = 0.0,
    ) -> None:
        self._window = window
        self._n = len(poses)
        self._threshold = float(robust_threshold_sigma)
        self._lens = lens(camera)
        self._whiten = kernels.whiteners(window.sightings.covariance)
        first = np.flatnonzero(np.diff(window.landmark, prepend=-1))
        self._starts = np.append(first, len(window.landmark)).astype(np.int64)
        self._share = 1.0 / (1.0 + landmark_correlation * (len(self._starts) - 1))
        motions = window.motions
        self._motion_ends = np.array([[m.first, m.second] for m in motions]).reshape(-1, 2)
        self._motion_back = inverse(_stacked([m.a_T_b for m in motions], 4))
        roots = np.linalg.cholesky(_stacked([m.covariance for m in motions], 6))
        self._motion_roots = np.ascontiguousarray(np.linalg.inv(roots))
        self._poses = poses
        anchored = homogeneous(camera, window.sightings.uuv[first])
        points = np.einsum("lij,lj->li", poses[window.pose[first]], anchored)
        self._points = points / np.linalg.norm(points, axis=1, keepdims=True)

    def _linearise(
        self, poses: FloatArray, points: FloatArray, disparity_px: float = 0.0
    ) -> _System:
        window = self._window
        uuv = window.sightings.uuv
        cost, hessian, gradient, *landmarks = kernels.linearise(
            self._lens,
            inverse(poses),
            points,
            uuv - (0.0, disparity_px, 0.0) if disparity_px else uuv,
            self._whiten,
            window.pose,
            self._starts,
            self._threshold,
        )
        whitened = cost
        cost *= self._share
        hessian *= self._share
        gradient *= self._share
        first, second = self._motion_ends.T.astype(np.int64)
        cost += kernels.add_motions(
            poses, first, second, self._motion_back, self._motion_roots, hessian, gradient
        )
        unshared = cost + (1.0 - self._share) * whitened
        recovery = (landmarks[0], landmarks[1], landmarks[2])
        return _System(cost, unshared, hessian, gradient, recovery)

    def _stepped(
        self,
        system: _System,
        step: FloatArray,
        poses: FloatArray,
        points: FloatArray,
        stretch: float,
    ) -> tuple[FloatArray, FloatArray]:
        window = self._window
        return kernels.moved(poses, stretch * step), kernels.stepped(
            points, step, window.pose, self._starts, *system.landmarks, stretch
        )

    def solve(self, max_iterations: int) -> Adjusted:
        """Minimise, then invert the reduced system at the minimum.

        Raises
        ------
        EstimationError
            When the measurements do not fix all poses.
        """
        poses, points = self._poses, self._points
        damping, stretch, converged, iterations = 0.0, 1.0, self._n == 1, 0
        still = _STEP_SIGMA * np.sqrt(6.0 * self._n)
        system = self._linearise(poses, points)
        while not converged and iterations < max_iterations:
            iterations += 1
            positive, step, square = kernels.step_of(system.hessian, system.gradient, damping)
            if not positive:
                raise EstimationError(_LOOSE)
            new_poses, new_points = self._stepped(system, step, poses, points, stretch)
            new = self._linearise(new_poses, new_points)
            size = float(np.sqrt(abs(square)))
            if new.cost <= system.cost * (1.0 + 1e-12):
                poses, points, system = new_poses, new_points, new
                damping = 0.0 if damping < 1e-6 else 0.1 * damping
                converged, stretch = size < still, _STRETCH
            elif stretch > 1.0:
                stretch = 1.0
            elif size < still:
                converged = True
            else:
                damping = max(1e-4, 10.0 * damping)
                if damping > _LARGEST_DAMPING:
                    break
        covariance = inverse_positive(np.ascontiguousarray(system.hessian[6:, 6:]))
        shifted = self._linearise(poses, points, _SHIFT_PX)
        pull = (shifted.gradient - system.gradient)[6:] / _SHIFT_PX
        freedom = 3 * len(self._window.pose) - 3 * (len(self._starts) - 1) - 6 * (self._n - 1)
        freedom += 6 * len(self._window.motions)
        return Adjusted(
            poses,
            covariance,
            -covariance @ pull,
            2.0 * system.unshared,
            freedom,
            iterations,
            converged,
        )


def _stacked(matrices: list[FloatArray], size: int) -> FloatArray:
    return np.array(matrices, dtype=np.float64).reshape(-1, size, size)


def inverse_positive(matrix: FloatArray) -> FloatArray:
    """Inverse of a matrix that must be positive definite."""
    positive, result = kernels.inverse_positive(matrix)
    if not positive:
        raise EstimationError(_LOOSE)
    return result
