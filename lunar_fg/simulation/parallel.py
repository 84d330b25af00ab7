"""Work spread over processes that share the scene's memory."""

from __future__ import annotations

import multiprocessing
import os
import queue
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from frontends.errors import EstimationError

Job = TypeVar("Job")
Result = TypeVar("Result")

_POLL_S = 1.0


def in_processes(
    work: Callable[[Job], Result], jobs: Sequence[Job], workers: int | None = None
) -> Iterator[tuple[Job, Result]]:
    """Do `work` on each job; yield as they finish, in any order.

    Where processes can be forked (Linux), they inherit the scene without copying it;
    elsewhere `work` is pickled to each process once and rebuilds it.

    Parameters
    ----------
    work
        Called in the other processes.
    jobs
        Its arguments, dealt out in turn.
    workers
        Processes; default the cores. One works in this process.

    Raises
    ------
    EstimationError
        When a process dies, e.g. for want of memory. What `work` raises is raised here.
    """
    count = min(workers or os.cpu_count() or 1, len(jobs))
    if count <= 1:
        for job in jobs:
            yield job, work(job)
        return
    context: Any = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    results = context.Queue()
    processes = [
        context.Process(
            target=_work_through,
            args=(work, jobs, range(k, len(jobs), count), results),
            daemon=True,
        )
        for k in range(count)
    ]
    for process in processes:
        process.start()
    try:
        for _ in jobs:
            index, result, error = _next(results, processes)
            if error is not None:
                raise error
            yield jobs[index], result
    finally:
        for process in processes:
            process.terminate()
            process.join()


def _work_through(
    work: Callable[[Any], Any], jobs: Sequence[Any], mine: range, results: Any
) -> None:
    for index in mine:
        try:
            results.put((index, work(jobs[index]), None))
        except Exception as error:  # carried to the parent, which raises it
            results.put((index, None, error))
            return


def _next(results: Any, processes: Sequence[Any]) -> tuple[int, Any, Exception | None]:
    while True:
        try:
            return results.get(timeout=_POLL_S)  # type: ignore[no-any-return]
        except queue.Empty:
            failed = [p.exitcode for p in processes if p.exitcode not in (None, 0)]
            if failed:
                raise EstimationError(
                    f"a rendering process ended with code {failed[0]} (out of memory?)"
                ) from None
