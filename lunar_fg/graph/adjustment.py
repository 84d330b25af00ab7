"""Stereo landmark factors and motions of a few poses, solved together, landmarks eliminated.

The factors are those of GTSAM's GenericStereoFactor3D and BetweenFactorPose3 with Huber's
loss; the solver is Gauss-Newton on the poses after the Schur complement over all landmarks
at once, in numpy. For windows of some ten poses it takes a fraction of the time that
GTSAM's per-factor elimination takes (`benchmarks/graph.py`); the tests hold the two equal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frontends.camera import StereoCamera
from frontends.geometry import adjoint, inverse, se3_exp, se3_log, skew
from frontends.measurements import FloatArray, IntArray
from lunar_fg.graph.linear import gram, inverse_positive, tangent_basis
from lunar_fg.graph.tracks import (
    Sightings,
    homogeneous,
    in_front,
    pose_jacobian,
    project,
    projection_jacobian,
)

#: Rest: a step of this share of the poses' own sigmas.
_STEP_SIGMA = 0.02
_LARGEST_DAMPING = 1e8
_LEAST_GAIN = 1e-12


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
    chi_square, degrees_of_freedom
        Robust cost doubled, and residuals less unknowns.
    iterations, converged
        Of the solver.
    """

    poses: FloatArray
    covariance: FloatArray
    chi_square: float
    degrees_of_freedom: int
    iterations: int
    converged: bool


@dataclass(frozen=True, slots=True)
class _State:
    """Points in their cameras (M, 4), whitened residuals (M, 3), roots of the weights (M,)."""

    local: FloatArray
    whitened: FloatArray
    root_weight: FloatArray


