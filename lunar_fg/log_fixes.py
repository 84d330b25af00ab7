"""What the traverse log holds of map measurements: each with every verdict ever given on it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from typing import Any

from frontends.errors import InputError
from frontends.measurements import AbsoluteFix, FixCandidate, Verdict
from lunar_fg.graph.ledger import (
    FixDecision,
    Height,
    LedgerEntry,
    LoopClosure,
    MapMeasurement,
    Ruling,
)
from lunar_fg.log_rows import RowReader, pack

FIX_TABLES = """
CREATE TABLE map_measurement (number INTEGER PRIMARY KEY, kind TEXT NOT NULL,
    frame INTEGER NOT NULL, base INTEGER, pose BLOB, covariance BLOB, height_m REAL,
    sigma_height_m REAL, second_best_ratio REAL, window TEXT, reason TEXT,
    UNIQUE (kind, frame, base));
CREATE TABLE fix_candidate (measurement INTEGER NOT NULL REFERENCES map_measurement,
    number INTEGER NOT NULL, x_m REAL NOT NULL, y_m REAL NOT NULL, yaw_rad REAL NOT NULL,
    covariance BLOB NOT NULL, score REAL NOT NULL, proposer TEXT NOT NULL,
    inliers INTEGER NOT NULL, PRIMARY KEY (measurement, number));
CREATE TABLE ruling (number INTEGER PRIMARY KEY,
    measurement INTEGER NOT NULL REFERENCES map_measurement, at_frame INTEGER NOT NULL,
    verdict TEXT NOT NULL, candidate INTEGER, mahalanobis REAL, reason TEXT NOT NULL,
    by_person INTEGER NOT NULL);
"""
#: Each after the ones that refer to it.
FIX_TABLE_NAMES = ("ruling", "fix_candidate", "map_measurement")
FIX_QUERIES = (
    "SELECT * FROM map_measurement ORDER BY number",
    "SELECT * FROM fix_candidate ORDER BY measurement, number",
    "SELECT * FROM ruling ORDER BY number",
)

Row = tuple[str, tuple[object, ...]]


def rows_of_decision(decision: FixDecision) -> Iterator[Row]:
    """Tables and rows of what is new with a decision: its measurement, and all new rulings."""
    if len(decision.entry.history) == 1:
        yield from _rows_of_measurement(decision.entry)
    for entry in (decision.entry, *decision.changes):
        yield _row_of_ruling(entry.number, entry.ruling)


def rows_of_ledger(ledger: Iterable[LedgerEntry]) -> Iterator[Row]:
    """Tables and rows of whole entries."""
    for entry in ledger:
        yield from _rows_of_measurement(entry)
        for ruling in entry.history:
            yield _row_of_ruling(entry.number, ruling)


def _rows_of_measurement(entry: LedgerEntry) -> Iterator[Row]:
    measurement, number = entry.measurement, entry.number
    if isinstance(measurement, LoopClosure):
        yield "map_measurement", (
            number, "closure", measurement.frame, measurement.base,
            pack(measurement.a_T_b), pack(measurement.covariance), *(None,) * 5,
        )  # fmt: skip
        return
    if isinstance(measurement, Height):
        yield "map_measurement", (
            number, "height", measurement.frame, None, None, None,
            float(measurement.z_m), float(measurement.sigma_m), *(None,) * 3,
        )  # fmt: skip
        return
    fix = measurement
    yield "map_measurement", (
        number, "fix", fix.frame, None, None, None, _real(fix.height_m),
        _real(fix.sigma_height_m), float(fix.second_best_ratio),
        None if fix.window_m is None else json.dumps([float(v) for v in fix.window_m]), fix.reason,
    )  # fmt: skip
    for i, place in enumerate(fix.candidates):
        yield "fix_candidate", (
            number, i, float(place.x_m), float(place.y_m), float(place.yaw_rad),
            pack(place.covariance), float(place.score), place.proposer, int(place.inliers),
        )  # fmt: skip


def _row_of_ruling(measurement: int, ruling: Ruling) -> Row:
    # SQLite keeps NaN as NULL.
    return "ruling", (
        ruling.number, measurement, ruling.at_frame, ruling.verdict.value, ruling.candidate,
        float(ruling.mahalanobis), ruling.reason, int(ruling.by_person),
    )  # fmt: skip


def _real(value: float | None) -> float | None:
    return None if value is None else float(value)


def ledger_of(
    measurements: list[tuple[Any, ...]],
    candidates: list[tuple[Any, ...]],
    rulings: list[tuple[Any, ...]],
    reader: RowReader,
    source: str,
) -> list[LedgerEntry]:
    """Build the ledger from the rows that `FIX_QUERIES` give.

    Raises
    ------
    InputError
        A row is damaged, or a measurement has no ruling.
    """
    places: dict[int, list[FixCandidate]] = {}
    for number, _, x, y, yaw, covariance, score, proposer, inliers in candidates:
        matrix = reader.array(covariance, f"fix {number}")
        place = FixCandidate(x, y, yaw, matrix, score, proposer, inliers)
        places.setdefault(number, []).append(place)
    history: dict[int, list[Ruling]] = {}
    for number, measurement, at_frame, verdict, candidate, distance, reason, by_person in rulings:
        sigmas = float("nan") if distance is None else distance
        history.setdefault(measurement, []).append(
            Ruling(at_frame, Verdict(verdict), candidate, sigmas, reason, number, bool(by_person))
        )
    ledger = []
    for row in measurements:
        number = row[0]
        if number not in history:
            raise InputError("has no ruling", source=source, field=f"map measurement {number}")
        what = _measurement(row, tuple(places.get(number, ())), reader)
        ledger.append(LedgerEntry(number, what, tuple(history[number])))
    return ledger


def _measurement(
    row: tuple[Any, ...], places: tuple[FixCandidate, ...], reader: RowReader
) -> MapMeasurement:
    number, kind, frame, base, pose, covariance, height, sigma, ratio, window, reason = row
    where = f"map measurement {number}"
    if kind == "closure":
        a_T_b, matrix = reader.array(pose, where), reader.array(covariance, where)
        return LoopClosure(base, frame, a_T_b, matrix)
    if kind == "height":
        return Height(frame, height, sigma)
    searched = None
    if window is not None:
        x_from, y_from, x_to, y_to = json.loads(window)
        searched = (x_from, y_from, x_to, y_to)
    return AbsoluteFix(frame, places, ratio, height, sigma, searched, reason)
