"""Relative positioning (paper, 2.2): the motion between two frames from 3-D landmarks.

RANSAC over rigid transforms of three landmarks (eq. 6), then least squares on the
reprojection in both images with a robust kernel. A failure is a result with a reason.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Ge, Gt, Lt
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from frontends.camera import StereoCamera
from frontends.consensus import false_alarms
from frontends.geometry import adjoint, inverse, transform_points
from frontends.jit import kernel
from frontends.measurements import RelativePose, StereoObservations, Verdict
from frontends.reprojection import TwoViewProblem

FloatArray = NDArray[np.float64]

#: Between the errors of any two landmarks: they look at the same rocks under the same light
#: from the same side.
LANDMARK_CORRELATION = 0.005


_DOES_NOT_HOLD = "the motion does not hold after refinement"


@dataclass(frozen=True, slots=True)
class RelativeConfig:
    """Settings of relative positioning.

    Attributes
    ----------
    inlier_probability
        A true correspondence passes the chi-square gate with this probability.
    confidence
        RANSAC ends when a clean sample was drawn with this probability.
    max_hypotheses
        Bound on the samples drawn.
    min_inliers
        Fewer make the motion refused.
    kernel_sigma
        Scale of the Cauchy kernel, in sigmas.
    false_alarms
        Wrong motions accepted, a frame that shows none.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "allow_inf_nan": False}

    inlier_probability: Annotated[float, Gt(0.5), Lt(1)] = 0.99
    confidence: Annotated[float, Gt(0), Lt(1)] = 0.9999
    max_hypotheses: Annotated[int, Ge(1)] = 500
    min_inliers: Annotated[int, Ge(3)] = 12
    kernel_sigma: Annotated[float, Gt(0)] = 2.0
    false_alarms: Annotated[float, Gt(0), Lt(1)] = 1e-3


@dataclass(frozen=True, slots=True)
class MotionPrediction:
    """Motion expected before the images were looked at; `covariance` as `RelativePose`."""

    a_T_b: FloatArray
    covariance: FloatArray

    def in_frames(self, body_T_sensor: FloatArray) -> MotionPrediction:
        """The same motion between bodies that carry the sensor at `body_T_sensor`."""
        rotate = adjoint(body_T_sensor)
        return MotionPrediction(
            body_T_sensor @ self.a_T_b @ inverse(body_T_sensor),
            rotate @ self.covariance @ rotate.T,
        )


def rigid_transform(points_a: FloatArray, points_b: FloatArray) -> FloatArray:
    """Least-squares rigid transform between two point sets (paper, eq. 6).

    Parameters
    ----------
    points_a, points_b
        (N, 3) corresponding points, m, N >= 3, not on one line.

    Returns
    -------
    FloatArray
        ``b_T_a``, (4, 4): ``points_b ~ R points_a + t``.
    """
    return _rigid(np.ascontiguousarray(points_a), np.ascontiguousarray(points_b))


@kernel
def _rigid(points_a: FloatArray, points_b: FloatArray) -> FloatArray:
    """Kabsch: the rotation is V diag(1, 1, +-1) U^T of the points' cross-covariance."""
    count = len(points_a)
    mean_a, mean_b = np.zeros(3), np.zeros(3)
    for i in range(count):
        mean_a += points_a[i] / count
        mean_b += points_b[i] / count
    u, _, vt = np.linalg.svd((points_a - mean_a).T.copy() @ (points_b - mean_b))
    if np.linalg.det(u) * np.linalg.det(vt) < 0.0:
        vt[2] = -vt[2]
    rotation = vt.T.copy() @ u.T.copy()
    b_T_a = np.eye(4)
    b_T_a[:3, :3] = rotation
    b_T_a[:3, 3] = mean_b - rotation @ mean_a
    return b_T_a


