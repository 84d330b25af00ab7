"""What the commands share: consoles, options, and how errors end them."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Annotated, ParamSpec, TypeVar

import typer
from rich.console import Console

from frontends.errors import LunarFgError

P = ParamSpec("P")
R = TypeVar("R")

#: Exit code for input that cannot be used, and for an estimate that cannot be made.
BAD_INPUT = 2

out = Console(highlight=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, soft_wrap=True)

Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an earlier run there.")]


def guarded(command: Callable[P, R]) -> Callable[P, R]:
    """Turn the project's own errors into one line and exit code 2."""

    @wraps(command)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return command(*args, **kwargs)
        except LunarFgError as error:
            err.print(f"error: {error}", style="red", markup=False)
            raise typer.Exit(BAD_INPUT) from error

    return call
