"""A disparity error of the rectified pair, found from the motion between its frames.

A single pair cannot tell a disparity error from depth. Motion can: points triangulated
with wrong disparities do not move rigidly. The three coefficients of the disparity field
(`frontends.rectification`) are unknowns of the two-view problem beside the motion; the
motion is eliminated and the information of many frame pairs added up.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Gt, Lt
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from frontends.camera import StereoCamera
from frontends.measurements import StereoObservations
from frontends.rectification import DISPARITY_TERMS, disparity_basis, within_range
from frontends.relative import rigid_transform
from frontends.reprojection import TwoViewProblem
from frontends.stereo import StereoConfig
from frontends.tracks import common_landmarks

FloatArray = NDArray[np.float64]

_MEDIAN_CHI2 = float(chi2_distribution.median(df=3))


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

    def refined(self, later: DisparityFinding) -> DisparityFinding:
        """Return this finding with what a later look, at disparities corrected by it, adds."""
        return replace(
            later,
            field_px=self.field_px + later.field_px,
            border_px=self.border_px + later.border_px,
            chance=self.chance,
            significant=self.significant,
        )

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
    max_depth_sigma
        Useful range, see `frontends.stereo.StereoConfig`; its default by default.
    expected_px
        (3,) 1-sigma of the terms at the image border, as expected beforehand; None where nothing
        is known.
    """

    #: A pair of frames counts when its landmarks moved by this much in the image, px.
    _LEAST_FLOW_PX = 2.0
    #: The partner of a frame is the oldest one that shares this part of its landmarks.
    _SHARED = 0.33
    _LEAST_SHARED = 30
    _LONGEST_GAP = 10
    _KERNEL_SIGMA = 2.0
    #: Solved: the field's last step at the image border, in `floor_px`.
    _LAST_STEP_FLOORS = 0.1

    def __init__(
        self,
        camera: StereoCamera,
        config: DisparityCheckConfig | None = None,
        max_depth_sigma: float | None = None,
        expected_px: FloatArray | None = None,
    ) -> None:
        self.camera = camera
        self._prior = np.zeros((DISPARITY_TERMS, DISPARITY_TERMS))
        if expected_px is not None:
            self._prior = np.diag((self._border_scale() / expected_px) ** 2)
        self.max_depth_sigma = max_depth_sigma or StereoConfig().max_depth_sigma
        self.config = config or DisparityCheckConfig()
        self._frames: deque[StereoObservations] = deque(maxlen=self._LONGEST_GAP + 1)
        self._pairs: list[tuple[StereoObservations, StereoObservations]] = []

    @property
    def ready(self) -> bool:
        """Whether enough moving frames came for a finding."""
        return self.pairs >= self.config.frames

    @property
    def pairs(self) -> int:
        """Pairs of frames with enough motion so far."""
        return len(self._pairs)

    def add(self, observations: StereoObservations) -> None:
        """Take in the next frame, with tracked ids and uncorrected disparities."""
        now = set(observations.landmark_id.tolist())
        known = [] if not self._frames else self._frames[-1].landmark_id.tolist()
        tracked = len(now.intersection(known))
        self._frames.append(observations)
        for older in list(self._frames)[:-1]:
            shared = len(now.intersection(older.landmark_id.tolist()))
            if shared < max(self._LEAST_SHARED, self._SHARED * tracked):
                continue
            a, b = common_landmarks(older, observations)
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
        scale = self._border_scale()
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

    def _border_scale(self) -> FloatArray:
        """Largest value of each term in the image, (3,)."""
        camera = self.camera
        side = np.array([0.0, camera.width - 1.0]), np.array([0.0, camera.height - 1.0])
        return np.asarray(disparity_basis(camera, *side).max(axis=0))

    def _solve(self) -> tuple[FloatArray, FloatArray] | None:
        """Coefficients of the field over all pairs, and their covariance, where they tell."""
        enough = self._LAST_STEP_FLOORS * self.config.floor_px / self._border_scale()
        field = np.zeros(DISPARITY_TERMS)
        motions: list[FloatArray | None] = [None] * len(self._pairs)
        covariance: FloatArray = np.zeros((DISPARITY_TERMS, DISPARITY_TERMS))
        for _ in range(5):
            information = self._prior.copy()
            gradient = -self._prior @ field
            ratio: list[float] = []
            for k, pair in enumerate(self._pairs):
                problem, points_a, points_b = self._problem(*pair, field)
                if len(problem) < self._LEAST_SHARED:
                    continue
                start = motions[k]
                if start is None:
                    start = _first_motion(points_a, points_b)
                motion = problem.solve(start, self._KERNEL_SIGMA)
                motions[k] = motion
                whole, slope, chi2 = problem.linearise(motion, self._KERNEL_SIGMA)
                spread = np.linalg.eigvalsh(whole[:6, :6])
                if spread[0] <= 1e-12 * spread[-1]:
                    continue  # such landmarks do not tell the motion
                through = np.linalg.solve(whole[:6, :6], whole[:6, 6:]).T
                information += whole[6:, 6:] - through @ whole[:6, 6:]
                gradient += slope[6:] - through @ slope[:6]
                ratio.append(float(np.median(chi2)) / _MEDIAN_CHI2)
            spread = np.linalg.eigvalsh(information)
            if not ratio or spread[0] <= 1e-12 * spread[-1]:
                return None
            step = np.linalg.solve(information, gradient)
            field += step
            # a frame enters two pairs, once as the earlier and once as the later one
            inflation = 2.0 * max(1.0, float(np.median(ratio)))
            covariance = np.asarray(inflation * np.linalg.inv(information), dtype=np.float64)
            if (np.abs(step) < enough).all():
                break
        return field, covariance

    def _problem(
        self, a: StereoObservations, b: StereoObservations, field: FloatArray
    ) -> tuple[TwoViewProblem, FloatArray, FloatArray]:
        """Two-view problem with the disparity coefficients as further unknowns; its points.

        With D = D_measured - basis c, the point moves by X / D per px of error, and the
        disparity measured in b is the point's own plus the error there.
        """
        camera = self.camera
        basis_a = disparity_basis(camera, a.u_left, a.v)
        basis_b = disparity_basis(camera, b.u_left, b.v)
        disparity_a = a.disparity_px - basis_a @ field
        disparity_b = b.disparity_px - basis_b @ field
        keep = within_range(disparity_a, a.sigma_disparity_px, self.max_depth_sigma)
        keep &= within_range(disparity_b, b.sigma_disparity_px, self.max_depth_sigma)
        a, b, disparity_a, disparity_b = (
            a.select(keep), b.select(keep), disparity_a[keep], disparity_b[keep]
        )  # fmt: skip
        points_a = camera.triangulate(a.u_left, a.v, disparity_a)
        points_b = camera.triangulate(b.u_left, b.v, disparity_b)
        covariance_a = camera.triangulation_covariance(
            a.u_left, a.v, disparity_a, a.sigma_px, a.sigma_disparity_px
        )
        per_px = points_a / disparity_a[:, None]
        of_points = per_px[:, :, None] * basis_a[keep][:, None, :]
        terms = np.concatenate([of_points, basis_b[keep][:, None, :]], axis=1)
        seen_b = replace(b, u_right=b.u_left - disparity_b)
        problem = TwoViewProblem.of_landmarks(camera, points_a, covariance_a, seen_b, terms)
        return problem, points_a, points_b


def _first_motion(points_a: FloatArray, points_b: FloatArray) -> FloatArray:
    """Start of the least squares: rigid transform of the nearer half of the points (eq. 6)."""
    nearer = np.argsort(points_b[:, 2])[: max(3, len(points_b) // 2)]
    return rigid_transform(points_a[nearer], points_b[nearer])
