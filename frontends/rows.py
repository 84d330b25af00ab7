"""Dataclasses whose fields are arrays of the same length."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    Table = TypeVar("Table", bound=DataclassInstance)


def replaced_rows(table: Table, rows: NDArray[np.int64], other: Table) -> Table:
    """Copy of a table with the rows of another, one after the other, in the place of some."""
    parts = {part.name: getattr(table, part.name).copy() for part in fields(table)}
    for name, mine in parts.items():
        mine[rows] = getattr(other, name)
    return type(table)(**parts)
