"""What the traverse log's tables hold, and how measurements become rows and come back.

Arrays are stored as NumPy's own ``.npy`` bytes without pickle: little-endian, with dtype and
shape, so what is read back is what was written, bit for bit.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterator
from dataclasses import astuple, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from frontends.errors import InputError
from frontends.measurements import (
    Attitude,
    Estimate,
    Odometry,
    RelativePose,
    StereoObservations,
    Tilt,
    Verdict,
    WheelOdometry,
)
from lunar_fg.arrays import DAMAGED
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.record import DeadReckoned, FrameRecord, FrameReport, Sensors

TABLES = """
CREATE TABLE run (only INTEGER PRIMARY KEY CHECK (only = 1), camera TEXT NOT NULL,
    rover_T_camera BLOB NOT NULL, start TEXT NOT NULL, start_pose BLOB NOT NULL,
    config TEXT NOT NULL);
CREATE TABLE sitting (number INTEGER PRIMARY KEY, dataset TEXT NOT NULL, images TEXT,
    traverse TEXT, index_offset INTEGER NOT NULL, stamp_offset_s REAL NOT NULL,
    given TEXT NOT NULL);
CREATE TABLE keyframe (frame INTEGER PRIMARY KEY, stamp_s REAL NOT NULL,
    tilt_roll_rad REAL, tilt_pitch_rad REAL, tilt_sigma_rad REAL,
    odometry_pose BLOB, odometry_covariance BLOB);
CREATE TABLE observations (frame INTEGER PRIMARY KEY REFERENCES keyframe,
    landmark_id BLOB NOT NULL, u_left BLOB NOT NULL, u_right BLOB NOT NULL, v BLOB NOT NULL,
    sigma_px BLOB NOT NULL, sigma_disparity_px BLOB NOT NULL, points_cam BLOB NOT NULL,
    points_covariance BLOB NOT NULL);
CREATE TABLE relative (frame INTEGER PRIMARY KEY REFERENCES keyframe,
    pose BLOB NOT NULL, covariance BLOB NOT NULL, inlier_ids BLOB NOT NULL,
    correspondences INTEGER NOT NULL, verdict TEXT NOT NULL, reason TEXT NOT NULL);
CREATE TABLE estimate (frame INTEGER PRIMARY KEY REFERENCES keyframe,
    pose BLOB NOT NULL, covariance BLOB NOT NULL, lost INTEGER NOT NULL, used TEXT NOT NULL,
    refused TEXT NOT NULL);
CREATE TABLE sensors (frame INTEGER PRIMARY KEY, stamp_s REAL NOT NULL,
    wheels_forward_m REAL, wheels_lateral_m REAL, wheels_yaw_rad REAL,
    roll_rad REAL, pitch_rad REAL, yaw_rad REAL, sigma_rp_rad REAL, sigma_yaw_rad REAL);
CREATE TABLE counts (frame INTEGER PRIMARY KEY, keypoints INTEGER NOT NULL,
    stereo_matches INTEGER NOT NULL, refined INTEGER NOT NULL, landmarks INTEGER NOT NULL,
    tracked INTEGER NOT NULL, inliers INTEGER NOT NULL, wrong_match_rate REAL,
    unusable TEXT NOT NULL);
CREATE TABLE dead_reckoning (frame INTEGER PRIMARY KEY, pose BLOB NOT NULL,
    covariance BLOB NOT NULL);
CREATE TABLE checkpoint (only INTEGER PRIMARY KEY CHECK (only = 1), frame INTEGER NOT NULL,
    state BLOB NOT NULL);
