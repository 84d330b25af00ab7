"""A disparity error of the rectified pair, found from the motion between its frames.

A single pair cannot tell a disparity error from depth. Motion can: points triangulated
with wrong disparities do not move rigidly. The three coefficients of the disparity field
(`frontends.rectification`) are unknowns of the two-view problem beside the motion; the
motion is eliminated and the information of many frame pairs added up.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Gt, Lt
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from frontends.camera import StereoCamera
from frontends.measurements import StereoObservations
from frontends.rectification import (
    DISPARITY_TERMS,
    RectificationError,
    disparity_basis,
    within_range,
)
from frontends.relative import rigid_transform
from frontends.reprojection import TwoViewProblem, solve_motion
from frontends.tracking import common_landmarks

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DisparityCheckConfig:
    """Settings of the check.

    Attributes
    ----------
    mode
        ``"apply"``: correct a significant error; ``"report"``: only say so; ``"off"``.
    frames
        Moving frames that the check uses, from the start of the run.
    false_alarm_probability
        A pair without any error is corrected with this probability.
    floor_px
        Sub-pixel matching is biased by up to about this much whatever the number of
        matches: added to every sigma.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "allow_inf_nan": False}

    mode: Literal["apply", "report", "off"] = "apply"
    frames: Annotated[int, Ge(2)] = 30
    false_alarm_probability: Annotated[float, Gt(0), Lt(1)] = 1e-4
    floor_px: Annotated[float, Gt(0)] = 0.05


@dataclass(frozen=True, slots=True)
class DisparityFinding:
    """What the motion says about the disparities.

    Attributes
    ----------
    field_px
        (3,) coefficients for `RectificationError.disparity_px`.
    border_px, border_sigma_px
        (3,) the same terms, in px at the image border, and their 1-sigma with the
        matching bias in it.
    chance
        Probability that a pair without any error shows as much.
    significant
        Whether that is below the allowed false-alarm probability.
    pairs
        Frame pairs used.
    """

    field_px: FloatArray
    border_px: FloatArray
    border_sigma_px: FloatArray
    chance: float
    significant: bool
    pairs: int

    def __str__(self) -> str:
        names = ("constant", "x^2 at the side", "y^2 at the top")
        values = zip(names, self.border_px, self.border_sigma_px, strict=True)
        parts = [f"{name} {value:+.2f} +- {sigma:.2f} px" for name, value, sigma in values]
        return f"disparity error seen in the motion of {self.pairs} frame pairs: " + ", ".join(
            parts
        )


