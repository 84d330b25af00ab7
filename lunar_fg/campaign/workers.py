"""Who runs the trials: processes of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import importlib
import multiprocessing
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, Protocol

from frontends.errors import DependencyError, InputError
from lunar_fg.campaign.study import Trial
from lunar_fg.campaign.trial import Outcome, failed, run_trial

Run = Callable[[Trial], Outcome]

#: A trial that takes its worker down so often is given up.
MOST_DEATHS = 2
_CONNECT_S = 10.0


class Workers(Protocol):
    """Runs trials, in any order."""

    def outcomes(self, trials: Sequence[Trial], run: Run = run_trial) -> Iterator[Outcome]:
        """Yield each trial's outcome as soon as it is there."""
        ...


@dataclass(frozen=True, slots=True)
class LocalProcesses:
    """Fresh processes of this machine; one that dies costs its own trial one try.

    Attributes
    ----------
    count
        How many at once.
    """

    count: int

    def outcomes(self, trials: Sequence[Trial], run: Run = run_trial) -> Iterator[Outcome]:
        """Yield each trial's outcome as soon as it is there."""
        deaths: Counter[int] = Counter()
        left = {trial.number: trial for trial in trials}
        together = self.count
        while left:
            try:
                for outcome in self._pass(list(left.values()), run, together, deaths):
                    del left[outcome.number]
                    yield outcome
            except BrokenProcessPool:
                # Nobody knows which of the running trials it was: from here they run one at a
                # time until the culprit has shown itself.
                together = 1
                worn = [number for number in left if deaths[number] >= MOST_DEATHS]
                for number in worn:
                    yield failed(left.pop(number), f"its worker died {MOST_DEATHS} times")
                    together = self.count

    def _pass(
        self, trials: list[Trial], run: Run, together: int, deaths: Counter[int]
    ) -> Iterator[Outcome]:
        """Run until all are done or a worker dies; count a death for those that were running."""
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(together, mp_context=context) as pool:
            waiting = iter(trials)
            running: dict[Future[Outcome], Trial] = {}
            while True:
                for trial in waiting:
                    running[pool.submit(run, trial)] = trial
                    if len(running) >= together:
                        break
                if not running:
                    return
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    try:
                        outcome = future.result()
                    except BrokenProcessPool:
                        deaths.update(trial.number for trial in running.values())
                        raise
                    del running[future]
                    yield outcome


class DaskCluster:
    """The workers of a running Dask cluster; a lost worker's trials are run again.

    Parameters
    ----------
    address
        Of its scheduler, ``tcp://host:port``. Connect to your own clusters only: Dask's
        protocol runs code.

    Raises
    ------
    DependencyError
        The extra ``cluster`` is not installed.
    InputError
        Nobody answers there.
    """

    def __init__(self, address: str) -> None:
        try:
            distributed: Any = importlib.import_module("distributed")
        except ImportError as error:
            raise DependencyError(
                'distributed is not installed; pip install "lunar-fg[cluster]"'
            ) from error
        self._as_completed = distributed.as_completed
        try:
            self._client = distributed.Client(address, timeout=_CONNECT_S)
        except (OSError, ValueError) as error:
            raise InputError(
                f"no scheduler answers ({error})", source="--scheduler", field=address,
                remedy="start one with `dask scheduler`, workers with `dask worker ADDRESS`",
            ) from error  # fmt: skip

    def outcomes(self, trials: Sequence[Trial], run: Run = run_trial) -> Iterator[Outcome]:
        """Yield each trial's outcome as soon as it is there."""
        futures = {
            self._client.submit(run, trial, pure=False, retries=MOST_DEATHS): trial
            for trial in trials
        }
        for future in self._as_completed(list(futures)):
            trial = futures.pop(future)
            error = future.exception()
            yield future.result() if error is None else failed(trial, f"its worker died: {error}")
            future.release()
        self._client.close()
