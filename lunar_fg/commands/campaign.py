"""Run a study: many trials, one table."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from lunar_fg.commands.progress import progress_bar
from lunar_fg.commands.shared import out


def campaign(
    study: Annotated[Path, typer.Argument(help="STUDY.yaml: base, what varies, seeds.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the results.")],
    scheduler: Annotated[
        str | None, typer.Option(help="Dask scheduler, tcp://host:port, instead of processes here.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes here; one a core by default.")
    ] = None,
) -> None:
    """Run many traverses over seeds, settings and faults; go on where it was interrupted.

    Example: lunar-fg campaign study.yaml -o campaigns/first
    """
    # plotly and pyarrow take seconds to import: no other command should wait for them.
    from lunar_fg.campaign.campaign import run_campaign
    from lunar_fg.campaign.results import Results
    from lunar_fg.campaign.study import read_study
    from lunar_fg.campaign.workers import DaskCluster, LocalProcesses, Workers

    read = read_study(study)
    total = len(read.trials())
    results = Results.open(output, read)
    pool: Workers = (
        LocalProcesses(workers or os.cpu_count() or 1)
        if scheduler is None
        else DaskCluster(scheduler)
    )
    with progress_bar() as progress:
        task = progress.add_task(read.name, total=total)
        outcomes = run_campaign(read, results, pool, lambda _: progress.advance(task))
    failures = sum(bool(outcome.error) for outcome in outcomes)
    out.print(
        f"{read.name}: {len(outcomes)} runs, {failures} failed; "
        f"{results.table_path}, {results.page_path}",
        markup=False,
    )
