"""Navigate through a dataset."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lunar_fg import runs
from lunar_fg.commands.shared import Overwrite, err, out
from lunar_fg.config import Config, read_config
from lunar_fg.console import run_summary
from lunar_fg.datasets import open_dataset
from lunar_fg.route_file import watch
from lunar_fg.run_folder import RunFolder
from lunar_fg.run_source import RunSource


def run(
    dataset: Annotated[Path, typer.Argument(help="Folder of the dataset (folder format, KITTI).")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Run folder to write.")],
    config: Annotated[Path | None, typer.Option(help="YAML with settings that differ.")] = None,
    traverse: Annotated[
        Path | None, typer.Option(help="traverse.yaml for a folder of images without one.")
    ] = None,
    images: Annotated[
        Path | None, typer.Option(help="Folder that frames.csv's paths are relative to.")
    ] = None,
    route: Annotated[
        Path | None, typer.Option(help="Planned route, GeoJSON, to watch the drive against.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all random choices.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Navigate through a stereo sequence.

    Example: lunar-fg run my-traverse -o runs/first
    """
    settings = Config() if config is None else read_config(config)
    if seed is not None:
        settings = settings.model_copy(update={"seed": seed})
    opened = open_dataset(dataset, images, traverse)
    monitor = None if route is None else watch(route, opened, settings.route)
    folder = RunFolder.create(output, settings, overwrite=overwrite)
    RunSource.of(opened, images, traverse).write(folder)
    if route is not None:
        folder.route_path.write_bytes(route.read_bytes())
    handler = logging.FileHandler(folder.log_path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.getLogger("lunar_fg").addHandler(handler)
    try:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=err, transient=True) as progress:
            task = progress.add_task(opened.name, total=len(opened))
            metrics = runs.run(opened, folder, settings, lambda _: progress.advance(task), monitor)
    finally:
        logging.getLogger("lunar_fg").removeHandler(handler)
        handler.close()
    out.print(run_summary(opened.name, metrics, output), markup=False)
