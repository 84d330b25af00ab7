"""Dataclasses whose fields are arrays of the same length, or tables of that length themselves."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    Table = TypeVar("Table", bound=DataclassInstance)


def selected_rows(table: Table, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Table:
    """Rows of a table at a mask or an index array."""
    parts = {part.name: getattr(table, part.name) for part in fields(table)}
    return type(table)(
        **{
            name: part[rows] if isinstance(part, np.ndarray) else selected_rows(part, rows)
            for name, part in parts.items()
        }
    )


def joined_rows(table: Table, other: Table) -> Table:
    """Rows of a table and then those of another."""
    parts = {part.name: (getattr(table, part.name), getattr(other, part.name))
             for part in fields(table)}  # fmt: skip
    return type(table)(
        **{
            name: np.concatenate(pair) if isinstance(pair[0], np.ndarray) else joined_rows(*pair)
            for name, pair in parts.items()
        }
    )


def replaced_rows(table: Table, rows: NDArray[np.int64], other: Table) -> Table:
    """Copy of a table with the rows of another, one after the other, in the place of some."""
    parts = {part.name: getattr(table, part.name).copy() for part in fields(table)}
    for name, mine in parts.items():
        mine[rows] = getattr(other, name)
    return type(table)(**parts)