@dataclass(frozen=True, slots=True)
class _System:
    """The reduced normal equations, and what recovers the landmarks' steps."""

    hessian: FloatArray
    gradient: FloatArray
    landmark_gain: FloatArray
    landmark_coupling: FloatArray
    landmark_gradient: FloatArray
    basis: FloatArray


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
    """

    def __init__(
        self,
        camera: StereoCamera,
        window: Window,
        poses: FloatArray,
        robust_threshold_sigma: float,
    ) -> None:
        self._camera = camera
        self._window = window
        self._n = len(poses)
        self._threshold = robust_threshold_sigma
        self._whiten = np.linalg.inv(np.linalg.cholesky(window.sightings.covariance))
        self._starts = np.flatnonzero(np.diff(window.landmark, prepend=-1))
        self._motion_whiten = [
            np.linalg.inv(np.linalg.cholesky(motion.covariance)) for motion in window.motions
        ]
        self._poses = poses
        first_seen = window.pose[self._starts]
        anchored = homogeneous(camera, window.sightings.uuv[self._starts])
        points = np.einsum("lij,lj->li", poses[first_seen], anchored)
        self._points = points / np.linalg.norm(points, axis=1, keepdims=True)

    def _local(self, poses: FloatArray, points: FloatArray) -> FloatArray:
        window = self._window
        return np.asarray(
            (inverse(poses)[window.pose] @ points[window.landmark][:, :, None])[:, :, 0]
        )

    def _residuals(self, poses: FloatArray, points: FloatArray) -> tuple[_State, float]:
        """Where every sighting stands, and the robust cost."""
        local = self._local(poses, points)
        visible = in_front(local)
        local = np.where(visible[:, None], local, [0.0, 0.0, 1.0, 0.0])
        raw = project(self._camera, local) - self._window.sightings.uuv
        whitened = (self._whiten @ raw[:, :, None])[:, :, 0]
        size = np.linalg.norm(whitened, axis=1)
        k = self._threshold
        weight = np.where(size <= k, 1.0, k / np.maximum(size, k))
        loss = np.where(size <= k, 0.5 * size**2, k * (size - 0.5 * k))
        # A sighting behind the camera pulls nothing but costs, so that no step goes there.
        weight = np.where(visible, weight, 0.0)
        loss = np.where(visible, loss, 10.0 * k**2)
        cost = float(loss.sum())
        for motion, root in zip(self._window.motions, self._motion_whiten, strict=True):
            error = root @ self._motion_error(motion, poses)
            cost += 0.5 * float(error @ error)
        return _State(local, whitened, np.sqrt(weight)), cost

    @staticmethod
    def _motion_error(motion: Motion, poses: FloatArray) -> FloatArray:
        measured = inverse(poses[motion.first]) @ poses[motion.second]
        return se3_log(inverse(motion.a_T_b) @ measured)

    def _linearise(self, poses: FloatArray, points: FloatArray, state: _State) -> _System:
        local, whitened, root_weight = state.local, state.whitened, state.root_weight
        window, n = self._window, self._n
        count = len(self._starts)
        by_local = root_weight[:, None, None] * (
            self._whiten @ projection_jacobian(self._camera, local)
        )
        residual = root_weight[:, None] * whitened
        by_pose = by_local @ pose_jacobian(local)
        basis = tangent_basis(points)
        moved = inverse(poses)[window.pose] @ basis[window.landmark]
        by_landmark = by_local @ moved
        by_landmark_t = by_landmark.transpose(0, 2, 1)
        gain = np.add.reduceat(by_landmark_t @ by_landmark, self._starts)
        gain += _LEAST_GAIN * (1.0 + np.trace(gain, axis1=1, axis2=2))[:, None, None] * np.eye(3)
        landmark_gradient = np.add.reduceat(
            (by_landmark_t @ residual[:, :, None])[:, :, 0], self._starts
        )
        blocks = np.zeros((count, 3, n, 6))
        blocks[window.landmark, :, window.pose, :] = by_landmark_t @ by_pose
        coupling = blocks.reshape(count, 3, 6 * n)
        whitener = np.asarray(np.linalg.inv(np.linalg.cholesky(gain)), dtype=np.float64)
        joined = np.concatenate([coupling, landmark_gradient[:, :, None]], axis=2)
        eliminated = gram((whitener @ joined).reshape(3 * count, 6 * n + 1))
        hessian = -eliminated[:-1, :-1]
        gradient = -eliminated[:-1, -1]
        by_pose_t = by_pose.transpose(0, 2, 1)
        own = by_pose_t @ by_pose
        own_gradient = (by_pose_t @ residual[:, :, None])[:, :, 0]
        for i in range(n):
            rows, block = window.pose == i, slice(6 * i, 6 * i + 6)
            hessian[block, block] += own[rows].sum(axis=0)
            gradient[block] += own_gradient[rows].sum(axis=0)
        self._add_motions(poses, hessian, gradient)
        return _System(hessian, gradient, whitener, coupling, landmark_gradient, basis)

    def _add_motions(self, poses: FloatArray, hessian: FloatArray, gradient: FloatArray) -> None:
        for motion, root in zip(self._window.motions, self._motion_whiten, strict=True):
            error = self._motion_error(motion, poses)
            # Derivative of the logarithm to first order in the error.
            half_ad = np.zeros((6, 6))
            half_ad[:3, :3] = half_ad[3:, 3:] = skew(error[:3])
            half_ad[3:, :3] = skew(error[3:])
            right = np.eye(6) + 0.5 * half_ad
            back = adjoint(inverse(poses[motion.second]) @ poses[motion.first])
            by_second = root @ right
            by_first = -by_second @ back
            white = root @ error
            a = slice(6 * motion.first, 6 * motion.first + 6)
            b = slice(6 * motion.second, 6 * motion.second + 6)
            hessian[a, a] += by_first.T @ by_first
            hessian[b, b] += by_second.T @ by_second
            hessian[a, b] += by_first.T @ by_second
            hessian[b, a] += by_second.T @ by_first
            gradient[a] += by_first.T @ white
            gradient[b] += by_second.T @ white

    @staticmethod
    def _stepped(
        system: _System, step: FloatArray, poses: FloatArray, points: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        moved = poses.copy()
        for i in range(1, len(poses)):
            moved[i] = poses[i] @ se3_exp(step[6 * i : 6 * i + 6])
        toward = system.landmark_gradient + system.landmark_coupling @ step
        white = system.landmark_gain @ toward[:, :, None]
        tangent = -(system.landmark_gain.transpose(0, 2, 1) @ white)
        shifted = points + (system.basis @ tangent)[:, :, 0]
        return moved, shifted / np.linalg.norm(shifted, axis=1, keepdims=True)

    def solve(self, max_iterations: int) -> Adjusted:
        """Minimise, then invert the reduced system at the minimum.

        Raises
        ------
        EstimationError
            When the measurements do not fix all poses.
        """
        poses, points = self._poses, self._points
        state, cost = self._residuals(poses, points)
        damping, converged, iterations = 0.0, self._n == 1, 0
        system = self._linearise(poses, points, state)
        while not converged and iterations < max_iterations:
            iterations += 1
            reduced = system.hessian[6:, 6:]
            damped = reduced + damping * np.diag(np.diag(reduced))
            step = np.zeros(6 * self._n)
            step[6:] = -inverse_positive(damped) @ system.gradient[6:]
            new_poses, new_points = self._stepped(system, step, poses, points)
            new_state, new_cost = self._residuals(new_poses, new_points)
            size = float(np.sqrt(abs(float(step[6:] @ reduced @ step[6:]))))
            if new_cost <= cost * (1.0 + 1e-12):
                poses, points, state, cost = new_poses, new_points, new_state, new_cost
                damping = 0.0 if damping < 1e-6 else 0.1 * damping
                system = self._linearise(poses, points, state)
                converged = size < _STEP_SIGMA
            elif size < _STEP_SIGMA:
                converged = True
            else:
                damping = max(1e-4, 10.0 * damping)
                if damping > _LARGEST_DAMPING:
                    break
        covariance = inverse_positive(system.hessian[6:, 6:])
        freedom = 3 * len(self._window.pose) - 3 * len(self._starts) - 6 * (self._n - 1)
        freedom += 6 * len(self._window.motions)
        return Adjusted(poses, covariance, 2.0 * cost, freedom, iterations, converged)
