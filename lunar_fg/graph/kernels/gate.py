"""The two-view chi-square gate."""

from __future__ import annotations

import numpy as np

from frontends.jit import kernel
from frontends.measurements import FloatArray, IntArray
from lunar_fg.graph.kernels.projection import (
    pixel_residual,
    pixels_by_point,
    pose_columns,
    times_lower,
    to_camera,
    whitener_of,
)

_BEHIND = 1e30


@kernel
def distances(
    lens: FloatArray,
    old_uuv: FloatArray,
    old_covariance: FloatArray,
    new_uuv: FloatArray,
    new_covariance: FloatArray,
    age: IntArray,
    inverses: FloatArray,
    covariances: FloatArray,
) -> FloatArray:
    """Squared Mahalanobis distances of new sightings from what old ones predict, (M,).

    `inverses` (A, 4, 4) and `covariances` (A, 6, 6) are of the motion over each age.
    """
    result = np.empty(len(age))
    point, local, raw = np.empty(4), np.empty(4), np.empty(3)
    by_point, by_pose = np.empty((3, 4)), np.empty((3, 6))
    by_pixel, total, white = np.empty((3, 3)), np.empty((3, 3)), np.empty(6)
    for m in range(len(age)):
        inverse, covariance = inverses[age[m]], covariances[age[m]]
        point[0] = (old_uuv[m, 0] - lens[2]) / lens[0]
        point[1] = (old_uuv[m, 2] - lens[3]) / lens[1]
        point[2] = 1.0
        point[3] = (old_uuv[m, 0] - old_uuv[m, 1]) / lens[4]
        if not to_camera(inverse, point, local):
            result[m] = _BEHIND
            continue
        pixels_by_point(lens, local, by_point)
        pose_columns(by_point, local, by_pose)
        for r in range(3):
            a, b, c = by_point[r, 0], by_point[r, 1], by_point[r, 2]
            x = a * inverse[0, 0] + b * inverse[1, 0] + c * inverse[2, 0]
            y = a * inverse[0, 1] + b * inverse[1, 1] + c * inverse[2, 1]
            w = (a * inverse[0, 3] + b * inverse[1, 3] + c * inverse[2, 3] + by_point[r, 3]) / lens[
                4
            ]
            by_pixel[r, 0] = x / lens[0] + w
            by_pixel[r, 1] = -w
            by_pixel[r, 2] = y / lens[1]
        for r in range(3):
            for c in range(r + 1):
                value = new_covariance[m, r, c]
                for i in range(3):
                    for j in range(3):
                        value += by_pixel[r, i] * old_covariance[m, i, j] * by_pixel[c, j]
                for i in range(6):
                    for j in range(6):
                        value += by_pose[r, i] * covariance[i, j] * by_pose[c, j]
                total[r, c] = value
        whitener_of(total, white)
        pixel_residual(lens, local, new_uuv[m], raw)
        times_lower(white, raw)
        result[m] = raw[0] ** 2 + raw[1] ** 2 + raw[2] ** 2
    return result
