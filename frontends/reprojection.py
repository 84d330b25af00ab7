"""Normal equations of the motion between two stereo frames, on the reprojection error.

A point X_a with covariance C_a, triangulated in frame a, is carried into frame b and
compared with what b's two images show of it, (u, v, disparity). The residual's covariance
is the observation's plus C_a carried through the projection, so that a far point counts
for the rotation and little for the translation: the two-view maximum-likelihood weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.gauss_newton import gauss_newton
from frontends.measurements import StereoObservations
from frontends.normal_equations import normal_equations
from frontends.whitening import BLOCK, ROWS, distances

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Part(IntEnum):
    """Weights of the matrix that `TwoViewProblem.linearise` sums over the landmarks.

    With m the Mahalanobis distance of a residual, w = 1 / (1 + m^2 / k^2) the Cauchy
    weight, and the residual's three components taken as alike:
    """

    SOLVE = 0
    """w: the iteration matrix."""
    CURVATURE = 1
    """w - 2 w^2 m^2 / (3 k^2): the mean second derivative of the cost."""
    SCATTER = 2
    """w^2 m^2 / 3: the covariance of its first derivative."""


@dataclass(frozen=True, slots=True)
class TwoViewProblem:
    """Landmarks known in frame a and observed in frame b.

    Attributes
    ----------
    camera
        The rectified pair, the same in both frames.
    data
        The landmarks as `frontends.normal_equations` packs them: position and covariance in a's
        left-camera axes, what b shows of them and its variances.
    terms
        (N, 4, K) derivative of position and predicted disparity by K more unknowns; K may be 0.
    """

    camera: StereoCamera
    data: FloatArray
    terms: FloatArray

    @classmethod
    def of_landmarks(
        cls,
        camera: StereoCamera,
        points_a: FloatArray,
        covariance_a: FloatArray,
        observations_b: StereoObservations,
        terms: FloatArray | None = None,
    ) -> TwoViewProblem:
        """Problem of N landmarks.

        Parameters
        ----------
        camera
            The rectified pair.
        points_a, covariance_a
            (N, 3) m and (N, 3, 3) m^2, in a's left-camera axes.
        observations_b
            The same landmarks in frame b.
        terms
            See the class; None: the motion is the only unknown.
        """
        n = len(observations_b)
        blocks = -(-n // BLOCK)
        rows = np.zeros((ROWS, blocks * BLOCK))
        # what fills up the last block must be harmless: it is summed with weight 0
        rows[2], rows[12:] = 1.0, 1.0
        rows[:3, :n] = points_a.T
        rows[3:9, :n] = covariance_a.reshape(n, 9).T[[0, 1, 2, 4, 5, 8]]
        rows[9, :n] = observations_b.u_left - camera.cx
        rows[10, :n] = observations_b.v - camera.cy
        rows[11, :n] = observations_b.disparity_px
        rows[12, :n] = observations_b.sigma_px**2
        rows[13, :n] = observations_b.sigma_disparity_px**2
        data = rows.reshape(ROWS, blocks, BLOCK).transpose(1, 0, 2)
        unknowns = np.zeros((n, 4, 0)) if terms is None else np.ascontiguousarray(terms)
        return cls(camera, np.ascontiguousarray(data).ravel(), unknowns)

    def __len__(self) -> int:
        return len(self.terms)

    def distances2(self, b_T_a: FloatArray) -> FloatArray:
        """Squared Mahalanobis distances (N,), 3 degrees of freedom; 1e12 behind the camera."""
        chi2 = np.empty(len(self.data) // ROWS)
        distances(self._constants(), np.ascontiguousarray(b_T_a), self.data, chi2)
        return chi2[: len(self)]

    def linearise(
        self,
        b_T_a: FloatArray,
        kernel_sigma: float,
        *,
        part: Part = Part.SOLVE,
        among: Mask | None = None,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Weighted normal equations about a motion.

        Parameters
        ----------
        b_T_a
            (4, 4); its right perturbation (rotation, translation) is the unknown.
        kernel_sigma
            Scale of the Cauchy kernel, in sigmas.
        part
            Which weights the first returned matrix is summed with.
        among
            (N,) the landmarks that count; all by default.

        Returns
        -------
        information, gradient, chi2
            (6+K, 6+K), (6+K,), and (N,) as `distances2`.
        """
        linear, square = {
            Part.SOLVE: (1.0, 0.0),
            Part.CURVATURE: (1.0, -2.0 / (3.0 * kernel_sigma**2)),
            Part.SCATTER: (0.0, 1.0 / 3.0),
        }[part]
        chi2 = np.empty(len(self.data) // ROWS)
        information, gradient = normal_equations(
            self._constants(),
            np.ascontiguousarray(b_T_a),
            self.data,
            self.terms,
            self._counts(among),
            kernel_sigma**-2,
            linear,
            square,
            chi2,
        )
        return information, gradient, chi2[: len(self)]

    def solve(
        self,
        b_T_a: FloatArray,
        kernel_sigma: float,
        *,
        iterations: int = 10,
        among: Mask | None = None,
    ) -> FloatArray:
        """Motion (4, 4) by Gauss-Newton with a Cauchy kernel, from a start near the solution.

        Ends where a step is a ten-thousandth of the motion's sigma, and at a singular system;
        further unknowns stay at zero.
        """
        return gauss_newton(
            self._constants(),
            np.ascontiguousarray(b_T_a),
            self.data,
            self._counts(among),
            kernel_sigma**-2,
            iterations,
        )

    def motion_covariance(
        self, b_T_a: FloatArray, kernel_sigma: float, *, among: Mask | None = None
    ) -> FloatArray | None:
        """Covariance of the solved motion, (6, 6), right perturbation of ``b_T_a``.

        The sandwich of a robust estimate, A^-1 B A^-1: B holds the residuals as they
        are, so noise larger than stated makes it larger. None when it is singular.
        """
        parts = (
            self.linearise(b_T_a, kernel_sigma, part=part, among=among)[0][:6, :6]
            for part in (Part.CURVATURE, Part.SCATTER)
        )
        curvature, scatter = parts
        spread = np.linalg.eigvalsh(curvature)
        if not np.isfinite(spread).all() or spread[0] <= spread[-1] * 1e-14:
            return None
        half = np.linalg.inv(curvature)
        return np.asarray(half @ scatter @ half)

    def _constants(self) -> FloatArray:
        camera = self.camera
        return np.array([camera.fx, camera.fy, camera.fx * camera.baseline_m])

    def _counts(self, among: Mask | None) -> FloatArray:
        counts = np.zeros(len(self.data) // ROWS)
        counts[: len(self)] = 1.0 if among is None else among
        return counts
