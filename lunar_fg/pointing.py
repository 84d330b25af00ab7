"""Two views of one turning camera: the rotation that their labels state, and the images'.

A mast turns its camera about a point some centimetres away, so near ground moves by more than
the rotation. The shift is taken from the labels (it is the mast's geometry) and the rotation
from the matches: each must lie on its epipolar line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from frontends.cahv import CahvCamera
from frontends.errors import EstimationError
from frontends.geometry import inverse, so3_exp, so3_log
from frontends.measurements import Image
from lunar_fg.match import MatchModel, match_images

FloatArray = NDArray[np.float64]

_ENOUGH_MATCHES = 20
#: A shift below this moves nothing by a tenth of a pixel beyond 10 m: a pure rotation.
_NO_SHIFT_M = 1e-3


@dataclass(frozen=True, slots=True)
class PointingComparison:
    """A relative rotation by labels and by images.

    Attributes
    ----------
    labelled_deg, measured_deg
        Angle of the rotation.
    difference_deg
        Angle between the two rotations.
    sigma_deg
        1-sigma of the measured one, each axis, by the scatter of the matches; errors of the
        lens model are not in it.
    matches
        That the rotation rests on.
    residual_px
        Their median distance from the epipolar line.
    a_R_b
        (3, 3) the measured rotation, camera axes.
    """

    labelled_deg: float
    measured_deg: float
    difference_deg: float
    sigma_deg: FloatArray
    matches: int
    residual_px: float
    a_R_b: FloatArray


def compare_pointings(
    images: tuple[Image, Image], cameras: tuple[CahvCamera, CahvCamera], *, seed: int = 0
) -> PointingComparison:
    """Measure the rotation between two views of one camera and hold it against the labels.

    Parameters
    ----------
    images
        Grey, as taken.
    cameras
        Their models, both in the same rover frame.
    seed
        Of RANSAC.

    Raises
    ------
    EstimationError
        When too few matches agree.
    """
    result = match_images(*images, MatchModel.FUNDAMENTAL, seed=seed)
    if result.reason or result.inliers < _ENOUGH_MATCHES:
        raise EstimationError(
            f"the two views cannot be compared: {result.reason or f'{result.inliers} matches'}"
        )
    rays_a = cameras[0].in_own_axes().rays(result.first_xy)
    rays_b = cameras[1].in_own_axes().rays(result.second_xy)
    a_T_b = inverse(cameras[0].reference_T_camera()) @ cameras[1].reference_T_camera()
    labelled, shift = a_T_b[:3, :3], a_T_b[:3, 3]
    focal = cameras[0].focal_px

    def residual(turn: FloatArray) -> FloatArray:
        turned = rays_b @ (so3_exp(turn) @ labelled).T
        if np.linalg.norm(shift) < _NO_SHIFT_M:
            return np.asarray(focal * (rays_a - turned)).ravel()
        normal = np.cross(shift, turned)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return np.asarray(focal * np.sum(rays_a * normal, axis=1))

    found = cast(Any, least_squares(residual, np.zeros(3), loss="cauchy", f_scale=0.5))
    rest = residual(found.x)
    sigma_px = 1.4826 * float(np.median(np.abs(rest)))
    covariance = np.linalg.inv(found.jac.T @ found.jac) * sigma_px**2
    measured = so3_exp(found.x) @ labelled
    return PointingComparison(
        _angle_deg(labelled),
        _angle_deg(measured),
        float(np.degrees(np.linalg.norm(found.x))),
        np.degrees(np.sqrt(np.diag(covariance))),
        result.inliers,
        float(np.median(np.abs(rest))),
        measured,
    )


def _angle_deg(rotation: FloatArray) -> float:
    return float(np.degrees(np.linalg.norm(so3_log(rotation))))
