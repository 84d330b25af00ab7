"""Factors, each checked before it reaches GTSAM."""

from __future__ import annotations

import gtsam
import numpy as np

from frontends.errors import InputError
from frontends.measurements import FloatArray, StartPrior, Tilt
from lunar_fg.graph.checks import check_covariance, check_finite, check_pose
from lunar_fg.graph.setup import Setup


def pose_key(ordinal: int) -> int:
    """GTSAM's key of the pose of the n-th keyframe."""
    return int(gtsam.symbol("x", ordinal))


def landmark_key(track: int) -> int:
    """GTSAM's key of the point of a landmark track."""
    return int(gtsam.symbol("l", track))


def gaussian(covariance: FloatArray, source: str, field: str) -> gtsam.noiseModel.Gaussian:
    """Noise model of a checked, positive definite covariance."""
    check_covariance(covariance, len(covariance), source, field)
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError as error:
        raise InputError(
            "is singular", source=source, field=field, remedy="give every direction a sigma above 0"
        ) from error
    return gtsam.noiseModel.Gaussian.Covariance(covariance)


def start_factor(key: int, start: StartPrior) -> gtsam.PriorFactorPose3:
    """Prior on the first pose."""
    check_pose(start.map_T_rover, "start", "map_T_rover")
    noise = gaussian(start.covariance(), "start", "sigmas")
    return gtsam.PriorFactorPose3(key, gtsam.Pose3(start.map_T_rover), noise)


def between_factor(
    first: int, second: int, a_T_b: FloatArray, covariance: FloatArray, source: str
) -> gtsam.BetweenFactorPose3:
    """Measured motion between two poses, covariance in the axes of the second."""
    check_pose(a_T_b, source, "motion")
    noise = gaussian(covariance, source, "covariance")
    return gtsam.BetweenFactorPose3(first, second, gtsam.Pose3(a_T_b), noise)


def tilt_factor(key: int, tilt: Tilt, source: str) -> gtsam.AttitudeFactorPose3:
    """Roll and pitch against the map's vertical; heading stays free."""
    check_finite([tilt.roll_rad, tilt.pitch_rad, tilt.sigma_rad], source, "tilt")
    if tilt.sigma_rad <= 0.0:
        raise InputError("must be above 0", source=source, field="tilt.sigma_rad")
    return upright_factor(key, up_in_rover(tilt), tilt.sigma_rad)


def up_in_rover(tilt: Tilt) -> FloatArray:
    """Direction of the map's vertical in rover axes, (3,)."""
    sp, cp = np.sin(tilt.pitch_rad), np.cos(tilt.pitch_rad)
    sr, cr = np.sin(tilt.roll_rad), np.cos(tilt.roll_rad)
    return np.array([-sp, cp * sr, cp * cr])


def upright_factor(key: int, up: FloatArray, sigma_rad: float) -> gtsam.AttitudeFactorPose3:
    """The map's vertical seen along `up` in rover axes."""
    noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma_rad)
    up_in_map = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
    return gtsam.AttitudeFactorPose3(key, up_in_map, noise, gtsam.Unit3(up))


class StereoFactors:
    """Stereo landmark factors of one camera with Huber's loss.

    Parameters
    ----------
    setup
        Of the graph; its poses are the rover's.
    """

    def __init__(self, setup: Setup) -> None:
        camera = setup.camera
        self._calibration = gtsam.Cal3_S2Stereo(
            camera.fx, camera.fy, 0.0, camera.cx, camera.cy, camera.baseline_m
        )
        self._rover_P_camera = gtsam.Pose3(setup.rover_T_camera)
        self._threshold = setup.config.robust_threshold_sigma

    def create(
        self,
        pose: int,
        landmark: int,
        uuv: FloatArray,
        covariance: FloatArray,
        inflation: float = 1.0,
    ) -> gtsam.GenericStereoFactor3D:
        """One factor; `uuv` (3,) px and `covariance` (3, 3) come checked from a keyframe.

        The factor's cost is divided by `inflation`; what it takes for an outlier stays the same.
        """
        loss = gtsam.noiseModel.mEstimator.Huber.Create(self._threshold / np.sqrt(inflation))
        noise = gtsam.noiseModel.Robust.Create(
            loss, gtsam.noiseModel.Gaussian.Covariance(inflation * covariance)
        )
        measured = gtsam.StereoPoint2(uuv[0], uuv[1], uuv[2])
        return gtsam.GenericStereoFactor3D(
            measured, noise, pose, landmark, self._calibration, self._rover_P_camera
        )
