"""One writer a folder: an advisory lock that ends with its process, however that ends."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Self

from frontends.errors import InputError

if sys.platform != "win32":
    import fcntl


class FolderLock:
    """A folder taken for this process; without effect on Windows.

    Parameters
    ----------
    folder
        What is taken.

    Raises
    ------
    InputError
        Another process has it.
    """

    def __init__(self, folder: Path) -> None:
        self._descriptor: int | None = None
        if sys.platform == "win32":
            return
        try:
            self._descriptor = os.open(folder, os.O_RDONLY)
        except OSError:
            return  # whoever writes into it names the reason
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self.release()
            raise InputError(
                "is being written by another process",
                source=folder,
                remedy="wait until it ends, or end it",
            ) from error

    def release(self) -> None:
        """Let go of the folder; once is enough."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def __enter__(self) -> Self:
        """Return the lock."""
        return self

    def __exit__(self, *_: object) -> None:
        """Let go of the folder."""
        self.release()
