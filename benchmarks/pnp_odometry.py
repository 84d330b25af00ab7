"""The odometry that anyone would write with OpenCV: a detector, brute force, PnP."""

from __future__ import annotations

import time

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.geometry import inverse, pose
from frontends.measurements import StereoFrame
from lunar_fg.stopwatch import Stopwatch
from lunar_fg.trajectory import Trajectory

FloatArray = NDArray[np.float64]

RATIO = 0.8
ROW_PX = 2.0
REPROJECTION_PX = 1.5
LEAST_INLIERS = 8


class PnpOdometry:
    """Stereo odometry from any ``cv2.Feature2D``: knn matching with ratio, PnP with RANSAC.

    A motion that cannot be found repeats the one before.
    """

    def __init__(
        self, camera: StereoCamera, rover_T_camera: FloatArray, detector: cv2.Feature2D, norm: int
    ) -> None:
        self.camera = camera
        self.stopwatch = Stopwatch(time.process_time)
        self.frames_lost = 0
        self._rover_T_camera = rover_T_camera
        self._detector = detector
        self._matcher = cv2.BFMatcher(norm)
        self._matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        self._previous: tuple[FloatArray, NDArray[np.generic]] | None = None
        self._motion = np.eye(4)
        self._poses: list[FloatArray] = []
        self._stamps: list[float] = []

    def step(self, frame: StereoFrame) -> None:
        """Take in the next frame."""
        with self.stopwatch.frame():
            with self.stopwatch.stage("stereo"):
                points, pixels, descriptors = self._landmarks(frame)
            if self._previous is not None:
                old_points, old_descriptors = self._previous
                with self.stopwatch.stage("tracking"):
                    pairs = self._matches(old_descriptors, descriptors)
                with self.stopwatch.stage("relative pose"):
                    self._move(old_points[pairs[:, 0]], pixels[pairs[:, 1]])
        self._previous = points, descriptors
        last = self._poses[-1] if self._poses else np.eye(4)
        self._poses.append(last @ self._motion)
        self._stamps.append(frame.stamp_s)

    def trajectory(self) -> Trajectory:
        """Poses of the rover, the first one at the origin."""
        camera = np.array(self._poses)
        mount = self._rover_T_camera
        return Trajectory(np.array(self._stamps), mount @ camera @ inverse(mount))

    def _landmarks(self, frame: StereoFrame) -> tuple[FloatArray, FloatArray, NDArray[np.generic]]:
        """Points in camera axes, their left pixels and descriptors."""
        left, left_descriptors = self._detector.detectAndCompute(frame.left, None)
        right, right_descriptors = self._detector.detectAndCompute(frame.right, None)
        pairs = self._matches(left_descriptors, right_descriptors)
        uv = np.array([left[i].pt for i in pairs[:, 0]]).reshape(-1, 2)
        others = np.array([right[j].pt for j in pairs[:, 1]]).reshape(-1, 2)
        disparity = uv[:, 0] - others[:, 0]
        good = (np.abs(uv[:, 1] - others[:, 1]) < ROW_PX) & (disparity > 1.0)
        points = self.camera.triangulate(uv[good, 0], uv[good, 1], disparity[good])
        return points, uv[good], left_descriptors[pairs[good, 0]]

    def _matches(self, query: NDArray[np.generic], train: NDArray[np.generic]) -> NDArray[np.intp]:
        found = self._matcher.knnMatch(query, train, 2)
        pairs = [
            (two[0].queryIdx, two[0].trainIdx)
            for two in found
            if len(two) == 2 and two[0].distance < RATIO * two[1].distance
        ]
        return np.array(pairs, np.intp).reshape(-1, 2)

    def _move(self, points: FloatArray, pixels: FloatArray) -> None:
        if len(points) >= LEAST_INLIERS:
            found, turn, shift, inliers = cv2.solvePnPRansac(
                points, pixels, self._matrix, None, iterationsCount=500,
                reprojectionError=REPROJECTION_PX, confidence=0.999,
            )  # fmt: skip
            if found and inliers is not None and len(inliers) >= LEAST_INLIERS:
                rows = inliers.ravel()
                turn, shift = cv2.solvePnPRefineLM(
                    points[rows], pixels[rows], self._matrix, None, turn, shift
                )
                self._motion = inverse(pose(cv2.Rodrigues(turn)[0], shift.ravel()))
                return
        self.frames_lost += 1
