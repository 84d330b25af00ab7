"""What NumPy raises on reading a damaged array or archive of arrays."""

from __future__ import annotations

import zlib
from tokenize import TokenError
from zipfile import BadZipFile

#: A header may ask for any memory, any type and any compression, and need not be Python.
DAMAGED: tuple[type[Exception], ...] = (
    OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, MemoryError,
    OverflowError, NotImplementedError, RuntimeError, SyntaxError, TokenError, BadZipFile,
    zlib.error,
)  # fmt: skip
