"""One SQLite file that a single process writes: opened with checks, written all or nothing."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from frontends.errors import InputError
from lunar_fg.folder_lock import FolderLock


class LogFile:
    """An open file; make it with `create`, `open` or `reopen`.

    Parameters
    ----------
    path
        The file.
    connection
        Its open database.
    lock
        Held by the one that writes it.
    """

    def __init__(
        self, path: Path, connection: sqlite3.Connection, lock: FolderLock | None = None
    ) -> None:
        self.path = path
        self.connection = connection
        self._lock = lock
        self._within = False

    @classmethod
    def create(cls, path: Path, tables: str, version: int) -> Self:
        """Start a new file with these tables (SQL).

        Raises
        ------
        InputError
            The file exists already, or cannot be written.
        """
        if path.exists():
            raise InputError("exists already", source=path, remedy="choose another run folder")
        file = None
        lock = FolderLock(path.parent)
        try:
            file = cls(path, sqlite3.connect(path, isolation_level=None), lock)
            file._journal()
            file.connection.executescript(f"BEGIN;{tables}PRAGMA user_version={version};COMMIT;")
        except sqlite3.Error as error:
            if file is not None:
                file.close()
            lock.release()
            raise InputError(f"cannot be written ({error})", source=path) from error
        return file

    @classmethod
    def open(cls, path: Path, version: int) -> Self:
        """Open an existing file for reading; another process may be writing it.

        Raises
        ------
        InputError
            The file is missing, damaged, no log, or of another version.
        """
        _require(path)
        # Without a writer's journal the file is at rest: read it without making one.
        alone = "" if path.with_name(f"{path.name}-wal").exists() else "&immutable=1"
        return cls._checked(path, f"{path.resolve().as_uri()}?mode=ro{alone}", version)

    @classmethod
    def reopen(cls, path: Path, version: int) -> Self:
        """Open an existing file to go on writing it.

        Raises
        ------
        InputError
            As for `open`; also when another process is writing it, or it may not be written.
        """
        _require(path)
        lock = FolderLock(path.parent)
        try:
            file = cls._checked(path, f"{path.resolve().as_uri()}?mode=rw", version)
        except BaseException:
            lock.release()
            raise
        file._lock = lock
        try:
            file._journal()
        except sqlite3.Error as error:
            file.close()
            raise InputError(f"cannot be written ({error})", source=path) from error
        return file

    def _journal(self) -> None:
        self.connection.execute("PRAGMA journal_mode=WAL")
        self.connection.execute("PRAGMA synchronous=NORMAL")

    @classmethod
    def _checked(cls, path: Path, uri: str, version: int) -> Self:
        """Connect and check; see `open` for what is raised."""
        file = cls(path, sqlite3.connect(uri, uri=True, isolation_level=None))
        try:
            (state,) = file.connection.execute("PRAGMA integrity_check(1)").fetchone()
            (found,) = file.connection.execute("PRAGMA user_version").fetchone()
        except sqlite3.DatabaseError as error:
            file.close()
            raise InputError(f"is not a readable log ({error})", source=path) from error
        if state != "ok":
            file.close()
            raise InputError(f"is damaged ({state})", source=path)
        if found != version:
            file.close()
            raise InputError(
                f"has schema version {found}, this program reads {version}",
                source=path,
                remedy="use the lunar-fg that wrote it",
            )
        return file

    def close(self) -> None:
        """Close the file; it is then one file without journals."""
        self.connection.close()
        if self._lock is not None:
            self._lock.release()

    @contextmanager
    def together(self) -> Iterator[None]:
        """Make all that is written within one entry, all or nothing.

        Raises
        ------
        InputError
            The file cannot be written.
        """
        with self.transaction():
            self._within = True
            try:
                yield
            finally:
                self._within = False

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Make what is written within all or nothing.

        Raises
        ------
        InputError
            The file cannot be written.
        """
        if self._within:
            yield
            return
        try:
            self.connection.execute("BEGIN IMMEDIATE")
            try:
                yield
                self.connection.execute("COMMIT")
            except BaseException:
                if self.connection.in_transaction:
                    self.connection.execute("ROLLBACK")
                raise
        except sqlite3.Error as error:
            raise InputError(
                f"cannot be written ({error})", source=self.path,
                remedy="what was logged before is kept; check disk space and permissions",
            ) from error  # fmt: skip

    def insert(self, frame: int, rows: Iterable[tuple[str, tuple[object, ...]]]) -> None:
        """Insert rows, each with the name of its table.

        Raises
        ------
        InputError
            One is there already; `frame` is what they are about.
        """
        for table, values in rows:
            marks = ", ".join("?" * len(values))
            try:
                # names of tables are constants of the program, values are bound
                self.connection.execute(f"INSERT INTO {table} VALUES ({marks})", values)  # noqa: S608
            except sqlite3.IntegrityError as error:
                raise InputError(
                    "is in the log already", source=self.path, field=f"keyframe {frame}"
                ) from error

    def clear(self, tables: Iterable[str]) -> None:
        """Delete all rows of these tables."""
        for table in tables:
            self.connection.execute(f"DELETE FROM {table}")  # noqa: S608  # see insert

    def query(self, sql: str) -> list[tuple[Any, ...]]:
        """Fetch all rows.

        Raises
        ------
        InputError
            The file cannot be read.
        """
        try:
            return self.connection.execute(sql).fetchall()
        except sqlite3.Error as error:
            raise InputError(f"cannot be read ({error})", source=self.path) from error


def _require(path: Path) -> None:
    if not path.is_file():
        raise InputError("is missing", source=path, remedy="give the folder of a recorded run")
