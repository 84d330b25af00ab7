"""Nothing reaches GTSAM unchecked: it accepts NaN and non-PSD matrices in silence, or aborts."""

from __future__ import annotations

from typing import Any

import numpy as np

from frontends.errors import InputError
from frontends.geometry import is_rigid
from frontends.measurements import AbsoluteFix, FloatArray, StereoObservations

_PSD_TOLERANCE = 1e-9
#: m: far past any map; beyond it squares overflow.
_LARGEST = 1e9


def check_finite(value: Any, source: str, field: str) -> None:
    """Raise `InputError` unless every number in `value` is finite."""
    if not np.isfinite(np.asarray(value, dtype=np.float64)).all():
        raise InputError(
            "holds a value that is not finite", source=source, field=field,
            remedy="drop the measurement or give numbers",
        )  # fmt: skip


def check_size(value: Any, source: str, field: str) -> None:
    """Raise `InputError` unless every number in `value` is finite and below 1e9."""
    check_finite(value, source, field)
    if np.abs(np.asarray(value, dtype=np.float64)).max(initial=0.0) > _LARGEST:
        raise InputError(
            f"holds a value above {_LARGEST:g}", source=source, field=field,
            remedy="give metres and radians in the map's own frame",
        )  # fmt: skip


def check_pose(value: FloatArray, source: str, field: str) -> None:
    """Raise `InputError` unless `value` is a finite rigid 4x4 transform."""
    if not is_rigid(value):
        raise InputError(
            "is not a finite rigid 4x4 transform", source=source, field=field,
            remedy="the upper left 3x3 must be a rotation, the last row 0 0 0 1",
        )  # fmt: skip


def check_covariance(value: FloatArray, size: int, source: str, field: str) -> None:
    """Raise `InputError` unless `value` is a finite, symmetric, positive semidefinite matrix."""
    value = np.asarray(value)
    if value.shape != (size, size):
        raise InputError(
            f"has shape {value.shape}", source=source, field=field,
            remedy=f"give a {size}x{size} matrix",
        )  # fmt: skip
    check_finite(value, source, field)
    if (value == value.T).all() and _is_definite(value):
        return
    scale = max(float(np.abs(value).max()), 1e-300)
    if np.abs(value - value.T).max() > 1e-6 * scale:
        raise InputError("is not symmetric", source=source, field=field, remedy="symmetrise it")
    if np.linalg.eigvalsh(value)[0] < -_PSD_TOLERANCE * scale:
        raise InputError(
            "is not positive semidefinite", source=source, field=field,
            remedy="a covariance has no negative eigenvalue; check its order and units",
        )  # fmt: skip


def check_observations(observations: StereoObservations, source: str) -> None:
    """Raise `InputError` on wrong shapes, non-finite pixels, sigmas of 0 or a repeated landmark."""
    n = len(observations)
    for name in ("u_left", "u_right", "v", "sigma_px", "sigma_disparity_px"):
        array = getattr(observations, name)
        if array.shape != (n,):
            raise InputError(
                f"has shape {array.shape}", source=source, field=f"observations.{name}",
                remedy=f"give one value for each of the {n} landmark ids",
            )  # fmt: skip
        check_finite(array, source, f"observations.{name}")
    for name in ("sigma_px", "sigma_disparity_px"):
        if n and getattr(observations, name).min() <= 0.0:
            raise InputError(
                "must be above 0", source=source, field=f"observations.{name}",
                remedy="give 1-sigma values in pixels",
            )  # fmt: skip
    ids = np.sort(observations.landmark_id)
    if (ids[1:] == ids[:-1]).any():
        raise InputError(
            "holds a landmark twice", source=source, field="observations.landmark_id",
            remedy="one observation of a landmark in a frame",
        )  # fmt: skip


def check_height(frame: int, height_m: float, sigma_m: float) -> None:
    """Raise `InputError` unless a height and its sigma are usable numbers."""
    source = f"keyframe {frame}"
    check_size([height_m, sigma_m], source, "height")
    if sigma_m <= 0.0:
        raise InputError(
            f"is {sigma_m}", source=source, field="height sigma", remedy="give metres, above 0"
        )


def check_fix(fix: AbsoluteFix) -> None:
    """Raise `InputError` unless every candidate of a fix is finite with a proper covariance."""
    source = f"fix of keyframe {fix.frame}"
    for number, place in enumerate(fix.candidates):
        field = f"candidate {number}"
        check_size([place.x_m, place.y_m, place.yaw_rad], source, field)
        check_covariance(place.covariance, 3, source, f"{field}, covariance")
        check_size(np.sqrt(np.abs(place.covariance)), source, f"{field}, covariance")
        if np.diag(place.covariance).min() <= 0.0 or not _is_definite(place.covariance):
            raise InputError(
                "is singular", source=source, field=f"{field}, covariance",
                remedy="give x, y and yaw a sigma above 0",
            )  # fmt: skip
    if (fix.height_m is None) != (fix.sigma_height_m is None):
        raise InputError("has no sigma, or no value", source=source, field="height_m")
    if fix.height_m is not None and fix.sigma_height_m is not None:
        check_height(fix.frame, fix.height_m, fix.sigma_height_m)


def check_closure(i: int, j: int, a_T_b: FloatArray, covariance: FloatArray) -> None:
    """Raise `InputError` unless a motion from keyframe `i` to a later one `j` is usable."""
    source = f"closure {i} to {j}"
    check_pose(a_T_b, source, "a_T_b")
    check_covariance(covariance, 6, source, "covariance")
    check_size(a_T_b, source, "a_T_b")
    check_size(np.sqrt(np.abs(covariance)), source, "covariance")
    if i >= j:
        raise InputError(
            "does not lead forward", source=source, remedy="give the earlier keyframe first"
        )


def _is_definite(covariance: FloatArray) -> bool:
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return False
    return True
