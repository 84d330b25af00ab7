"""Dense stereo (OpenCV's semi-global matching) of a rectified pair, as points of the ground."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import cv2
import numpy as np
from annotated_types import Ge, Gt
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.geometry import inverse, transform_points
from frontends.measurements import Image, StereoFrame
from frontends.rectification import RectificationError

FloatArray = NDArray[np.float64]

_BLOCK_PX = 5
#: Pixels at or below this grey level are shadow or sky: nothing but noise to match.
_DARK = 5


@dataclass(frozen=True, slots=True)
class DenseStereoConfig:
    """Settings of dense stereo.

    Attributes
    ----------
    cell_m
        Points of one pair are averaged over cells of this side.
    max_depth_sigma_m
        Useful range: largest 1-sigma of the depth.
    sigma_disparity_px
        1-sigma of a dense disparity.
    max_width_px
        Wider images are halved until they fit; the ground needs no finer ones.
    near_baselines
        Nearest depth searched where no landmarks tell it, in baselines.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "allow_inf_nan": False}

    cell_m: Annotated[float, Gt(0)] = 0.05
    max_depth_sigma_m: Annotated[float, Gt(0)] = 0.25
    sigma_disparity_px: Annotated[float, Gt(0)] = 0.3
    max_width_px: Annotated[int, Ge(32)] = 800
    near_baselines: Annotated[float, Gt(0)] = 4.0


@dataclass(frozen=True, slots=True)
class SurfacePoints:
    """What one stereo pair saw of the ground.

    Attributes
    ----------
    frame
        Index of the keyframe.
    points
        (N, 3) in rover axes at that keyframe, m, float32.
    sigma_m
        (N,) 1-sigma of the height, m. The errors of neighbouring points are alike.
    grey
        (N,) grey level of the left image, 0 to 255.
    count
        (N,) how many pixels a point is the mean of.
    """

    frame: int
    points: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    grey: NDArray[np.float32]
    count: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.points)

    def corrected(
        self,
        camera: StereoCamera,
        rover_T_camera: FloatArray,
        rectification: RectificationError,
    ) -> SurfacePoints:
        """The same points with a disparity error, found later, removed."""
        in_camera = transform_points(inverse(rover_T_camera), self.points.astype(np.float64))
        u, right, v = camera.project(in_camera).T
        disparity = u - right - rectification.disparity_at(camera, u, v)
        keep = disparity > 0.1 * (u - right)
        moved = camera.triangulate(u[keep], v[keep], disparity[keep])
        return SurfacePoints(
            self.frame,
            transform_points(rover_T_camera, moved).astype(np.float32),
            self.sigma_m[keep],
            self.grey[keep],
            self.count[keep],
        )


