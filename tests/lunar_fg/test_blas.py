"""BLAS on one thread while a frame is processed, and as before afterwards."""

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

from lunar_fg.blas import one_blas_thread


def blas_threads():
    return {lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"}


def test_one_thread_within_and_as_before_after():
    np.ones((2, 2)) @ np.ones((2, 2))
    with threadpool_limits(limits=2, user_api="blas"):
        before = blas_threads()
        with one_blas_thread():
            assert blas_threads() == {1}
        assert blas_threads() == before
