"""Go on with an interrupted run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from lunar_fg import runs, sittings
from lunar_fg.commands.progress import navigating
from lunar_fg.commands.shared import out
from lunar_fg.console import run_summary
from lunar_fg.datasets import open_dataset
from lunar_fg.datasets.base import Dataset
from lunar_fg.faults import FaultyDataset, parse_fault
from lunar_fg.route import RouteMonitor
from lunar_fg.route_file import watch
from lunar_fg.run_folder import RunFolder


def resume(
    run_folder: Annotated[Path, typer.Argument(help="Folder of the interrupted run.")],
    dataset: Annotated[
        Path | None, typer.Option(help="The run's dataset, where it lies elsewhere now.")
    ] = None,
) -> None:
    """Go on where a run was interrupted; it ends as it would have without that.

    Example: lunar-fg resume runs/first
    """
    folder = RunFolder.open(run_folder)
    sitting = sittings.last_sitting(folder)
    if dataset is not None:
        sitting = replace(sitting, dataset=str(dataset))
    calibration = [Path(path) for path in sitting.calibration]
    opened: Dataset = open_dataset(
        sitting.dataset, sitting.images, sitting.traverse, calibration, sitting.topics
    )
    if sitting.faults:
        faults = [parse_fault(text) for text in sitting.faults]
        opened = FaultyDataset(opened, faults, runs.settings_of(folder).seed, folder.path)
    route = route_of(folder, opened)
    with navigating(folder, opened.name, len(opened)) as advance:
        metrics = sittings.resume(opened, folder, advance, route)
    out.print(run_summary(opened.name, metrics, run_folder), markup=False)


def route_of(folder: RunFolder, dataset: Dataset) -> RouteMonitor | None:
    """Watch the planned route of the run, where it has one."""
    if not folder.route_path.is_file():
        return None
    return watch(folder.route_path, dataset, runs.settings_of(folder).route)