"""
#: Those that hold what the graph was given and gave, each after the ones that refer to it.
KEYFRAME_TABLES = ("estimate", "relative", "observations", "keyframe")


def pack(array: Any) -> bytes:
    """Bytes of an array."""
    array = np.asarray(array)
    buffer = io.BytesIO()
    np.save(buffer, array.astype(array.dtype.newbyteorder("<")), allow_pickle=False)
    return buffer.getvalue()


def rows_of(keyframe: Keyframe, estimate: Estimate) -> Iterator[tuple[str, tuple[object, ...]]]:
    """Tables and rows of a keyframe and its estimate."""
    frame, tilt, odometry = keyframe.index, keyframe.tilt, keyframe.odometry
    yield "keyframe", (
        frame, keyframe.stamp_s,
        *((tilt.roll_rad, tilt.pitch_rad, tilt.sigma_rad) if tilt else (None,) * 3),
        *((pack(odometry.a_T_b), pack(odometry.covariance)) if odometry else (None,) * 2),
    )  # fmt: skip
    observations, relative = keyframe.observations, keyframe.relative
    if observations is not None:
        arrays = (getattr(observations, field.name) for field in fields(observations))
        yield "observations", (frame, *(pack(array) for array in arrays))
    if relative is not None:
        yield "relative", (
            frame, pack(relative.a_T_b), pack(relative.covariance), pack(relative.inlier_ids),
            relative.correspondences, relative.verdict.value, relative.reason,
        )  # fmt: skip
    yield "estimate", (
        frame, pack(estimate.map_T_rover), pack(estimate.covariance), int(estimate.lost),
        json.dumps(estimate.used), json.dumps(estimate.refused),
    )  # fmt: skip


def rows_of_record(frame: int, record: FrameRecord) -> Iterator[tuple[str, tuple[object, ...]]]:
    """Tables and rows of what a frame gave beside its keyframe."""
    sensors, wheels, attitude = record.sensors, record.sensors.odometry, record.sensors.attitude
    yield "sensors", (
        frame, sensors.stamp_s,
        *((None,) * 3 if wheels is None else astuple(wheels)),
        *((None,) * 5 if attitude is None else astuple(attitude)),
    )  # fmt: skip
    # SQLite keeps a NaN as NULL
    yield "counts", (frame, *astuple(record.report), record.unusable)
    if record.dead_reckoned is not None:
        by_wheels = record.dead_reckoned
        yield "dead_reckoning", (frame, pack(by_wheels.map_T_rover), pack(by_wheels.covariance))


class RowReader:
    """Turns rows back into measurements.

    Parameters
    ----------
    path
        The log, for errors.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def array(self, blob: bytes, where: str) -> Any:
        """Read an array.

        Raises
        ------
        InputError
            It is damaged, or holds Python objects.
        """
        try:
            return np.load(io.BytesIO(blob), allow_pickle=False)
        except DAMAGED as error:
            raise InputError(
                f"holds a damaged array ({error})", source=self._path, field=where
            ) from error

    def keyframe(
        self,
        row: tuple[Any, ...],
        observations: tuple[Any, ...] | None,
        relative: tuple[Any, ...] | None,
    ) -> Keyframe:
        """Build a keyframe from its row and those of what it measured, if anything."""
        frame, stamp_s, roll, pitch, sigma, pose, covariance = row
        where = f"keyframe {frame}"
        odometry = None
        if pose is not None:
            odometry = Odometry(self.array(pose, where), self.array(covariance, where))
        return Keyframe(
            frame,
            stamp_s,
            None if observations is None else self._observations(observations, where),
            None if relative is None else self._relative(relative, where),
            odometry,
            None if sigma is None else Tilt(roll, pitch, sigma),
        )

    def _observations(self, row: tuple[Any, ...], where: str) -> StereoObservations:
        return StereoObservations(*(self.array(blob, where) for blob in row[1:]))

    def _relative(self, row: tuple[Any, ...], where: str) -> RelativePose:
        _, pose, covariance, inliers, correspondences, verdict, reason = row
        a_T_b, matrix, ids = (self.array(blob, where) for blob in (pose, covariance, inliers))
        return RelativePose(a_T_b, matrix, ids, correspondences, Verdict(verdict), reason)

    def estimate(self, row: tuple[Any, ...]) -> Estimate:
        """Build an estimate from (frame, stamp_s, pose, covariance, lost, used, refused)."""
        frame, stamp_s, pose, covariance, lost, used, refused = row
        where = f"keyframe {frame}"
        return Estimate(
            frame,
            stamp_s,
            self.array(pose, where),
            self.array(covariance, where),
            bool(lost),
            tuple(json.loads(used)),
            tuple(json.loads(refused)),
        )

    def record(
        self,
        sensors: tuple[Any, ...],
        counts: tuple[Any, ...],
        dead_reckoned: tuple[Any, ...] | None,
    ) -> FrameRecord:
        """Build a record from its rows."""
        frame, stamp_s, *readings = sensors
        wheels = None if readings[0] is None else WheelOdometry(*readings[:3])
        attitude = None if readings[3] is None else Attitude(*readings[3:])
        *numbers, rate, unusable = counts[1:]
        report = replace(FrameReport(*numbers), wrong_match_rate=math.nan if rate is None else rate)
        by_wheels = None
        if dead_reckoned is not None:
            where = f"keyframe {frame}"
            by_wheels = DeadReckoned(*(self.array(blob, where) for blob in dead_reckoned[1:]))
        return FrameRecord(Sensors(stamp_s, wheels, attitude), report, unusable, by_wheels)
