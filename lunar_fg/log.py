"""The traverse log: every measurement and estimate of a run in one SQLite file."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, astuple
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from frontends.camera import StereoCamera
from frontends.errors import InputError
from frontends.measurements import Estimate, StartPrior
from frontends.revisit import Place
from lunar_fg.checkpoint import Checkpoint
from lunar_fg.folder_lock import FolderLock
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.graph.ledger import FixDecision, LedgerEntry
from lunar_fg.log_entries import LoggedFrame, RunHeader, Sitting
from lunar_fg.log_fixes import (
    FIX_QUERIES,
    FIX_TABLE_NAMES,
    FIX_TABLES,
    ledger_of,
    rows_of_decision,
    rows_of_ledger,
)
from lunar_fg.log_places import PLACE_QUERY, PLACE_TABLE, place_of, row_of_place
from lunar_fg.log_rows import (
    KEYFRAME_TABLES,
    TABLES,
    RowReader,
    pack,
    rows_of,
    rows_of_record,
)
from lunar_fg.record import FrameRecord

SCHEMA_VERSION = 9


class TraverseLog:
    """One run's log; make it with `create` or `open`, use it as a context manager.

    Parameters
    ----------
    path
        The file.
    connection
        Its open database.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self._path = path
        self._db = connection
        self._rows = RowReader(path)
        self._lock: FolderLock | None = None
        self._within = False

    @classmethod
    def create(cls, path: Path, header: RunHeader) -> Self:
        """Start a new log.

        Raises
        ------
        InputError
            The file exists already, or cannot be written.
        """
        if path.exists():
            raise InputError("exists already", source=path, remedy="choose another run folder")
        log = None
        lock = FolderLock(path.parent)
        try:
            log = cls(path, sqlite3.connect(path, isolation_level=None))
            log._lock = lock
            log._db.execute("PRAGMA journal_mode=WAL")
            log._db.execute("PRAGMA synchronous=NORMAL")
            tables = f"{TABLES}{FIX_TABLES}{PLACE_TABLE}"
            log._db.executescript(f"BEGIN;{tables}PRAGMA user_version={SCHEMA_VERSION};COMMIT;")
            log._write_header(header)
        except sqlite3.Error as error:
            if log is not None:
                log.close()
            lock.release()
            raise InputError(f"cannot be written ({error})", source=path) from error
        return log

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open an existing log for reading; another process may be writing it.

        Raises
        ------
        InputError
            The file is missing, damaged, no log, or of another version.
        """
        _require(path)
        # Without a writer's journal the file is at rest: read it without making one.
        alone = "" if path.with_name(f"{path.name}-wal").exists() else "&immutable=1"
        return cls._checked(path, f"{path.resolve().as_uri()}?mode=ro{alone}")

    @classmethod
    def reopen(cls, path: Path) -> Self:
        """Open an existing log to go on writing it.

        Raises
        ------
        InputError
            As for `open`; also when another process is writing it, or it may not be written.
        """
        _require(path)
        lock = FolderLock(path.parent)
        try:
            log = cls._checked(path, f"{path.resolve().as_uri()}?mode=rw")
        except BaseException:
            lock.release()
            raise
        log._lock = lock
        try:
            log._db.execute("PRAGMA journal_mode=WAL")
            log._db.execute("PRAGMA synchronous=NORMAL")
        except sqlite3.Error as error:
            log.close()
            raise InputError(f"cannot be written ({error})", source=path) from error
        return log

    @classmethod
    def _checked(cls, path: Path, uri: str) -> Self:
        """Connect and check; see `open` for what is raised."""
        log = cls(path, sqlite3.connect(uri, uri=True, isolation_level=None))
        try:
            (state,) = log._db.execute("PRAGMA integrity_check(1)").fetchone()
            (version,) = log._db.execute("PRAGMA user_version").fetchone()
        except sqlite3.DatabaseError as error:
            log.close()
            raise InputError(f"is not a readable log ({error})", source=path) from error
        if state != "ok":
            log.close()
            raise InputError(f"is damaged ({state})", source=path)
        if version != SCHEMA_VERSION:
            log.close()
            raise InputError(
                f"has schema version {version}, this program reads {SCHEMA_VERSION}",
                source=path,
                remedy="use the lunar-fg that wrote it",
            )
        return log

    def close(self) -> None:
        """Close the file; the log is then one file without journals."""
        self._db.close()
        if self._lock is not None:
            self._lock.release()

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

    def _write_header(self, header: RunHeader) -> None:
        start = header.start
        sigmas = {"rot_rad": start.sigma_rot_rad, "trans_m": start.sigma_trans_m}
        self._db.execute(
            "INSERT INTO run VALUES (1, ?, ?, ?, ?, ?)",
            (
                json.dumps(asdict(header.camera)),
                pack(header.rover_T_camera),
                json.dumps(sigmas),
                pack(start.map_T_rover),
                header.config_json,
            ),
        )

    def header(self) -> RunHeader:
        """Read what holds for the whole run."""
        row = self._query("SELECT * FROM run")[0]
        _, camera, rover_T_camera, start, start_pose, config = row
        sigmas = json.loads(start)
        start_pose = self._rows.array(start_pose, "run")
        prior = StartPrior(start_pose, tuple(sigmas["rot_rad"]), tuple(sigmas["trans_m"]))
        rover_T_camera = self._rows.array(rover_T_camera, "run")
        return RunHeader(StereoCamera(**json.loads(camera)), rover_T_camera, prior, config)

    def begin(self, sitting: Sitting) -> None:
        """Note the dataset that the next frames are of."""
        with self._transaction():
            values = astuple(sitting)
            values = (*values[:5], json.dumps(values[5:]))  # calibration, topics, faults
            marks = "(SELECT count(*) FROM sitting), ?, ?, ?, ?, ?, ?"
            self._db.execute(f"INSERT INTO sitting VALUES ({marks})", values)  # noqa: S608  # see _insert

    def sittings(self) -> list[Sitting]:
        """Datasets of the run, in order."""
        rows = self._query("SELECT * FROM sitting ORDER BY number")
        return [
            Sitting(dataset, images, traverse, index, stamp_s, *map(tuple, json.loads(given)))
            for _, dataset, images, traverse, index, stamp_s, given in rows
        ]

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
        with self._transaction():
            self._insert(keyframe.index, rows_of(keyframe, estimate))
            if record is not None:
                self._insert(keyframe.index, rows_of_record(keyframe.index, record))
            self._keep(checkpoint, keyframe.index)
            self._insert_decisions(decisions)

    def append_place(self, place: Place) -> None:
        """Write what a keyframe saw of a place that may be recognised again.

        Raises
        ------
        InputError
            The file cannot be written.
        """
        with self._transaction():
            self._insert(place.frame, [row_of_place(place)])

    def append_decisions(self, decisions: Sequence[FixDecision]) -> None:
        """Write what was decided on map measurements, all or nothing.

        Raises
        ------
        InputError
            A ruling is in the log already, or the file cannot be written.
        """
        with self._transaction():
            self._insert_decisions(decisions)

    def replace_ledger(self, ledger: Sequence[LedgerEntry]) -> None:
        """Write all map measurements and verdicts anew, all or nothing.

        For where they were reached again from the log, or voted on once more at the end.

        Raises
        ------
        InputError
            The file cannot be written; the old ones are kept.
        """
        with self._transaction():
            self._clear(FIX_TABLE_NAMES)
            self._insert(-1, rows_of_ledger(ledger))

    def _clear(self, tables: Iterable[str]) -> None:
        for table in tables:
            self._db.execute(f"DELETE FROM {table}")  # noqa: S608  # see _insert

    def _insert_decisions(self, decisions: Sequence[FixDecision]) -> None:
        for decision in decisions:
            self._insert(decision.entry.frame, rows_of_decision(decision))

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
        with self._transaction():
            self._clear((*FIX_TABLE_NAMES, "place", *KEYFRAME_TABLES))
            for keyframe, estimate in entries:
                self._insert(keyframe.index, rows_of(keyframe, estimate))
            self._insert(-1, rows_of_ledger(ledger))
            self._insert(-1, (row_of_place(place) for place in places))
            self._keep(checkpoint, entries[-1][0].index if entries else -1)

    def _insert(self, frame: int, rows: Iterable[tuple[str, tuple[object, ...]]]) -> None:
        for table, values in rows:
            marks = ", ".join("?" * len(values))
            try:
                # names of tables are constants of the program, values are bound
                self._db.execute(f"INSERT INTO {table} VALUES ({marks})", values)  # noqa: S608
            except sqlite3.IntegrityError as error:
                raise InputError(
                    "is in the log already", source=self._path, field=f"keyframe {frame}"
                ) from error

    def _keep(self, checkpoint: Checkpoint | None, frame: int) -> None:
        if checkpoint is not None:
            values = (frame, checkpoint.to_bytes())
            self._db.execute("INSERT OR REPLACE INTO checkpoint VALUES (1, ?, ?)", values)

    @contextmanager
    def together(self) -> Iterator[None]:
        """Make all that is written within one entry, all or nothing.

        Raises
        ------
        InputError
            The file cannot be written.
        """
        with self._transaction():
            self._within = True
            try:
                yield
            finally:
                self._within = False

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        if self._within:
            yield
            return
        try:
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise
        except sqlite3.Error as error:
            raise InputError(
                f"cannot be written ({error})", source=self._path,
                remedy="what was logged before is kept; check disk space and permissions",
            ) from error  # fmt: skip

    def ledger(self) -> list[LedgerEntry]:
        """Read every map measurement with its verdicts, in the order in which they came."""
        measurements, candidates, rulings = (self._query(query) for query in FIX_QUERIES)
        return ledger_of(measurements, candidates, rulings, self._rows, str(self._path))

    def places(self) -> list[Place]:
        """Read what was kept of places, in frame order."""
        return [place_of(row, self._rows, self._path) for row in self._query(PLACE_QUERY)]

    def keyframes(self) -> list[Keyframe]:
        """Read all measurements in frame order."""
        observations = {row[0]: row for row in self._query("SELECT * FROM observations")}
        relatives = {row[0]: row for row in self._query("SELECT * FROM relative")}
        return [
            self._rows.keyframe(row, observations.get(row[0]), relatives.get(row[0]))
            for row in self._query("SELECT * FROM keyframe ORDER BY frame")
        ]

    def estimates(self) -> list[Estimate]:
        """Read the estimates as they stood when each keyframe came in."""
        query = (
            "SELECT frame, stamp_s, pose, covariance, lost, used, refused"
            " FROM keyframe JOIN estimate USING (frame) ORDER BY frame"
        )
        return [self._rows.estimate(row) for row in self._query(query)]

    def frames(self) -> list[LoggedFrame]:
        """Read all that there is of each frame, in order."""
        sensors, counts, by_wheels = (
            {row[0]: row for row in self._query(f"SELECT * FROM {table}")}  # noqa: S608
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
        rows = self._query("SELECT frame, state FROM checkpoint")
        if not rows:
            return None
        try:
            return rows[0][0], Checkpoint.from_bytes(rows[0][1])
        except (ValueError, KeyError, OSError, EOFError) as error:
            raise InputError(
                f"holds a damaged checkpoint ({error})", source=self._path, field="checkpoint"
            ) from error

    def _query(self, sql: str) -> list[tuple[Any, ...]]:
        try:
            return self._db.execute(sql).fetchall()
        except sqlite3.Error as error:
            raise InputError(f"cannot be read ({error})", source=self._path) from error


def _require(path: Path) -> None:
    if not path.is_file():
        raise InputError("is missing", source=path, remedy="give the folder of a recorded run")
