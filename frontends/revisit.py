"""Old places seen again: the motion between two views of a place that lie far apart in time.

What a view shows is kept in a compact form (`Place`). A later view is matched with it by
descriptors, within the window that the predicted motion allows, and the motion between both is
measured as between frames that follow each other (`frontends.relative`): RANSAC over rigid
motions of three landmarks, a test against chance agreement, least squares on the reprojection.
Landmarks are then looked for again near where that motion puts them, which finds more of them.

From another side, and under another sun, a feature is not quite the same point of the ground: it
walks over the surface as the view changes, as between frames (`frontends.tracking`), and as the
light does. What differs from landmark to landmark is noise of each; what they have in common
moves the whole view and is added to the covariance of the motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.geometry import inverse, transform_points
from frontends.matching import Matches, SearchWindows, match_in_windows
from frontends.measurements import RelativePose, StereoObservations
from frontends.rectification import observe
from frontends.relative import (
    LANDMARK_CORRELATION,
    MotionPrediction,
    RelativeConfig,
    RelativePositioning,
)
from frontends.stereo_features import StereoFeatures
from frontends.tracking import TrackingConfig

FloatArray = NDArray[np.float64]

#: Descriptors of unit length as whole numbers of this step: the squared distance of two changes
#: by 3e-4, a hundredth of what tells features apart.
_STEPS = 127.0
#: Landmarks are kept up to so many times the median depth.
_NEARER = 3.0
#: Half width of the window when the motion is known from a first match, in sigmas: twice the
#: gate, so that wrong matches still show as such.
_NEAR_SIGMAS = 7.0
_WINDOW_SIGMAS = 3.0
#: Descriptor distance ratios: when looked for in a wide window, and where the place is known.
_RATIO = 0.85
_NEAR_RATIO = 0.9
#: 1-sigma, as a share of a feature's size, of its walk over the surface under another light.
_BY_LIGHT = 0.03
#: What of the walk all features of a view have in common.
_COMMON = 0.3


@dataclass(frozen=True, slots=True)
class Place:
    """The landmarks of a keyframe, small enough to be kept for a whole drive.

    Attributes
    ----------
    frame
        Index of the keyframe.
    landmark_id
        (N,) int64, as tracked.
    uvd
        (N, 3) float32: u and v in the left image and the disparity, px.
    sigma_px
        (N, 2) float32: 1-sigma of the localisation and of the disparity, px.
    size_px
        (N,) float32 diameter of the image region a feature describes.
    laplacian
        (N,) int8.
    descriptors
        (N, D) int8, in steps of 1/127.
    """

    frame: int
    landmark_id: NDArray[np.int64]
    uvd: NDArray[np.float32]
    sigma_px: NDArray[np.float32]
    size_px: NDArray[np.float32]
    laplacian: NDArray[np.int8]
    descriptors: NDArray[np.int8]

    @classmethod
    def of(cls, frame: int, features: StereoFeatures, most: int) -> Place:
        """Keep the strongest `most` of the nearer landmarks of a frame.

        What lies beyond three times the median depth tells how the rover has turned, not where it
        is: with one wrong match nearby, many such landmarks would agree on a wrong place.

        Parameters
        ----------
        frame
            Index of the keyframe.
        features
            Its N landmarks with ids, strongest first, where they were detected: there they will be
            found again by their descriptors.
        most
            How many are kept.
        """
        observations = features.observations
        depth = observations.points_cam[:, 2]
        kept = np.flatnonzero(depth <= _NEARER * np.median(depth))[:most]
        seen = observations.select(kept)
        return cls(
            frame,
            seen.landmark_id,
            np.stack([seen.u_left, seen.v, seen.disparity_px], axis=-1).astype(np.float32),
            np.stack([seen.sigma_px, seen.sigma_disparity_px], axis=-1).astype(np.float32),
            features.size_px[kept].astype(np.float32),
            features.laplacian[kept],
            np.rint(features.descriptors[kept] * _STEPS).astype(np.int8),
        )

    def __len__(self) -> int:
        return len(self.landmark_id)

    @property
    def nbytes(self) -> int:
        """Memory that it takes, bytes."""
        return sum(
            array.nbytes
            for array in (
                self.landmark_id, self.uvd, self.sigma_px, self.size_px, self.laplacian,
                self.descriptors,
            )
        )  # fmt: skip

    def observations(self, camera: StereoCamera) -> StereoObservations:
        """The landmarks with their points triangulated anew."""
        u, v, disparity = self.uvd.T.astype(np.float64)
        sigma, sigma_disparity = self.sigma_px.T.astype(np.float64)
        return observe(camera, self.landmark_id, u, v, disparity, sigma, sigma_disparity)

    def corrected(self, observations: StereoObservations) -> Place:
        """The same place with what a correction of the disparities has left of its landmarks."""
        _, kept, rows = np.intersect1d(
            self.landmark_id, observations.landmark_id, assume_unique=True, return_indices=True
        )
        order = np.argsort(kept)
        kept, rows = kept[order], rows[order]
        seen = observations.select(rows)
        uvd = np.stack([seen.u_left, seen.v, seen.disparity_px], axis=-1).astype(np.float32)
        return replace(
            self, landmark_id=self.landmark_id[kept], uvd=uvd, sigma_px=self.sigma_px[kept],
            size_px=self.size_px[kept], laplacian=self.laplacian[kept],
            descriptors=self.descriptors[kept],
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Views:
    """A kept place, unpacked, and the view that may show it again."""

    place: Place
    old: StereoObservations
    descriptors: NDArray[np.float32]
    features: StereoFeatures


class Revisiting:
    """Measures the motion from an old view of a place to the present one.

    Parameters
    ----------
    camera
        The rectified pair.
    config
        Of relative positioning; its `false_alarms` is that of a closed loop.
    seed
        Of the random sampling.
    landmark_correlation
        As for `RelativePositioning`.
    tracking
        How features walk over the surface.
    """

    def __init__(
        self,
        camera: StereoCamera,
        config: RelativeConfig | None = None,
        seed: int = 0,
        landmark_correlation: float = LANDMARK_CORRELATION,
        tracking: TrackingConfig | None = None,
    ) -> None:
        self.camera = camera
        self._tracking = tracking or TrackingConfig()
        self._positioning = RelativePositioning(camera, config, seed, landmark_correlation)

    def measure(
        self,
        place: Place,
        features: StereoFeatures,
        prediction: MotionPrediction,
    ) -> RelativePose:
        """Motion from the old view to the new one, left cameras, or the reason why there is none.

        Parameters
        ----------
        place
            The old view.
        features
            Of the new view.
        prediction
            Motion from old to new as expected.
        """
        old = place.observations(self.camera)
        descriptors = place.descriptors.astype(np.float32) / np.float32(_STEPS)
        views = _Views(place, old, descriptors, features)
        size = place.size_px.astype(np.float64)
        half_px = self._window_px(old, prediction)
        first = self._estimate(views, prediction, half_px, _RATIO)
        if not first.accepted:
            return first
        known = MotionPrediction(first.a_T_b, first.covariance)
        walk = self._walk_px(old.points_cam, size, first.a_T_b)
        near_px = min(half_px, _NEAR_SIGMAS * float(np.median(np.hypot(old.sigma_px, walk))))
        return self._estimate(views, known, near_px, _NEAR_RATIO)

    def least_sigma_m(self, place: Place) -> float:
        """1-sigma of the position below which a view of a place cannot tell more, m."""
        depth = self.camera.depth(place.uvd[:, 2].astype(np.float64))
        walk_px = _BY_LIGHT * place.size_px.astype(np.float64)
        return _COMMON * float(np.median(walk_px * depth)) / self.camera.fx

    def _walk_px(self, points: FloatArray, size_px: FloatArray, a_T_b: FloatArray) -> FloatArray:
        """1-sigma of a feature's walk over the surface, seen from another place, px.

        A random walk: its variance grows with the change of the view, which is that of the
        logarithm of the distance and that of the direction (rad). `points` are the landmarks in
        the old view's axes, `a_T_b` leads from the new view's there.
        """
        here = points - a_T_b[:3, 3]
        old_range, new_range = np.linalg.norm(points, axis=1), np.linalg.norm(here, axis=1)
        cosine = np.sum(points * here, axis=1) / np.maximum(old_range * new_range, 1e-9)
        direction = np.arccos(np.clip(cosine, -1.0, 1.0))
        distance = np.abs(np.log(np.maximum(old_range, 1e-6) / np.maximum(new_range, 1e-6)))
        variance = self._tracking.scale_change_sigma**2 * (distance + direction) + _BY_LIGHT**2
        return np.asarray(size_px * np.sqrt(variance))

    def _estimate(
        self, views: _Views, prediction: MotionPrediction, half_px: float, ratio: float
    ) -> RelativePose:
        matches = self._match(views, prediction, half_px, ratio)
        old = views.old
        points = old.points_cam[matches.query]
        size = np.maximum(views.place.size_px[matches.query], views.features.size_px[matches.train])
        seen = views.features.observations.select(matches.train)
        walk = self._walk_px(points, size, prediction.a_T_b)
        seen = replace(
            seen,
            landmark_id=old.landmark_id[matches.query],
            sigma_px=np.hypot(seen.sigma_px, walk),
            sigma_disparity_px=np.hypot(
                seen.sigma_disparity_px, self._tracking.surface_slope * walk
            ),
        )
        measured = self._positioning.estimate(
            points, old.points_covariance[matches.query], seen, prediction
        )
        if not measured.accepted:
            return measured
        inlier = np.isin(seen.landmark_id, measured.inlier_ids)
        common = _COMMON * self._walk_px(points, size, measured.a_T_b)[inlier] / self.camera.fx
        turn = float(np.median(common))
        shift_m = float(np.median(common * seen.points_cam[inlier, 2]))
        covariance = measured.covariance + np.diag([turn**2] * 3 + [shift_m**2] * 3)
        return replace(measured, covariance=covariance)

    def _match(
        self, views: _Views, prediction: MotionPrediction, half_px: float, ratio: float
    ) -> Matches:
        camera, old, observations = self.camera, views.old, views.features.observations
        points = transform_points(inverse(prediction.a_T_b), old.points_cam)
        with np.errstate(divide="ignore", invalid="ignore"):
            projected = camera.project(points)
        u, v = projected[:, 0], projected[:, 2]
        reach = half_px >= camera.width
        if reach:  # nothing is known: anywhere in the image
            u, v = np.full(len(old), camera.cx), np.full(len(old), camera.cy)
            rows = np.arange(len(old))
        else:
            rows = np.flatnonzero((points[:, 2] > 0.0) & camera.contains(u, v, -half_px))
        matches = match_in_windows(
            views.descriptors[rows],
            views.place.laplacian[rows],
            SearchWindows(u[rows], v[rows], half_px, half_px),
            views.features.descriptors,
            views.features.laplacian,
            np.stack([observations.u_left, observations.v], axis=-1),
            ratio=ratio,
        )
        return Matches(rows[matches.query], matches.train, matches.distance2, matches.candidates)

    def _window_px(self, old: StereoObservations, prediction: MotionPrediction) -> float:
        """Half width of the window that the prediction leaves open, for the nearer landmarks."""
        turn = float(np.sqrt(np.linalg.eigvalsh(prediction.covariance[:3, :3])[-1]))
        shift = float(np.sqrt(np.linalg.eigvalsh(prediction.covariance[3:, 3:])[-1]))
        near = float(np.percentile(old.points_cam[:, 2], 25.0)) if len(old) else 1.0
        wide = _WINDOW_SIGMAS * self.camera.fx * (turn + shift / near)
        return min(wide + 8.0, float(max(self.camera.width, self.camera.height)))
