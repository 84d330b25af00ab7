"""Typed access to numba, so that the rest of the package needs no type ignores.

Every kernel is serial, releases the GIL (one Python thread an image) and is
cached on disk (a second process loads machine code instead of compiling).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

logger = logging.getLogger("lunar_fg.surf")

# No NaN or infinity enters a kernel (images are integers, keypoints are checked), so the
# compiler may reorder sums to use SIMD; "arcp"/"afn" stay off: they would cost accuracy.
_FASTMATH = {"nnan", "ninf", "nsz", "reassoc", "contract"}


def njit(function: F) -> F:
    """Compile `function` on first use: nogil, serial, cached on disk where possible.

    Parameters
    ----------
    function : callable
        Plain Python function within numba's subset.

    Returns
    -------
    callable
        Its numba dispatcher.
    """
    options: dict[str, Any] = {"nogil": True, "fastmath": _FASTMATH, "error_model": "numpy"}
    try:
        return cast(F, numba.njit(function, cache=True, **options))
    except RuntimeError:  # nowhere to write a cache: still correct, compiles in every process
        return cast(F, numba.njit(function, **options))


def load_kernels(kernels: Iterable[tuple[Callable[..., Any], str]]) -> float:
    """Load each kernel from the disk cache, or compile it and say so once.

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
    announced = False
    for kernel, signature in kernels:
        dispatcher = cast(Any, kernel)
        dispatcher.compile(signature)
        if dispatcher.stats.cache_misses and not announced:
            announced = True
            logger.warning("compiling the SURF kernels, once on this machine (about 10 s)")
    return time.perf_counter() - start
