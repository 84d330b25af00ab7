"""What passes between the parts: frozen dataclasses of numpy arrays.

Every measurement carries its covariance. Pose covariances are 6x6 in GTSAM's order
(rotation in rad, then translation in m) and perturb on the right, in the axes of the
pose's body frame. ``a_T_b`` maps coordinates of `b` to coordinates of `a`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.geometry import adjoint, inverse
from frontends.rows import replaced_rows, selected_rows

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class WheelOdometry:
    """Motion by the wheels since the frame before, in the rover axes of that frame."""

    d_forward_m: float
    d_lateral_m: float
    d_yaw_rad: float


@dataclass(frozen=True, slots=True)
class Attitude:
    """Rover attitude: map from rover = Rz(yaw) Ry(pitch) Rx(roll), z up, rad."""

    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    sigma_rp_rad: float
    sigma_yaw_rad: float


@dataclass(frozen=True, slots=True)
class SunDirection:
    """Direction to the Sun: azimuth clockwise from map north, elevation above level, deg."""

    azimuth_deg: float
    elevation_deg: float


@dataclass(frozen=True, slots=True)
class StereoFrame:
    """One rectified stereo pair and what else was measured at its time.

    Attributes
    ----------
    index
        Frame number in the dataset.
    stamp_s
        Time, s, strictly increasing within a dataset.
    left, right
        Grey images, uint8, (height, width) of `camera`.
    odometry
        Wheel increment since the previous frame of the dataset, where there is one.
    attitude, sun
        Where the dataset has them.
    """

    index: int
    stamp_s: float
    left: Image
    right: Image
    camera: StereoCamera
    odometry: WheelOdometry | None = None
    attitude: Attitude | None = None
    sun: SunDirection | None = None


@dataclass(frozen=True, slots=True)
class UnusableFrame:
    """A frame whose images cannot be used; the run goes on without them."""

    index: int
    stamp_s: float
    reason: str
    odometry: WheelOdometry | None = None
    attitude: Attitude | None = None


@dataclass(frozen=True, slots=True)
class StereoObservations:
    """Landmarks seen in one rectified pair.

    Attributes
    ----------
    landmark_id
        (N,) int64; the same landmark keeps its id over frames.
    u_left, u_right, v
        (N,) px; one common v, since the pair is rectified.
    sigma_px
        (N,) 1-sigma of the localisation in the left image, each axis, px.
    sigma_disparity_px
        (N,) 1-sigma of ``u_left - u_right``, independent of the localisation error, px.
    points_cam
        (N, 3) triangulated points in left-camera axes, m.
    points_covariance
        (N, 3, 3) by propagation of the above, m^2.
    """

    landmark_id: IntArray
    u_left: FloatArray
    u_right: FloatArray
    v: FloatArray
    sigma_px: FloatArray
    sigma_disparity_px: FloatArray
    points_cam: FloatArray
    points_covariance: FloatArray

    def __len__(self) -> int:
        return len(self.landmark_id)

    @property
    def disparity_px(self) -> FloatArray:
        """``u_left - u_right``, px, (N,)."""
        return np.asarray(self.u_left - self.u_right)

    def pixel_covariance(self) -> FloatArray:
        """Covariance of (u_left, u_right, v), (N, 3, 3), px^2.

        The right coordinate is the left one less the disparity, so it shares the left
        one's localisation error.
        """
        result = np.zeros((len(self), 3, 3))
        s2 = self.sigma_px**2
        result[:, 0, 0] = result[:, 0, 1] = result[:, 1, 0] = result[:, 2, 2] = s2
        result[:, 1, 1] = s2 + self.sigma_disparity_px**2
        return result

    def select(self, keep: NDArray[np.bool_] | IntArray) -> StereoObservations:
        """The observations at a boolean mask or an index array."""
        return selected_rows(self, keep)

    def replaced(self, rows: IntArray, other: StereoObservations) -> StereoObservations:
        """These observations with others in the place of some rows."""
        return replaced_rows(self, rows, other)


class Verdict(StrEnum):
    """Whether a measurement is good enough to be used."""

    ACCEPTED = "accepted"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class RelativePose:
    """A measured motion between two frames, or the reason why there is none.

    Attributes
    ----------
    a_T_b
        (4, 4) pose of frame `b` in frame `a`.
    covariance
        (6, 6), right perturbation, in the axes of `b`.
    inlier_ids
        Landmark ids that agree with the motion, (M,).
    correspondences
        How many landmark correspondences were tried.
    verdict, reason
        A refused pose still holds the prediction, with the prediction's covariance.
    agreeing
        How many correspondences agree on the best motion, be it refused. Not kept in logs.
    """

    a_T_b: FloatArray
    covariance: FloatArray
    inlier_ids: IntArray
    correspondences: int
    verdict: Verdict
    reason: str = ""
    agreeing: int = 0

    @property
    def accepted(self) -> bool:
        """Whether the motion was measured, not only predicted."""
        return self.verdict is Verdict.ACCEPTED

    @property
    def wrong_match_rate(self) -> float:
        """Share of the correspondences that disagree with the motion; NaN without any."""
        if self.correspondences == 0:
            return float("nan")
        return 1.0 - len(self.inlier_ids) / self.correspondences

    def in_frames(self, body_T_sensor: FloatArray) -> RelativePose:
        """The same motion between bodies that carry the sensor at `body_T_sensor`."""
        rotate = adjoint(body_T_sensor)
        return RelativePose(
            body_T_sensor @ self.a_T_b @ inverse(body_T_sensor),
            rotate @ self.covariance @ rotate.T,
            self.inlier_ids,
            self.correspondences,
            self.verdict,
            self.reason,
            self.agreeing,
        )


@dataclass(frozen=True, slots=True)
class Odometry:
    """A motion from wheels and attitude, independent of the images."""

    a_T_b: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class Tilt:
    """Roll and pitch against gravity or Sun; 1-sigma of both, rad."""

    roll_rad: float
    pitch_rad: float
    sigma_rad: float


@dataclass(frozen=True, slots=True)
class FixCandidate:
    """One place that the rover may be at, as an absolute measurement sees it.

    Attributes
    ----------
    x_m, y_m, yaw_rad
        Of the rover, in map axes; yaw counter-clockwise from map x.
    covariance
        (3, 3) of (x, y, yaw), map axes. Where yaw was not measured, its sigma is large.
    score
        How well it fits, in the proposer's own measure (correlation, or inlier share).
    proposer
        Name of the method that found it.
    inliers
        Matches that agree with it, where it was found from matches.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    covariance: FloatArray
    score: float = 1.0
    proposer: str = ""
    inliers: int = 0


