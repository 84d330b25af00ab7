"""Tracking landmarks from frame to frame (paper, 2.2): search where the motion puts them.

A landmark is recognised by its descriptor, and then put where the patch around it is found: a
feature is not detected at quite the same point of the surface again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.foreshortening import surface_warp
from frontends.landmark_memory import LandmarkMemory
from frontends.matching import Matches, SearchWindows, match_in_windows
from frontends.measurements import RelativePose, StereoObservations
from frontends.rectification import observe
from frontends.relative import MotionPrediction, predicted_points
from frontends.stereo_features import StereoFeatures
from frontends.tracks import Tracks

FloatArray = NDArray[np.float64]

#: How far from its feature a patch may be found, in sigmas of the feature's place.
_REACH_SIGMAS = 4.0


class Reach(Enum):
    """How far from its predicted place a landmark is looked for; in this order."""

    NEAR = "near"
    WIDE = "wide"
    ANYWHERE = "anywhere"


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Settings of landmark tracking.

    Attributes
    ----------
    search_fraction
        Half width of the search window about a predicted position, as a share of the
        image width, once the motion is known.
    wide_search_fraction
        The same at the start and after a loss.
    max_unseen
        A landmark is kept for so many frames after it was last seen.
    ratio
        Largest ratio of nearest to second-nearest descriptor distance.
    scale_change_sigma
        A feature's centre walks over the surface while its distance changes: 1-sigma as a
        share of the feature's size, per square root of the logarithm of the distance.
    surface_slope
        How much of that movement turns into disparity.
    template_sigma_px
        1-sigma per axis of a landmark that is found by its patch, beside the noise of the images:
        the ground is not plane, nor is its light the same from all sides.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "allow_inf_nan": False}

    search_fraction: Annotated[float, Gt(0), Le(1)] = 0.04
    wide_search_fraction: Annotated[float, Gt(0), Le(1)] = 0.12
    max_unseen: Annotated[int, Ge(0)] = 2
    ratio: Annotated[float, Gt(0), Le(1)] = 0.85
    scale_change_sigma: Annotated[float, Ge(0)] = 0.08
    surface_slope: Annotated[float, Ge(0)] = 0.2
    template_sigma_px: Annotated[float, Gt(0)] = 0.1


class LandmarkTracker:
    """Gives the same landmark the same id over frames.

    Parameters
    ----------
    camera
        The rectified pair.
    config
        Settings.
    """

    def __init__(self, camera: StereoCamera, config: TrackingConfig | None = None) -> None:
        self.camera = camera
        self.config = config or TrackingConfig()
        self._memory: LandmarkMemory | None = None
        self._next_id = 0

    @property
    def state(self) -> tuple[LandmarkMemory | None, int]:
        """What is remembered, and the next new landmark's id: all that `restore` needs."""
        return self._memory, self._next_id

    def restore(self, memory: LandmarkMemory | None, next_id: int) -> None:
        """Go on from the `state` of another tracker."""
        self._memory, self._next_id = memory, next_id

    def associate(
        self,
        features: StereoFeatures,
        prediction: MotionPrediction,
        reach: Reach = Reach.NEAR,
    ) -> Tracks:
        """Match remembered landmarks with the features of a new frame.

        Parameters
        ----------
        features
            Of the new frame.
        prediction
            Expected motion since the previous frame.
        reach
            How far from the predicted positions to search.
        """
        memory = self._memory
        if memory is None or len(memory) == 0 or len(features) == 0:
            return Tracks.none(features)
        half = self._half_window_px(reach)
        points_b = predicted_points(prediction, memory.points)
        near = np.flatnonzero(points_b[:, 2] > 1e-3)
        u_left, _, v = self.camera.project(points_b[near]).T
        reached = self.camera.contains(u_left, v, -half)
        near = near[reached]
        seen = features.observations
        matches: Matches = match_in_windows(
            memory.descriptors[near],
            memory.laplacian[near],
            SearchWindows(u_left[reached], v[reached], half, half),
            features.descriptors,
            features.laplacian,
            np.stack([seen.u_left, seen.v], axis=-1),
            ratio=self.config.ratio,
        )
        chosen = near[matches.query]
        again = seen.select(matches.train)
        first_depth = memory.first_depth_m[chosen]
        return Tracks(
            memory.points[chosen],
            memory.covariance[chosen],
            replace(
                self._found_again(again, first_depth, features.size_px[matches.train]),
                landmark_id=memory.landmark_id[chosen],
            ),
            matches.train,
            first_depth,
            memory.slope[chosen],
            memory.templates.select(chosen),
            np.zeros(len(chosen), dtype=np.bool_),
        )

    def follow(self, features: StereoFeatures, tracks: Tracks, relative: RelativePose) -> Tracks:
        """Put the tracks that agree with a motion where their patches are found.

        Parameters
        ----------
        features, tracks, relative
            Of the new frame.
        """
        rows = np.flatnonzero(tracks.agreeing(relative))
        seen, feature = tracks.observations_b.select(rows), tracks.feature[rows]
        warp, bend = surface_warp(
            self.camera, relative.a_T_b, tracks.points_a[rows], tracks.slope[rows]
        )
        templates = tracks.templates.select(rows).turned(warp, bend)
        start = np.stack([seen.u_left, seen.v], axis=-1)
        found = templates.follow(features.image, start, _REACH_SIGMAS * seen.sigma_px)
        held, feature, uv = rows[found.found], feature[found.found], found.uv[found.found]
        moved = uv - start[found.found]
        at_feature = features.observations
        put = observe(
            self.camera,
            tracks.observations_b.landmark_id[held],
            uv[:, 0],
            uv[:, 1],
            at_feature.disparity_px[feature] + np.sum(features.slope[feature] * moved, axis=1),
            np.hypot(features.noise * found.sigma_px[found.found], self.config.template_sigma_px),
            at_feature.sigma_disparity_px[feature],
        )
        followed = tracks.followed.copy()
        followed[held] = True
        return replace(
            tracks,
            observations_b=tracks.observations_b.replaced(held, put),
            templates=tracks.templates.warped(rows, found.warp, templates.bend),
            followed=followed,
        )

    def in_view(self, prediction: MotionPrediction) -> int:
        """How many landmarks of the previous frame a predicted motion leaves in the picture."""
        memory = self._memory
        if memory is None:
            return 0
        return in_view(self.camera, memory.points[memory.unseen == 0], prediction)

    def commit(
        self, features: StereoFeatures, tracks: Tracks, relative: RelativePose
    ) -> StereoObservations:
        """Take the new frame in: tracked landmarks keep their id, all others get a new one.

        Parameters
        ----------
        features, tracks
            Of the new frame.
        relative
            The measured motion; its inliers are the tracks that hold.

        Returns
        -------
        StereoObservations
            All landmarks of the new frame, with ids.
        """
        holds = np.flatnonzero(tracks.agreeing(relative))
        tracked = tracks.feature[holds]
        new = self._first_seen(features)
        seen = new.replaced(tracked, tracks.observations_b.select(holds))
        first_depth = seen.points_cam[:, 2].copy()
        first_depth[tracked] = tracks.first_depth_m[holds]
        # the patch of the first sighting stays; where it is of no more use, the new one goes on
        moved = np.stack([seen.u_left, seen.v], -1) - np.stack([new.u_left, new.v], -1)
        sigma = np.zeros(len(seen))
        sigma[tracked] = seen.sigma_px[tracked]
        first = tracks.templates.select(holds)
        useful = first.useful()
        templates = features.templates.moved(moved, sigma).replaced(
            tracked[useful], first.select(useful)
        )
        current = LandmarkMemory(
            seen.landmark_id,
            features.descriptors,
            features.laplacian,
            seen.points_cam,
            seen.points_covariance,
            np.zeros(len(seen), dtype=np.int64),
            first_depth,
            features.slope,
            templates,
        )
        if self._memory is not None:
            older = self._memory.carried(relative.a_T_b, seen.landmark_id, self.config.max_unseen)
            current = current.joined(older)
        self._memory = current
        return seen

    def skip(self, relative: RelativePose) -> None:
        """Carry the memory over a frame without images."""
        if self._memory is not None:
            nothing = np.zeros(0, dtype=np.int64)
            self._memory = self._memory.carried(relative.a_T_b, nothing, self.config.max_unseen)

    def forget(self) -> None:
        """Drop all landmarks; ids go on."""
        self._memory = None

    def replace_points(self, observations: StereoObservations) -> None:
        """Forget all but the newest frame's landmarks and take their points anew."""
        if self._memory is None:
            return
        row = {int(i): k for k, i in enumerate(self._memory.landmark_id)}
        keep = np.array([row[int(i)] for i in observations.landmark_id], dtype=np.int64)
        self._memory = replace(
            self._memory.select(keep),
            points=observations.points_cam,
            covariance=observations.points_covariance,
        )

    def _half_window_px(self, reach: Reach) -> float:
        if reach is Reach.ANYWHERE:
            return float(max(self.camera.width, self.camera.height))
        near = reach is Reach.NEAR
        share = self.config.search_fraction if near else self.config.wide_search_fraction
        return share * self.camera.width

    def _first_seen(self, features: StereoFeatures) -> StereoObservations:
        """Features as new landmarks, each at the point that its patch defines."""
        seen = features.observations
        ids = self._next_id + np.arange(len(seen))
        self._next_id += len(seen)
        return observe(
            self.camera,
            ids,
            seen.u_left,
            seen.v,
            seen.disparity_px,
            np.minimum(seen.sigma_px, self.config.template_sigma_px),
            seen.sigma_disparity_px,
        )

    def _found_again(
        self, seen: StereoObservations, first_depth_m: FloatArray, size_px: FloatArray
    ) -> StereoObservations:
        """Features as landmarks first seen at a depth.

        They have the noise of both detections, and of the walk over the surface in between.
        """
        change = np.abs(np.log(np.maximum(first_depth_m, 1e-6) / seen.points_cam[:, 2]))
        walk = self.config.scale_change_sigma * size_px * np.sqrt(change)
        return observe(
            self.camera,
            seen.landmark_id,
            seen.u_left,
            seen.v,
            seen.disparity_px,
            np.hypot(np.sqrt(2.0) * seen.sigma_px, walk),
            np.hypot(seen.sigma_disparity_px, self.config.surface_slope * walk),
        )


def in_view(camera: StereoCamera, points_a: FloatArray, prediction: MotionPrediction) -> int:
    """How many points (N, 3) in a's axes a predicted motion leaves in the picture."""
    points_b = predicted_points(prediction, points_a)
    u_left, _, v = camera.project(points_b[points_b[:, 2] > 1e-3]).T
    return int(camera.contains(u_left, v, 0.0).sum())
