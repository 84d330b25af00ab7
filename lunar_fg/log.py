"""The traverse log: every measurement and estimate of a run in one SQLite file.

Arrays are stored as NumPy's own ``.npy`` bytes without pickle: little-endian, with dtype and
shape, so what is read back is what was written, bit for bit.
"""

from __future__ import annotations

import io
import json
import sqlite3
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from frontends.camera import StereoCamera
from frontends.errors import InputError
from frontends.measurements import (
    Estimate,
    FloatArray,
    Odometry,
    RelativePose,
    StartPrior,
    StereoObservations,
    Tilt,
    Verdict,
)
from lunar_fg.graph.keyframe import Keyframe

SCHEMA_VERSION = 1

_TABLES = """
CREATE TABLE run (only INTEGER PRIMARY KEY CHECK (only = 1), camera TEXT NOT NULL,
    rover_T_camera BLOB NOT NULL, start TEXT NOT NULL, start_pose BLOB NOT NULL,
    config TEXT NOT NULL);
CREATE TABLE keyframe (frame INTEGER PRIMARY KEY, stamp_s REAL NOT NULL,
    tilt_roll_rad REAL, tilt_pitch_rad REAL, tilt_sigma_rad REAL,
    odometry_pose BLOB, odometry_covariance BLOB);
CREATE TABLE observations (frame INTEGER PRIMARY KEY REFERENCES keyframe,
    landmark_id BLOB NOT NULL, u_left BLOB NOT NULL, u_right BLOB NOT NULL, v BLOB NOT NULL,
    sigma_px BLOB NOT NULL, sigma_disparity_px BLOB NOT NULL, points_cam BLOB NOT NULL,
    points_covariance BLOB NOT NULL);
CREATE TABLE relative (frame INTEGER PRIMARY KEY REFERENCES keyframe,
    pose BLOB NOT NULL, covariance BLOB NOT NULL, inlier_ids BLOB NOT NULL,
    correspondences INTEGER NOT NULL, verdict TEXT NOT NULL, reason TEXT NOT NULL);
CREATE TABLE estimate (frame INTEGER PRIMARY KEY REFERENCES keyframe,
    pose BLOB NOT NULL, covariance BLOB NOT NULL, lost INTEGER NOT NULL, used TEXT NOT NULL,
    refused TEXT NOT NULL);
"""


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
            log._db.executescript(f"BEGIN;{_TABLES}PRAGMA user_version={SCHEMA_VERSION};COMMIT;")
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
                _pack(header.rover_T_camera),
                json.dumps(sigmas),
                _pack(start.map_T_rover),
                header.config_json,
            ),
        )

    def header(self) -> RunHeader:
        """Read what holds for the whole run."""
        row = self._query("SELECT * FROM run")[0]
        _, camera, rover_T_camera, start, start_pose, config = row
        sigmas = json.loads(start)
        start_pose = self._unpack(start_pose, "run")
        prior = StartPrior(start_pose, tuple(sigmas["rot_rad"]), tuple(sigmas["trans_m"]))
        rover_T_camera = self._unpack(rover_T_camera, "run")
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
        try:
            self._db.execute("BEGIN IMMEDIATE")
            try:
                if start_anew:
                    for table in ("estimate", "relative", "observations", "keyframe"):
                        self._db.execute(f"DELETE FROM {table}")
                for keyframe, estimate in entries:
                    self._insert(keyframe, estimate)
            except BaseException:
                self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")
        except sqlite3.IntegrityError as error:
            raise InputError(
                "is in the log already", source=self._path,
                field=f"keyframe {entries[-1][0].index}",
            ) from error  # fmt: skip
        except sqlite3.Error as error:
            raise InputError(
                f"cannot be written ({error})", source=self._path,
                remedy="what was logged before is kept; check disk space and permissions",
            ) from error  # fmt: skip

    def _insert(self, keyframe: Keyframe, estimate: Estimate) -> None:
        frame, tilt, odometry = keyframe.index, keyframe.tilt, keyframe.odometry
        self._row(
            "keyframe", frame, keyframe.stamp_s,
            *((tilt.roll_rad, tilt.pitch_rad, tilt.sigma_rad) if tilt else (None,) * 3),
            *((_pack(odometry.a_T_b), _pack(odometry.covariance)) if odometry else (None,) * 2),
        )  # fmt: skip
        observations, relative = keyframe.observations, keyframe.relative
        if observations is not None:
            arrays = (getattr(observations, field.name) for field in fields(observations))
            self._row("observations", frame, *(_pack(array) for array in arrays))
        if relative is not None:
            self._row(
                "relative", frame, _pack(relative.a_T_b), _pack(relative.covariance),
                _pack(relative.inlier_ids), relative.correspondences, relative.verdict.value,
                relative.reason,
            )  # fmt: skip
        self._row(
            "estimate", frame, _pack(estimate.map_T_rover), _pack(estimate.covariance),
            int(estimate.lost), json.dumps(estimate.used), json.dumps(estimate.refused),
        )  # fmt: skip

    def _row(self, table: str, *values: object) -> None:
        marks = ", ".join("?" * len(values))
        self._db.execute(f"INSERT INTO {table} VALUES ({marks})", values)

    def keyframes(self) -> list[Keyframe]:
        """Read all measurements in frame order."""
        observations = {row[0]: row[1:] for row in self._query("SELECT * FROM observations")}
        relatives = {row[0]: row[1:] for row in self._query("SELECT * FROM relative")}
        result = []
        for frame, stamp_s, roll, pitch, sigma, pose, covariance in self._query(
            "SELECT * FROM keyframe ORDER BY frame"
        ):
            where = f"keyframe {frame}"
            seen, moved = observations.get(frame), relatives.get(frame)
            result.append(
                Keyframe(
                    frame,
                    stamp_s,
                    self._observations(seen, where) if seen else None,
                    self._relative(moved, where) if moved else None,
                    pose and Odometry(self._unpack(pose, where), self._unpack(covariance, where)),
                    None if sigma is None else Tilt(roll, pitch, sigma),
                )
            )
        return result

    def _observations(self, row: tuple[Any, ...], where: str) -> StereoObservations:
        return StereoObservations(*(self._unpack(blob, where) for blob in row))

    def _relative(self, row: tuple[Any, ...], where: str) -> RelativePose:
        pose, covariance, inliers, correspondences, verdict, reason = row
        a_T_b, matrix, ids = (self._unpack(blob, where) for blob in (pose, covariance, inliers))
        return RelativePose(a_T_b, matrix, ids, correspondences, Verdict(verdict), reason)

    def estimates(self) -> list[Estimate]:
        """Read the estimates as they stood when each keyframe came in."""
        query = (
            "SELECT frame, stamp_s, pose, covariance, lost, used, refused"
            " FROM keyframe JOIN estimate USING (frame) ORDER BY frame"
        )
        return [
            Estimate(
                frame,
                stamp_s,
                self._unpack(pose, f"keyframe {frame}"),
                self._unpack(covariance, f"keyframe {frame}"),
                bool(lost),
                tuple(json.loads(used)),
                tuple(json.loads(refused)),
            )
            for frame, stamp_s, pose, covariance, lost, used, refused in self._query(query)
        ]

    def _query(self, sql: str) -> list[tuple[Any, ...]]:
        try:
            return self._db.execute(sql).fetchall()
        except sqlite3.Error as error:
            raise InputError(f"cannot be read ({error})", source=self._path) from error

    def _unpack(self, blob: bytes, where: str) -> Any:
        try:
            return np.load(io.BytesIO(blob), allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise InputError(
                f"holds a damaged array ({error})", source=self._path, field=where
            ) from error


def _pack(array: Any) -> bytes:
    array = np.asarray(array)
    buffer = io.BytesIO()
    np.save(buffer, array.astype(array.dtype.newbyteorder("<")), allow_pickle=False)
    return buffer.getvalue()