class DenseStereo:
    """Measures the ground in front of the rover.

    Parameters
    ----------
    camera, rover_T_camera
        The rectified pair and its place in the rover.
    config
        Settings.
    """

    def __init__(
        self,
        camera: StereoCamera,
        rover_T_camera: FloatArray,
        config: DenseStereoConfig | None = None,
    ) -> None:
        self.config = config or DenseStereoConfig()
        self._camera = camera
        self._rover_T_camera = np.array(rover_T_camera, dtype=np.float64)
        halvings = max(0, math.ceil(math.log2(camera.width / self.config.max_width_px)))
        self._scale = 2**halvings

    @property
    def range_m(self) -> float:
        """Useful range: beyond it the depth is less certain than the settings allow."""
        sigma = self.config.sigma_disparity_px * self._scale
        reach = self._camera.fx * self._camera.baseline_m
        return math.sqrt(self.config.max_depth_sigma_m * reach / sigma)

    def measure(
        self,
        frame: StereoFrame,
        rectification: RectificationError | None = None,
        near_m: float | None = None,
    ) -> SurfacePoints:
        """Points of the ground within the useful range.

        Parameters
        ----------
        frame
            The pair.
        rectification
            What rectification left over; removed.
        near_m
            Depth of the nearest ground, where it is known (from landmarks, say): the
            search is as long as that asks for.
        """
        rectification = rectification or RectificationError()
        camera, s = self._camera, self._scale
        left, right = _reduced(frame.left, s), _reduced(frame.right, s)
        # centre of a reduced pixel (i, j) lies at (s i + (s - 1) / 2, ...) of the full image
        v, u = np.mgrid[: left.shape[0], : left.shape[1]].astype(np.float64)
        u, v = s * u + 0.5 * (s - 1), s * v + 0.5 * (s - 1)
        error = np.zeros_like(u)
        if np.any(rectification.vertical_px):
            shift = rectification.vertical_at(camera, u.ravel(), v.ravel()).reshape(u.shape) / s
            columns, rows = np.meshgrid(np.arange(left.shape[1]), np.arange(left.shape[0]))
            right = np.asarray(
                cv2.remap(
                    right,
                    columns.astype(np.float32),
                    (rows - shift).astype(np.float32),
                    cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_REPLICATE,
                ),
                dtype=np.uint8,
            )
        if np.any(rectification.disparity_px):
            error = rectification.disparity_at(camera, u.ravel(), v.ravel()).reshape(u.shape)
        disparity, found = self._disparities(left, right, float(np.median(error)), near_m)
        disparity -= error
        reach = camera.fx * camera.baseline_m
        found &= disparity > reach / self.range_m
        found &= left > _DARK
        disparity, grey = disparity[found], left[found]
        points = camera.triangulate(u[found], v[found], disparity)
        # an error of depth moves the point along its ray: its height by the ray's share of up
        rays = points @ self._rover_T_camera[2, :3]
        sigma = self.config.sigma_disparity_px * s / disparity * np.maximum(np.abs(rays), 1e-3)
        in_rover = transform_points(self._rover_T_camera, points)
        return _averaged(frame.index, in_rover, sigma, grey, self.config.cell_m)

    def _disparities(
        self,
        left: NDArray[np.uint8],
        right: NDArray[np.uint8],
        error_px: float,
        near_m: float | None,
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Disparity of each pixel in px of the full image, and where there is one."""
        camera, s = self._camera, self._scale
        reach = camera.fx * camera.baseline_m
        near = near_m or self.config.near_baselines * camera.baseline_m
        least = math.floor((reach / self.range_m + error_px) / s) - 1
        most = math.ceil((reach / near + error_px) / s) + 1
        span = 16 * max(1, math.ceil((most - least) / 16))
        span = min(span, 16 * max(1, left.shape[1] // 32))
        matcher = cv2.StereoSGBM.create(
            minDisparity=least,
            numDisparities=span,
            blockSize=_BLOCK_PX,
            P1=8 * _BLOCK_PX**2,
            P2=32 * _BLOCK_PX**2,
            disp12MaxDiff=1,
            preFilterCap=31,
            uniquenessRatio=10,
            speckleWindowSize=100,
            speckleRange=1,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )
        raw = matcher.compute(left, right)
        found = raw > 16 * least
        # the ends of the search hold what belongs beyond them
        found &= raw < 16 * (least + span - 1)
        return raw.astype(np.float64) * (s / 16.0), found


def _reduced(image: Image, factor: int) -> Image:
    if factor == 1:
        return image
    size = (image.shape[1] // factor, image.shape[0] // factor)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _averaged(
    frame: int, points: FloatArray, sigma: FloatArray, grey: NDArray[np.uint8], cell_m: float
) -> SurfacePoints:
    """Mean over cells in the rover's plane."""
    if len(points) == 0:
        empty = np.zeros(0, dtype=np.float32)
        return SurfacePoints(
            frame, np.zeros((0, 3), dtype=np.float32), empty, empty, np.zeros(0, dtype=np.int32)
        )
    cells = np.floor(points[:, :2] / cell_m).astype(np.int64)
    cells -= cells.min(axis=0)
    key = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    _, member = np.unique(key, return_inverse=True)
    count = np.bincount(member)

    def mean(values: FloatArray) -> NDArray[np.float32]:
        return np.asarray(np.bincount(member, values) / count, dtype=np.float32)

    means = np.stack([mean(points[:, k]) for k in range(3)], axis=1)
    return SurfacePoints(
        frame, means, mean(sigma), mean(grey.astype(np.float64)), count.astype(np.int32)
    )
