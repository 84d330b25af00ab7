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
from frontends.geometry import se3_exp
from frontends.jit import kernel
from frontends.measurements import StereoObservations

FloatArray = NDArray[np.float64]

#: Points nearer than this to the camera plane have no usable projection, m.
_NEAREST_M = 1e-3
#: Squared distance given to landmarks behind the camera: never an inlier, and finite, as
#: the compiled kernel's arithmetic asks for.
_FAR_OFF = 1e12
#: Least variance left after elimination, px^2: rounding must not make it negative.
_LEAST_VARIANCE = 1e-9
#: A Gauss-Newton step beyond this (rad, m) comes from a singular system.
_LARGEST_STEP = 1e3


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
    DISTANCES = 3
    """None: only the Mahalanobis distances are computed."""


@dataclass(frozen=True, slots=True)
class TwoViewProblem:
    """Landmarks known in frame a and observed in frame b.

    Attributes
    ----------
    camera
        The rectified pair, the same in both frames.
    points_a, covariance_a
        (N, 3) m and (N, 3, 3) m^2, in a's left-camera axes.
    observed_b
        (N, 3): u, v, disparity, px.
    sigma_px, sigma_disparity_px
        (N,) of the observation in b.
    point_terms
        (N, 3, K) derivative of `points_a` by K more unknowns; K may be 0.
    disparity_terms
        (N, K) derivative of b's predicted disparity by the same unknowns.
    """

    camera: StereoCamera
    points_a: FloatArray
    covariance_a: FloatArray
    observed_b: FloatArray
    sigma_px: FloatArray
    sigma_disparity_px: FloatArray
    point_terms: FloatArray
    disparity_terms: FloatArray

    @classmethod
    def of_landmarks(
        cls,
        camera: StereoCamera,
        points_a: FloatArray,
        covariance_a: FloatArray,
        observations_b: StereoObservations,
    ) -> TwoViewProblem:
        """The motion alone: no further unknowns."""
        n = len(observations_b)
        return cls(
            camera,
            np.ascontiguousarray(points_a),
            np.ascontiguousarray(covariance_a),
            np.stack(
                [observations_b.u_left, observations_b.v, observations_b.disparity_px], axis=-1
            ),
            np.ascontiguousarray(observations_b.sigma_px),
            np.ascontiguousarray(observations_b.sigma_disparity_px),
            np.zeros((n, 3, 0)),
            np.zeros((n, 0)),
        )

    def __len__(self) -> int:
        return len(self.points_a)

    def select(self, keep: NDArray[np.bool_]) -> TwoViewProblem:
        """The problem restricted to some landmarks."""
        return TwoViewProblem(
            self.camera,
            self.points_a[keep],
            self.covariance_a[keep],
            self.observed_b[keep],
            self.sigma_px[keep],
            self.sigma_disparity_px[keep],
            self.point_terms[keep],
            self.disparity_terms[keep],
        )

    def linearise(
        self, b_T_a: FloatArray, kernel_sigma: float, *, part: Part = Part.SOLVE
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

        Returns
        -------
        information, gradient, chi2
            (6+K, 6+K), (6+K,), and (N,) squared Mahalanobis distances (3 degrees of
            freedom; 1e12 behind the camera).
        """
        camera = self.camera
        return _normal_equations(
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            camera.fx * camera.baseline_m,
            np.ascontiguousarray(b_T_a[:3]),
            self.points_a,
            self.covariance_a,
            self.observed_b,
            self.sigma_px,
            self.sigma_disparity_px,
            self.point_terms,
            self.disparity_terms,
            kernel_sigma,
            int(part),
        )

    def motion_covariance(self, b_T_a: FloatArray, kernel_sigma: float) -> FloatArray | None:
        """Covariance of the solved motion, (6, 6), right perturbation of ``b_T_a``.

        The sandwich of a robust estimate, A^-1 B A^-1: B holds the residuals as they
        are, so noise larger than stated makes it larger. None when it is singular.
        """
        curvature = self.linearise(b_T_a, kernel_sigma, part=Part.CURVATURE)[0][:6, :6]
        spread = np.linalg.eigvalsh(curvature)
        if not np.isfinite(spread).all() or spread[0] <= spread[-1] * 1e-14:
            return None
        scatter = self.linearise(b_T_a, kernel_sigma, part=Part.SCATTER)[0][:6, :6]
        half = np.linalg.inv(curvature)
        return np.asarray(half @ scatter @ half)


def solve_motion(
    problem: TwoViewProblem, b_T_a: FloatArray, *, kernel_sigma: float, iterations: int = 10
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gauss-Newton with a Cauchy kernel from a start near the solution.

    Returns
    -------
    b_T_a, information, chi2
        (4, 4); (6, 6) for its right perturbation; (N,). A singular information matrix
        ends the iteration and is returned as it is, for the caller to judge.
    """
    information, gradient, chi2 = problem.linearise(b_T_a, kernel_sigma)
    for _ in range(iterations):
        try:
            step = np.linalg.solve(information[:6, :6], gradient[:6])
        except np.linalg.LinAlgError:
            break
        if not np.isfinite(step).all() or float(np.abs(step).max()) > _LARGEST_STEP:
            break
        b_T_a = b_T_a @ se3_exp(step)
        information, gradient, chi2 = problem.linearise(b_T_a, kernel_sigma)
        if float(np.abs(step).max()) < 1e-8:
            break
    return b_T_a, information, chi2


@kernel
def _normal_equations(
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    fb: float,
    transform: FloatArray,
    points: FloatArray,
    covariance: FloatArray,
    observed: FloatArray,
    sigma: FloatArray,
    sigma_disparity: FloatArray,
    point_terms: FloatArray,
    disparity_terms: FloatArray,
    kernel_sigma: float,
    part: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    n, extra = points.shape[0], point_terms.shape[2]
    size = 6 + extra
    information = np.zeros((size, size))
    gradient = np.zeros(size)
    chi2 = np.empty(n)
    projection = np.zeros((3, 3))  # d(u, v, disparity) / d(point in a)
    jacobian = np.zeros((3, size))
    whitened = np.zeros((3, size))
    for i in range(n):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = transform[0, 0] * px + transform[0, 1] * py + transform[0, 2] * pz + transform[0, 3]
        y = transform[1, 0] * px + transform[1, 1] * py + transform[1, 2] * pz + transform[1, 3]
        z = transform[2, 0] * px + transform[2, 1] * py + transform[2, 2] * pz + transform[2, 3]
        if z < _NEAREST_M:
            chi2[i] = _FAR_OFF
            continue
        inverse_z = 1.0 / z
        u = fx * x * inverse_z
        v = fy * y * inverse_z
        d = fb * inverse_z
        r0 = observed[i, 0] - u - cx
        r1 = observed[i, 1] - v - cy
        r2 = observed[i, 2] - d
        for c in range(3):
            projection[0, c] = inverse_z * (fx * transform[0, c] - u * transform[2, c])
            projection[1, c] = inverse_z * (fy * transform[1, c] - v * transform[2, c])
            projection[2, c] = -inverse_z * d * transform[2, c]
        # s = observation covariance + projected point covariance (symmetric 3x3)
        s00 = sigma[i] * sigma[i]
        s11 = s00
        s22 = sigma_disparity[i] * sigma_disparity[i]
        s01 = s02 = s12 = 0.0
        for a in range(3):
            for b in range(3):
                cab = covariance[i, a, b]
                s00 += projection[0, a] * cab * projection[0, b]
                s01 += projection[0, a] * cab * projection[1, b]
                s02 += projection[0, a] * cab * projection[2, b]
                s11 += projection[1, a] * cab * projection[1, b]
                s12 += projection[1, a] * cab * projection[2, b]
                s22 += projection[2, a] * cab * projection[2, b]
        # Cholesky factor of s, and its forward substitution: rows become independent
        l00 = np.sqrt(s00)
        l10 = s01 / l00
        l20 = s02 / l00
        l11 = np.sqrt(max(s11 - l10 * l10, _LEAST_VARIANCE))
        l21 = (s12 - l20 * l10) / l11
        l22 = np.sqrt(max(s22 - l20 * l20 - l21 * l21, _LEAST_VARIANCE))
        w0 = r0 / l00
        w1 = (r1 - l10 * w0) / l11
        w2 = (r2 - l20 * w0 - l21 * w1) / l22
        distance2 = w0 * w0 + w1 * w1 + w2 * w2
        chi2[i] = distance2
        if part == 3:
            continue
        weight = 1.0 / (1.0 + distance2 / (kernel_sigma * kernel_sigma))
        matrix_weight = weight
        if part == 1:
            matrix_weight -= 2.0 * weight * weight * distance2 / (3.0 * kernel_sigma**2)
        elif part == 2:
            matrix_weight = weight * weight * distance2 / 3.0
        for r in range(3):
            p0, p1, p2 = projection[r, 0], projection[r, 1], projection[r, 2]
            jacobian[r, 0] = p2 * py - p1 * pz
            jacobian[r, 1] = p0 * pz - p2 * px
            jacobian[r, 2] = p1 * px - p0 * py
            jacobian[r, 3] = p0
            jacobian[r, 4] = p1
            jacobian[r, 5] = p2
            for k in range(extra):
                jacobian[r, 6 + k] = (
                    p0 * point_terms[i, 0, k]
                    + p1 * point_terms[i, 1, k]
                    + p2 * point_terms[i, 2, k]
                )
        for k in range(extra):
            jacobian[2, 6 + k] += disparity_terms[i, k]
        for k in range(size):
            whitened[0, k] = jacobian[0, k] / l00
            whitened[1, k] = (jacobian[1, k] - l10 * whitened[0, k]) / l11
            whitened[2, k] = (jacobian[2, k] - l20 * whitened[0, k] - l21 * whitened[1, k]) / l22
        for k in range(size):
            g0, g1, g2 = whitened[0, k], whitened[1, k], whitened[2, k]
            gradient[k] += weight * (g0 * w0 + g1 * w1 + g2 * w2)
            for m in range(k + 1):
                information[k, m] += matrix_weight * (
                    g0 * whitened[0, m] + g1 * whitened[1, m] + g2 * whitened[2, m]
                )
    for k in range(size):
        for m in range(k):
            information[m, k] = information[k, m]
    return information, gradient, chi2
