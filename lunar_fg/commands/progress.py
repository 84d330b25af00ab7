"""What commands that take their time share: the run's text log and a progress bar."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from frontends.measurements import Estimate
from lunar_fg.commands.shared import err
from lunar_fg.run_folder import RunFolder


@contextmanager
def text_log(folder: RunFolder) -> Iterator[None]:
    """Write the program's messages into the run's ``run.log``, too."""
    handler = logging.FileHandler(folder.log_path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.getLogger("lunar_fg").addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger("lunar_fg").removeHandler(handler)
        handler.close()


def progress_bar() -> Progress:
    """Bar of any command: what, how much, how many, time left; gone when done."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=err, transient=True)


@contextmanager
def navigating(
    folder: RunFolder, name: str, frames: int, done: int = 0
) -> Iterator[Callable[[Estimate], None]]:
    """Write the text log and show a progress bar; the result takes each estimate."""
    with text_log(folder), progress_bar() as progress:
        task = progress.add_task(name, total=frames, completed=done)
        yield lambda _: progress.advance(task)
