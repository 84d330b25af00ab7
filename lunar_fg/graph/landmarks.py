"""Keyframes to the factors of the whole graph: every stereo landmark factor, every motion."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import gtsam
import numpy as np

from frontends.geometry import inverse, transform_points
from frontends.measurements import FloatArray, IntArray
from lunar_fg.graph.factors import (
    StereoFactors,
    between_factor,
    landmark_key,
    pose_key,
    start_factor,
    tilt_factor,
)
from lunar_fg.graph.keyframe import Entered, Keyframe, floored, no_motion
from lunar_fg.graph.motions import in_rover_frames
from lunar_fg.graph.setup import Setup
from lunar_fg.graph.tracks import Sightings, TrackTable, in_front

#: A point whose disparity is below this many sigmas has no usable depth as x, y, z; one that
#: moved so far out that its best disparity is below the other many has none any more.
_LEAST_DISPARITY_SIGMA = 4.0
_LEAST_DISPARITY_SIGMA_LATER = 1.0
#: GTSAM's symbols carry their letter in the highest byte.
_SYMBOL_SHIFT = 56


@dataclass(frozen=True, slots=True)
class NewFactors:
    """What a keyframe adds to the whole graph.

    Attributes
    ----------
    factors
        All of them.
    landmarks
        Keys of new landmarks, each with the ordinal of the keyframe that saw it better and
        its point there, camera axes, m.
    seen
        Keys of all landmarks that this keyframe sees.
    previous_T_rover, covariance
        Initial motion since the keyframe before and its covariance, rover frames; None at
        the first.
    entered
        How the keyframe was taken in.
    """

    factors: gtsam.NonlinearFactorGraph
    landmarks: tuple[tuple[int, int, FloatArray], ...]
    seen: tuple[int, ...]
    previous_T_rover: FloatArray | None
    covariance: FloatArray | None
    entered: Entered


@dataclass(frozen=True, slots=True)
class _Pending:
    """The first sighting of a track, kept until a second one makes it a landmark."""

    ordinal: int
    uuv: FloatArray
    covariance: FloatArray
    sigma_disparity: float


class WholeGraph:
    """Makes the factors of ``landmarks="full"`` and of the offline optimiser.

    Parameters
    ----------
    setup
        What it is made for.
    """

    def __init__(self, setup: Setup) -> None:
        self._camera, self._config = setup.camera, setup.config
        self._rover_T_camera, self._start = setup.rover_T_camera, setup.start
        self._stereo = StereoFactors(setup)
        self._tracks = TrackTable(setup)
        self._pending: dict[int, _Pending] = {}
        self._known: dict[int, int] = {}
        self._aside: set[int] = set()
        # Of each keyframe: landmark keys and ordinals (M, 2), and disparity sigmas (M,).
        self._sighted: list[tuple[IntArray, FloatArray]] = []
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
            previous_T_rover = covariance = None
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
        sighted = self._sighted[-1][0]
        seen = tuple(sighted[sighted[:, 1] == here, 0].tolist())
        if keyframe.tilt is not None:
            factors.add(tilt_factor(pose_key(here), keyframe.tilt, source))
            used.append("tilt")
        self._count += 1
        entered = Entered(tracked.linked, tracked.cut, tuple(used), lost)
        return NewFactors(factors, landmarks, seen, previous_T_rover, covariance, entered)

    def set_aside(self, keys: Iterable[int]) -> None:
        """Take no more sightings of these landmarks."""
        tracks = {int(gtsam.Symbol(key).index()) for key in keys}
        self._aside |= tracks
        for track in tracks:
            self._known.pop(track, None)

    def live(self) -> list[int]:
        """Keys of the landmarks that may be seen again."""
        return [landmark_key(track) for track in self._known]

    def first_seen(self) -> dict[int, int]:
        """Ordinal of the first keyframe that saw each landmark, by key."""
        table = np.concatenate([np.empty((0, 2), np.int64), *(rows for rows, _ in self._sighted)])
        keys, at = np.unique(table[:, 0], return_index=True)
        return dict(zip(keys.tolist(), table[at, 1].tolist(), strict=True))

    def unsound(self, values: gtsam.Values, latest: int | None = None) -> set[int]:
        """Landmarks that lie behind a camera that saw them, or too far out to have a depth.

        Their factors have no derivative there, so they make any system indeterminate.

        Parameters
        ----------
        values
            Poses and landmarks; those that are not there are not judged.
        latest
            Look at the sightings of this many last keyframes only.
        """
        keys = np.array(values.keys(), dtype=np.int64)
        kind = keys >> _SYMBOL_SHIFT
        poses, landmarks = keys[kind == ord("x")], keys[kind == ord("l")]
        if not len(landmarks):
            return set()
        rotation_translation = gtsam.utilities.extractPose3(values)
        points = gtsam.utilities.extractPoint3(values)
        chunks = self._sighted if latest is None else self._sighted[-latest:]
        table = np.concatenate([chunk[0] for chunk in chunks])
        sigma = np.concatenate([chunk[1] for chunk in chunks])
        pose_keys = pose_key(0) + table[:, 1]
        known = np.isin(table[:, 0], landmarks) & np.isin(pose_keys, poses)
        at = np.searchsorted(poses, pose_keys[known])
        rotation = rotation_translation[at, :9].reshape(-1, 3, 3)
        landmark = np.searchsorted(landmarks, table[known, 0])
        in_rover = np.einsum(
            "mji,mj->mi", rotation, points[landmark] - rotation_translation[at, 9:]
        )
        local = transform_points(inverse(self._rover_T_camera), in_rover)
        sound = in_front(np.hstack([local, np.ones((len(local), 1))]))
        depth = np.where(sound, local[:, 2], np.inf)
        snr = self._camera.fx * self._camera.baseline_m / depth / sigma[known]
        best = np.zeros(len(landmarks))
        np.maximum.at(best, landmark, snr)
        bad = best < _LEAST_DISPARITY_SIGMA_LATER
        bad[landmark[~sound]] = True
        return set(landmarks[bad].tolist())

    def _add_landmarks(
        self,
        factors: gtsam.NonlinearFactorGraph,
        sightings: Sightings,
        tracks: IntArray,
        here: int,
    ) -> tuple[tuple[int, int, FloatArray], ...]:
        landmarks = []
        rows: list[tuple[int, int]] = []
        sigmas: list[float] = []
        disparity = sightings.uuv[:, 0] - sightings.uuv[:, 1]
        covariance = sightings.covariance
        sigma = np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1] - 2.0 * covariance[:, 0, 1])
        near = disparity > _LEAST_DISPARITY_SIGMA * sigma
        inflation = 1.0 + self._config.landmark_correlation * len(self._known)
        for row, track in enumerate(tracks.tolist()):
            uuv, noise, key = sightings.uuv[row], covariance[row], landmark_key(track)
            if track in self._aside:
                continue
            if track in self._pending:
                first = self._pending.pop(track)
                now = _Pending(here, uuv, noise, float(sigma[row]))
                landmarks.append(self._first_point(key, first, now))
                factors.add(
                    self._stereo.create(
                        pose_key(first.ordinal), key, first.uuv, first.covariance, inflation
                    )
                )
                rows.append((key, first.ordinal))
                sigmas.append(first.sigma_disparity)
            elif track not in self._known:
                if near[row]:
                    self._pending[track] = _Pending(here, uuv, noise, float(sigma[row]))
                continue
            self._known[track] = here
            rows.append((key, here))
            sigmas.append(float(sigma[row]))
            factors.add(self._stereo.create(pose_key(here), key, uuv, noise, inflation))
        self._sighted.append((np.array(rows, dtype=np.int64).reshape(-1, 2), np.array(sigmas)))
        oldest = here - self._config.max_track_gap
        self._pending = {t: p for t, p in self._pending.items() if p.ordinal > oldest}
        self._known = {t: seen for t, seen in self._known.items() if seen > oldest}
        return tuple(landmarks)

    def _first_point(
        self, key: int, first: _Pending, second: _Pending
    ) -> tuple[int, int, FloatArray]:
        """Start a landmark where the better of its first two disparities puts it."""
        snr = [(s.uuv[0] - s.uuv[1]) / s.sigma_disparity for s in (first, second)]
        best = first if snr[0] >= snr[1] else second
        disparity = best.uuv[:1] - best.uuv[1:2]
        return key, best.ordinal, self._camera.triangulate(best.uuv[:1], best.uuv[2:], disparity)[0]


def map_point(map_T_rover: FloatArray, rover_T_camera: FloatArray, point: FloatArray) -> FloatArray:
    """Put a camera point (3,) into the map."""
    return np.asarray(transform_points(map_T_rover @ rover_T_camera, point[None])[0])
