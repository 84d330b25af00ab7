"""CSV and TUM text tables with strict columns; every error names its line."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from frontends.errors import InputError
from lunar_fg.bounded import MAX_BYTES
from lunar_fg.datasets.base import FloatArray, GroundTruth
from lunar_fg.datasets.schema import nearest_known

_LIMIT = 1e12


@dataclass(frozen=True, slots=True)
class Table:
    """Cells of a text table by column, with the line each row came from."""

    path: Path
    lines: tuple[int, ...]
    columns: dict[str, tuple[str, ...]]

    def __len__(self) -> int:
        """Count the rows."""
        return len(self.lines)

    def angles(self, column: str) -> FloatArray:
        """Read a column as angles of at most one turn, rad, (N,)."""
        values = self.numbers(column)
        if (wrong := np.abs(values) > 2.0 * np.pi).any():
            row = int(np.argmax(wrong))
            raise InputError(
                f"{column} is {values[row]:g}, more than a turn",
                source=self.path,
                field=f"line {self.lines[row]}",
                remedy="angles are radians; a wheel increment is less than a turn",
            )
        return values

    def numbers(self, column: str, *, positive: bool = False) -> FloatArray:
        """Read a column as finite numbers, (N,)."""
        values = np.array(
            [
                parse_number(cell, self.path, line, column)
                for line, cell in zip(self.lines, self.columns[column], strict=True)
            ]
        )
        if positive and (values <= 0).any():
            row = int(np.argmax(values <= 0))
            raise InputError(
                f"{column} is {values[row]:g}, must be positive",
                source=self.path,
                field=f"line {self.lines[row]}",
                remedy="give the 1-sigma; a large one where nothing is known",
            )
        return values

    def increasing(self, column: str) -> FloatArray:
        """Read a column as strictly increasing numbers, (N,)."""
        values = self.numbers(column)
        check_increasing(values, self.lines, self.path, column)
        return values


@dataclass(frozen=True, slots=True)
class FrameRow:
    """One row of frames.csv."""

    line: int
    frame: int
    stamp_s: float
    left: str
    right: str


@dataclass(frozen=True, slots=True)
class OdometryTable:
    """odometry.csv: `increments` (N, 3) forward m, lateral m, yaw rad since the row before."""

    stamp_s: FloatArray
    increments: FloatArray


@dataclass(frozen=True, slots=True)
class AttitudeTable:
    """attitude.csv: `angles` (N, 3) roll, pitch, yaw; `sigmas` (N, 2) roll-pitch, yaw; rad."""

    stamp_s: FloatArray
    angles: FloatArray
    sigmas: FloatArray


def read_frames_csv(path: Path) -> tuple[FrameRow, ...]:
    """Rows of frames.csv; frames and stamps strictly increasing."""
    table = read_csv(path, ("frame", "stamp_s", "left", "right"))
    stamps, numbers = table.increasing("stamp_s"), table.increasing("frame")
    for line, number in zip(table.lines, numbers, strict=True):
        if number != int(number) or number < 0:
            raise InputError(
                f"frame is {number:g}, must be a whole number from 0",
                source=path,
                field=f"line {line}",
                remedy="number the frames",
            )
    cells = zip(table.lines, table.columns["left"], table.columns["right"], strict=True)
    return tuple(
        FrameRow(line, int(number), float(stamp), left, right)
        for (line, left, right), number, stamp in zip(cells, numbers, stamps, strict=True)
    )


def read_odometry_csv(path: Path) -> OdometryTable:
    """Wheel increments."""
    table = read_csv(path, ("stamp_s", "d_forward_m", "d_lateral_m", "d_yaw_rad"))
    increments = np.column_stack(
        [table.numbers("d_forward_m"), table.numbers("d_lateral_m"), table.angles("d_yaw_rad")]
    )
    return OdometryTable(table.increasing("stamp_s"), increments)


def read_attitude_csv(path: Path) -> AttitudeTable:
    """Roll, pitch and yaw with their sigmas."""
    angles, sigmas = ("roll_rad", "pitch_rad", "yaw_rad"), ("sigma_rp_rad", "sigma_yaw_rad")
    table = read_csv(path, ("stamp_s", *angles, *sigmas))
    return AttitudeTable(
        table.increasing("stamp_s"),
        np.column_stack([table.angles(name) for name in angles]),
        np.column_stack([table.numbers(name, positive=True) for name in sigmas]),
    )


def read_position_csv(path: Path) -> GroundTruth:
    """Position-only truth, in a frame of its own."""
    table = read_csv(path, ("stamp_s", "x_m", "y_m"), ("z_m",))
    has_height = "z_m" in table.columns
    z = table.numbers("z_m") if has_height else np.zeros(len(table))
    position = np.column_stack([table.numbers("x_m"), table.numbers("y_m"), z])
    return GroundTruth(table.increasing("stamp_s"), position, has_height=has_height)


def read_tum(path: Path) -> GroundTruth:
    """Poses in TUM form: ``stamp_s x y z qx qy qz qw``, '#' begins a comment."""
    lines, rows = read_numbers(path, 8)
    values = np.array(rows)
    check_increasing(values[:, 0], lines, path, "stamp_s")
    norms = np.linalg.norm(values[:, 4:], axis=1)
    if (wrong := np.abs(norms - 1.0) > 1e-2).any():
        row = int(np.argmax(wrong))
        raise InputError(
            f"the quaternion has norm {norms[row]:.4g}, must be 1",
            source=path,
            field=f"line {lines[row]}",
            remedy="the columns are: stamp_s x y z qx qy qz qw",
        )
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(values[:, 4:]).as_matrix()
    poses[:, :3, 3] = values[:, 1:4]
    return GroundTruth.of_poses(values[:, 0].copy(), poses)


def read_csv(path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> Table:
    """Read a CSV file whose header holds all `required` and no unknown columns."""
    reader = csv.reader(read_text(path).splitlines(), strict=True)
    lines: list[int] = []
    rows: list[list[str]] = []
    header: list[str] | None = None
    try:
        for cells in reader:
            cells = [cell.strip() for cell in cells]
            if not any(cells):
                continue
            if header is None:
                header = cells
                _check_header(header, required, optional, path)
                continue
            if len(cells) != len(header):
                raise InputError(
                    f"has {len(cells)} cells, the header {len(header)}",
                    source=path,
                    field=f"line {reader.line_num}",
                    remedy=f"give {','.join(header)}",
                )
            lines.append(reader.line_num)
            rows.append(cells)
    except csv.Error as error:
        raise InputError(
            f"is not CSV: {error}",
            source=path,
            field=f"line {reader.line_num}",
            remedy="separate by commas",
        ) from error
    if header is None or not rows:
        raise InputError(
            "has no rows", source=path, remedy=f"give a header {','.join(required)} and rows"
        )
    return Table(
        path, tuple(lines), dict(zip(header, map(tuple, zip(*rows, strict=True)), strict=True))
    )


def read_numbers(path: Path, width: int) -> tuple[tuple[int, ...], list[list[float]]]:
    """Read whitespace-separated rows of `width` numbers: line numbers and rows."""
    lines: list[int] = []
    rows: list[list[float]] = []
    for line, text in enumerate(read_text(path).splitlines(), start=1):
        cells = text.split("#", maxsplit=1)[0].split()
        if not cells:
            continue
        if len(cells) != width:
            raise InputError(
                f"has {len(cells)} values, must have {width}",
                source=path,
                field=f"line {line}",
                remedy="check that the file is complete",
            )
        lines.append(line)
        rows.append([parse_number(cell, path, line, "value") for cell in cells])
    if not rows:
        raise InputError("has no rows", source=path, remedy=f"give rows of {width} numbers")
    return tuple(lines), rows


def read_text(path: Path) -> str:
    """Text of a file, UTF-8, bounded."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror}", source=path, remedy="check the path and its rights"
        ) from error
    if len(data) > MAX_BYTES:
        raise InputError(f"has more than {MAX_BYTES} bytes", source=path, remedy="split the run")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError("is not UTF-8 text", source=path, remedy="save it as UTF-8") from error


