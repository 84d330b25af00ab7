"""The traverse log: every measurement and estimate of a run in one SQLite file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import Self

from frontends.errors import InputError
from frontends.measurements import Estimate
from frontends.revisit import Place
from lunar_fg.checkpoint import Checkpoint
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.graph.ledger import FixDecision, LedgerEntry
from lunar_fg.log_entries import LoggedFrame, RunHeader, Sitting
from lunar_fg.log_file import LogFile
from lunar_fg.log_fixes import (
    FIX_QUERIES,
    FIX_TABLE_NAMES,
    FIX_TABLES,
    ledger_of,
    rows_of_decision,
    rows_of_ledger,
)
from lunar_fg.log_header import (
    HEADER_QUERY,
    SITTING_QUERY,
    header_of,
    row_of_header,
    row_of_sitting,
    sitting_of,
)
from lunar_fg.log_places import PLACE_QUERY, PLACE_TABLE, place_of, row_of_place
from lunar_fg.log_rows import (
    KEYFRAME_TABLES,
    TABLES,
    RowReader,
    rows_of,
    rows_of_record,
)
from lunar_fg.record import FrameRecord

SCHEMA_VERSION = 10


class TraverseLog:
    """One run's log; make it with `create` or `open`, use it as a context manager.

    Parameters
    ----------
    file
        With the log's tables.
    """

    def __init__(self, file: LogFile) -> None:
        self._file = file
        self._path = file.path
        self._rows = RowReader(file.path)

    @classmethod
    def create(cls, path: Path, header: RunHeader) -> Self:
        """Start a new log.

        Raises
        ------
        InputError
            The file exists already, or cannot be written.
        """
        log = cls(LogFile.create(path, f"{TABLES}{FIX_TABLES}{PLACE_TABLE}", SCHEMA_VERSION))
        try:
            with log._file.transaction():
                log._file.insert(0, [row_of_header(header)])
        except BaseException:
            log.close()
            raise
        return log

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open an existing log for reading; another process may be writing it.

        Raises
        ------
        InputError
            The file is missing, damaged, no log, or of another version.
        """
        return cls(LogFile.open(path, SCHEMA_VERSION))

    @classmethod
    def reopen(cls, path: Path) -> Self:
        """Open an existing log to go on writing it.

        Raises
        ------
        InputError
            As for `open`; also when another process is writing it, or it may not be written.
        """
        return cls(LogFile.reopen(path, SCHEMA_VERSION))

    def close(self) -> None:
        """Close the file; the log is then one file without journals."""
        self._file.close()

    def __enter__(self) -> Self:
        """Return the log itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the log."""
        self.close()

    def header(self) -> RunHeader:
        """Read what holds for the whole run."""
        return header_of(self._file.query(HEADER_QUERY)[0], self._rows)

    def begin(self, sitting: Sitting) -> None:
        """Note the dataset that the next frames are of."""
        with self._file.transaction():
            (number,) = self._file.query("SELECT count(*) FROM sitting")[0]
            self._file.insert(-1, [row_of_sitting(number, sitting)])

    def sittings(self) -> list[Sitting]:
        """Datasets of the run, in order."""
        return list(map(sitting_of, self._file.query(SITTING_QUERY)))

    def append(
        self,
        keyframe: Keyframe,
        estimate: Estimate,
        record: FrameRecord | None = None,
        checkpoint: Checkpoint | None = None,
        decisions: Sequence[FixDecision] = (),
    ) -> None:
        """Write a keyframe and what belongs to it, all or nothing.

        Parameters
        ----------
        keyframe, estimate
            What went into the graph and what came out.
        record
            The frame's sensors and counts.
        checkpoint
            What the frames after it need; only the newest one is kept.
        decisions
            On the map measurements that came with it, in order.

        Raises
        ------
        InputError
            The keyframe is in the log already, or the file cannot be written.
        """
        with self._file.transaction():
            self._file.insert(keyframe.index, rows_of(keyframe, estimate))
            if record is not None:
                self._file.insert(keyframe.index, rows_of_record(keyframe.index, record))
            self._keep(checkpoint, keyframe.index)
            self._insert_decisions(decisions)

    def append_place(self, place: Place) -> None:
        """Write what a keyframe saw of a place that may be recognised again.

        Raises
        ------
        InputError
            The file cannot be written.
        """
        with self._file.transaction():
            self._file.insert(place.frame, [row_of_place(place)])

    def append_decisions(self, decisions: Sequence[FixDecision]) -> None:
        """Write what was decided on map measurements, all or nothing.

        Raises
        ------
        InputError
            A ruling is in the log already, or the file cannot be written.
        """
        with self._file.transaction():
            self._insert_decisions(decisions)

    def replace_ledger(self, ledger: Sequence[LedgerEntry]) -> None:
        """Write all map measurements and verdicts anew, all or nothing.

        For where they were reached again from the log, or voted on once more at the end.

        Raises
        ------
        InputError
            The file cannot be written; the old ones are kept.
        """
        with self._file.transaction():
            self._file.clear(FIX_TABLE_NAMES)
            self._file.insert(-1, rows_of_ledger(ledger))

    def _insert_decisions(self, decisions: Sequence[FixDecision]) -> None:
        for decision in decisions:
            self._file.insert(decision.entry.frame, rows_of_decision(decision))

    def rewrite(
        self,
        entries: Sequence[tuple[Keyframe, Estimate]],
        checkpoint: Checkpoint | None = None,
        ledger: Sequence[LedgerEntry] = (),
        places: Iterable[Place] = (),
    ) -> None:
        """Replace everything by these, all or nothing: the first keyframes were re-measured.

        Raises
        ------
        InputError
            The file cannot be written; the old keyframes are kept.
        """
        with self._file.transaction():
            self._file.clear((*FIX_TABLE_NAMES, "place", *KEYFRAME_TABLES))
            for keyframe, estimate in entries:
                self._file.insert(keyframe.index, rows_of(keyframe, estimate))
            self._file.insert(-1, rows_of_ledger(ledger))
            self._file.insert(-1, (row_of_place(place) for place in places))
            self._keep(checkpoint, entries[-1][0].index if entries else -1)

    def _keep(self, checkpoint: Checkpoint | None, frame: int) -> None:
        if checkpoint is not None:
            self._file.clear(["checkpoint"])
            self._file.insert(frame, [("checkpoint", (1, frame, checkpoint.to_bytes()))])

    def together(self) -> AbstractContextManager[None]:
        """Make all that is written within one entry, all or nothing.

        Raises
        ------
        InputError
            The file cannot be written.
        """
        return self._file.together()

    def ledger(self) -> list[LedgerEntry]:
        """Read every map measurement with its verdicts, in the order in which they came."""
        measurements, candidates, rulings = (self._file.query(query) for query in FIX_QUERIES)
        return ledger_of(measurements, candidates, rulings, self._rows, str(self._path))

    def places(self) -> list[Place]:
        """Read what was kept of places, in frame order."""
        return [place_of(row, self._rows, self._path) for row in self._file.query(PLACE_QUERY)]

    def keyframes(self) -> list[Keyframe]:
        """Read all measurements in frame order."""
        observations = {row[0]: row for row in self._file.query("SELECT * FROM observations")}
        relatives = {row[0]: row for row in self._file.query("SELECT * FROM relative")}
        return [
            self._rows.keyframe(row, observations.get(row[0]), relatives.get(row[0]))
            for row in self._file.query("SELECT * FROM keyframe ORDER BY frame")
        ]

    def estimates(self) -> list[Estimate]:
        """Read the estimates as they stood when each keyframe came in."""
        query = (
            "SELECT frame, stamp_s, pose, covariance, lost, used, refused"
            " FROM keyframe JOIN estimate USING (frame) ORDER BY frame"
        )
        return [self._rows.estimate(row) for row in self._file.query(query)]

    def frames(self) -> list[LoggedFrame]:
        """Read all that there is of each frame, in order."""
        sensors, counts, by_wheels = (
            {row[0]: row for row in self._file.query(f"SELECT * FROM {table}")}  # noqa: S608
            for table in ("sensors", "counts", "dead_reckoning")
        )
        records = {
            frame: self._rows.record(row, counts[frame], by_wheels.get(frame))
            for frame, row in sensors.items()
            if frame in counts
        }
        return [
            LoggedFrame(keyframe, estimate, records.get(keyframe.index))
            for keyframe, estimate in zip(self.keyframes(), self.estimates(), strict=True)
        ]

    def checkpoint(self) -> tuple[int, Checkpoint] | None:
        """Read the newest checkpoint and the number of its frame.

        Raises
        ------
        InputError
            It is damaged.
        """
        rows = self._file.query("SELECT frame, state FROM checkpoint")
        if not rows:
            return None
        try:
            return rows[0][0], Checkpoint.from_bytes(rows[0][1])
        except (ValueError, KeyError, OSError, EOFError) as error:
            raise InputError(
                f"holds a damaged checkpoint ({error})", source=self._path, field="checkpoint"
            ) from error