@dataclass(frozen=True, slots=True)
class AbsoluteFix:
    """Where a keyframe is in the map, or the reason why that cannot be said.

    Attributes
    ----------
    frame
        Index of the keyframe.
    candidates
        Places, the best first; at most one is true. Empty when refused.
    second_best_ratio
        Score of the second-best place over that of the best, 0 to 1; 1 is ambiguous.
    height_m, sigma_height_m
        Rover's height from the orbital elevation model, where there is one.
    window_m
        Part of the map that was searched: x and y from, x and y to, m, map frame.
    reason
        Why there is no candidate.
    """

    frame: int
    candidates: tuple[FixCandidate, ...] = ()
    second_best_ratio: float = 0.0
    height_m: float | None = None
    sigma_height_m: float | None = None
    window_m: tuple[float, float, float, float] | None = None
    reason: str = ""

    @property
    def verdict(self) -> Verdict:
        """Whether there is anything to use; whether it is true, the graph decides."""
        return Verdict.ACCEPTED if self.candidates else Verdict.REFUSED


@dataclass(frozen=True, slots=True)
class StartPrior:
    """Where the rover starts; sigmas about and along the rover's own axes."""

    map_T_rover: FloatArray = field(default_factory=lambda: np.eye(4))
    sigma_rot_rad: tuple[float, float, float] = (1e-4, 1e-4, 1e-4)
    sigma_trans_m: tuple[float, float, float] = (1e-3, 1e-3, 1e-3)

    def covariance(self) -> FloatArray:
        """(6, 6), rotation then translation, rover axes."""
        sigmas = np.array([*self.sigma_rot_rad, *self.sigma_trans_m])
        return np.diag(sigmas**2)


@dataclass(frozen=True, slots=True)
class Estimate:
    """Where the rover is, after one frame.

    Attributes
    ----------
    index, stamp_s
        Of the frame.
    map_T_rover
        (4, 4).
    covariance
        (6, 6), right perturbation, rover axes (see the module's text).
    lost
        True when the motion since the frame before is only predicted.
    used
        Names of the measurements that went in, e.g. ``("stereo landmarks",)``.
    refused
        What did not go in, each with its reason.
    """

    index: int
    stamp_s: float
    map_T_rover: FloatArray
    covariance: FloatArray
    lost: bool = False
    used: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
