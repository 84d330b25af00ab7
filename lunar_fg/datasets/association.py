"""Wheel odometry and attitude of other clocks, brought to the frames' stamps.

Odometry: the row at t_k holds the motion over (t_(k-1), t_k]. The motion between two
frames is the composition (SE2) of the rows between them; a row that straddles a frame is
split in proportion to time, along its arc of constant twist. The first row has no row
before it: it counts from the frame before it when that is at most 1.5 median row spacings
ago, otherwise it only marks a time. A frame interval that the rows do not cover whole, to
1 ms, has no odometry.

Attitude: a row within 1 ms of the frame is taken as it is; otherwise angles are
interpolated linearly (the short way round) between neighbours at most 2 s apart, with
the larger sigmas of the two; outside of the rows, or in a longer gap, the nearest row
counts up to 50 ms away, otherwise the frame has no attitude.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from frontends.measurements import Attitude, WheelOdometry
from lunar_fg.datasets.base import STAMP_TOLERANCE_S, FloatArray
from lunar_fg.datasets.tables import AttitudeTable, OdometryTable

MAX_ATTITUDE_GAP_S = 2.0
MAX_ATTITUDE_AGE_S = 0.05
_FIRST_ROW_SPACINGS = 1.5
_SMALL_ANGLE_RAD = 1e-9


def odometry_between_frames(
    frame_stamp_s: FloatArray, table: OdometryTable
) -> tuple[WheelOdometry | None, ...]:
    """Wheel motion since the frame before, for each of (N,) increasing frame stamps."""
    ends = table.stamp_s
    starts = np.concatenate([[_first_start(frame_stamp_s, ends)], ends[:-1]])
    result: list[WheelOdometry | None] = [None]
    for begin, end in itertools.pairwise(frame_stamp_s.tolist()):
        covered = starts[0] <= begin + STAMP_TOLERANCE_S and end <= ends[-1] + STAMP_TOLERANCE_S
        result.append(_compose(begin, end, starts, ends, table.increments) if covered else None)
    return tuple(result)


def composed(motions: Sequence[WheelOdometry]) -> WheelOdometry:
    """Return the motion that consecutive motions add up to (SE2)."""
    x = y = yaw = 0.0
    for motion in motions:
        cosine, sine = math.cos(yaw), math.sin(yaw)
        x += cosine * motion.d_forward_m - sine * motion.d_lateral_m
        y += sine * motion.d_forward_m + cosine * motion.d_lateral_m
        yaw += motion.d_yaw_rad
    return WheelOdometry(x, y, yaw)


def attitude_at_frames(
    frame_stamp_s: FloatArray, table: AttitudeTable
) -> tuple[Attitude | None, ...]:
    """Attitude at each of (N,) frame stamps."""
    return tuple(_attitude_at(float(stamp), table) for stamp in frame_stamp_s)


def _first_start(frames: FloatArray, ends: FloatArray) -> float:
    before = frames[frames < ends[0] - STAMP_TOLERANCE_S]
    if not len(before):
        return float(ends[0])
    spacing = float(np.median(np.diff(ends))) if len(ends) > 1 else math.inf
    return float(before[-1] if ends[0] - before[-1] <= _FIRST_ROW_SPACINGS * spacing else ends[0])


def _compose(
    begin: float, end: float, starts: FloatArray, ends: FloatArray, increments: FloatArray
) -> WheelOdometry:
    parts = []
    first = int(np.searchsorted(ends, begin, side="right"))
    last = int(np.searchsorted(starts, end, side="left"))
    for row in range(first, last):
        duration = ends[row] - starts[row]
        inside = min(end, ends[row]) - max(begin, starts[row])
        if duration <= 0.0 or inside <= 0.0:
            continue
        parts.append(WheelOdometry(*_part_of(increments[row], inside / duration)))
    return composed(parts)


def _part_of(increment: FloatArray, share: float) -> tuple[float, float, float]:
    """Motion after a share of the time of an SE2 increment at constant twist."""
    dx, dy, dyaw = (float(value) for value in increment)
    if share >= 1.0:
        return dx, dy, dyaw
    if abs(dyaw) < _SMALL_ANGLE_RAD:
        return share * dx, share * dy, share * dyaw
    # The chord of an arc: length by the ratio of half-angle sines, turned by half the angle.
    scale = math.sin(0.5 * share * dyaw) / math.sin(0.5 * dyaw)
    turn = 0.5 * (share - 1.0) * dyaw
    cosine, sine = math.cos(turn), math.sin(turn)
    return scale * (cosine * dx - sine * dy), scale * (sine * dx + cosine * dy), share * dyaw


def _attitude_at(stamp: float, table: AttitudeTable) -> Attitude | None:
    stamps = table.stamp_s
    after = int(np.searchsorted(stamps, stamp))
    neighbours = [row for row in (after - 1, after) if 0 <= row < len(stamps)]
    nearest = min(neighbours, key=lambda row: abs(stamps[row] - stamp))
    age = abs(stamps[nearest] - stamp)
    if age > STAMP_TOLERANCE_S and len(neighbours) == 2:
        low, high = neighbours
        gap = stamps[high] - stamps[low]
        if gap <= MAX_ATTITUDE_GAP_S:
            share = (stamp - stamps[low]) / gap
            turn = (table.angles[high] - table.angles[low] + np.pi) % (2.0 * np.pi) - np.pi
            angles = table.angles[low] + share * turn
            sigmas = np.maximum(table.sigmas[low], table.sigmas[high])
            return Attitude(*angles.tolist(), *sigmas.tolist())
    if age > MAX_ATTITUDE_AGE_S:
        return None
    return Attitude(*table.angles[nearest].tolist(), *table.sigmas[nearest].tolist())
