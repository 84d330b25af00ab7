"""The one exception family of the project.

Every error that a user can cause is an `InputError`: its text names the source (file or
argument), the field, what is wrong and the remedy, on one line.
"""

from __future__ import annotations

from pathlib import Path


class LunarFgError(Exception):
    """Base of every error that lunar-fg raises on purpose."""


class InputError(LunarFgError, ValueError):
    """Something the caller gave cannot be used.

    Parameters
    ----------
    problem
        What is wrong, in plain words.
    source
        File or argument that holds the bad value.
    field
        Field, column, key or line inside `source`.
    remedy
        What the caller can do about it.
    """

    def __init__(
        self,
        problem: str,
        *,
        source: str | Path | None = None,
        field: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.problem = problem
        self.source = None if source is None else str(source)
        self.field = field
        self.remedy = remedy
        where = ": ".join(part for part in (self.source, field) if part)
        text = f"{where}: {problem}" if where else problem
        super().__init__(f"{text} ({remedy})" if remedy else text)


class DependencyError(LunarFgError, ImportError):
    """The installed gtsam, numpy and OpenCV do not fit together."""


class EstimationError(LunarFgError, RuntimeError):
    """The estimator could not use what it was given; what it had is kept."""