class DisparityCheck:
    """Collects the first moving frames of a run and judges their disparities.

    Parameters
    ----------
    camera
        The rectified pair.
    config
        Settings.
    """

    #: A pair of frames counts when its landmarks moved by this much in the image, px.
    _LEAST_FLOW_PX = 2.0
    #: The partner of a frame is the oldest one that shares this part of its landmarks.
    _SHARED = 0.33
    _LEAST_SHARED = 30
    _LONGEST_GAP = 10
    _KERNEL_SIGMA = 2.0
    _MAX_DEPTH_SIGMA = 0.25

    def __init__(self, camera: StereoCamera, config: DisparityCheckConfig | None = None) -> None:
        self.camera = camera
        self.config = config or DisparityCheckConfig()
        self._frames: deque[StereoObservations] = deque(maxlen=self._LONGEST_GAP + 1)
        self._pairs: list[tuple[StereoObservations, StereoObservations]] = []

    @property
    def ready(self) -> bool:
        """Whether enough moving frames came for a finding."""
        return len(self._pairs) >= self.config.frames

    def add(self, observations: StereoObservations) -> None:
        """Take in the next frame, with tracked ids and uncorrected disparities."""
        known = set() if not self._frames else set(self._frames[-1].landmark_id.tolist())
        tracked = len(known.intersection(observations.landmark_id.tolist()))
        self._frames.append(observations)
        for older in list(self._frames)[:-1]:
            a, b = common_landmarks(older, observations)
            if len(a) < max(self._LEAST_SHARED, self._SHARED * tracked):
                continue
            flow = np.hypot(b.u_left - a.u_left, b.v - a.v)
            if float(np.median(flow)) >= self._LEAST_FLOW_PX:
                self._pairs.append((a, b))
            return

    def finding(self) -> DisparityFinding | None:
        """Judge what has come so far; None without any usable pair.

        The three terms are correlated, so they are judged and applied together: dropping
        one would push its share into the others.
        """
        if not self._pairs:
            return None
        camera = self.camera
        side = np.array([0.0, camera.width - 1.0]), np.array([0.0, camera.height - 1.0])
        scale = disparity_basis(camera, *side).max(axis=0)
        solution = self._solve()
        if solution is None:
            return None
        field, covariance = solution
        border = field * scale
        spread = covariance * np.outer(scale, scale) + self.config.floor_px**2 * np.eye(len(field))
        distance2 = float(border @ np.linalg.solve(spread, border))
        chance = float(chi2_distribution.sf(distance2, df=len(field)))
        return DisparityFinding(
            field,
            border,
            np.sqrt(np.diag(spread)),
            chance,
            chance < self.config.false_alarm_probability,
            len(self._pairs),
        )

    def _solve(self) -> tuple[FloatArray, FloatArray] | None:
        """Coefficients of the field over all pairs, and their covariance, where they tell."""
        field = np.zeros(DISPARITY_TERMS)
        motions: list[FloatArray | None] = [None] * len(self._pairs)
        covariance: FloatArray = np.zeros((DISPARITY_TERMS, DISPARITY_TERMS))
        for _ in range(5):
            information = np.zeros((DISPARITY_TERMS, DISPARITY_TERMS))
            gradient = np.zeros(DISPARITY_TERMS)
            ratio: list[float] = []
            for k, pair in enumerate(self._pairs):
                problem = self._problem(*pair, field)
                if len(problem) < self._LEAST_SHARED:
                    continue
                start = motions[k]
                if start is None:
                    start = _first_motion(problem, self.camera)
                motion, _, _ = solve_motion(problem, start, kernel_sigma=self._KERNEL_SIGMA)
                motions[k] = motion
                whole, slope, chi2 = problem.linearise(motion, self._KERNEL_SIGMA)
                spread = np.linalg.eigvalsh(whole[:6, :6])
                if spread[0] <= 1e-12 * spread[-1]:
                    continue  # such landmarks do not tell the motion
                through = np.linalg.solve(whole[:6, :6], whole[:6, 6:]).T
                information += whole[6:, 6:] - through @ whole[:6, 6:]
                gradient += slope[6:] - through @ slope[:6]
                ratio.append(float(np.median(chi2)) / chi2_distribution.median(df=3))
            spread = np.linalg.eigvalsh(information)
            if not ratio or spread[0] <= 1e-12 * spread[-1]:
                return None
            step = np.linalg.solve(information, gradient)
            field += step
            # a frame enters two pairs, once as the earlier and once as the later one
            inflation = 2.0 * max(1.0, float(np.median(ratio)))
            covariance = np.asarray(inflation * np.linalg.inv(information), dtype=np.float64)
            if float(np.abs(step).max()) < 1e-3:
                break
        return field, covariance

    def _problem(
        self, a: StereoObservations, b: StereoObservations, field: FloatArray
    ) -> TwoViewProblem:
        """Two-view problem with the disparity coefficients as further unknowns.

        With D = D_measured - basis c, the point moves by X / D per px of error, and the
        disparity measured in b is the point's own plus the error there.
        """
        camera = self.camera
        error = RectificationError(disparity_px=field)
        basis_a = disparity_basis(camera, a.u_left, a.v)
        basis_b = disparity_basis(camera, b.u_left, b.v)
        true_a = a.disparity_px - basis_a @ field
        true_b = b.disparity_px - basis_b @ field
        limit = self._MAX_DEPTH_SIGMA
        keep = within_range(true_a, a.sigma_disparity_px, limit)
        keep &= within_range(true_b, b.sigma_disparity_px, limit)
        corrected_a = error.correct(camera, a.select(keep), limit)
        base = TwoViewProblem.of_landmarks(
            camera,
            corrected_a.points_cam,
            corrected_a.points_covariance,
            error.correct(camera, b.select(keep), limit),
        )
        per_px = corrected_a.points_cam / true_a[keep][:, None]
        return TwoViewProblem(
            camera,
            base.points_a,
            base.covariance_a,
            base.observed_b,
            base.sigma_px,
            base.sigma_disparity_px,
            np.ascontiguousarray(per_px[:, :, None] * basis_a[keep][:, None, :]),
            np.ascontiguousarray(basis_b[keep]),
        )


def _first_motion(problem: TwoViewProblem, camera: StereoCamera) -> FloatArray:
    """Start of the least squares: rigid transform of the triangulated points (eq. 6)."""
    u, v, disparity = problem.observed_b.T
    nearer = np.argsort(-disparity)[: max(3, len(problem) // 2)]
    points_b = camera.triangulate(u, v, disparity)
    return rigid_transform(problem.points_a[nearer], points_b[nearer])
