"""Nothing is read whole before its size is known."""

from __future__ import annotations

from pathlib import Path

from frontends.errors import InputError

#: Of a table.
MAX_BYTES = 200_000_000


def check_size(path: Path) -> None:
    """Raise InputError for a file that is larger than what is read of any table."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", source=path) from error
    if size > MAX_BYTES:
        raise InputError(
            f"has {size} bytes, more than {MAX_BYTES}", source=path, remedy="split the run"
        )
