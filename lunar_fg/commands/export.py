"""Write a run in the format of another program."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from frontends.errors import InputError
from lunar_fg.commands.shared import out
from lunar_fg.datasets.schema import nearest_known
from lunar_fg.export import EXPORTERS
from lunar_fg.run_folder import RunFolder


def export(
    run_folder: Annotated[Path, typer.Argument(help="Folder that `lunar-fg run` wrote.")],
    format_name: Annotated[
        str, typer.Option("--format", "-f", help=f"One of {', '.join(EXPORTERS)}.")
    ] = "",
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File; into the run folder by default.")
    ] = None,
    mcap: Annotated[
        bool, typer.Option("--mcap", help="Short for --format mcap: for Foxglove and ROS 2.")
    ] = False,
) -> None:
    """Write a run's trajectory or pose graph in the format of another program.

    Example: lunar-fg export runs/first --format g2o -o first.g2o
    """
    if mcap:
        format_name = "mcap" if format_name in ("", "mcap") else f"{format_name} --mcap"
    if format_name not in EXPORTERS:
        raise InputError(
            f"{format_name!r} is not a known format", source="--format",
            remedy=nearest_known(format_name, EXPORTERS),
        )  # fmt: skip
    folder = RunFolder.open(run_folder)
    ending, exporter = EXPORTERS[format_name]
    target = folder.path / f"export.{ending}" if output is None else output
    if not target.parent.is_dir():
        raise InputError("no such folder", source=target.parent)
    for path in exporter(folder, target):
        out.print(str(path), markup=False)
