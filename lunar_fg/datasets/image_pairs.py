"""A bare folder of ``left/`` and ``right/`` images, described by a traverse.yaml elsewhere."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from frontends.errors import InputError
from lunar_fg.datasets.base import GroundTruth
from lunar_fg.datasets.images import SUFFIXES
from lunar_fg.datasets.tables import FrameRow, Table, read_csv

#: Optional positions by frame: ``frame,time_s,x_m,y_m[,z_m]``; it also dates the frames.
FRAME_POSITIONS = "ground_truth.csv"
#: Assumed time between frames where nothing dates them.
PERIOD_S = 1.0
#: Larger frame numbers are times in nanoseconds.
NANOSECONDS_FROM = 10**14


def pair_by_name(path: Path) -> tuple[tuple[FrameRow, ...], str | None, GroundTruth | None]:
    """Pair ``left/NAME`` with ``right/NAME``; the number in the name is the frame.

    Returns
    -------
    rows, note, truth
        One row a pair, in the order of their numbers; what was assumed of the times; the
        position-only truth beside the images, where there is one, in a frame of its own.

    Raises
    ------
    InputError
        When a folder is missing or empty, an image lacks its partner or a number, or a
        frame has no time.
    """
    names = {side: _images(path / side) for side in ("left", "right")}
    for side, other in (("left", "right"), ("right", "left")):
        alone = sorted(set(names[side]) - set(names[other]))
        if alone:
            raise InputError(
                f"{other}/{alone[0]} does not exist",
                source=path,
                field=f"{side}/{alone[0]}",
                remedy="images are paired by name: add it, or remove its partner",
            )
    numbered = sorted((frame_number(path, name), name) for name in names["left"])
    table = _frame_positions(path)
    truth = None if table is None else _truth(table)
    times = None
    if table is not None and truth is not None:
        frames = table.numbers("frame").astype(np.int64).tolist()
        times = dict(zip(frames, truth.stamp_s.tolist(), strict=True))
    rows = []
    for line, (frame, name) in enumerate(numbered, start=1):
        if times is not None and frame not in times:
            raise InputError(
                f"has no time for frame {frame}",
                source=path / FRAME_POSITIONS,
                remedy="add the row, or write a frames.csv",
            )
        stamp = stamp_of(frame) if times is None else times[frame]
        rows.append(FrameRow(line, frame, stamp, f"left/{name}", f"right/{name}"))
    note = None if times is not None else f"frames are taken to be {PERIOD_S:g} s apart"
    return tuple(rows), note, truth


def _truth(table: Table) -> GroundTruth:
    has_height = "z_m" in table.columns
    z = table.numbers("z_m") if has_height else np.zeros(len(table))
    position = np.column_stack([table.numbers("x_m"), table.numbers("y_m"), z])
    return GroundTruth(table.increasing("time_s"), position, has_height=has_height)


def _frame_positions(path: Path) -> Table | None:
    if not (path / FRAME_POSITIONS).is_file():
        return None
    return read_csv(path / FRAME_POSITIONS, ("frame", "time_s", "x_m", "y_m"), ("z_m",))


def _images(folder: Path) -> list[str]:
    names = os.listdir(folder) if folder.is_dir() else []
    images = [name for name in names if name.lower().endswith(SUFFIXES)]
    if not images:
        raise InputError(
            "holds no images",
            source=folder,
            remedy="put the images into left/ and right/ under equal names, or write a frames.csv",
        )
    return images


def stamp_of(number: int) -> float:
    """Time of a frame that only its number dates, s: nanoseconds where it is that large."""
    return 1e-9 * number if number >= NANOSECONDS_FROM else PERIOD_S * number


def frame_number(path: Path, name: str) -> int:
    """Number in an image's name: the last one there is.

    Raises
    ------
    InputError
        There is none.
    """
    digits = re.findall(r"\d+", Path(name).stem)
    if not digits or len(digits[-1]) > 18:
        raise InputError(
            f"left/{name[:100]} has no frame number in its name",
            source=path,
            remedy="number the images, or write a frames.csv",
        )
    return int(digits[-1])
