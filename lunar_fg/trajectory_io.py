"""Trajectory files: TUM, KITTI, EuRoC ground truth, position tables.

`read_track` finds the format from the content; whatever is wrong is an `InputError` that
names the file and the line.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from frontends.errors import InputError
from lunar_fg.bounded import check_size
from lunar_fg.mission_traverses import read_mission_traverse
from lunar_fg.trajectory import PositionTrack, Trajectory, Truth, are_rigid

FloatArray = NDArray[np.float64]

_FORMATS = "TUM (8 columns), KITTI (12), EuRoC ground truth (17, commas) or stamp_s,x_m,y_m[,z_m]"
_STAMP_NAMES = ("stamp_s", "time_s", "timestamp", "timestamp [ns]", "stamp", "time", "t")
_AXIS_NAMES = (("x_m", "x", "p_x [m]"), ("y_m", "y", "p_y [m]"), ("z_m", "z", "p_z [m]"))
_ROW_NAMES = ("frame", "index")
#: Larger stamps are nanoseconds: in seconds they would lie three million years ahead.
_NANOSECONDS_FROM = 1e14
_EUROC_COLUMNS = (8, 17)
_QUATERNION_TOLERANCE = 1e-2


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """The numbers of a file, where each row stood, and the header if there was one."""

    path: Path
    values: FloatArray
    lines: tuple[int, ...]
    header: tuple[str, ...] | None
    commas: bool
    said_nanoseconds: bool = False

    @property
    def nanoseconds(self) -> bool:
        """Whether the stamps are: by a comment that says so, or too large for seconds."""
        return self.said_nanoseconds or bool(self.values[0, 0] > _NANOSECONDS_FROM)

    def error(self, row: int, problem: str, remedy: str | None = None) -> InputError:
        return InputError(problem, source=self.path, field=f"line {self.lines[row]}", remedy=remedy)


def read_track(path: str | Path) -> Truth:
    """Read poses or positions in any of the known formats.

    Parameters
    ----------
    path
        TUM ``stamp x y z qx qy qz qw``; KITTI 3x4 rows (no stamps: the row number is the
        stamp, and the result is marked `indexed`); EuRoC ``data.csv`` of a ground truth
        (nanoseconds, quaternion w first); position table with commas, with or without a
        header, columns stamp_s (or time_s), x_m, y_m and perhaps z_m; a ``frame`` column
        beside the stamp is skipped; tables of `lunar_fg.mission_traverses`.

    Returns
    -------
    Trajectory or PositionTrack
        A `PositionTrack` when the file has no orientation.

    Raises
    ------
    InputError
        When the file cannot be read as any of these; the text names the line.
    """
    mission = read_mission_traverse(Path(path))
    if mission is not None:
        return mission.truth
    table = _read_table(Path(path))
    columns = table.values.shape[1]
    if table.commas and columns in _EUROC_COLUMNS:
        euroc = columns != 8 or table.nanoseconds
        return _poses_from_quaternions(table, euroc=euroc)
    if table.commas:
        return _positions(table)
    if columns == 8:
        return _poses_from_quaternions(table, euroc=False)
    if columns == 12:
        return _poses_from_rows(table)
    raise table.error(0, f"{columns} columns fit no known format", f"known: {_FORMATS}")


def read_trajectory(path: str | Path) -> Trajectory:
    """Read poses as `read_track` does; a file of positions only is an `InputError`.

    Of a mission's table that has both, the telemetry is read, not the localisation.
    """
    mission = read_mission_traverse(Path(path))
    if mission is not None and mission.telemetry is not None:
        return mission.telemetry
    track = read_track(path)
    if isinstance(track, PositionTrack):
        raise InputError(
            "holds positions without orientation", source=path, remedy="give poses: TUM or KITTI"
        )
    return track


def tum_line(stamp_s: float, map_T_rover: FloatArray) -> str:
    """One line of a TUM file, without the line's end; positions to the nanometre."""
    return _tum_lines(np.array([stamp_s]), map_T_rover[None])[0]


def tum_text(trajectory: Trajectory) -> str:
    """Whole TUM file of a trajectory."""
    lines = _tum_lines(trajectory.stamp_s, trajectory.map_T_rover)
    return "\n".join(["# stamp_s x_m y_m z_m qx qy qz qw", *lines, ""])


def kitti_text(trajectory: Trajectory) -> str:
    """Whole KITTI file of a trajectory: rows of the 3x4 matrices, no stamps."""
    rows = trajectory.map_T_rover[:, :3].reshape(-1, 12)
    return "".join(" ".join(f"{value:.12e}" for value in row) + "\n" for row in rows)


def euroc_text(trajectory: Trajectory) -> str:
    """Whole EuRoC file of a trajectory: nanoseconds, position, quaternion with w first."""
    header = "#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z []"
    quaternions = Rotation.from_matrix(trajectory.map_T_rover[:, :3, :3]).as_quat(canonical=True)
    rows = np.column_stack([trajectory.positions, quaternions[:, [3, 0, 1, 2]]]).tolist()
    lines = [
        ",".join([str(round(stamp * 1e9)), *map(repr, row)])
        for stamp, row in zip(trajectory.stamp_s.tolist(), rows, strict=True)
    ]
    return "\n".join([header, *lines, ""])


