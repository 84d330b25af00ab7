"""What the traverse log holds of the places that may be recognised again."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

from frontends.errors import InputError
from frontends.revisit import Place
from lunar_fg.log_rows import RowReader, pack

PLACE_TABLE = """
CREATE TABLE place (frame INTEGER PRIMARY KEY, landmark_id BLOB NOT NULL, uvd BLOB NOT NULL,
    sigma_px BLOB NOT NULL, size_px BLOB NOT NULL, laplacian BLOB NOT NULL,
    descriptors BLOB NOT NULL);
"""
PLACE_QUERY = "SELECT * FROM place ORDER BY frame"

_ARRAYS = tuple(field.name for field in fields(Place) if field.name != "frame")


def row_of_place(place: Place) -> tuple[str, tuple[object, ...]]:
    """Table and row of a place."""
    return "place", (place.frame, *(pack(getattr(place, name)) for name in _ARRAYS))


def place_of(row: tuple[Any, ...], reader: RowReader, path: Path) -> Place:
    """Build a place from its row.

    Raises
    ------
    InputError
        The row is damaged.
    """
    frame, *blobs = row
    where = f"place {frame}"
    arrays = [reader.array(blob, where) for blob in blobs]
    count = len(arrays[0])
    shapes = [(count,), (count, 3), (count, 2), (count,), (count,)]
    if [array.shape for array in arrays[:-1]] != shapes or arrays[-1].shape[:1] != (count,):
        raise InputError("holds arrays that do not fit each other", source=path, field=where)
    return Place(frame, *arrays)
