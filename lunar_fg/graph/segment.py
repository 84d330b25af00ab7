"""A segment: a short window of keyframes that becomes one relative pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from frontends.errors import EstimationError
from frontends.geometry import adjoint, inverse
from frontends.measurements import FloatArray, IntArray
from lunar_fg.graph.adjustment import Motion, Window, WindowSolver
from lunar_fg.graph.keyframe import Entered, Keyframe, floored, no_motion
from lunar_fg.graph.setup import Setup
from lunar_fg.graph.tracks import Sightings, TrackTable


@dataclass(frozen=True, slots=True)
class SegmentSolution:
    """A closed segment, in rover frames, relative to its first keyframe.

    Attributes
    ----------
    first_T_rover
        (n, 4, 4) smoothed poses; the first is the identity.
    covariance
        (6 (n-1), 6 (n-1)) joint covariance of all poses but the first, each in its own
        rover axes.
    sightings
        Stereo observations that went in.
    chi_square, degrees_of_freedom
        Of the solution; their ratio is 1 where the pixel sigmas are right.
    converged
        Whether the solver came to rest.
    """

    first_T_rover: FloatArray
    covariance: FloatArray
    sightings: int
    chi_square: float
    degrees_of_freedom: int
    converged: bool

    @property
    def first_T_last(self) -> FloatArray:
        """(4, 4): what the segment measures."""
        return np.asarray(self.first_T_rover[-1])

    @property
    def last_covariance(self) -> FloatArray:
        """(6, 6) of `first_T_last`, in the axes of the last keyframe."""
        return np.asarray(self.covariance[-6:, -6:])


class Segment:
    """An open segment; it starts with the boundary keyframe that ended the one before.

    Parameters
    ----------
    setup
        Of the graph.
    boundary
        The first keyframe.
    """

    def __init__(self, setup: Setup, boundary: Keyframe) -> None:
        self._camera, self._config = setup.camera, setup.config
        self._rover_T_camera = setup.rover_T_camera
        self._camera_T_rover = inverse(setup.rover_T_camera)
        self._to_rover, self._to_camera = map(adjoint, (self._rover_T_camera, self._camera_T_rover))
        self._tracks = TrackTable(setup)
        self._motions: list[Motion] = []
        self._poses: list[FloatArray] = [np.eye(4)]
        self._covariances: list[FloatArray] = [np.zeros((6, 6))]
        sightings = Sightings.of(boundary.observations)
        self._sightings = [sightings]
        self._numbers = [self._tracks.add(sightings, None, None).track]

    def __len__(self) -> int:
        """Keyframes in the segment, its boundary included."""
        return len(self._poses)

    def add(self, keyframe: Keyframe) -> Entered:
        """Take in the next keyframe.

        Raises
        ------
        InputError
            When nothing connects it to the keyframe before.
        """
        motion = keyframe.motion(self._rover_T_camera)
        if motion is None:
            raise no_motion(f"keyframe {keyframe.index}")
        relative, odometry = keyframe.relative, keyframe.odometry
        trusted = relative is None or relative.accepted
        sightings = Sightings.of(keyframe.observations)
        here = len(self._poses)
        tracked = self._tracks.add(sightings, motion, self._config.min_tracks if trusted else None)
        enough = tracked.linked > 0
        used = ["stereo landmarks"] if enough else []
        if odometry is not None:
            self._motions.append(
                Motion(
                    here - 1,
                    here,
                    self._camera_T_rover @ odometry.a_T_b @ self._rover_T_camera,
                    floored(self._to_camera @ odometry.covariance @ self._to_camera.T),
                )
            )
            used.append("odometry")
        measured = relative is not None and relative.accepted
        if not enough and (odometry is None or measured):
            self._motions.append(Motion(here - 1, here, *motion))
            used.append("relative pose" if measured else "prediction")
        self._sightings.append(sightings)
        self._numbers.append(tracked.track)
        carry = adjoint(inverse(motion[0]))
        self._poses.append(self._poses[-1] @ motion[0])
        self._covariances.append(carry @ self._covariances[-1] @ carry.T + motion[1])
        return Entered(tracked.linked, tracked.cut, tuple(used), not (enough or measured))

    def predicted(self) -> tuple[FloatArray, FloatArray]:
        """Latest pose against the boundary by the motions alone, and its covariance.

        Rover frames, (4, 4) and (6, 6).
        """
        return self._in_rover(self._poses[-1], self._covariances[-1])

    def _in_rover(self, pose: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        return (
            self._rover_T_camera @ pose @ self._camera_T_rover,
            self._to_rover @ covariance @ self._to_rover.T,
        )

    def chain(self) -> list[tuple[FloatArray, FloatArray]]:
        """Poses and covariances after the boundary by the motions alone, rover frames."""
        return list(map(self._in_rover, self._poses[1:], self._covariances[1:]))

    def chained(self) -> SegmentSolution:
        """Solve the segment by its motions alone: for when its landmarks cannot be solved."""
        chain = self.chain()
        n = len(chain)
        joint = np.zeros((6 * n, 6 * n))
        for i in range(n):
            for j in range(i, n):
                carry = adjoint(inverse(chain[j][0]) @ chain[i][0])
                block = chain[i][1] @ carry.T
                joint[6 * i : 6 * i + 6, 6 * j : 6 * j + 6] = block
                joint[6 * j : 6 * j + 6, 6 * i : 6 * i + 6] = block.T
        poses = np.stack([np.eye(4), *(pose for pose, _ in chain)])
        return SegmentSolution(poses, joint, 0, 0.0, 0, converged=False)

    def _window(self) -> Window:
        sightings = Sightings(
            np.concatenate([s.landmark for s in self._sightings]),
            np.concatenate([s.uuv for s in self._sightings]),
            np.concatenate([s.covariance for s in self._sightings]),
        )
        pose = np.repeat(np.arange(len(self)), [len(s) for s in self._sightings])
        track = np.concatenate(self._numbers)
        _, first, landmark, count = np.unique(
            track, return_index=True, return_inverse=True, return_counts=True
        )
        kept = _longest(pose[first], count, self._config.max_landmarks)
        rows = np.flatnonzero(kept[landmark])
        rows = rows[np.argsort(track[rows], kind="stable")]
        _, landmark = np.unique(track[rows], return_inverse=True)
        return Window(sightings.take(rows), pose[rows], landmark, tuple(self._motions))

    def solve(self) -> SegmentSolution:
        """Smooth the segment and marginalise its landmarks.

        Raises
        ------
        EstimationError
            When the measurements do not fix all poses.
        """
        window = self._window()
        if not len(window.pose) and len(self._motions) == len(self) - 1:
            return replace(self.chained(), converged=True)
        solver = WindowSolver(
            self._camera,
            window,
            np.stack(self._poses),
            self._config.robust_threshold_sigma,
            self._config.landmark_correlation,
        )
        solved = solver.solve(self._config.max_iterations)
        if not np.isfinite(solved.covariance).all():
            raise EstimationError("its covariance is not finite")
        rotate = np.kron(np.eye(len(self) - 1), self._to_rover)
        by_disparity = self._config.disparity_sigma_px * solved.by_disparity
        covariance = solved.covariance + np.outer(by_disparity, by_disparity)
        covariance = rotate @ covariance @ rotate.T
        return SegmentSolution(
            self._rover_T_camera @ solved.poses @ self._camera_T_rover,
            0.5 * (covariance + covariance.T),
            len(window.pose),
            solved.chi_square,
            solved.degrees_of_freedom,
            solved.converged,
        )


def _longest(start: IntArray, length: IntArray, most: int) -> NDArray[np.bool_]:
    """Tracks of two sightings or more; of too many the longest, the same share at each start.

    Parameters
    ----------
    start
        (L,) where in the segment each track begins.
    length
        (L,) its sightings.
    most
        Tracks to keep, about.
    """
    kept = length > 1
    total = int(kept.sum())
    if total <= most:
        return np.asarray(kept)
    for here in np.unique(start[kept]):
        group = np.flatnonzero(kept & (start == here))
        quota = -(-len(group) * most // total)
        kept[group[np.argsort(-length[group], kind="stable")[quota:]]] = False
    return np.asarray(kept)
