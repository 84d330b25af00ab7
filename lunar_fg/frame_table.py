"""Counts and times of every frame, as a CSV of the run folder."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from frontends.errors import InputError
from lunar_fg.record import FrameReport

FloatArray = NDArray[np.float64]

_TIME = "_ms"


@dataclass(frozen=True, slots=True)
class FrameTable:
    """One row a frame.

    Attributes
    ----------
    stamp_s
        (N,).
    counts
        (N,) each, by the names of `FrameReport`'s fields.
    timing_ms
        (N,) each, by stage; NaN where a stage did not run.
    """

    stamp_s: FloatArray
    counts: Mapping[str, FloatArray]
    timing_ms: Mapping[str, FloatArray]

    def __len__(self) -> int:
        """Count the frames."""
        return len(self.stamp_s)

    @classmethod
    def of_run(
        cls,
        stamp_s: FloatArray,
        reports: Sequence[FrameReport],
        timing_ms: Mapping[str, FloatArray],
    ) -> FrameTable:
        """Table of a run, as far as all three go."""
        rows = min(len(stamp_s), len(reports), *(len(ms) for ms in timing_ms.values()))
        counts = {
            field.name: np.array([float(getattr(r, field.name)) for r in reports[:rows]])
            for field in fields(FrameReport)
        }
        timing = {name: np.asarray(ms, np.float64)[:rows] for name, ms in timing_ms.items()}
        return cls(np.asarray(stamp_s, np.float64)[:rows], counts, timing)

    def text(self) -> str:
        """Text of the CSV; nothing between commas is a value that there was not."""
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        names = [*self.counts, *(f"{name}{_TIME}" for name in self.timing_ms)]
        writer.writerow(["stamp_s", *names])
        columns = [self.stamp_s, *self.counts.values(), *self.timing_ms.values()]
        for row in zip(*columns, strict=True):
            writer.writerow(["" if np.isnan(value) else f"{value:.10g}" for value in row])
        return buffer.getvalue()

    @classmethod
    def read(cls, path: Path) -> FrameTable | None:
        """Read the table; None where the run has none.

        Raises
        ------
        InputError
            The file is damaged.
        """
        if not path.is_file():
            return None
        try:
            with path.open(encoding="utf-8", newline="") as file:
                names, *rows = csv.reader(file)
            values = np.array([[float(cell or "nan") for cell in row] for row in rows])
            values = values.reshape(len(rows), len(names))
        except (OSError, ValueError, UnicodeDecodeError, csv.Error) as error:
            problem = f"cannot be read as a table of frames ({error})"
            raise InputError(problem, source=path) from error
        columns = dict(zip(names, values.T, strict=True))
        stamps = columns.pop("stamp_s", None)
        if stamps is None:
            raise InputError("is missing", source=path, field="stamp_s")
        times = {n.removesuffix(_TIME): v for n, v in columns.items() if n.endswith(_TIME)}
        counts = {n: v for n, v in columns.items() if not n.endswith(_TIME)}
        return cls(stamps, counts, times)
