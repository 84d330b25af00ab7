"""Landmark tracks behind a two-view chi-square gate that cuts a track where it breaks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from frontends.camera import StereoCamera
from frontends.geometry import adjoint, inverse
from frontends.measurements import FloatArray, IntArray, StereoObservations
from lunar_fg.graph import kernels
from lunar_fg.graph.setup import Setup

BoolArray = NDArray[np.bool_]


def homogeneous(camera: StereoCamera, uuv: FloatArray) -> FloatArray:
    """Stereo pixels (M, 3) to homogeneous points (M, 4) in camera axes, scaled to z = 1.

    The fourth value is the inverse depth (1/m), linear in the disparity, so a far point
    is as well behaved as a near one.
    """
    result = np.ones((len(uuv), 4))
    result[:, 0] = (uuv[:, 0] - camera.cx) / camera.fx
    result[:, 1] = (uuv[:, 2] - camera.cy) / camera.fy
    result[:, 3] = (uuv[:, 0] - uuv[:, 1]) / (camera.fx * camera.baseline_m)
    return result


def lens(camera: StereoCamera) -> FloatArray:
    """The camera as the kernels take it."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.fx * camera.baseline_m])


def in_front(points: FloatArray) -> BoolArray:
    """Whether homogeneous points (M, 4) lie before the camera plane, (M,)."""
    norm = np.linalg.norm(points[:, :3], axis=1)
    return np.asarray(points[:, 2] > kernels.LEAST_DEPTH_SHARE * norm)


@dataclass(frozen=True, slots=True)
class Sightings:
    """Stereo pixels of landmarks with their noise: the hot path's view of the observations.

    Attributes
    ----------
    landmark
        (M,) int64.
    uuv
        (M, 3) u_left, u_right, v, px.
    covariance
        (M, 3, 3) of `uuv`, px^2.
    """

    landmark: IntArray
    uuv: FloatArray
    covariance: FloatArray

    @classmethod
    def of(cls, observations: StereoObservations | None) -> Sightings:
        """Take the observations with positive disparity."""
        if observations is None:
            return cls(np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))
        uuv = np.stack([observations.u_left, observations.u_right, observations.v], axis=-1)
        keep = uuv[:, 0] > uuv[:, 1]
        landmark = np.asarray(observations.landmark_id, dtype=np.int64)
        every = cls(landmark, uuv, observations.pixel_covariance())
        return every if keep.all() else every.take(keep)

    def take(self, rows: IntArray | BoolArray) -> Sightings:
        """Select the sightings at a mask or an index array."""
        return Sightings(self.landmark[rows], self.uuv[rows], self.covariance[rows])

    def __len__(self) -> int:
        """Count the sightings."""
        return len(self.landmark)


@dataclass(frozen=True, slots=True)
class Tracked:
    """Which track each sighting of a keyframe belongs to.

    Attributes
    ----------
    track
        (M,) track numbers; a cut track goes on under a new number.
    linked
        How many of them continue a track.
    cut
        How many continued a landmark id but were not believed to.
    """

    track: IntArray
    linked: int
    cut: int


class TrackTable:
    """The last sighting of every live landmark, and the motions since.

    Parameters
    ----------
    setup
        Of the graph.
    """

    def __init__(self, setup: Setup) -> None:
        self._lens = lens(setup.camera)
        self._gate = float(chi2.ppf(setup.config.gate_probability, 3))
        self._max_gap = setup.config.max_track_gap
        self.clear()
        self._next_track = 0

    def clear(self) -> None:
        """Forget all sightings; track numbers go on."""
        self._sightings = Sightings.of(None)
        self._track = np.empty(0, dtype=np.int64)
        self._age = np.empty(0, dtype=np.int64)
        self._motions: list[tuple[FloatArray, FloatArray]] = []

    def _accept(self, old: IntArray, new: IntArray, sightings: Sightings) -> BoolArray:
        a_T_b, covariance = np.eye(4), np.zeros((6, 6))
        oldest = int(self._age[old].max(initial=0))
        inverses, covariances = np.empty((oldest + 1, 4, 4)), np.empty((oldest + 1, 6, 6))
        steps = reversed(self._motions[-oldest:] if oldest else [])
        for age, (step, step_covariance) in enumerate(steps, start=1):
            if age == 1:
                a_T_b, covariance = step, step_covariance
            else:
                carry = adjoint(inverses[age - 1])
                covariance = carry @ step_covariance @ carry.T + covariance
                a_T_b = step @ a_T_b
            inverses[age], covariances[age] = inverse(a_T_b), covariance
        distance = kernels.distances(
            self._lens,
            self._sightings.uuv[old],
            self._sightings.covariance[old],
            sightings.uuv[new],
            sightings.covariance[new],
            self._age[old],
            inverses,
            covariances,
        )
        return np.asarray(distance <= self._gate)

    def add(
        self, sightings: Sightings, motion: tuple[FloatArray, FloatArray] | None, least: int | None
    ) -> Tracked:
        """Enter a keyframe's sightings.

        Parameters
        ----------
        sightings
            Of the keyframe.
        motion
            ``a_T_b`` and covariance since the keyframe before; None at the first.
        least
            With fewer continued tracks than this all are cut; None cuts all anyway.
        """
        if motion is not None:
            self._motions = [*self._motions, motion][-self._max_gap :]
            self._age = self._age + 1
        _, old, new = np.intersect1d(
            self._sightings.landmark, sightings.landmark, assume_unique=True, return_indices=True
        )
        accepted = np.zeros(len(new), dtype=bool)
        if least is not None:
            accepted = self._accept(old, new, sightings)
            if accepted.sum() < least:
                accepted[:] = False
        track = np.full(len(sightings), -1, dtype=np.int64)
        track[new[accepted]] = self._track[old[accepted]]
        fresh = track < 0
        track[fresh] = self._next_track + np.arange(fresh.sum())
        self._next_track += int(fresh.sum())
        keep = self._age < self._max_gap
        keep[old] = False
        self._sightings = Sightings(
            np.concatenate([self._sightings.landmark[keep], sightings.landmark]),
            np.concatenate([self._sightings.uuv[keep], sightings.uuv]),
            np.concatenate([self._sightings.covariance[keep], sightings.covariance]),
        )
        self._track = np.concatenate([self._track[keep], track])
        self._age = np.concatenate([self._age[keep], np.zeros(len(track), dtype=np.int64)])
        linked = int(accepted.sum())
        return Tracked(track, linked, len(new) - linked)
