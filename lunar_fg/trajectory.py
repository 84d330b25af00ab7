"""Stamps, poses and covariances of a traverse; what a run writes and an evaluation reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from frontends.errors import InputError
from frontends.geometry import adjoint, inverse
from frontends.measurements import Estimate

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: A rotation read from a file of few digits may be this far from orthonormal.
RIGID_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses over time.

    Attributes
    ----------
    stamp_s
        (N,) s, strictly increasing.
    map_T_rover
        (N, 4, 4). The body need not be the rover: a camera trajectory is one as well.
    covariance
        (N, 6, 6), rotation then translation, right perturbation, in the axes of each
        pose's body; None where unknown.
    indexed
        True when the source had no stamps and `stamp_s` only counts the rows.

    Raises
    ------
    InputError
        When shapes disagree, a value is not finite, a pose is not rigid, or stamps do
        not increase.
    """

    stamp_s: FloatArray
    map_T_rover: FloatArray
    covariance: FloatArray | None = None
    indexed: bool = False

    def __post_init__(self) -> None:
        """Check everything that later steps rely on."""
        stamps = _checked_stamps(self.stamp_s)
        object.__setattr__(self, "stamp_s", stamps)
        poses = np.asarray(self.map_T_rover, dtype=np.float64)
        object.__setattr__(self, "map_T_rover", poses)
        _require_shape("map_T_rover", poses, (len(stamps), 4, 4))
        bad = np.flatnonzero(~are_rigid(poses))
        if bad.size:
            raise InputError(
                f"pose {bad[0]} is not a rigid transform",
                source="trajectory",
                field="map_T_rover",
                remedy="the rotation must be orthonormal, the last row 0 0 0 1",
            )
        if self.covariance is not None:
            covariance = np.asarray(self.covariance, dtype=np.float64)
            object.__setattr__(self, "covariance", covariance)
            _require_shape("covariance", covariance, (len(stamps), 6, 6))
            _require_finite("covariance", covariance)

    def __len__(self) -> int:
        """Count the rows."""
        return len(self.stamp_s)

    @classmethod
    def from_estimates(cls, estimates: Sequence[Estimate]) -> Trajectory:
        """Trajectory of a navigator's estimates, in their order."""
        return cls(
            np.array([e.stamp_s for e in estimates], dtype=np.float64),
            np.array([e.map_T_rover for e in estimates], dtype=np.float64).reshape(-1, 4, 4),
            np.array([e.covariance for e in estimates], dtype=np.float64).reshape(-1, 6, 6),
        )

    @property
    def positions(self) -> FloatArray:
        """(N, 3) m, map axes."""
        return self.map_T_rover[:, :3, 3]

    @property
    def distance_m(self) -> float:
        """Length of the polyline through all positions."""
        return float(travelled_m(self.positions)[-1]) if len(self) else 0.0

    def select(self, index: IntArray | NDArray[np.bool_] | slice) -> Trajectory:
        """Poses at an index array, a mask or a slice."""
        covariance = None if self.covariance is None else self.covariance[index]
        return Trajectory(self.stamp_s[index], self.map_T_rover[index], covariance, self.indexed)

    def moved(self, b_T_map: FloatArray) -> Trajectory:
        """Move the poses to another fixed frame; body covariances stay as they are."""
        return Trajectory(self.stamp_s, b_T_map @ self.map_T_rover, self.covariance, self.indexed)

    def of_sensor(self, rover_T_sensor: FloatArray) -> Trajectory:
        """Poses of a sensor mounted on the rover, covariances in the sensor's axes."""
        covariance = self.covariance
        if covariance is not None:
            sensor_A_rover = adjoint(inverse(rover_T_sensor))
            covariance = sensor_A_rover @ covariance @ sensor_A_rover.T
        poses = self.map_T_rover @ rover_T_sensor
        return Trajectory(self.stamp_s, poses, covariance, self.indexed)

    def from_start(self) -> Trajectory:
        """Poses in the frame of the first one."""
        return self.moved(inverse(self.map_T_rover[0])) if len(self) else self

    def covariance_in(self, frame: Literal["rover", "map"]) -> FloatArray:
        """Covariances (N, 6, 6) in the axes of the rover, or of the map.

        In ``"map"`` the rotation vector and the position error *of the rover* are
        expressed along the map's axes: the lower right block is the covariance of
        `positions`. (It is not the left-perturbation covariance about the map's origin.)

        Raises
        ------
        InputError
            When the trajectory has no covariance.
        """
        if self.covariance is None:
            raise InputError("has no covariance", source="trajectory", field="covariance")
        if frame == "rover":
            return self.covariance
        turn = np.zeros((len(self), 6, 6))
        turn[:, :3, :3] = turn[:, 3:, 3:] = self.map_T_rover[:, :3, :3]
        return np.asarray(turn @ self.covariance @ turn.transpose(0, 2, 1))

    def at(self, stamp_s: FloatArray) -> Trajectory:
        """Poses at other stamps: positions linear, rotations by SLERP, no covariance.

        Raises
        ------
        InputError
            When a stamp lies outside the trajectory: nothing is extrapolated.
        """
        stamp_s = np.asarray(stamp_s, dtype=np.float64)
        if not len(self) or (
            stamp_s.size and (stamp_s.min() < self.stamp_s[0] or stamp_s.max() > self.stamp_s[-1])
        ):
            raise InputError("asked for a stamp outside the trajectory", source="trajectory")
        poses = np.tile(np.eye(4), (len(stamp_s), 1, 1))
        for axis in range(3):
            poses[:, axis, 3] = np.interp(stamp_s, self.stamp_s, self.positions[:, axis])
        rotations = Rotation.from_matrix(self.map_T_rover[:, :3, :3])
        if len(self) > 1 and len(stamp_s):
            poses[:, :3, :3] = Slerp(self.stamp_s, rotations)(stamp_s).as_matrix()
        else:
            poses[:, :3, :3] = self.map_T_rover[0, :3, :3]
        return Trajectory(stamp_s, poses)


