"""Linear algebra on one thread: our matrices are small.

A second thread of BLAS gains nothing on them, and after each product it spins for tens of
milliseconds on a core that others could use.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from threadpoolctl import ThreadpoolController


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Within this block BLAS has one thread; afterwards as many as before."""
    with _controller().limit(limits=1, user_api="blas"):
        yield


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()
