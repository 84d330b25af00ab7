"""How a small piece of ground looks from another place: the warp of its image.

A rectified pair shows the ground's slope: disparity is the inverse depth in the units of baseline
times focal length, and on a plane it is linear in the image,

    1 / Z = (D + d_u (u - u0) + d_v (v - v0)) / (B f).

So the ray of each pixel reaches the plane at R ray + t / Z of the other camera, but for the
scale, which is linear in u and v as well: a pixel p beside the landmark is seen at A p / (1 + g p)
beside it. On ground that the rover approaches the image grows by the square of the ratio of
distances along v, and by the ratio along u.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.geometry import inverse, transform_points

FloatArray = NDArray[np.float64]

_LEAST_DEPTH_M = 1e-3


def surface_warp(
    camera: StereoCamera, a_T_b: FloatArray, points_a: FloatArray, slope: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Warp A and bend g of the surface around landmarks from image a to image b.

    Parameters
    ----------
    camera
        The rectified pair.
    a_T_b
        (4, 4) of the left cameras.
    points_a
        (N, 3) on the surface, m.
    slope
        (N, 2) change of the disparity along u and along v in image a, px per px.

    Returns
    -------
    warp, bend
        (N, 2, 2) px per px, (N, 2) per px.
    """
    b_T_a = inverse(a_T_b)
    rotation, translation = b_T_a[:3, :3], b_T_a[:3, 3]
    depth = np.maximum(points_a[:, 2], _LEAST_DEPTH_M)
    seen = transform_points(b_T_a, points_a) / depth[:, None]
    per_px = slope / (camera.baseline_m * camera.fx)
    along_u = rotation[:, 0] / camera.fx + per_px[:, :1] * translation
    along_v = rotation[:, 1] / camera.fy + per_px[:, 1:] * translation
    scale = np.maximum(seen[:, 2], _LEAST_DEPTH_M)
    warp = np.empty((len(points_a), 2, 2))
    for column, along in enumerate((along_u, along_v)):
        for row, focal in enumerate((camera.fx, camera.fy)):
            moved = along[:, row] - seen[:, row] / scale * along[:, 2]
            warp[:, row, column] = focal * moved / scale
    bend = np.stack([along_u[:, 2], along_v[:, 2]], axis=-1) / scale[:, None]
    return warp, bend
