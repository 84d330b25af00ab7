"""Smooth a run's measurements anew."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from frontends.errors import InputError
from lunar_fg import runs
from lunar_fg.commands.shared import Overwrite, out
from lunar_fg.config import read_config
from lunar_fg.console import run_summary
from lunar_fg.replay import replay as replay_run
from lunar_fg.run_folder import RunFolder


def replay(
    run_folder: Annotated[Path, typer.Argument(help="Folder that `lunar-fg run` wrote.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Run folder to write.")],
    config: Annotated[Path | None, typer.Option(help="YAML with settings that differ.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Smooth a run's measurements anew with other settings; needs no images.

    Settings of the graph and of the wheels take effect, those of the images do not. Without
    --config the run's own settings are used.

    Example: lunar-fg replay runs/first --config full.yaml -o runs/full
    """
    source = RunFolder.open(run_folder)
    if output.resolve() == run_folder.resolve():
        raise InputError("is the run itself", source=output, remedy="name another folder")
    settings = runs.settings_of(source) if config is None else read_config(config)
    target = RunFolder.create(output, settings, overwrite=overwrite)
    metrics = replay_run(source, target, settings)
    out.print(run_summary(run_folder.name, metrics, output), markup=False)