@dataclass(frozen=True, slots=True, eq=False)
class PositionTrack:
    """Positions over time without orientation, e.g. of a tracker or GNSS.

    Attributes
    ----------
    stamp_s
        (N,) s, strictly increasing.
    position_m
        (N, 3), or (N, 2) where the height was not measured.
    indexed
        As in `Trajectory`.
    """

    stamp_s: FloatArray
    position_m: FloatArray
    indexed: bool = False

    def __post_init__(self) -> None:
        """Check everything that later steps rely on."""
        stamps = _checked_stamps(self.stamp_s)
        position = np.asarray(self.position_m, dtype=np.float64)
        object.__setattr__(self, "stamp_s", stamps)
        object.__setattr__(self, "position_m", position)
        columns = 2 if position.ndim == 2 and position.shape[1] == 2 else 3
        _require_shape("position_m", position, (len(stamps), columns))
        _require_finite("position_m", position)

    def __len__(self) -> int:
        """Count the rows."""
        return len(self.stamp_s)

    @property
    def planar(self) -> bool:
        """Whether only x and y are known."""
        return int(self.position_m.shape[1]) == 2

    @property
    def positions(self) -> FloatArray:
        """(N, 3) m; z = 0 in a planar track."""
        if not self.planar:
            return self.position_m
        return np.column_stack([self.position_m, np.zeros(len(self))])

    @property
    def distance_m(self) -> float:
        """Length of the polyline through all positions."""
        return float(travelled_m(self.positions)[-1]) if len(self) else 0.0

    def select(self, index: IntArray | NDArray[np.bool_] | slice) -> PositionTrack:
        """Positions at an index array, a mask or a slice."""
        return PositionTrack(self.stamp_s[index], self.position_m[index], self.indexed)


Truth = Trajectory | PositionTrack


def travelled_m(positions: FloatArray) -> FloatArray:
    """Distance along the polyline up to each point, (N, 3) -> (N,)."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def are_rigid(poses: FloatArray, tolerance: float = RIGID_TOLERANCE) -> NDArray[np.bool_]:
    """Which of (N, 4, 4) matrices are finite rigid transforms."""
    finite = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    poses = np.where(finite[:, None, None], poses, 0.0)
    rotation = poses[:, :3, :3]
    product = rotation @ rotation.transpose(0, 2, 1)
    orthonormal = np.abs(product - np.eye(3)).max(axis=(1, 2)) < tolerance
    last_row = np.abs(poses[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) < tolerance
    return np.asarray(finite & orthonormal & last_row & (np.linalg.det(rotation) > 0.0))


def _checked_stamps(stamp_s: FloatArray) -> FloatArray:
    stamps = np.asarray(stamp_s, dtype=np.float64)
    _require_shape("stamp_s", stamps, (stamps.size,))
    _require_finite("stamp_s", stamps)
    late = np.flatnonzero(np.diff(stamps) <= 0.0)
    if late.size:
        raise InputError(
            f"stamp {stamps[late[0] + 1]:.9g} follows {stamps[late[0]]:.9g}",
            source="trajectory",
            field="stamp_s",
            remedy="stamps must increase strictly: remove repeats, sort the rows",
        )
    return stamps


def _require_shape(name: str, array: FloatArray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        problem = f"has shape {array.shape}, expected {shape}"
        raise InputError(problem, source="trajectory", field=name)


def _require_finite(name: str, array: FloatArray) -> None:
    if not np.isfinite(array).all():
        raise InputError("holds a NaN or infinity", source="trajectory", field=name)
