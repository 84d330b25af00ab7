"""The traverse log: every measurement and estimate of a run in one SQLite file."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from frontends.camera import StereoCamera
from frontends.errors import InputError
from frontends.measurements import Estimate, FloatArray, StartPrior
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.log_rows import KEYFRAME_TABLES, TABLES, RowReader, pack, rows_of

SCHEMA_VERSION = 1


@dataclass(frozen=True, slots=True)
class RunHeader:
    """What holds for a whole run.

    Attributes
    ----------
    camera, rover_T_camera, start
        As given to the smoother.
    config_json
        The effective configuration, as JSON.
    """

    camera: StereoCamera
    rover_T_camera: FloatArray
    start: StartPrior
    config_json: str = "{}"


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
        try:
            log = cls(path, sqlite3.connect(path, isolation_level=None))
            log._db.execute("PRAGMA journal_mode=WAL")
            log._db.execute("PRAGMA synchronous=NORMAL")
            log._db.executescript(f"BEGIN;{TABLES}PRAGMA user_version={SCHEMA_VERSION};COMMIT;")
            log._write_header(header)
        except sqlite3.Error as error:
            if log is not None:
                log.close()
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
        if not path.is_file():
            raise InputError("is missing", source=path, remedy="give the folder of a recorded run")
        # Without a writer's journal the file is at rest: read it without making one.
        alone = "" if path.with_name(f"{path.name}-wal").exists() else "&immutable=1"
        log = cls(path, sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro{alone}", uri=True))
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

    def append(self, keyframe: Keyframe, estimate: Estimate) -> None:
        """Write a keyframe and its estimate, both or nothing.

        Raises
        ------
        InputError
            The keyframe is in the log already, or the file cannot be written.
        """
        self._transact([(keyframe, estimate)], start_anew=False)

    def rewrite(self, entries: Sequence[tuple[Keyframe, Estimate]]) -> None:
        """Replace all keyframes by these, all or nothing: the first ones were re-measured.

        Raises
        ------
        InputError
            The file cannot be written; the old keyframes are kept.
        """
        self._transact(entries, start_anew=True)

    def _transact(self, entries: Sequence[tuple[Keyframe, Estimate]], *, start_anew: bool) -> None:
        frame = -1
        try:
            self._db.execute("BEGIN IMMEDIATE")
            try:
                if start_anew:
                    for table in KEYFRAME_TABLES:
                        self._db.execute(f"DELETE FROM {table}")
                for keyframe, estimate in entries:
                    frame = keyframe.index
                    for table, values in rows_of(keyframe, estimate):
                        marks = ", ".join("?" * len(values))
                        self._db.execute(f"INSERT INTO {table} VALUES ({marks})", values)
            except BaseException:
                self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")
        except sqlite3.IntegrityError as error:
            raise InputError(
                "is in the log already", source=self._path,
                field=f"keyframe {frame}",
            ) from error  # fmt: skip
        except sqlite3.Error as error:
            raise InputError(
                f"cannot be written ({error})", source=self._path,
                remedy="what was logged before is kept; check disk space and permissions",
            ) from error  # fmt: skip

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

    def _query(self, sql: str) -> list[tuple[Any, ...]]:
        try:
            return self._db.execute(sql).fetchall()
        except sqlite3.Error as error:
            raise InputError(f"cannot be read ({error})", source=self._path) from error
