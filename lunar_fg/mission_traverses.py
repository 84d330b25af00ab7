"""Published traverses of Mars rovers, as truth and estimate for ``lunar-fg eval``.

Two tables are known by their headers:

* Spirit's whole traverse, ``SITE,DRIVE,START_SOL,END_SOL,RAW_X,...,CORRECTED_X,CORRECTED_Y``:
  the rover's own telemetry (RAW, m, x east, y north) beside its localisation on orbital and
  surface images (CORRECTED, the map's easting and northing). One file, both sides of a
  comparison: as a truth it is the localisation, as an estimate the telemetry.
* Curiosity's waypoints, ``...,SCLK_START,...,easting_m,northing_m,elev_m,...,pitch_rad,roll_rad,
  ...,yaw_rad,...``: localised positions and attitude at each stop, yaw clockwise from north,
  pitch nose up. They are a truth; stamps are the spacecraft clock.

Poses are ``map_T_rover``: map x east, y north, z up; rover x forward, y left, z up.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from frontends.errors import InputError
from lunar_fg.trajectory import PositionTrack, Trajectory

FloatArray = NDArray[np.float64]

MAX_BYTES = 50_000_000
_SPIRIT = ("SITE", "DRIVE", "RAW_X", "RAW_Y", "CORRECTED_X", "CORRECTED_Y")
_WAYPOINTS = ("SCLK_START", "easting_m", "northing_m", "elev_m", "pitch_rad", "roll_rad", "yaw_rad")
#: North-east-down to east-north-up, and forward-right-down to forward-left-up.
_ENU_R_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_FRD_R_FLU = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, slots=True)
class MissionTraverse:
    """A published traverse.

    Attributes
    ----------
    truth
        The localised positions or poses.
    telemetry
        Where the rover believed to be, where the table has it; its orientation is not in the
        table: identity.
    """

    truth: Trajectory | PositionTrack
    telemetry: Trajectory | None = None


def read_mission_traverse(path: Path) -> MissionTraverse | None:
    """Read one of the known tables; None where the header is of neither.

    Raises
    ------
    InputError
        When the file is such a table, and a cell in it is wrong: names its line.
    """
    header = _header(path)
    if set(_SPIRIT) <= set(header):
        values = _columns(path, _SPIRIT[2:])
        rows = np.arange(len(values), dtype=np.float64)
        poses = np.tile(np.eye(4), (len(values), 1, 1))
        poses[:, :2, 3] = values[:, :2]
        return MissionTraverse(
            PositionTrack(rows, values[:, 2:].copy(), indexed=True),
            Trajectory(rows, poses, indexed=True),
        )
    if set(_WAYPOINTS) <= set(header):
        return MissionTraverse(_waypoints(path))
    return None


def _waypoints(path: Path) -> Trajectory:
    values = _columns(path, _WAYPOINTS)
    clock = values[:, 0]
    # a new site repeats the last stop of the old one under the same clock
    later = clock > np.concatenate([[-np.inf], np.maximum.accumulate(clock)[:-1]])
    values = values[later]
    turns = Rotation.from_euler("ZYX", values[:, [6, 4, 5]]).as_matrix()
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3, :3] = _ENU_R_NED @ turns @ _FRD_R_FLU
    poses[:, :3, 3] = values[:, 1:4]
    return Trajectory(values[:, 0].copy(), poses)


def _header(path: Path) -> list[str]:
    try:
        with path.open("rb") as file:
            first = file.readline(10_000)
    except OSError:
        return []  # the general reader says it better
    return [cell.strip() for cell in first.decode("utf-8-sig", "replace").strip().split(",")]


def _columns(path: Path, names: tuple[str, ...]) -> FloatArray:
    """Some columns as finite numbers, (N, len(names))."""
    with path.open("rb") as file:
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise InputError(f"has more than {MAX_BYTES} bytes", source=path)
    reader = csv.DictReader(data.decode("utf-8-sig", "replace").splitlines())
    rows: list[list[float]] = []
    for cells in reader:
        row = []
        for name in names:
            try:
                row.append(float(cells[name] or ""))
            except ValueError as error:
                raise InputError(
                    f"{name} is {str(cells[name])[:40]!a}, must be a number",
                    source=path,
                    field=f"line {reader.line_num}",
                    remedy="the file may be cut off",
                ) from error
        rows.append(row)
    if not rows or not np.isfinite(rows).all():
        raise InputError(
            "holds no rows" if not rows else "holds a value that is not finite", source=path
        )
    return np.array(rows)
