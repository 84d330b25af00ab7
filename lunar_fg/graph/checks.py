"""Nothing reaches GTSAM unchecked: it accepts NaN and non-PSD matrices in silence, or aborts."""

from __future__ import annotations

from typing import Any

import numpy as np

from frontends.errors import InputError
from frontends.geometry import is_rigid
from frontends.measurements import FloatArray, StereoObservations

_PSD_TOLERANCE = 1e-9


def check_finite(value: Any, source: str, field: str) -> None:
    """Raise `InputError` unless every number in `value` is finite."""
    if not np.isfinite(np.asarray(value, dtype=np.float64)).all():
        raise InputError(
            "holds a value that is not finite", source=source, field=field,
            remedy="drop the measurement or give numbers",
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