def parse_number(cell: str, path: Path, line: int, column: str) -> float:
    """Parse one finite number of reasonable size."""
    try:
        value = float(cell) if "_" not in cell else math.nan
    except ValueError:
        value = math.nan
    if abs(value) <= _LIMIT:
        return value
    raise InputError(
        f"{column} is {cell[:40]!r}, must be a finite number up to {_LIMIT:g}",
        source=path,
        field=f"line {line}",
        remedy="stamps are seconds; leave out rows without a value",
    )


def check_increasing(
    values: FloatArray, lines: Sequence[int], path: Path, column: str = "stamp_s"
) -> None:
    """Raise an InputError that names the line where `values` (N,) do not increase."""
    wrong = values[1:] <= values[:-1]
    if wrong.any():
        row = int(np.argmax(wrong)) + 1
        how = "repeats" if values[row] == values[row - 1] else "goes back from"
        raise InputError(
            f"{column} {values[row]:.9g} {how} {values[row - 1]:.9g} of line {lines[row - 1]}",
            source=path,
            field=f"line {lines[row]}",
            remedy=f"{column} must increase from row to row; sort, and drop repeated rows",
        )


def _check_header(
    header: list[str], required: Sequence[str], optional: Sequence[str], path: Path
) -> None:
    known = (*required, *optional)
    for name in header:
        if name not in known:
            raise InputError(
                f"{name[:40]!r} is not a known column",
                source=path,
                field="header",
                remedy=nearest_known(name, known),
            )
    if missing := [name for name in required if name not in header]:
        raise InputError(
            f"column {missing[0]!r} is missing",
            source=path,
            field="header",
            remedy=f"the columns are {','.join(required)}",
        )
    if len(set(header)) != len(header):
        raise InputError("a column is there twice", source=path, field="header", remedy="drop one")