class RelativePositioning:
    """Estimates the motion between two stereo frames.

    Parameters
    ----------
    camera
        The rectified pair.
    config
        Settings.
    seed
        Of the random sampling. The draws of a frame depend on the seed and the number
        of correspondences only, never on what came before.
    landmark_correlation
        Between the errors of any two landmarks; N count for N / (1 + correlation N).
    """

    def __init__(
        self,
        camera: StereoCamera,
        config: RelativeConfig | None = None,
        seed: int = 0,
        landmark_correlation: float = LANDMARK_CORRELATION,
    ) -> None:
        self.camera = camera
        self.config = config or RelativeConfig()
        self.seed = seed
        self._correlation = landmark_correlation
        self._needed = max(3, self.config.min_inliers)
        self._gate = float(chi2_distribution.ppf(self.config.inlier_probability, df=3))

    def estimate(
        self,
        points_a: FloatArray,
        covariance_a: FloatArray,
        observations_b: StereoObservations,
        prediction: MotionPrediction,
    ) -> RelativePose:
        """Motion from landmarks known in `a` and observed in `b`.

        Parameters
        ----------
        points_a, covariance_a
            (N, 3) m, (N, 3, 3) m^2: the landmarks in a's left-camera axes.
        observations_b
            The same N landmarks as frame b sees them; their ids name the inliers.
        prediction
            Returned, refused, when the images do not tell the motion.

        Returns
        -------
        RelativePose
            Between the left cameras. The covariance comes from the final Jacobian and the
            residuals (`TwoViewProblem.motion_covariance`).
        """
        count = len(observations_b)
        needed = self._needed
        if count < needed:
            return _refuse(prediction, count, f"{count} tracked landmarks, {needed} are needed")
        problem = TwoViewProblem.of_landmarks(self.camera, points_a, covariance_a, observations_b)
        b_T_a, inlier = self._ransac(problem, points_a, observations_b.points_cam, prediction)
        if inlier.sum() < needed:
            return _refuse(
                prediction,
                count,
                f"{int(inlier.sum())} of {count} tracked landmarks agree on one motion, "
                f"{needed} are needed",
                int(inlier.sum()),
            )
        return self._refine(problem, observations_b, b_T_a, inlier, prediction)

    def refine(
        self,
        points_a: FloatArray,
        covariance_a: FloatArray,
        observations_b: StereoObservations,
        prediction: MotionPrediction,
    ) -> RelativePose:
        """As `estimate`, for known correspondences and a prediction near the solution."""
        count = len(observations_b)
        if count < self._needed:
            return _refuse(prediction, count, f"{count} known correspondences are too few")
        problem = TwoViewProblem.of_landmarks(self.camera, points_a, covariance_a, observations_b)
        start = inverse(prediction.a_T_b)
        everything = np.ones(count, dtype=np.bool_)
        return self._refine(problem, observations_b, start, everything, prediction)

    def agreeing(
        self,
        a_T_b: FloatArray,
        points_a: FloatArray,
        covariance_a: FloatArray,
        observations_b: StereoObservations,
    ) -> NDArray[np.bool_]:
        """Which landmarks agree with a motion, (N,)."""
        problem = TwoViewProblem.of_landmarks(self.camera, points_a, covariance_a, observations_b)
        return problem.distances2(inverse(a_T_b)) < self._gate

    def _ransac(
        self,
        problem: TwoViewProblem,
        points_a: FloatArray,
        points_b: FloatArray,
        prediction: MotionPrediction,
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Motion with the smallest truncated cost, locally optimised, and its inliers."""
        count = len(problem)
        best = inverse(prediction.a_T_b)
        cost, inlier = self._score(problem, best)
        random = np.random.default_rng((self.seed, count))
        wanted = float(self.config.max_hypotheses)
        for tried, sample in enumerate(_samples(random, count, self.config.max_hypotheses)):
            if tried >= wanted:
                break
            candidate = rigid_transform(points_a[sample], points_b[sample])
            candidate_cost, candidate_inlier = self._score(problem, candidate)
            if candidate_cost >= cost and tried > 0:
                continue
            for _ in range(2):
                if candidate_inlier.sum() < 6:
                    break
                improved = problem.solve(
                    candidate, self.config.kernel_sigma, iterations=3, among=candidate_inlier
                )
                improved_cost, improved_inlier = self._score(problem, improved)
                if improved_cost >= candidate_cost:
                    break
                candidate, candidate_cost, candidate_inlier = (
                    improved,
                    improved_cost,
                    improved_inlier,
                )
            if candidate_cost < cost:
                best, cost, inlier = candidate, candidate_cost, candidate_inlier
            clean = float(inlier.mean()) ** 3
            if clean > 0.0:
                miss = np.log1p(-min(clean, 1.0 - 1e-12))
                wanted = np.log(1.0 - self.config.confidence) / miss
        return best, inlier

    def _score(self, problem: TwoViewProblem, b_T_a: FloatArray) -> tuple[float, NDArray[np.bool_]]:
        chi2 = problem.distances2(b_T_a)
        return float(np.minimum(chi2, self._gate).sum()), chi2 < self._gate

    def _refine(
        self,
        problem: TwoViewProblem,
        observations_b: StereoObservations,
        b_T_a: FloatArray,
        inlier: NDArray[np.bool_],
        prediction: MotionPrediction,
    ) -> RelativePose:
        count = len(observations_b)
        sigma = self.config.kernel_sigma
        b_T_a = problem.solve(b_T_a, sigma, among=inlier)
        # Residuals up to twice the gate's size still belong to the noise when that is larger
        # than stated; what is farther off is wrong.
        plausible = problem.distances2(b_T_a) < 4.0 * self._gate
        if plausible.sum() < self._needed:
            return _refuse(prediction, count, _DOES_NOT_HOLD, int(plausible.sum()))
        b_T_a = problem.solve(b_T_a, sigma, among=plausible)
        chi2 = problem.distances2(b_T_a)
        inlier = chi2 < self._gate
        if inlier.sum() < self._needed:
            return _refuse(prediction, count, _DOES_NOT_HOLD, int(inlier.sum()))
        if false_alarms(chi2, self._gate) > self.config.false_alarms:
            return _refuse(
                prediction,
                count,
                f"{int(inlier.sum())} of {count} tracked landmarks agree, as many as by chance",
                int(inlier.sum()),
            )
        covariance_b_T_a = problem.motion_covariance(b_T_a, sigma, among=plausible)
        if covariance_b_T_a is None:
            return _refuse(
                prediction, count, "the landmarks do not fix all six motions", int(inlier.sum())
            )
        # right perturbation of the inverse: Ad of b_T_a, the sign squares away
        turn = adjoint(b_T_a)
        shared = 1.0 + self._correlation * float(inlier.sum())
        covariance = shared * turn @ covariance_b_T_a @ turn.T
        return RelativePose(
            inverse(b_T_a),
            0.5 * (covariance + covariance.T),
            observations_b.landmark_id[inlier],
            count,
            Verdict.ACCEPTED,
            agreeing=int(inlier.sum()),
        )


def _refuse(
    prediction: MotionPrediction, count: int, reason: str, agreeing: int = 0
) -> RelativePose:
    return RelativePose(
        prediction.a_T_b,
        prediction.covariance,
        np.zeros(0, dtype=np.int64),
        count,
        Verdict.REFUSED,
        reason,
        agreeing,
    )


def _samples(random: np.random.Generator, count: int, draws: int) -> NDArray[np.int64]:
    """Triples of different numbers below `count`, all equally likely, (draws, 3).

    Each is drawn from what the ones before it leave, so that none has to be drawn again.
    """
    first, second, third = random.integers(0, [count, count - 1, count - 2], (draws, 3)).T
    second = second + (second >= first)
    third = third + (third >= np.minimum(first, second))
    third = third + (third >= np.maximum(first, second))
    return np.stack([first, second, third], axis=-1)


def predicted_points(prediction: MotionPrediction, points_a: FloatArray) -> FloatArray:
    """Where points of frame a should be in frame b's axes, (N, 3) m."""
    return transform_points(inverse(prediction.a_T_b), points_a)
