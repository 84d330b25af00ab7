"""Keyframes to the factors of the whole graph: every stereo landmark factor, every motion."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from frontends.camera import StereoCamera
from frontends.geometry import adjoint, inverse, transform_points
from frontends.measurements import FloatArray, IntArray, StartPrior
from lunar_fg.graph.config import GraphConfig
from lunar_fg.graph.factors import (
    StereoFactors,
    between_factor,
    landmark_key,
    pose_key,
    start_factor,
    tilt_factor,
)
from lunar_fg.graph.keyframe import Entered, Keyframe, floored, no_motion
from lunar_fg.graph.tracks import Sightings, TrackTable

#: A point whose disparity is below this many sigmas has no usable depth as x, y, z.
_LEAST_DISPARITY_SIGMA = 4.0


@dataclass(frozen=True, slots=True)
class NewFactors:
    """What a keyframe adds to the whole graph.

    Attributes
    ----------
    factors
        All of them.
    landmarks
        Keys of new landmarks, each with the ordinal of the keyframe that saw it first and
        its point there, camera axes, m.
    previous_T_rover
        Initial motion since the keyframe before, rover frames; None at the first.
    entered
        How the keyframe was taken in.
    """

    factors: gtsam.NonlinearFactorGraph
    landmarks: tuple[tuple[int, int, FloatArray], ...]
    previous_T_rover: FloatArray | None
    entered: Entered


@dataclass(frozen=True, slots=True)
class _Pending:
    """The first sighting of a track, kept until a second one makes it a landmark."""

    ordinal: int
    uuv: FloatArray
    covariance: FloatArray


class WholeGraph:
    """Makes the factors of ``landmarks="full"`` and of the offline optimiser.

    Parameters
    ----------
    camera, rover_T_camera, start, config
        As for `IncrementalSmoother`.
    """

    def __init__(
        self,
        camera: StereoCamera,
        rover_T_camera: FloatArray,
        start: StartPrior,
        config: GraphConfig,
    ) -> None:
        self._camera = camera
        self._rover_T_camera = rover_T_camera
        self._start = start
        self._config = config
        self._stereo = StereoFactors(camera, rover_T_camera, config.robust_threshold_sigma)
        self._tracks = TrackTable(camera, config.gate_probability, config.max_track_gap)
        self._pending: dict[int, _Pending] = {}
        self._known: dict[int, int] = {}
        self._count = 0

    def add(self, keyframe: Keyframe) -> NewFactors:
        """Factors of the next keyframe.

        Raises
        ------
        InputError
            When nothing connects it to the keyframe before.
        """
        here, factors = self._count, gtsam.NonlinearFactorGraph()
        source = f"keyframe {keyframe.index}"
        sightings = Sightings.of(keyframe.observations)
        used: list[str] = []
        if here == 0:
            factors.add(start_factor(pose_key(0), self._start))
            tracked = self._tracks.add(sightings, None, None)
            previous_T_rover = None
            lost = False
            used.append("start")
        else:
            motion = keyframe.motion(self._rover_T_camera)
            if motion is None:
                raise no_motion(source)
            relative, odometry = keyframe.relative, keyframe.odometry
            measured = relative is not None and relative.accepted
            trusted = relative is None or measured
            tracked = self._tracks.add(
                sightings, motion, self._config.min_tracks if trusted else None
            )
            enough = tracked.linked > 0
            ends = (pose_key(here - 1), pose_key(here))
            if enough:
                used.append("stereo landmarks")
            if odometry is not None:
                factors.add(
                    between_factor(*ends, odometry.a_T_b, floored(odometry.covariance), source)
                )
                used.append("odometry")
            previous_T_rover, covariance = in_rover_frames(*motion, self._rover_T_camera)
            if not enough and (odometry is None or measured):
                factors.add(between_factor(*ends, previous_T_rover, covariance, source))
                used.append("relative pose" if measured else "prediction")
            lost = not (enough or measured)
        landmarks = self._add_landmarks(factors, sightings, tracked.track, here)
        if keyframe.tilt is not None:
            factors.add(tilt_factor(pose_key(here), keyframe.tilt, source))
            used.append("tilt")
        self._count += 1
        entered = Entered(tracked.linked, tracked.cut, tuple(used), lost)
        return NewFactors(factors, landmarks, previous_T_rover, entered)

    def _add_landmarks(
        self,
        factors: gtsam.NonlinearFactorGraph,
        sightings: Sightings,
        tracks: IntArray,
        here: int,
    ) -> tuple[tuple[int, int, FloatArray], ...]:
        landmarks = []
        disparity = sightings.uuv[:, 0] - sightings.uuv[:, 1]
        covariance = sightings.covariance
        sigma = np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1] - 2.0 * covariance[:, 0, 1])
        near = disparity > _LEAST_DISPARITY_SIGMA * sigma
        for row, track in enumerate(tracks.tolist()):
            uuv, noise = sightings.uuv[row], covariance[row]
            if track in self._known:
                self._known[track] = here
            elif track in self._pending:
                first = self._pending.pop(track)
                point = self._camera.triangulate(
                    first.uuv[:1], first.uuv[2:], first.uuv[:1] - first.uuv[1:2]
                )[0]
                key = landmark_key(track)
                landmarks.append((key, first.ordinal, point))
                factors.add(
                    self._stereo.create(pose_key(first.ordinal), key, first.uuv, first.covariance)
                )
                self._known[track] = here
            else:
                if near[row]:
                    self._pending[track] = _Pending(here, uuv, noise)
                continue
            factors.add(self._stereo.create(pose_key(here), landmark_key(track), uuv, noise))
        oldest = here - self._config.max_track_gap
        self._pending = {t: p for t, p in self._pending.items() if p.ordinal > oldest}
        self._known = {t: seen for t, seen in self._known.items() if seen > oldest}
        return tuple(landmarks)


def in_rover_frames(
    a_T_b: FloatArray, covariance: FloatArray, rover_T_camera: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Turn a camera motion and its covariance into the rover's."""
    rotate = adjoint(rover_T_camera)
    return rover_T_camera @ a_T_b @ inverse(rover_T_camera), rotate @ covariance @ rotate.T


def map_point(map_T_rover: FloatArray, rover_T_camera: FloatArray, point: FloatArray) -> FloatArray:
    """Put a camera point (3,) into the map."""
    return np.asarray(transform_points(map_T_rover @ rover_T_camera, point[None])[0])
