"""Typed access to numba, so that the rest of the package needs no type ignores.

Every kernel is serial, releases the GIL (one Python thread an image) and is
cached on disk (a second process loads machine code instead of compiling).
"""

from __future__ import annotations

import contextlib
import functools
import logging
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

logger = logging.getLogger("lunar_fg.surf")

# No NaN or infinity enters a kernel (images are integers, keypoints are checked), so the
# compiler may reorder sums to use SIMD; "arcp"/"afn" stay off: they would cost accuracy.
_FASTMATH = {"nnan", "ninf", "nsz", "reassoc", "contract"}


_OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": _FASTMATH, "error_model": "numpy"}


def njit(function: F) -> F:
    """Compile a function that kernels call; it is cached as part of them only.

    Were it cached by itself, numba would go on using it after a change in what it calls. It is
    always inlined: where LLVM left a call, a process that has just compiled would run the
    function's own code, and one with a cache the copy in the kernel, which rounds differently.
    """
    return cast(F, numba.njit(function, forceinline=True, **_OPTIONS))


def kernel(function: F) -> F:
    """Compile an entry point: releases the GIL, serial, cached on disk where possible.

    Parameters
    ----------
    function : callable
        Plain Python function within numba's subset.

    Returns
    -------
    callable
        Its numba dispatcher.
    """
    try:
        return cast(F, numba.njit(function, cache=True, **_OPTIONS))
    except RuntimeError:  # nowhere to write a cache: still correct, compiles in every process
        return cast(F, numba.njit(function, **_OPTIONS))


def _drop_stale(function: Callable[..., Any], folder: str) -> None:
    """Delete cached code older than any source beside the kernel's.

    numba checks only the file of the kernel itself, not those of the functions inlined in it.
    """
    sources = Path(function.__code__.co_filename).parent.glob("*.py")
    newest = max(max(stat.st_mtime, stat.st_ctime) for stat in map(Path.stat, sources))
    stem = Path(function.__code__.co_filename).stem
    for index in Path(folder).glob(f"{stem}.{function.__name__}-*.nbi"):
        with contextlib.suppress(OSError):
            if index.stat().st_mtime < newest:
                index.unlink()


@functools.cache
def _announce() -> None:
    """Say once a process that it is compiling."""
    logger.warning("compiling the SURF kernels, once on this machine (10 to 20 s)")


def load_kernels(kernels: Iterable[tuple[Callable[..., Any], str]]) -> float:
    """Load each kernel from the disk cache, or compile it and say so once a process.

    Parameters
    ----------
    kernels : iterable of (dispatcher, str)
        Kernel and its numba signature; put a small one first: its cache miss tells
        that the large ones will have to be compiled too.

    Returns
    -------
    float
        Seconds spent (wall clock).
    """
    start = time.perf_counter()
    for kernel, signature in kernels:
        dispatcher = cast(Any, kernel)
        if not dispatcher.signatures and dispatcher.stats.cache_path:
            _drop_stale(dispatcher.py_func, dispatcher.stats.cache_path)
        dispatcher.compile(signature)
        if dispatcher.stats.cache_misses:
            _announce()
    return time.perf_counter() - start
