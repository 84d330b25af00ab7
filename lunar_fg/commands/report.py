"""The report of one or more runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunar_fg.commands.shared import out
from lunar_fg.run_folder import RunFolder


def report(
    run_folders: Annotated[
        list[Path], typer.Argument(help="Folders that `lunar-fg run` wrote; several are compared.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Page to write; report.html of the first run."),
    ] = None,
) -> None:
    """Write one HTML page on a run, or on several side by side. It needs no network.

    Example: lunar-fg report runs/first

    Example: lunar-fg report runs/first runs/second -o comparison.html
    """
    # plotly takes a second to import: no other command should wait for it.
    from lunar_fg.report import write_report

    page = run_folders[0] / "report.html" if output is None else output
    write_report([RunFolder.open(path) for path in run_folders], page)
    out.print(f"report in {page}", markup=False)