def position_text(track: PositionTrack) -> str:
    """Position CSV with the header ``stamp_s,x_m,y_m[,z_m]``."""
    names = ["stamp_s", "x_m", "y_m", "z_m"][: 1 + track.position_m.shape[1]]
    rows = np.column_stack([track.stamp_s, track.position_m]).tolist()
    return "\n".join([",".join(names), *(",".join(map(repr, row)) for row in rows)]) + "\n"


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a TUM file."""
    Path(path).write_text(tum_text(trajectory), encoding="utf-8")


def write_kitti(path: str | Path, trajectory: Trajectory) -> None:
    """Write a KITTI file; stamps and covariances are not part of it."""
    Path(path).write_text(kitti_text(trajectory), encoding="utf-8")


def _tum_lines(stamp_s: FloatArray, poses: FloatArray) -> list[str]:
    if not len(poses):
        return []
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    # Adding zero makes a rounded -0.0 a 0.0: the same file from numbers that are the same so far.
    numbers = np.column_stack([stamp_s, np.round(poses[:, :3, 3], 9) + 0.0])
    turns = np.round(quaternions, 12) + 0.0
    return [
        " ".join([*(f"{v:.9f}" for v in number), *(f"{v:.12f}" for v in turn)])
        for number, turn in zip(numbers.tolist(), turns.tolist(), strict=True)
    ]


def _read_table(path: Path) -> _Table:
    check_size(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", source=path) from error
    except UnicodeDecodeError as error:
        raise InputError("is not a text file", source=path, remedy=f"known: {_FORMATS}") from error
    header: tuple[str, ...] | None = None
    commas: bool | None = None
    rows: list[list[float]] = []
    lines: list[int] = []
    said_nanoseconds = False
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if not line or line.startswith("#"):
            said_nanoseconds = said_nanoseconds or (not rows and "[ns]" in line)
            continue
        commas = "," in line if commas is None else commas
        words = [word.strip() for word in line.split(",")] if commas else line.split()
        try:
            row = [float(word) for word in words]
        except ValueError as error:
            if not rows and header is None and commas:
                header = tuple(word.lower() for word in words)
                continue
            bad = next(word for word in words if not _is_number(word))
            raise InputError(
                f"'{bad[:40]}' is not a number", source=path, field=f"line {number}"
            ) from error
        expected = len(rows[0]) if rows else len(header or row)
        if len(row) != expected:
            raise InputError(
                f"{len(row)} columns, {expected} in the lines before",
                source=path,
                field=f"line {number}",
                remedy="the file may be cut off",
            )
        if not np.isfinite(row).all():
            raise InputError("holds a NaN or infinity", source=path, field=f"line {number}")
        rows.append(row)
        lines.append(number)
    if not rows:
        raise InputError("holds no pose", source=path, remedy=f"known: {_FORMATS}")
    values = np.array(rows, dtype=np.float64)
    return _Table(path, values, tuple(lines), header, bool(commas), said_nanoseconds)


def _poses_from_quaternions(table: _Table, *, euroc: bool) -> Trajectory:
    quaternions = table.values[:, [5, 6, 7, 4]] if euroc else table.values[:, 4:8]
    norms = np.linalg.norm(quaternions, axis=1)
    bad = np.flatnonzero(np.abs(norms - 1.0) > _QUATERNION_TOLERANCE)
    if bad.size:
        raise table.error(int(bad[0]), f"quaternion has norm {norms[bad[0]]:.3g}, must be 1")
    poses = np.tile(np.eye(4), (len(norms), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    poses[:, :3, 3] = table.values[:, 1:4]
    return Trajectory(_stamps(table, table.values[:, 0]), poses)


def _poses_from_rows(table: _Table) -> Trajectory:
    poses = np.tile(np.eye(4), (len(table.values), 1, 1))
    poses[:, :3] = table.values.reshape(-1, 3, 4)
    bad = np.flatnonzero(~are_rigid(poses))
    if bad.size:
        raise table.error(int(bad[0]), "the 3x4 matrix is not a rigid transform")
    return Trajectory(np.arange(len(poses), dtype=np.float64), poses, indexed=True)


def _positions(table: _Table) -> PositionTrack:
    columns = table.values.shape[1]
    if table.header is None:
        if columns not in (3, 4):
            raise table.error(0, f"{columns} columns fit no known format", f"known: {_FORMATS}")
        stamps = _stamps(table, table.values[:, 0])
        return PositionTrack(stamps, table.values[:, 1:])
    names = table.header
    known = (*_STAMP_NAMES, *_ROW_NAMES, *(name for axis in _AXIS_NAMES for name in axis))
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0]
            remedy = f"the nearest known one is '{near}'"
            raise InputError("unknown column", source=table.path, field=name, remedy=remedy)
    x, y, z = (_column(names, axis) for axis in _AXIS_NAMES)
    if x is None or y is None:
        missing = "x_m" if x is None else "y_m"
        raise InputError("column is missing", source=table.path, field=missing)
    position = table.values[:, [x, y] if z is None else [x, y, z]]
    stamp, row = _column(names, _STAMP_NAMES), _column(names, _ROW_NAMES)
    if stamp is not None:
        return PositionTrack(_stamps(table, table.values[:, stamp]), position)
    if row is None:
        raise InputError("column is missing", source=table.path, field="stamp_s")
    return PositionTrack(_stamps(table, table.values[:, row]), position, indexed=True)


def _column(names: Sequence[str], wanted: Sequence[str]) -> int | None:
    return next((i for i, name in enumerate(names) if name in wanted), None)


def _stamps(table: _Table, stamps: FloatArray) -> FloatArray:
    late = np.flatnonzero(np.diff(stamps) <= 0.0)
    if late.size:
        row = int(late[0])
        raise table.error(
            row + 1,
            f"stamp {stamps[row + 1]:.9f} does not come after {stamps[row]:.9f}",
            "stamps must increase strictly",
        )
    return np.asarray(stamps * 1e-9 if table.nanoseconds else stamps)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
